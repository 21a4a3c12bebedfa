"""The joint drive, defined once for every simulator: servo, motor, supply, gear friction, gear play.

Scalar source over *lanes* (a mapping name -> scalar of one robot), written with :mod:`wlr_gym.physics.codegen.ops`: each
simulator traces it into its own kernel, with its own lanes for joint angles and rates. :func:`pack` fills the parameter lanes
from the table. What a simulator must keep from substep to substep are the STATE lanes. All at the output shaft, SI units.

Order of calls within a substep of length ``step``, from the rates at its start:

1. :func:`command` advances the profile generators and the supply and gives every motor's voltage;
2. :func:`push` gives what each joint gets: an explicit impulse, an implicit damping and a dry friction bound;
3. the simulator solves for the new joint rates;
4. :func:`finish` gives the rotor's new rate, the motor's torque and its energies.

Families of effects that change what is traced: ``drive`` (weak motor, Stribeck and load-dependent friction, torque ripple,
supply sag), ``backlash`` and ``compliance`` (gears that creep). A joint whose own parameters are neutral gets the same bits
with and without them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics import servo
from wlr_gym.physics.codegen import ops
from wlr_gym.physics.codegen.ops import Lanes, Out, Value
from wlr_gym.robot import FIRST_WHEEL, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

JOINTS = range(8)
JOINT_LANES = (
    "kp", "kd", "volt_gain", "back_emf_damping", "viscous", "weight", "gear_bound", "creep_rate", "inverse_creep_rate",
    "inverse_constant", "idle_current", "effort_scale", "velocity_limit", "acceleration_limit",
    "torque_scale", "stribeck_torque", "inverse_stribeck_speed", "load_friction",
    "ripple_amplitude", "ripple_order", "ripple_phase",
    "half_play", "rotor_inertia", "teeth_stiffness", "teeth_damping",
)  # fmt: skip
#: Parameter lanes of the drive.
DRIVE_LANES: tuple[str, ...] = ("supply", "supply_resistance", *(f"{name}{j}" for name in JOINT_LANES for j in JOINTS))
#: What a simulator keeps from substep to substep. ``rotor_lead`` is the rotor's angle beyond its joint's (rad, 0 in the
#: middle of the play), ``rotor_rate`` its rate relative to the parent link (rad/s, at the output shaft).
STATE: tuple[str, ...] = (
    *(f"reference_position{j}" for j in JOINTS),
    *(f"reference_velocity{j}" for j in JOINTS),
    "supply_drop",
    *(f"rotor_lead{j}" for j in JOINTS),
    *(f"rotor_rate{j}" for j in JOINTS),
)


def pack(parameters: Parameters, robot: Robot, step: float, moved_inertia: Array | None = None) -> dict[str, Array]:
    """Return the lanes DRIVE_LANES, each (N,).

    Args:
        parameters: (N) batch.
        robot: for the voltage at which the motors' data hold, and the nominal currents.
        step: s.
        moved_inertia: (N, 8) inertia that turns with each rotor, its own included, while the gear is rigid, kg m2. The implicit
            share of the damping is fitted to it (with play: to the rotor's own), so that a free joint decays exactly
            (:func:`fitted_weight`). None makes the damping fully implicit.
    """
    constant, resistance = servo.motor_constants(
        parameters["servo.stall_torque"], parameters["servo.no_load_speed"], robot.servo.supply_voltage
    )
    line, law = servo.line_constants(robot)[0], servo.current_law(robot)
    back_emf_damping = constant * constant / resistance
    viscous, armature = parameters["servo.viscous_friction"], parameters["servo.armature"]
    torque_scale, play = parameters["servo.torque_scale"], parameters["servo.backlash"]
    creep = parameters["servo.creep_rate"]
    limits = servo.profile_limits(parameters["servo.profile_velocity"], parameters["servo.profile_acceleration"])
    weight = np.ones_like(armature)
    if moved_inertia is not None:
        moved = np.where(play > 0.0, armature, moved_inertia)
        weight = fitted_weight(step * (back_emf_damping * torque_scale + viscous) / moved)
    joint = {
        "kp": servo.position_gains(parameters),
        "kd": parameters["servo.kd"],
        "volt_gain": constant / resistance,
        "back_emf_damping": back_emf_damping,
        "viscous": viscous,
        "weight": weight,
        "gear_bound": step * parameters["servo.coulomb_friction"],
        "creep_rate": creep,
        "inverse_creep_rate": 1.0 / np.where(creep > 0.0, creep, 1.0),
        "inverse_constant": 1.0 / (constant * (law.torque_constant / line)),
        "idle_current": np.broadcast_to(law.idle, constant.shape),
        "effort_scale": line / constant,
        "velocity_limit": limits[0],
        "acceleration_limit": limits[1],
        "torque_scale": torque_scale,
        "stribeck_torque": parameters["servo.stribeck_torque"],
        "inverse_stribeck_speed": 1.0 / parameters["servo.stribeck_speed"],
        "load_friction": parameters["servo.load_friction"],
        "ripple_amplitude": parameters["servo.ripple_amplitude"],
        "ripple_order": parameters["servo.ripple_order"],
        "ripple_phase": parameters["servo.ripple_phase"],
        "half_play": 0.5 * play,
        "rotor_inertia": armature,
        "teeth_stiffness": parameters["servo.gear_stiffness"],
        "teeth_damping": TEETH_DAMPING * np.sqrt(parameters["servo.gear_stiffness"] * armature),
    }
    lanes = {"supply": parameters["servo.supply_voltage"], "supply_resistance": parameters["servo.supply_resistance"]}
    return lanes | {f"{name}{j}": joint[name][:, j] for name in JOINT_LANES for j in JOINTS}


def joint_armature(parameters: Parameters) -> Array:
    """Return the rotor inertia (N, 8) that is rigidly part of each joint, kg m2: none where the gear has play."""
    return np.where(parameters["servo.backlash"] > 0.0, 0.0, parameters["servo.armature"])


def fitted_weight(z: Array) -> Array:
    """Weight of the new velocity in an implicit damping force, so that a free joint decays exactly by exp(-z) per step.

    weight = 1/(1 - exp(-z)) - 1/z: 1/2 (second order) for a soft joint, 1 for a stiff one.
    """
    small = np.abs(z) < 1e-4
    safe = np.where(small, 1.0, z)
    return np.where(small, 0.5 + z / 12.0, -1.0 / np.expm1(-safe) - 1.0 / safe)


def families(parameters: Parameters) -> set[str]:
    """Return which families of drive effects some robot of the batch has."""
    added = ("stribeck_torque", "load_friction", "ripple_amplitude", "supply_resistance")
    present = {
        "drive": (parameters["servo.torque_scale"] != 1.0).any() or any(parameters[f"servo.{name}"].any() for name in added),
        "backlash": parameters["servo.backlash"].any(),
        "compliance": parameters["servo.creep_rate"].any(),
    }
    return {name for name, is_present in present.items() if is_present}


@dataclass(frozen=True)
class Joint:
    """One joint at the start of a substep: true angle (rad), rate relative to its parent (rad/s), encoder reading (rad)."""

    angle: Value
    rate: Value
    reading: Value


def motor_rate(lanes: Lanes, j: int, joint: Joint, features: frozenset[str]) -> Value:
    """Return the rate of motor ``j``: the joint's, or the rotor's own where the gear has play."""
    if "backlash" not in features:
        return joint.rate
    return ops.where_positive(lanes[f"half_play{j}"], lanes[f"rotor_rate{j}"], joint.rate)


def supply_voltage(lanes: Lanes, features: frozenset[str]) -> Value:
    """Return the voltage at the servos (V)."""
    if "drive" not in features:
        return lanes["supply"]
    return ops.maximum(lanes["supply"] - lanes["supply_drop"], 0.0)


def _goal(lanes: Lanes, j: int, time: Value, step: Value) -> Value:
    """Goal of a substep: in the one in which a new goal arrives, both in proportion, so that no time is lost to the step."""
    old, new = lanes[f"old_goal{j}"], lanes[f"goal{j}"]
    after = time + 0.5 * step - lanes[f"switch_time{j}"]
    partly = ops.where_positive(after - 1e-6 * step, old + after * (1.0 / step) * (new - old), old)
    return ops.where_positive(after - (1.0 - 1e-6) * step, new, partly)


def command(
    lanes: Lanes, joints: Sequence[Joint], time: Value, step: Value, features: frozenset[str]
) -> tuple[Out, list[Value]]:
    """Advance the profile generators and the supply; return new STATE lanes and the voltages (V) of this substep.

    While a motor is off, its references follow the joint, so that switching on does not jerk.

    Args:
        lanes: DRIVE_LANES, STATE, and the inputs ``goal{j}``, ``old_goal{j}``, ``switch_time{j}``, ``on{j}`` (1 or 0).
        joints: the eight joints.
        time: middle of the substep, from the start of the control tick, s.
        step: s.
        features: families of effects to trace.
    """
    out: Out = {}
    voltages: list[Value] = []
    supply = supply_voltage(lanes, features)
    for j, joint in enumerate(joints):
        goal = _goal(lanes, j, time, step)
        old = (lanes[f"reference_position{j}"], lanes[f"reference_velocity{j}"])
        if j < FIRST_WHEEL:
            new = servo.leg_profile_step(*old, goal, lanes[f"velocity_limit{j}"], lanes[f"acceleration_limit{j}"], step)
        else:
            new = servo.wheel_profile_step(
                *old, goal, lanes[f"acceleration_limit{j}"], step, joint.reading, lanes[f"kp{j}"], supply
            )
        position, velocity, mean_position, mean_velocity = new
        on = lanes[f"on{j}"] - 0.5
        out[f"reference_position{j}"] = ops.where_positive(on, position, joint.reading)
        out[f"reference_velocity{j}"] = ops.where_positive(on, velocity, joint.rate)
        gains = (lanes[f"kp{j}"], lanes[f"kd{j}"])
        voltages.append(servo.controller_voltage(*gains, mean_position, mean_velocity, joint.reading, joint.rate, supply))
    if "drive" in features:
        rates = [motor_rate(lanes, j, joint, features) for j, joint in enumerate(joints)]
        out["supply_drop"] = _supply_drop(lanes, voltages, rates)
    return out, voltages


def _supply_drop(lanes: Lanes, voltages: Sequence[Value], rates: Sequence[Value]) -> Value:
    """Drop of the supply (V) at the next substep: one quasi-Newton step towards resistance x sum of absolute currents.

    drop += (R sum |I| - drop)/(1 + R sum 1/R_j): exact in one step while every motor has the full voltage, and a stable
    low-pass of a few substeps otherwise.
    """
    total: Value = 0.0
    conductance: Value = 0.0
    for j in JOINTS:
        on, inverse_constant = lanes[f"on{j}"], lanes[f"inverse_constant{j}"]
        torque = on * (lanes[f"volt_gain{j}"] * voltages[j] - lanes[f"back_emf_damping{j}"] * rates[j])
        total = total + ops.absolute(torque * inverse_constant + on * lanes[f"idle_current{j}"] * rates[j])
        conductance = conductance + on * (lanes[f"volt_gain{j}"] * inverse_constant)
    resistance, drop = lanes["supply_resistance"], lanes["supply_drop"]
    change = (resistance * total - drop) * (1.0 / (1.0 + resistance * conductance))
    return ops.minimum(drop + change, lanes["supply"])


def push(lanes: Lanes, j: int, voltage: Value, joint: Joint, step: Value, ahead: Value, features: frozenset[str]) -> Push:
    """Return what motor, gear friction and gear play do to joint ``j`` within this substep.

    torque = on torque_scale ((K/R) voltage - (K^2/R) W) + ripple - viscous W, damping with weight on the new rate;
    dry friction = coulomb + stribeck_torque exp(-(W/stribeck_speed)^2) + load_friction |torque|; while a gear turns more slowly
    than its creep_rate, it is a damping instead: that times W/creep_rate.

    Args:
        lanes: as for :func:`command`.
        j: joint.
        voltage: V.
        joint: at the start of the substep.
        step: s.
        ahead: how long positions will still move with the new rates after this substep's solve, s: the teeth meet with the
            force of that moment. The whole step for semi-implicit Euler, half of it for drift-kick-drift.
        features: families of effects to trace.
    """
    on, rate = lanes[f"on{j}"], motor_rate(lanes, j, joint, features)
    strength = on * lanes[f"torque_scale{j}"] if "drive" in features else on
    loss = strength * lanes[f"back_emf_damping{j}"] + lanes[f"viscous{j}"]
    weight = lanes[f"weight{j}"]
    torque = strength * lanes[f"volt_gain{j}"] * voltage - loss * ((1.0 - weight) * rate)
    damping = loss * weight
    bound = lanes[f"gear_bound{j}"]
    ripple: Value = 0.0
    if "drive" in features:
        phase = lanes[f"ripple_order{j}"] * joint.angle + lanes[f"ripple_phase{j}"]
        ripple = lanes[f"ripple_amplitude{j}"] * ops.sin(phase)
        torque = torque + ripple
        bound = bound + step * _extra_friction(lanes, j, strength, voltage, rate, ripple)
    creep: Value = 0.0
    if "compliance" in features:
        slower = lanes[f"creep_rate{j}"] - ops.absolute(rate)
        creep = ops.where_positive(slower, bound * lanes[f"inverse_creep_rate{j}"], 0.0)
        damping = damping + creep * (1.0 / step)
        bound = ops.where_positive(slower, 0.0, bound)
    if "backlash" not in features:
        return Push(step * torque, step * damping, bound, ripple=ripple, creep=creep)
    pressed = teeth(lanes, j, joint.rate, step * torque, step * damping, bound, step, ahead)
    half_play = lanes[f"half_play{j}"]

    def either(with_play: Value, rigid: Value) -> Value:
        return ops.where_positive(half_play, with_play, rigid)

    return Push(
        # chosen before they are multiplied by the step: a product stays a product, which keeps a rigid joint's bits
        impulse=step * either(pressed.impulse * (1.0 / step), torque),
        damping=step * either(pressed.damping * (1.0 / step), damping),
        bound=bound,
        share=either(pressed.share, 1.0),
        rotor_free=either(pressed.rotor_free, 0.0),
        rotor_gain=either(pressed.rotor_gain, 0.0),
        ripple=ripple,
        creep=creep,
    )


def _extra_friction(lanes: Lanes, j: int, strength: Value, voltage: Value, rate: Value, ripple: Value) -> Value:
    """Dry gear friction beyond Coulomb's (N m), from the rate and the motor's torque at the start of the substep."""
    ratio = rate * lanes[f"inverse_stribeck_speed{j}"]
    motor = strength * (lanes[f"volt_gain{j}"] * voltage - lanes[f"back_emf_damping{j}"] * rate) + ripple
    return lanes[f"stribeck_torque{j}"] * ops.decay(ratio * ratio) + lanes[f"load_friction{j}"] * ops.absolute(motor)


def kept_for_finish(pushed: Push, j: int) -> Out:
    """Return the lanes of :class:`Push` that :func:`finish` reads."""
    return {
        f"share{j}": pushed.share,
        f"rotor_free{j}": pushed.rotor_free,
        f"rotor_gain{j}": pushed.rotor_gain,
        f"ripple{j}": pushed.ripple,
        f"creep{j}": pushed.creep,
    }


def finish(
    lanes: Lanes,
    j: int,
    voltage: Value,
    old_rate: Value,
    new_rate: Value,
    friction: Value,
    step: Value,
    features: frozenset[str],
) -> Out:
    """Return motor torques, work and the rotor's rate once the new joint rates are known.

    Args:
        lanes: as for :func:`command`, and those of :func:`kept_for_finish`.
        j: joint.
        voltage: V, from :func:`command`.
        old_rate, new_rate: of the joint, rad/s.
        friction: impulse of dry gear friction, N m s; read with ``backlash`` only.
        step: s.
        features: families of effects to trace.

    Returns:
        ``motor_torque{j}`` (N m, mean over the substep, before gear friction), ``current_torque{j}`` (N m, current times torque
        constant: what the reported effort is made of), ``work{j}`` and ``electrical_work{j}`` (J), ``rotor_rate{j}``,
        ``crept{j}`` (N m s, the friction of a gear that creeps).
    """
    out: Out = {}
    on, weight = lanes[f"on{j}"], lanes[f"weight{j}"]
    if "backlash" in features:
        half_play = lanes[f"half_play{j}"]
        with_play = lanes[f"rotor_free{j}"] + lanes[f"rotor_gain{j}"] * friction + lanes[f"share{j}"] * new_rate
        old_rate = ops.where_positive(half_play, lanes[f"rotor_rate{j}"], old_rate)
        new_rate = ops.where_positive(half_play, with_play, new_rate)
        out[f"rotor_rate{j}"] = new_rate
    out[f"crept{j}"] = -(lanes[f"creep{j}"] * new_rate) if "compliance" in features else 0.0
    mean_rate = weight * new_rate + (1.0 - weight) * old_rate
    current_torque = on * (lanes[f"volt_gain{j}"] * voltage - lanes[f"back_emf_damping{j}"] * mean_rate)
    torque = current_torque
    if "drive" in features:
        torque = lanes[f"torque_scale{j}"] * current_torque + lanes[f"ripple{j}"]
        out[f"current_torque{j}"] = current_torque
    out[f"motor_torque{j}"] = torque
    out[f"work{j}"] = step * (torque * (0.5 * (new_rate + old_rate)))
    idle = on * lanes[f"idle_current{j}"] * mean_rate
    out[f"electrical_work{j}"] = step * (current_torque * voltage * lanes[f"inverse_constant{j}"] + voltage * idle)
    return out


# ---- gears: what they pass on, and teeth that meet where they have play ----------------------------------------------


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
