"""Pictures of training and of episodes. Matplotlib only, drawn without a display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wlr_gym.base.plots import BLUE, COLOURS, GREY, new_figure, tidy
from wlr_gym.learning.evaluation.rollout import Rollout
from wlr_gym.robot import WHEELS

Array = NDArray[np.float64]

# Colours of curves.
ACTUAL = BLUE
COMMANDED = "black"
#: Terms of the reward that have a curve of their own.
TERMS = 4
#: Seconds between the heading arrows along a path.
ARROW_PERIOD = 2.0


def learning_curve(curve: Sequence[Mapping[str, float]], references: Mapping[str, float]) -> Figure:
    """Draw what training achieved per update.

    Args:
        curve: rows with ``steps``, ``reward_per_second``, ``slip_speed`` and ``term.*``.
        references: name -> reward per second of policies to compare with.
    """
    figure = new_figure(10.0, 4.0)
    left, right = figure.subplots(1, 2)
    steps = np.array([row["steps"] for row in curve]) / 1e6
    left.plot(steps, [row["reward_per_second"] for row in curve], color=ACTUAL, label="PPO, with its exploration")
    for (name, value), style in zip(references.items(), ("--", ":", "-.", (0, (1, 4))), strict=False):
        left.axhline(value, color="0.3", linestyle=style, linewidth=1.2, label=name)
    left.set(xlabel="environment steps (millions)", ylabel="reward per second", title="Reward while training")
    left.legend(fontsize=8)
    _draw_terms(right, steps, curve)
    for axes in (left, right):
        tidy(axes)
    return figure


def _draw_terms(axes: Axes, steps: Array, curve: Sequence[Mapping[str, float]]) -> None:
    """Draw the terms of the reward that ever count most, and the sum of the others."""
    values = {key.removeprefix("term."): np.array([row[key] for row in curve]) for key in curve[0] if key.startswith("term.")}
    ranked = sorted(values, key=lambda name: -float(np.abs(values[name]).max()))
    for name, colour in zip(ranked[:TERMS], COLOURS, strict=False):
        axes.plot(steps, values[name], color=colour, label=name)
    if others := ranked[TERMS:]:
        axes.plot(steps, np.sum([values[name] for name in others], axis=0), color=GREY, label=f"{len(others)} others")
    axes.set(xlabel="environment steps (millions)", ylabel="reward per second", title="What the reward is made of")
    axes.legend(fontsize=8)


def episode(rollout: Rollout, index: int, title: str) -> Figure:
    """Draw one episode: top view, commands against motion, and the slip of each wheel over time."""
    ticks = int(rollout.active[:, index].sum())
    time: Array = np.arange(1, ticks + 1) * np.float64(rollout.control_period)
    figure = new_figure(12.0, 7.5)
    figure.suptitle(title)
    grid = figure.add_gridspec(4, 2, width_ratios=(1.1, 1.0))
    _draw_path(figure.add_subplot(grid[:, 0]), rollout, index, ticks)
    velocity, yaw_rate, longitudinal, lateral = (figure.add_subplot(grid[k, 1]) for k in range(4))
    _draw_tracking(velocity, time, rollout.commanded("linear_velocity_x")[:, index], rollout.forward_velocity[:, index])
    _draw_tracking(yaw_rate, time, rollout.commanded("yaw_rate")[:, index], rollout.yaw_rate[:, index])
    velocity.set_ylabel("forward velocity\n(m/s)")
    yaw_rate.set_ylabel("yaw rate\n(rad/s)")
    velocity.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), fontsize=8, ncols=2, frameon=False)
    for axes, component, name in ((longitudinal, 0, "longitudinal\nslip (m/s)"), (lateral, 1, "lateral\nslip (m/s)")):
        for wheel, label in enumerate(WHEELS):
            slip = rollout.slip_velocity[:ticks, index, wheel, component]
            axes.plot(time, slip, color=COLOURS[wheel], label=label, linewidth=1)
        axes.set_ylabel(name)
    longitudinal.legend(loc="lower right", bbox_to_anchor=(1.0, 0.97), fontsize=8, ncols=4, frameon=False)
    for axes in (velocity, yaw_rate, longitudinal):
        axes.tick_params(labelbottom=False)
    for axes in (velocity, yaw_rate, longitudinal, lateral):
        tidy(axes)
        axes.set_xlim(0, time[-1])
    lateral.set_xlabel("time (s)")
    return figure


def _draw_tracking(axes: Axes, time: Array, commanded: Array, actual: Array) -> None:
    axes.plot(time, actual[: time.size], color=ACTUAL, label="actual", linewidth=1.2)
    axes.plot(time, commanded[: time.size], color=COMMANDED, linestyle="--", label="commanded", linewidth=1.2)


def _draw_path(axes: Axes, rollout: Rollout, index: int, ticks: int) -> None:
    position, yaw = rollout.position[:ticks, index], rollout.yaw[:ticks, index]
    wanted, wanted_yaw = commanded_path(rollout, index, ticks)
    every = max(1, round(ARROW_PERIOD / rollout.control_period))
    for path, heading, colour, style, label in (
        (wanted, wanted_yaw, COMMANDED, "--", "as commanded, from the same start"),
        (position, yaw, ACTUAL, "-", "actual"),
    ):
        axes.plot(*path.T, color=colour, linestyle=style, label=label)
        tips: dict[str, Any] = {"angles": "xy", "color": colour, "width": 0.005, "scale": 18, "zorder": 3}
        axes.quiver(*path[::every].T, np.cos(heading[::every]), np.sin(heading[::every]), **tips)
    axes.plot(*position[0], "o", color=BLUE, label="start", zorder=4)
    axes.set(xlabel="x (m)", ylabel="y (m)", title=f"Top view, heading every {ARROW_PERIOD:g} s")
    axes.set_aspect("equal", adjustable="datalim")
    tidy(axes)
    axes.legend(fontsize=8)


def commanded_path(rollout: Rollout, index: int, ticks: int) -> tuple[Array, Array]:
    """Return positions (T, 2) and headings (T,) of a robot that follows the commands exactly, from the same start."""
    period = rollout.control_period
    yaw = rollout.yaw[0, index] + np.concatenate([[0.0], np.cumsum(rollout.commanded("yaw_rate")[1:ticks, index]) * period])
    heading = np.stack([np.cos(yaw[:-1]), np.sin(yaw[:-1])], axis=1)
    steps = rollout.commanded("linear_velocity_x")[1:ticks, index, None] * heading * period
    return rollout.position[0, index] + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), yaw
