"""Write what docs/slip_observer.md shows; prints its table.

``python tests/perception/observer/observer_page.py [FIGURE.png [PACKAGE]]``; PACKAGE: importable name of an older
observer, which the table and the figure then show as well, before ours.
"""

from __future__ import annotations

import sys
from importlib import import_module

import numpy as np
from observed_runs import PERIOD, Runs, channel, observe, play, simulate, slip_in_truth_order

import wlr_gym.perception.observer as ours
from wlr_gym.physics.plants.base import TRUTH_LAYOUT

#: The robot of the batch that did worst before: its right wheels spin on friction 0.19, its left ones hold on 0.66.
ROBOT_SHOWN = 8
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


def measures(runs: Runs, package, camera: bool) -> list[str]:
    """Of one observer: v_x rms, median, 99 %; v_y rms; slip rms (mm/s), share inside 2 sigma (%), normalised error, NLL."""
    found, layout = observe(runs, camera, package.SlipObserver), package.ESTIMATE_LAYOUT
    velocity = (channel(layout, found, "linear_velocity_in_body") - runs.true("linear_velocity_in_body")[..., :2])[START:]
    error = (channel(layout, found, "slip_velocity") - runs.true("slip_velocity"))[START:]
    sigma = channel(layout, found, "slip_sigma")[START:]
    ahead, normalised = np.abs(velocity[..., 0]), error / sigma
    millimetres = (
        1e3 * value for value in (rms(ahead), np.median(ahead), np.quantile(ahead, 0.99), rms(velocity[..., 1]), rms(error))
    )
    inside = 100 * (np.abs(normalised) < 2).mean()
    likelihood = (0.5 * normalised**2 + np.log(sigma)).mean()
    return [*(f"{value:.1f}" for value in millimetres), f"{inside:.0f}", f"{rms(normalised):.2f}", f"{likelihood:.2f}"]


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def row(runs: Runs, name: str, packages) -> str:
    """One line of the table: both cases, the older observer's numbers before ours where they are asked for."""
    cells = []
    for camera in (False, True):
        columns = zip(*(measures(runs, package, camera) for package in packages), strict=True)
        cells += [" → ".join(column) for column in columns]
    return f"| {name} | " + " | ".join(cells) + " |"


def draw(path: str, packages) -> None:
    """One robot that skids on two floors at once: true slip of its wheels, the estimate and its 2 sigma."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    runs = simulate("gibbs_appell", "split", "commands", 64, 10.0, seed=SEED)
    time = PERIOD * np.arange(len(runs.sensors))
    true = slip_in_truth_order(runs.true("slip_velocity"))[:, ROBOT_SHOWN, :, 0]
    mu = runs.truth[:, ROBOT_SHOWN, TRUTH_LAYOUT.slices["effective_friction"]][len(time) // 2, ::2]
    shown = [(package, False, "no camera" if package is ours else "no camera, before") for package in packages]
    shown += [(ours, True, "with camera")]
    figure, axes = plt.subplots(2, len(shown), figsize=(4.0 * len(shown), 5.0), sharex=True, sharey=True, layout="constrained")
    for column, (package, camera, title) in enumerate(shown):
        found = observe(runs, camera, package.SlipObserver)
        slip, sigma = (
            slip_in_truth_order(channel(package.ESTIMATE_LAYOUT, found, name))[:, ROBOT_SHOWN, :, 0]
            for name in ("slip_velocity", "slip_sigma")
        )
        for line, wheel, name in ((0, 0, "left front"), (1, 1, "right front")):
            ax = axes[line, column]
            band = slip[:, wheel] - 2 * sigma[:, wheel], slip[:, wheel] + 2 * sigma[:, wheel]
            ax.fill_between(time, *band, color="tab:blue", alpha=0.25, lw=0, label="estimate, 2 sigma")
            ax.plot(time, slip[:, wheel], color="tab:blue", lw=1.2)
            ax.plot(time, true[:, wheel], color="black", lw=1.0, ls="--", label="truth")
            ax.set_ylim(-0.2, 0.2)
            ax.set_title(f"{name} wheel (friction {mu[wheel]:.2f}), {title}", fontsize=9)
            ax.grid(alpha=0.3)
    for ax in axes[:, 0]:
        ax.set_ylabel("slip along heading (m/s)")
    for ax in axes[1]:
        ax.set_xlabel("time (s)")
    axes[0, 0].legend(fontsize=8, loc="upper right")
    figure.savefig(path, dpi=110)


def main() -> None:
    packages = [*(import_module(name) for name in sys.argv[2:3]), ours]
    for backend, floor, drive, count in CASES:
        print(
            row(simulate(backend, floor, drive, count, 10.0, seed=SEED), f"{backend}, {floor}, {drive}", packages), flush=True
        )
    for policy, floor, count in PLAYED:
        print(row(play(policy, floor, count, 10.0, seed=SEED), f"{policy}, {floor}", packages), flush=True)
    if len(sys.argv) > 1:
        draw(sys.argv[1], packages)


if __name__ == "__main__":
    main()
