"""Servo and pendulum, one substep: the simulators' drive law (:mod:`wlr_gym.physics.plants.drive`) on one joint with one link.

Scalar source over lanes, written with :mod:`wlr_gym.physics.codegen.ops`; :mod:`wlr_gym.gap.rig.kernel` compiles it. Gear,
motor and friction are :func:`wlr_gym.physics.plants.drive.push` itself, so an effect found on the rig is the effect of the
library. Laws of the rig alone (torque that falls behind the current, a torque limit, friction quadratic in load, a warm
winding) act through the strength of the motor and the ratio of load-dependent friction that the drive law reads.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wlr_gym.physics.codegen import ops
from wlr_gym.physics.plants import drive

Value = Any
Lanes = Mapping[str, Value]
Out = dict[str, Value]

#: Lanes of the drive law that are read as they are, for its joint 0.
DRIVE_LANES = (
    "volt_gain", "back_emf_damping", "viscous", "weight", "inverse_constant",
    "stribeck_torque", "inverse_stribeck_speed",
    "ripple_amplitude", "ripple_order", "ripple_phase",
    "half_play", "rotor_inertia", "teeth_stiffness", "teeth_damping",
)  # fmt: skip
#: Numbers of one model. ``gain`` is duty per rad; ``gravity`` N m at a right angle; ``inertia`` kg m2, of all that turns with
#: the link; ``coulomb``, ``torque_limit`` N m; ``saturation`` 1/A; ``quadratic_friction`` 1/(N m); ``thermal`` 1/K.
PARAMETERS = (
    *DRIVE_LANES,
    "gain", "zero", "gravity", "inertia", "coulomb", "torque_scale", "load_friction",
    "saturation", "torque_limit", "quadratic_friction", "thermal",
)  # fmt: skip
#: What the measurement prescribes in each substep: goal (rad), supply (V), torque on (1 or 0), warmth (K above reference).
INPUTS = ("goal", "supply", "on", "warmth")
#: rad, rad/s, rotor's lead in the play (rad), rotor's rate (rad/s).
STATE = ("angle", "rate", "rotor_lead", "rotor_rate")
#: What a substep reports beside the state: voltage (V), motor torque before gear friction and dry friction (N m).
REPORTS = ("voltage", "motor_torque", "friction_torque")


def substep(lanes: Lanes, step: Value, features: frozenset[str], force: Value = 0.0) -> Out:
    """Return STATE after a substep of length ``step`` (s), and REPORTS: drift half a step, kick, drift the other half.

    Args:
        lanes: PARAMETERS, INPUTS and STATE.
        step: s.
        features: families of the drive law to trace.
        force: torque (N m) on the link beside motor, gear and gravity, held over the substep.
    """
    half = 0.5 * step
    rate, rotor_rate = lanes["rate"], lanes["rotor_rate"]
    angle = lanes["angle"] + half * rate
    lead = lanes["rotor_lead"] + half * (rotor_rate - rate)
    joint = drive.Joint(angle, rate, angle + lanes["zero"])
    voltage = lanes["supply"] * ops.clip(lanes["gain"] * (lanes["goal"] - joint.reading), -1.0, 1.0)

    gear = _Gear(lanes, {"rotor_lead0": lead, "rotor_rate0": rotor_rate, "on0": lanes["on"], "idle_current0": 0.0})
    motor_rate = drive.motor_rate(gear, 0, joint, features)
    strength, load_friction = _strength_and_load_friction(lanes, voltage, motor_rate)
    gear = gear.also(torque_scale0=strength, load_friction0=load_friction, gear_bound0=step * lanes["coulomb"])
    pushed = drive.push(gear, 0, voltage, joint, step, half, features)

    # rotor's rate without friction, and what a friction impulse on the rotor adds to it
    mass = 1.0 / (lanes["inertia"] + pushed.damping)
    momentum = lanes["inertia"] * rate + step * (force - lanes["gravity"] * ops.sin(angle)) + pushed.impulse
    free = pushed.rotor_free + pushed.share * (mass * momentum)
    mobility = pushed.rotor_gain + pushed.share * pushed.share * mass
    friction = ops.clip(-(free / mobility), -pushed.bound, pushed.bound)
    new_rate = mass * (momentum + pushed.share * friction)

    gear = gear.also(**drive.kept_for_finish(pushed, 0))
    done = drive.finish(gear, 0, voltage, rate, new_rate, friction, step, features)
    new_rotor_rate = done.get("rotor_rate0", new_rate)
    return {
        "angle": angle + half * new_rate,
        "rate": new_rate,
        "rotor_lead": lead + half * (new_rotor_rate - new_rate),
        "rotor_rate": new_rotor_rate,
        "voltage": voltage,
        "motor_torque": done["motor_torque0"],
        "friction_torque": friction * (1.0 / step),
    }


def _strength_and_load_friction(lanes: Lanes, voltage: Value, motor_rate: Value) -> tuple[Value, Value]:
    """Factor on the motor's torque, and friction per torque, at the voltage and the motor's rate of this substep.

    winding: 1/(1 + thermal warmth); torque per current: 1/(1 + saturation |I|); torque limit: at most ``torque_limit``;
    friction per torque: load_friction + quadratic_friction |torque|.
    """
    winding = 1.0 / (1.0 + lanes["thermal"] * lanes["warmth"])
    unsaturated = winding * ops.absolute(lanes["volt_gain"] * voltage - lanes["back_emf_damping"] * motor_rate)
    current = unsaturated * lanes["inverse_constant"]
    strength = lanes["torque_scale"] / (1.0 + lanes["saturation"] * current)
    torque = strength * unsaturated
    limited = lanes["torque_limit"] / ops.maximum(torque, lanes["torque_limit"])
    load_friction = lanes["load_friction"] + lanes["quadratic_friction"] * (limited * torque)
    return winding * strength * limited, load_friction


class _Gear(Mapping[str, Value]):
    """Lanes under the names the drive law gives its joint 0."""

    def __init__(self, lanes: Lanes, known: Mapping[str, Value]) -> None:
        self._lanes = lanes
        self._known = dict(known)

    def also(self, **known: Value) -> _Gear:
        """Return these lanes with some replaced or added."""
        return _Gear(self._lanes, self._known | known)

    def __getitem__(self, name: str) -> Value:
        return self._known[name] if name in self._known else self._lanes[name.removesuffix("0")]

    def __iter__(self) -> Any:
        raise TypeError("lanes are read by name")

    def __len__(self) -> int:
        raise TypeError("lanes are read by name")
