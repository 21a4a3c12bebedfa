"""Gears between motors and joints: what they pass on, and teeth that meet where they have play. See ``drive.py``."""

from __future__ import annotations

from dataclasses import dataclass

from wlr_gym.physics.codegen import ops
from wlr_gym.physics.codegen.ops import Lanes, Value

#: Damping of meeting teeth over sqrt(stiffness x rotor inertia): 0.7 of critical for the rotor against a wall.
TEETH_DAMPING = 1.4


@dataclass(frozen=True)
class Push:
    """What the drive does to one joint within a substep. Impulses in N m s, for joint rate w' at its end.

    The joint gets ``impulse`` - ``damping`` w' + ``share`` f, where f is the impulse of dry gear friction, |f| <= ``bound``,
    which opposes the rotor's rate  W' = ``rotor_free`` + ``rotor_gain`` f + ``share`` w'.  Without play W' = w': share 1,
    rotor_free and rotor_gain 0.

    Attributes:
        impulse: explicit impulse.
        damping: implicit damping times the step, N m s per rad/s.
        bound: bound of the friction impulse.
        share: part of friction that reaches the joint, and of the joint's rate that reaches the rotor.
        rotor_free: rad/s.
        rotor_gain: rad/s per N m s.
        ripple: N m, acts on the motor beside what its current makes.
        creep: what of the damping is dry friction of a gear that creeps, at the motor, N m s per rad/s.
    """

    impulse: Value
    damping: Value
    bound: Value
    share: Value = 1.0
    rotor_free: Value = 0.0
    rotor_gain: Value = 0.0
    ripple: Value = 0.0
    creep: Value = 0.0


def teeth(lanes: Lanes, j: int, rate: Value, impulse: Value, damping: Value, bound: Value, step: Value, ahead: Value) -> Push:
    """Rotor and teeth of a gear with play, the rotor's rate eliminated; the rotor gets ``impulse`` - ``damping`` W'.

    The teeth push with  k p' + c (W' - w')  when they touch: p' is their overlap at the end of the substep, implicit in both
    rates, so that any stiffness is stable. Whether they touch and push is judged with the joint's old rate; they never pull.
    """
    inertia, half_play = lanes[f"rotor_inertia{j}"], lanes[f"half_play{j}"]
    stiffness, resistance = lanes[f"teeth_stiffness{j}"], lanes[f"teeth_damping{j}"]
    lead = lanes[f"rotor_lead{j}"]
    momentum = inertia * lanes[f"rotor_rate{j}"] + impulse
    own = inertia + damping

    slip = (momentum + ops.clip(-momentum, -bound, bound)) / own - rate  # of the free rotor against the joint
    side = ops.where_positive(lead + ahead * slip, 1.0, -1.0)
    overlap = lead - side * half_play
    grip = step * (ahead * stiffness + resistance)
    pressed = momentum - step * stiffness * overlap
    friction = ops.clip(-(pressed + grip * rate), -bound, bound)
    slip_under_load = (pressed + friction + grip * rate) / (own + grip) - rate
    touching = side * (overlap + ahead * slip)
    pushing = side * (stiffness * (overlap + ahead * slip_under_load) + resistance * slip_under_load)
    engaged = ops.minimum(touching, pushing)

    grip = ops.where_positive(engaged, grip, 0.0)
    spring = ops.where_positive(engaged, stiffness * overlap, 0.0)
    rotor_gain = 1.0 / (own + grip)
    share = grip * rotor_gain
    free = momentum - step * spring
    return Push(step * spring + share * free, share * own, bound, share, rotor_free=free * rotor_gain, rotor_gain=rotor_gain)


def friction_on_rotor(pushed: Push, rate: Value) -> tuple[Value, Value]:
    """Return impulse and friction impulse of :class:`Push` with the friction solved here, for the joint's old rate.

    For a simulator that cannot solve a friction that acts on the rotor together with its contacts: the joint gets ``impulse``
    + share f, and no friction of its own. Only of use where the gear has play.
    """
    free = pushed.rotor_free + pushed.share * rate
    friction = ops.clip(-(free / pushed.rotor_gain), -pushed.bound, pushed.bound)
    return pushed.impulse + pushed.share * friction, friction
