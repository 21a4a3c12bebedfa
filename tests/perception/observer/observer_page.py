"""Write what docs/slip_observer.md shows: ``python tests/perception/observer/observer_page.py FIGURE.png`` prints its table."""

from __future__ import annotations

import sys

import numpy as np
from observed_runs import PERIOD, Runs, estimated, imu_only, observe, plain_odometry, simulate, slip_in_truth_order

from wlr_gym.physics.plants.base import TRUTH_LAYOUT

#: The robot of the batch that does worst without a camera: its right wheels spin on friction 0.19, its left ones hold on 0.66.
ROBOT_SHOWN = 8
START = 25  # ticks: robots of a simulation are dropped, which is not what is measured here
FLOORS = ("nominal", "wide", "split", "ice", "patches")
CASES = [("gibbs_appell", floor, drive, 64) for floor in FLOORS for drive in ("commands", "excitation")]
CASES += [("gibbs_appell", "slope", "climb", 64)]
CASES += [("mujoco", floor, drive, 32) for floor in FLOORS for drive in ("commands", "excitation")]


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values[START:]))))


def row(runs: Runs, name: str) -> str:
    """One line of the table: forward velocity of four estimators, then slip, normalised error and position of ours."""
    true = runs.true("linear_velocity_in_body")[..., :2]
    slip = runs.true("slip_velocity")
    cells = [f"{1e3 * rms(other(runs)[..., 0] - true[..., 0]):.0f}" for other in (plain_odometry, imu_only)]
    for camera in (False, True):
        found = observe(runs, camera)
        error = estimated(found, "linear_velocity_in_body") - true
        slip_error = estimated(found, "slip_velocity") - slip
        normalised = rms(slip_error / estimated(found, "slip_sigma"))
        cells += [f"{1e3 * rms(error[..., k]):.1f}" for k in (0, 1)]
        cells += [f"{1e3 * rms(slip_error):.1f}", f"{normalised:.2f}"]
    return f"| {name} | " + " | ".join(cells) + " |"


def draw(path: str) -> None:
    """One robot that skids on two floors at once: true slip of its four wheels, the estimate and its 2 sigma."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    runs = simulate("gibbs_appell", "split", "commands", 64, 10.0, seed=5)
    time = PERIOD * np.arange(len(runs.sensors))
    true = slip_in_truth_order(runs.true("slip_velocity"))[:, ROBOT_SHOWN, :, 0]
    mu = runs.truth[:, ROBOT_SHOWN, TRUTH_LAYOUT.slices["effective_friction"]][len(time) // 2, ::2]
    figure, axes = plt.subplots(2, 2, figsize=(9.0, 5.0), sharex=True, sharey=True, layout="constrained")
    for column, camera in enumerate((False, True)):
        found = observe(runs, camera)
        slip = slip_in_truth_order(estimated(found, "slip_velocity"))[:, ROBOT_SHOWN, :, 0]
        sigma = slip_in_truth_order(estimated(found, "slip_sigma"))[:, ROBOT_SHOWN, :, 0]
        for line, wheel, name in ((0, 0, "left front"), (1, 1, "right front")):
            ax = axes[line, column]
            band = slip[:, wheel] - 2 * sigma[:, wheel], slip[:, wheel] + 2 * sigma[:, wheel]
            ax.fill_between(time, *band, color="tab:blue", alpha=0.25, lw=0, label="estimate, 2 sigma")
            ax.plot(time, slip[:, wheel], color="tab:blue", lw=1.2)
            ax.plot(time, true[:, wheel], color="black", lw=1.0, ls="--", label="truth")
            ax.set_ylim(-0.2, 0.2)
            ax.set_title(f"{name} wheel (friction {mu[wheel]:.2f}), {'with' if camera else 'without'} camera", fontsize=9)
            ax.grid(alpha=0.3)
    for ax in axes[:, 0]:
        ax.set_ylabel("slip along heading (m/s)")
    for ax in axes[1]:
        ax.set_xlabel("time (s)")
    axes[0, 0].legend(fontsize=8, loc="upper right")
    figure.savefig(path, dpi=110)


def main() -> None:
    for backend, floor, drive, count in CASES:
        print(row(simulate(backend, floor, drive, count, 10.0, seed=5), f"{backend}, {floor}, {drive}"), flush=True)
    if len(sys.argv) > 1:
        draw(sys.argv[1])


if __name__ == "__main__":
    main()
