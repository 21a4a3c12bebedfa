"""Names and order of the joints: the four legs, then the four wheels, each lf, rf, lr, rr (left/right, front/rear)."""

from __future__ import annotations

CORNERS = ("lf", "rf", "lr", "rr")
#: Corners in words.
CORNER_NAMES: dict[str, str] = dict(zip(CORNERS, ("left front", "right front", "left rear", "right rear"), strict=True))
LEGS = tuple(f"leg_{corner}" for corner in CORNERS)
WHEELS = tuple(f"wheel_{corner}" for corner in CORNERS)
JOINTS = LEGS + WHEELS
#: Where legs and wheels stand in the joint order: ``position[:, LEG_SLICE]``; wheel i is joint ``FIRST_WHEEL + i``.
FIRST_WHEEL = len(LEGS)
LEG_SLICE = slice(0, FIRST_WHEEL)
WHEEL_SLICE = slice(FIRST_WHEEL, len(JOINTS))
#: Signs of the hip positions (x, y) in the body frame, in corner order.
CORNER_SIGNS = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))


def full_name(joint: str) -> str:
    """Return a joint's name with its corner in words: ``leg_lf (left front)``."""
    return f"{joint} ({CORNER_NAMES[joint.rpartition('_')[2]]})"
