"""What a run lacks, and what that costs the gap workflow."""

from __future__ import annotations

from collections.abc import Collection

from wlr_gym.robot import JOINTS, LEGS, WHEELS

_AXES = "xyz"
#: Columns that belong together -> what an analysis loses without them.
_COSTS: dict[tuple[str, ...], str] = {
    tuple(f"cmd_{joint}" for joint in JOINTS): "no run: every replay drives the simulator with the setpoints",
    tuple(f"pos_{joint}" for joint in JOINTS): "no run: every replay is compared with the joints' angles",
    tuple(f"vel_{joint}" for joint in JOINTS): (
        "rates come from angles alone: what a servo's velocity loop does shows less, errors of its reading not at all"
    ),
    tuple(f"eff_{leg}" for leg in LEGS): (
        "torques of legs are seen by their motion only: friction and springs show less, torque constants not at all"
    ),
    tuple(f"eff_{wheel}" for wheel in WHEELS): (
        "torques of the wheels are seen by the wheels' motion only: rolling resistance and friction in the gear look alike"
    ),
    tuple(f"gyro_{axis}" for axis in _AXES): (
        "turning is seen by the camera alone, pitch and roll hardly: masses, and slip in turns, show less"
    ),
    tuple(f"acc_{axis}" for axis in _AXES): "shocks and tilt are not seen: displaced masses, springs and slopes show less",
    ("cam_x", "cam_y", "cam_yaw"): (
        "no way is measured: what floor and wheels do (friction, slip, radius) shows in turning and torques only"
    ),
    ("volt",): "the supply counts as nominal: a weak or sagging one looks like weak motors",
}


def costs(columns: Collection[str]) -> list[tuple[str, str]]:
    """Return what is missing, as names of channels, and what each costs."""
    found = []
    for group, cost in _COSTS.items():
        missing = [name for name in group if name not in columns]
        if missing:
            found.append((_named(missing, group), cost))
    return found


def _named(missing: list[str], group: tuple[str, ...]) -> str:
    if len(missing) < len(group):
        return ", ".join(missing)
    kinds = {name.partition("_")[0] for name in group}
    return missing[0] if len(group) == 1 else f"{kinds.pop()}_* of {_whose(group)}"


def _whose(group: tuple[str, ...]) -> str:
    joints = {name.partition("_")[2] for name in group}
    if joints <= set(LEGS):
        return "the legs"
    if joints <= set(WHEELS):
        return "the wheels"
    return "all joints" if joints <= set(JOINTS) else ", ".join(sorted(joints))
