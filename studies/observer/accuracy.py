"""How accurate the observer is, and its figure: ``python -m studies.observer accuracy`` (docs/slip_observer.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from studies.observer.runs import (
    DRIVEN,
    PERIOD,
    PLAYED,
    Runs,
    estimated,
    observe,
    play,
    simulate,
    slip_in_truth_order,
    without_flow,
)
from wlr_gym.base.files import write_json
from wlr_gym.base.plots import COLOURS, legend_below, new_figure, save, tidy
from wlr_gym.base.provenance import git_commit
from wlr_gym.physics.plants.base import TRUTH_LAYOUT
from wlr_gym.robot import load_robot

SEED = 5
START = 25  # ticks: robots of a simulation are dropped, which is not what is measured here
CASES = [("gibbs_appell", floor, drive, 64) for floor, drive in DRIVEN]
CASES += [("mujoco", floor, drive, 32) for floor, drive in DRIVEN if floor != "slope"]
#: How far off the optical-flow sensor is, in the rows that have one.
FLOW = {"flow__scale": 1.05, "flow__mount_yaw": 0.02, "flow__dropout": 0.02}
FLOW_DRIVE = "commands, robot with optical flow"


def measures(runs: Runs, camera: bool) -> dict[str, float]:
    """Errors of forward speed (rms, median, 99 %), lateral speed and slip; how well the slip's sigma holds."""
    found = observe(runs, camera)
    velocity = estimated(found, "linear_velocity_in_body") - runs.true("linear_velocity_in_body")[..., :2]
    velocity, sigma = velocity[START:], estimated(found, "slip_sigma")[START:]
    error = (estimated(found, "slip_velocity") - runs.true("slip_velocity"))[START:]
    ahead, normalised = np.abs(velocity[..., 0]), error / sigma
    return {
        "v_x_mm_s": 1e3 * rms(ahead),
        "v_x_median_mm_s": 1e3 * float(np.median(ahead)),
        "v_x_99_percent_mm_s": 1e3 * float(np.quantile(ahead, 0.99)),
        "v_y_mm_s": 1e3 * rms(velocity[..., 1]),
        "slip_mm_s": 1e3 * rms(error),
        "within_2_sigma_percent": 100 * float((np.abs(normalised) < 2).mean()),
        "error_over_sigma": rms(normalised),
        "negative_log_likelihood": float((0.5 * normalised**2 + np.log(sigma)).mean()),
    }


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def row(runs: Runs, backend: str, floor: str, drive: str) -> dict[str, object]:
    """One row of the data, without and with camera and, where there is one, optical flow; printed as well."""
    plain = without_flow(runs)
    found = {"neither": measures(plain, camera=False), "camera": measures(plain, camera=True)}
    if runs.sensed("flow_is_new").any():
        found |= {"flow": measures(runs, camera=False), "camera and flow": measures(runs, camera=True)}
    cells = [f"{value:.3g}" for one in found.values() for value in one.values()]
    print(f"| {backend}, {floor}, {drive} | {' | '.join(cells)} |", flush=True)
    return {"backend": backend, "floor": floor, "drive": drive, "robots": runs.truth.shape[1], **found}


def draw(path: Path) -> None:
    """On split floors, the robot with the largest error without a camera: slip of both front wheels, estimates, 2 sigma."""
    runs = simulate("gibbs_appell", "split", "commands", 64, 10.0, seed=SEED)
    time = PERIOD * np.arange(len(runs.sensors))
    true = slip_in_truth_order(runs.true("slip_velocity"))[..., 0]
    estimates = {}
    for label, camera in (("without camera", False), ("with camera", True)):
        found = observe(runs, camera)
        estimates[label] = [slip_in_truth_order(estimated(found, name))[..., 0] for name in ("slip_velocity", "slip_sigma")]
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
    save(figure, path)


def measure_accuracy(data: Path | None = None, figure: Path | None = None) -> None:
    """Print a row per floor and drive; write all numbers and the figure where asked."""
    rows = [row(simulate(*case, 10.0, seed=SEED), *case[:3]) for case in CASES]
    robot = load_robot("flow")
    rows += [
        row(simulate("gibbs_appell", floor, "commands", 64, 10.0, SEED, robot, **FLOW), "gibbs_appell", floor, FLOW_DRIVE)
        for floor in ("split", "slippery")
    ]
    rows += [row(play(policy, floor, 64, 10.0, seed=SEED), "gibbs_appell", floor, policy) for policy, floor in PLAYED]
    if data is not None:
        write_json(data, {"commit": git_commit(), "seed": SEED, "rows": rows})
    if figure is not None:
        draw(figure)
