"""Calibration against ``mujoco.sysid``: a servo that swings a pendulum, and the robot."""

from __future__ import annotations

from studies.bench.measure import Measurement, Size
from wlr_gym.base.errors import MissingPackageError


def require_sysid() -> None:
    """Raise :class:`MissingPackageError` where MuJoCo has left its calibration out for want of packages."""
    from mujoco import sysid

    if not hasattr(sysid, "optimize"):
        raise MissingPackageError("sysid needs what MuJoCo's calibration does: pip install 'mujoco[sysid]'")


def measure_sysid(size: Size) -> list[Measurement]:
    """Fits per hour of one processor against ``mujoco.sysid``, and how far both are from the truth."""
    require_sysid()
    from studies.bench.sysid_contest import rows
    from studies.bench.sysid_rig import rig_contest
    from studies.bench.sysid_robot import robot_contest

    contests = rig_contest(size(10, 1)), robot_contest(size(4, 1))
    return [row for contest in contests for row in rows(contest, size.rounds)]
