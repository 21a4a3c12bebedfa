"""Open what is to be analysed: runs of the robot, of the test rig, or of a system of one's own, as a problem."""

from __future__ import annotations

from pathlib import Path

from wlr_gym.base.errors import unknown_name
from wlr_gym.gap.analysis import IntakeFinding
from wlr_gym.gap.problem import Problem
from wlr_gym.physics.effects import Patch, Source, load_patch

#: Kinds of rigs.
RIGS = ("pendulum",)
#: Ending of the file of a rig of one's own.
OWN_RIG = ".py"


def open_problem(
    data: str | Path, known: Source, rig: str | Path | None, backend: str, threads: int, robot: str | Path | None
) -> tuple[Patch, Problem | None, list[IntakeFinding]]:
    """Return what is known already, the problem (None where the data are too bad to go on), and what was noticed.

    For the arguments and errors see :func:`wlr_gym.gap.workflow.analyse`.
    """
    patch = known_patch(known, rig)
    if rig is None:
        from wlr_gym.gap.robot.open import open_robot

        return patch, *open_robot(data, patch, backend, threads, robot)
    if rig in RIGS:
        from wlr_gym.gap.rig.open import open_rig

        return patch, *open_rig(data, patch)
    from wlr_gym.gap.rig.own import load_rig
    from wlr_gym.gap.rig.own_problem import open_own_rig

    return patch, *open_own_rig(data, load_rig(rig), patch.effects)


def named_robot(data: str | Path, rig: str | Path | None, robot: str | Path | None) -> str | None:
    """Return what ``--robot`` takes for the robot that is analysed; None = nothing names it, or it is a rig."""
    from wlr_gym.data.read import read_meta
    from wlr_gym.data.robot_file import names_file, shipped_robots

    if rig is not None:
        return None
    if robot is not None:
        return str(robot)
    named = read_meta(data).robot
    if named is None:
        return None
    return str(Path(data) / named) if names_file(named) else shipped_robots()[named].stem


def known_patch(known: Source, rig: str | Path | None) -> Patch:
    """Return the effects given as known, in the vocabulary of the robot or of the rig.

    Raises:
        InputError: an effect that it does not have, or a rig that does not exist.
    """
    if rig is None:
        return load_patch(known)
    if rig in RIGS:
        from wlr_gym.gap.rig.open import rig_patch

        return rig_patch(known)
    if Path(rig).suffix != OWN_RIG:
        raise unknown_name("rig", str(rig), RIGS)
    from wlr_gym.gap.rig.own import load_rig
    from wlr_gym.gap.rig.own_problem import own_patch

    return own_patch(known, load_rig(rig))
