"""Open a folder of the robot's runs: read, check, and make a problem of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from wlr_gym.data.check import increments
from wlr_gym.data.format import COMMANDS
from wlr_gym.data.read import Run, read_dataset
from wlr_gym.data.replay import robot_of
from wlr_gym.gap.analysis import IntakeFinding
from wlr_gym.gap.robot.problem import RobotProblem
from wlr_gym.physics.effects import Source
from wlr_gym.robot import JOINTS, LEGS

#: Runs that an analysis needs: two to fit, one to hold out.
LEAST_RUNS = 3
#: s; shorter runs hold no window to compare.
LEAST_SECONDS = 3.0
#: Rows of all runs from which on the memory that an analysis needs is said.
MANY_ROWS = 20_000
#: GB; eight runs of 20 s need 1.4 GB.
MEMORY_PER_ROW = 1.8e-4
#: rad; a joint that is asked to move more than this ...
ASKED = 0.2
#: ... and moves less than this share of it is dead.
SHOWN = 0.02
#: Ratio of measured to commanded wheel motion that means a turned sign.
MIRRORED = -0.5
#: Correlation of a rate with its angle's turning that means a turned sign.
OPPOSITE = -0.8
#: rad in half a second by which both must turn, one sigma.
TURNED = 0.02
#: Rows that a correlation needs.
LEAST_ROWS = 100
#: Mean product of a leg's effort and its lag behind the goal, over the product of their rms, that means a turned sign of the
#: effort. A servo pushes towards its goal: with the right sign 0.99 in the median, and 0.10 with 0.35 N m of dry friction.
PUSHES_AWAY = -0.5
#: m/s2; the accelerometer's z reads about +9.8 at rest, so that half of all readings below this hang upside down.
UPSIDE_DOWN = -5.0
#: s between rows within which a joint cannot turn by half a turn.
LONGEST_STEP = 0.1


def open_robot(
    data: str | Path,
    known: Source = None,
    backend: str = "gibbs_appell",
    threads: int = 1,
    robot: str | Path | None = None,
) -> tuple[RobotProblem | None, list[IntakeFinding]]:
    """Return the problem, and what was noticed about the data; None where the data are too bad to go on.

    Raises:
        InputError: files that are not in the measured-run format, an unknown robot, backend or effect.
    """
    runs = read_dataset(data).runs
    findings = [IntakeFinding(run.name, found.column, found.kind, found.message) for run in runs for found in run.findings]
    for run in runs:
        findings += _look_at(run)
    findings += _dead_elsewhere(runs, findings)
    good = [run for run in runs if not any(f.fatal and f.run == run.name for f in findings)]
    if len(good) < LEAST_RUNS:
        text = (
            f"{len(good)} usable runs of {len(runs)}: at least {LEAST_RUNS} are needed, two to fit and one to hold out. "
            "Record more, of different kinds: wlr record --list"
        )
        return None, [*findings, IntakeFinding("", "", "few_runs", text, fatal=True)]
    rows = sum(len(run["t"]) for run in good)
    if rows > MANY_ROWS:
        text = f"{rows} rows in all: needs about {rows * MEMORY_PER_ROW:.0f} GB of memory; eight runs of 20 s are enough"
        findings.append(IntakeFinding("", "", "long", text))
    return RobotProblem(good, robot_of(good[0], robot), known, backend, threads=threads), findings


def _look_at(run: Run) -> list[IntakeFinding]:
    """What makes a run useless for the comparison."""
    found: list[IntakeFinding] = []
    seconds = float(run["t"][-1] - run["t"][0])
    if seconds < LEAST_SECONDS:
        text = f"{seconds:.2f} s long: a run needs at least {LEAST_SECONDS:g} s, better 15 to 25 s"
        return [IntakeFinding(run.name, "t", "short", text, fatal=True)]
    for leg in LEGS:
        found += _pushes_away(run, leg)
    for joint in JOINTS:
        found += _wrap(run, joint) or _motion(run, joint) or _opposite(run, f"vel_{joint}", f"pos_{joint}")
    found += _opposite(run, "gyro_z", "cam_yaw") + _opposite(run, "gyro_y", "cam_pitch") + _upside_down(run)
    if not np.isfinite(np.stack([run[name] for name in COMMANDS])).any():
        found.append(
            IntakeFinding(run.name, "cmd", "missing", "no motor was on in the whole run: nothing to replay", fatal=True)
        )
    return found


def _dead_elsewhere(runs: Sequence[Run], findings: Sequence[IntakeFinding]) -> list[IntakeFinding]:
    """Runs in which a channel that another run shows to be dead is constant, as nobody asked its joint to move."""
    dead = {finding.channel: finding.run for finding in findings if finding.kind == "dead"}
    told = {(finding.run, finding.channel) for finding in findings if finding.fatal}
    return [
        IntakeFinding(run.name, channel, "dead", f"constant, and dead in {first}", fatal=True)
        for run in runs
        for channel, first in dead.items()
        if (run.name, channel) not in told and np.nanmin(run[channel]) == np.nanmax(run[channel])
    ]


def _wrap(run: Run, joint: str) -> list[IntakeFinding]:
    """Whether an angle starts anew after a turn: no joint gets half a turn further between two rows."""
    jumps = np.flatnonzero((np.abs(np.diff(run[f"pos_{joint}"])) > np.pi) & (np.diff(run["t"]) < LONGEST_STEP))
    if not len(jumps):
        return []
    row = int(jumps[0]) + 1
    jump = run[f"pos_{joint}"][row] - run[f"pos_{joint}"][row - 1]
    text = f"jumps {len(jumps)} times, first by {jump:.3g} rad in row {row}: angles go on past a turn; numpy.unwrap mends it"
    return [IntakeFinding(run.name, f"pos_{joint}", "wrap", text, fatal=True)]


def _opposite(run: Run, rate: str, angle: str) -> list[IntakeFinding]:
    """Whether a rate is against the turning of its angle."""
    if rate not in run or angle not in run:
        return []
    rows = np.isfinite(run[rate]) & np.isfinite(run[angle])
    if rows.sum() < LEAST_ROWS:
        return []
    angles = np.unwrap(run[angle][rows])  # a camera may show a heading within a turn
    turned, measured = (part - part.mean() for part in increments(run["t"][rows], angles, run[rate][rows]))
    sizes = float(np.std(turned)), float(np.std(measured))
    if min(sizes) < TURNED or turned @ measured > OPPOSITE * len(turned) * sizes[0] * sizes[1]:
        return []
    text = f"turns against {angle}: one of the two has the wrong sign; check the hardware file, and the camera's axes"
    return [IntakeFinding(run.name, rate, "mirrored", text, fatal=True)]


def _pushes_away(run: Run, leg: str) -> list[IntakeFinding]:
    """Whether a leg's effort points away from its goal."""
    if f"eff_{leg}" not in run:
        return []
    lag, effort = run[f"cmd_{leg}"] - run[f"pos_{leg}"], run[f"eff_{leg}"]
    rows = np.isfinite(lag) & np.isfinite(effort)
    size = float(np.linalg.norm(lag[rows]) * np.linalg.norm(effort[rows]))
    if rows.sum() < LEAST_ROWS or float(lag[rows] @ effort[rows]) >= PUSHES_AWAY * size:
        return []
    text = "pushes away from its goal: its sign is turned; it goes with the leg's angle"
    return [IntakeFinding(run.name, f"eff_{leg}", "mirrored", text, fatal=True)]


def _upside_down(run: Run) -> list[IntakeFinding]:
    """Whether the accelerometer shows gravity itself, or its z axis points down."""
    if "acc_z" not in run or not np.isfinite(run["acc_z"]).any():
        return []
    middle = float(np.nanmedian(run["acc_z"]))
    if middle > UPSIDE_DOWN:
        return []
    text = f"reads {middle:.1f} m/s2 (median): at rest it reads +9.8, the push of the floor; check its mounting"
    return [IntakeFinding(run.name, "acc_z", "mirrored", text, fatal=True)]


def _motion(run: Run, joint: str) -> list[IntakeFinding]:
    """Whether a joint does what it is asked: dead or mirrored channels."""
    command, position = run[f"cmd_{joint}"], run[f"pos_{joint}"]
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
