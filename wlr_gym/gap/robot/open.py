"""Open a folder of the robot's runs: read, check, and make a problem of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from wlr_gym.effects import Source
from wlr_gym.errors import InputError
from wlr_gym.gap.analysis import IntakeFinding
from wlr_gym.gap.robot.problem import RobotProblem
from wlr_gym.robot import JOINTS
from wlr_gym.runs.format import COMMANDS
from wlr_gym.runs.read import Run, read_dataset

#: Runs that an analysis needs: two to fit, one for the proof.
LEAST_RUNS = 3
#: s; shorter runs hold no window to compare.
LEAST_SECONDS = 3.0
#: Share of a run's rows that may lack encoder readings.
MOST_MISSING = 0.2
#: rad, rad/s; a joint asked to move more than this and showing nothing is dead.
ASKED, SHOWN = 0.2, 0.02
#: Ratio of measured to commanded wheel motion that means a turned sign.
MIRRORED = -0.5


def open_robot(
    data: str | Path, known: Source = None, backend: str = "gibbs_appell", threads: int = 1
) -> tuple[RobotProblem | None, list[IntakeFinding]]:
    """Return the problem, and what was noticed about the data; None where the data are too bad to go on.

    Raises:
        InputError: files that are not in the measured-run format, an unknown robot, backend or effect.
    """
    runs = read_dataset(data).runs
    findings = [IntakeFinding(run.name, found.column, found.kind, found.message) for run in runs for found in run.findings]
    for run in runs:
        findings += _look_at(run)
    good = [run for run in runs if not any(f.fatal and f.run == run.name for f in findings)]
    if len(good) < LEAST_RUNS:
        text = (
            f"{len(good)} usable runs of {len(runs)}: at least {LEAST_RUNS} are needed, two to fit and one for the proof. "
            "Record more, of different kinds: wlr record --list"
        )
        return None, [*findings, IntakeFinding("", "", "few_runs", text, fatal=True)]
    try:
        return RobotProblem(good, known=known, backend=backend, threads=threads), findings
    except InputError as error:
        raise InputError(f"{data}: {error}") from None


def _look_at(run: Run) -> list[IntakeFinding]:
    """What makes a run useless for the comparison."""
    found: list[IntakeFinding] = []
    seconds = float(run["t"][-1] - run["t"][0])
    if seconds < LEAST_SECONDS:
        text = f"{seconds:.1f} s long: a run needs at least {LEAST_SECONDS:g} s, better 15 to 25 s"
        return [IntakeFinding(run.name, "t", "short", text, fatal=True)]
    for joint in JOINTS:
        position = run[f"pos_{joint}"]
        missing = float(np.mean(~np.isfinite(position)))
        if missing > MOST_MISSING:
            text = f"{missing:.0%} of the readings are missing: the run is left out"
            found.append(IntakeFinding(run.name, f"pos_{joint}", "missing", text, fatal=True))
            continue
        found += _motion(run, joint, position)
    if not np.isfinite(np.stack([run[name] for name in COMMANDS])).any():
        found.append(
            IntakeFinding(run.name, "cmd", "missing", "no motor was on in the whole run: nothing to replay", fatal=True)
        )
    return found


def _motion(run: Run, joint: str, position: np.ndarray) -> list[IntakeFinding]:
    """Whether a joint does what it is asked: dead or mirrored channels."""
    command = run[f"cmd_{joint}"]
    on = np.isfinite(command) & np.isfinite(position)
    if on.sum() < 50:
        return []
    if joint.startswith("wheel"):
        asked, shown = command[on][:-1] * np.diff(run["t"][on]), np.diff(position[on])
    else:
        asked, shown = command[on] - command[on].mean(), position[on] - position[on].mean()
    size = float(np.abs(asked).sum()) if joint.startswith("wheel") else float(np.ptp(asked))
    if size < ASKED:
        return []
    moved = float(np.abs(shown).sum()) if joint.startswith("wheel") else float(np.ptp(shown))
    if moved < SHOWN * size:
        text = f"commanded to move by {size:.2g} rad and shows {moved:.2g} rad: dead encoder, or the motor is not on"
        return [IntakeFinding(run.name, f"pos_{joint}", "dead", text, fatal=True)]
    slope = float(asked @ shown / max(float(asked @ asked), 1e-12))
    if slope < MIRRORED:
        text = f"moves against its command (ratio {slope:.2f}): check the sign in the hardware file"
        return [IntakeFinding(run.name, f"pos_{joint}", "mirrored", text, fatal=True)]
    return []
