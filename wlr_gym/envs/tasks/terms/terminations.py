"""Termination terms: the episode ends (``terminated``) in the step in which a term is greater than zero."""

from __future__ import annotations

from wlr_gym.envs.tasks.signals import Signals, Value
from wlr_gym.envs.tasks.terms.scalar import ScalarTerm, registered
from wlr_gym.physics.codegen import ops

TERMINATIONS: dict[str, ScalarTerm] = {}


@registered(TERMINATIONS)
def tilt(signals: Signals, *, limit: Value = 0.8) -> Value:
    """The body's z axis leans more than ``limit`` (rad) from the floor's normal."""
    _, x, y, _ = signals.truth("quaternion")
    return ops.cos(limit) - (1.0 - 2.0 * (x * x + y * y))


@registered(TERMINATIONS)
def body_contact(signals: Signals, *, clearance: Value = 0.0) -> Value:
    """The lowest corner of the body box is less than ``clearance`` (m) above the floor."""
    return clearance - signals.truth("body_clearance")[0]


@registered(TERMINATIONS)
def left_floor(signals: Signals, *, clearance: Value = 0.3) -> Value:
    """The body box is more than ``clearance`` (m) above the floor: no standing robot reaches that high."""
    return signals.truth("body_clearance")[0] - clearance
