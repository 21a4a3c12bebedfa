"""Print the table of docs/slip_observer.md, and draw its figure: ``python observer_page.py [FIGURE.png]``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from observed_runs import PERIOD, Runs, channel, observe, play, simulate, slip_in_truth_order

from wlr_gym.base.plots import COLOURS, legend_below, new_figure, save, tidy
from wlr_gym.perception.observer import ESTIMATE_LAYOUT
from wlr_gym.physics.plants.base import TRUTH_LAYOUT

SEED = 5
START = 25  # ticks: robots of a simulation are dropped, which is not what is measured here
FLOORS = ("nominal", "wide", "split", "ice", "patches")
CASES = [("gibbs_appell", floor, drive, 64) for floor in FLOORS for drive in ("commands", "excitation")]
CASES += [("gibbs_appell", "slope", "climb", 64), ("gibbs_appell", "slippery", "commands", 64)]
CASES += [("gibbs_appell", "changing", "commands", 64)]
CASES += [("mujoco", floor, drive, 32) for floor in FLOORS for drive in ("commands", "excitation")]
CASES += [("mujoco", floor, "commands", 32) for floor in ("slippery", "changing")]
POLICIES = ("velocity_blind", "velocity_slip_aware")
PLAYED = [(policy, floor, 64) for policy in POLICIES for floor in ("slippery", "ice", "split")]


def measures(runs: Runs, camera: bool) -> list[str]:
    """v_x rms, median, 99 %; v_y rms; slip rms (mm/s), share inside 2 sigma (%), normalised error, NLL."""
    found = observe(runs, camera)
    velocity = (channel(ESTIMATE_LAYOUT, found, "linear_velocity_in_body") - runs.true("linear_velocity_in_body")[..., :2])[
        START:
    ]
    error = (channel(ESTIMATE_LAYOUT, found, "slip_velocity") - runs.true("slip_velocity"))[START:]
    sigma = channel(ESTIMATE_LAYOUT, found, "slip_sigma")[START:]
    ahead, normalised = np.abs(velocity[..., 0]), error / sigma
    millimetres = (
        1e3 * value for value in (rms(ahead), np.median(ahead), np.quantile(ahead, 0.99), rms(velocity[..., 1]), rms(error))
    )
    inside = 100 * (np.abs(normalised) < 2).mean()
    likelihood = (0.5 * normalised**2 + np.log(sigma)).mean()
    return [*(f"{value:.1f}" for value in millimetres), f"{inside:.0f}", f"{rms(normalised):.2f}", f"{likelihood:.2f}"]


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def row(runs: Runs, name: str) -> str:
    """One line of the table: without and with the camera."""
    return f"| {name} | {' | '.join([*measures(runs, camera=False), *measures(runs, camera=True)])} |"


def draw(path: str) -> None:
    """On split floors, the robot with the largest error without a camera: slip of both front wheels, estimates, 2 sigma."""
    runs = simulate("gibbs_appell", "split", "commands", 64, 10.0, seed=SEED)
    time = PERIOD * np.arange(len(runs.sensors))
    true = slip_in_truth_order(runs.true("slip_velocity"))[..., 0]
    estimates = {}
    for label, camera in (("without camera", False), ("with camera", True)):
        found = observe(runs, camera)
        estimates[label] = [
            slip_in_truth_order(channel(ESTIMATE_LAYOUT, found, name))[..., 0] for name in ("slip_velocity", "slip_sigma")
        ]
    errors = (estimates["without camera"][0] - true)[START:]
    shown = int(np.argmax(np.square(errors).mean(axis=(0, 2))))
    mu = runs.truth[:, shown, TRUTH_LAYOUT.slices["effective_friction"]][len(time) // 2, ::2]
    figure = new_figure(10.0, 3.8)
    axes = figure.subplots(1, 2, sharey=True)
    for ax, wheel, name in zip(axes, (0, 1), ("left", "right"), strict=True):
        for (label, (slip, sigma)), color in zip(estimates.items(), COLOURS, strict=False):
            value, width = slip[:, shown, wheel], 2 * sigma[:, shown, wheel]
            ax.fill_between(time, value - width, value + width, color=color, alpha=0.2, lw=0, label=f"{label}, 2 sigma")
            ax.plot(time, value, color=color, lw=1.5, label=label)
        ax.plot(time, true[:, shown, wheel], color="black", lw=1.0, ls="--", label="truth")
        ax.set(xlim=(0, 10), ylim=(-0.2, 0.2), yticks=np.linspace(-0.2, 0.2, 5), xlabel="time (s)")
        ax.set_title(f"{name} front wheel, friction {mu[wheel]:.2f}", fontsize=10)
        tidy(ax)
    axes[0].set_ylabel("longitudinal slip (m/s)")
    legend_below(figure, columns=5)
    save(figure, Path(path))


def main() -> None:
    for backend, floor, drive, count in CASES:
        print(row(simulate(backend, floor, drive, count, 10.0, seed=SEED), f"{backend}, {floor}, {drive}"), flush=True)
    for policy, floor, count in PLAYED:
        print(row(play(policy, floor, count, 10.0, seed=SEED), f"{policy}, {floor}"), flush=True)
    if len(sys.argv) > 1:
        draw(sys.argv[1])


if __name__ == "__main__":
    main()
