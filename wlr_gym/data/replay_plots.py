"""Overlay plots of a replay: measured, full run, segments."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wlr_gym.base.plots import BLUE, GREY, ORANGE, new_figure, save, tidy
from wlr_gym.data.format import COLUMNS
from wlr_gym.data.replay import ReplayResult
from wlr_gym.robot import LEGS, WHEELS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_JOINTS = [[f"{kind}_{joint}" for joint in joints] for joints in (LEGS, WHEELS) for kind in ("pos", "vel", "eff")]
_BODY = [
    ["gyro_x", "gyro_y", "gyro_z"],
    ["acc_x", "acc_y", "acc_z"],
    ["cam_x", "cam_y", "cam_yaw"],
    ["cam_z", "cam_pitch", "volt"],
]
_CALM = 6.0  # noise units; flat channels are not blown up beyond this


def save_plots(result: ReplayResult, folder: Path) -> list[Path]:
    """Write ``<run>_joints.png`` and ``<run>_body.png`` and return their paths."""
    return [
        save(
            _figure(result, grid, f"{result.run.name}: {name}, measured and replayed"), folder / f"{result.run.name}_{name}.png"
        )
        for name, grid in (("joints", _JOINTS), ("body", _BODY))
    ]


def _figure(result: ReplayResult, grid: list[list[str]], title: str) -> Figure:
    grid = [row for row in grid if any(name in result.errors for name in row)]
    figure = new_figure(5.2 * len(grid[0]), 2.1 * len(grid) + 0.9)
    panels = figure.subplots(len(grid), len(grid[0]), squeeze=False, sharex=True)
    for axes, name in zip(panels.flat, (name for row in grid for name in row), strict=True):
        if name in result.errors:
            _draw(axes, result, name)
        else:
            axes.set_axis_off()
    for axes in panels[-1]:
        axes.set_xlabel("time (s)")
    handles, labels = next(axes for axes in panels.flat if axes.has_data()).get_legend_handles_labels()
    figure.suptitle(title, fontsize=13)
    figure.legend(handles, labels, loc="outside upper right", ncols=3, frameon=False)
    return figure


def _draw(axes: Axes, result: ReplayResult, name: str) -> None:
    run, error = result.run, result.errors[name]
    t = run["t"]
    known = np.isfinite(run[name])
    style: dict[str, Any] = (
        {"marker": ".", "markersize": 2.5, "linestyle": ""} if COLUMNS[name].may_be_nan else {"linewidth": 2.2}
    )
    axes.plot(t[known], run[name][known], color=GREY, label="measured", **style)
    axes.plot(t, result.full[name], color=ORANGE, linewidth=0.9, label="full run")
    pieces = result.segments[name].copy()
    pieces[list(result.starts)] = np.nan  # lift the pen between segments
    axes.plot(t, pieces, color=BLUE, linewidth=0.9, label="segments")
    low, high = axes.get_ylim()
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    if half < _CALM * error.noise:
        axes.set_ylim(middle - _CALM * error.noise, middle + _CALM * error.noise)
    ratio = error.segment_rms / error.noise
    axes.set_title(f"{name}: segment error {error.segment_rms:.2g} {error.unit} = {ratio:.1f} x noise", fontsize=9)
    axes.set_ylabel(error.unit)
    tidy(axes)
    axes.margins(x=0.01)
