"""Open a folder of the robot's runs: read, check, and make a problem of them."""

from __future__ import annotations

from pathlib import Path

from wlr_gym.data.read import read_dataset
from wlr_gym.data.replay import robot_of
from wlr_gym.gap.analysis import NO_PROFILE, IntakeFinding
from wlr_gym.gap.robot.intake import CHECKS, findings_of
from wlr_gym.gap.robot.problem import RobotProblem
from wlr_gym.physics.effects import Source

#: Runs that an analysis needs: two to fit, one to hold out.
LEAST_RUNS = 3
#: Rows of all runs from which on the memory that an analysis needs is said.
MANY_ROWS = 20_000
#: GB; eight runs of 20 s need 1.4 GB.
MEMORY_PER_ROW = 1.8e-4
_NO_PROFILE = (
    "meta.yaml does not state the servo profile (profile): none is assumed. A profile that was set looks like a command delay "
    "or a slow servo: state it, if there was one, and analyse again"
)


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
    read = read_dataset(data)
    runs = read.runs
    findings = [IntakeFinding(run.name, found.column, found.kind, found.message) for run in runs for found in run.findings]
    if not read.meta.states_profile:
        findings.append(IntakeFinding("", "", NO_PROFILE, _NO_PROFILE))
    findings += findings_of(runs, CHECKS, robot_of(runs[0], robot))
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
