"""What a run lacks, and what that costs the gap workflow."""

from __future__ import annotations

from collections.abc import Collection

from wlr_gym.data.logs.map import GROUPS

#: Channel or group of channels, all of it in words, and what an analysis loses without it.
_COSTS = (
    ("cmd", "cmd_* of all joints", "no run: every replay drives the simulator with the setpoints"),
    ("pos", "pos_* of all joints", "no run: every replay is compared with the joints' angles"),
    ("vel", "vel_* of all joints",
     "rates come from angles alone: what a servo's velocity loop does shows less, errors of its reading not at all"),
    ("eff_leg", "eff_* of the legs",
     "torques of legs are seen by their motion only: friction and springs show less, torque constants not at all"),
    ("eff_wheel", "eff_* of the wheels",
     "torques of the wheels are seen by the wheels' motion only: rolling resistance and friction in the gear look alike"),
    ("gyro", "gyro_* of x, y, z",
     "turning is seen by the camera alone, pitch and roll hardly: masses, and slip in turns, show less"),
    ("acc", "acc_* of x, y, z", "shocks and tilt are not seen: displaced masses, springs and slopes show less"),
    ("cam", "cam_* of x, y, yaw",
     "no way is measured: what floor and wheels do (friction, slip, radius) shows in turning and torques only"),
    ("volt", "volt", "the supply counts as nominal: a weak or sagging one looks like weak motors"),
)  # fmt: skip


def costs(columns: Collection[str]) -> list[tuple[str, str]]:
    """Return what is missing, as names of channels, and what each costs."""
    found = []
    for group, in_words, cost in _COSTS:
        members = GROUPS.get(group, (group,))
        missing = [name for name in members if name not in columns]
        if missing:
            found.append((in_words if len(missing) == len(members) else ", ".join(missing), cost))
    return found
