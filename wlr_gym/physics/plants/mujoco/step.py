"""What surrounds one MuJoCo step, as generic scalar arithmetic; ``kernel.py`` traces it into compiled code.

MuJoCo's part: rigid-body dynamics, normal contact, Coulomb friction of wheels and drive. Before each step :func:`before` writes
the motors' torques and this step's model fields, after it :func:`after` reads what happened. Choices, and why:

- Drift - kick - drift, as in the engine: within a control tick MuJoCo's positions stand half a step ahead
  (:func:`drift`), so that its Euler step is Moreau's midpoint rule. Forces act at the middle of a step; no cost.
- Damping is implicit without a second solve: MuJoCo's Euler step with C = step * damping added to the joint's armature, and
  -damping * rate as an applied torque, gives M (v' - v) = step (f - damping v') + constraint impulses. The constraint solver
  works with the same matrix, so wheels and gears that stick do stick while the motor brakes. (``dof_damping`` is unknown to the
  solver under ``implicitfast``.)
- The wheel is the engine's thin disc. The geom that touches is a hidden sphere, one end of a capsule whose axis leans
  upwards, away from the floor; a capsule's tangent frame turns with its axis, a sphere's does not. Before each step the
  sphere is placed so that MuJoCo's contact point, which lies halfway into the overlap, is exactly the disc's lowest point.
- Rolling resistance is a torque of our own: MuJoCo's (``condim`` 6) shares one cone with sliding friction, so a wheel that
  rolls would lose its grip. Tyre creep and the elastic tread are forces of our own: MuJoCo's friction knows no such curves.
  They depend on a rate, steeply; they are at the end of this file.
- MuJoCo's velocities: of the body origin in the floor frame, angular in the body frame, joint rates relative to the parent.
"""

from __future__ import annotations

import math
from collections import ChainMap
from functools import reduce
from operator import add

from wlr_gym.physics.codegen import ops
from wlr_gym.physics.codegen.ops import Lanes, Out, Value, Vector
from wlr_gym.physics.plants import body, drive, ground
from wlr_gym.physics.plants.base import COORDINATES
from wlr_gym.physics.plants.contacts import (
    AXES,
    CONTACTS,
    CORNERS,
    Contact,
    axes_on,
    contact_numbers,
    contacts_of,
    cross,
    dot,
    remembered,
    rolling_contact,
    rotation_rows,
    slip_velocity,
    to_body,
    vector,
)
from wlr_gym.physics.plants.gibbs_appell import step as engine
from wlr_gym.physics.plants.gibbs_appell.kinematics import INPUTS_OF_FORMULAS
from wlr_gym.robot import FIRST_WHEEL

#: Families of effects: always all, so that no robot's bits can depend on what its neighbours have. On a floor with relief,
#: :data:`ON_RELIEF`: MuJoCo's model is then another one.
FEATURES = frozenset({"drive", "backlash", "ground", "friction_map", "compliance", "brush"})
ON_RELIEF = FEATURES | {"relief", "waves", "bumps", "grid", "piece", "pieces"}

#: MuJoCo's state by lane: ``qpos`` and ``qvel``. Joints along the tree: leg, wheel, leg, wheel, ...
POSITION: tuple[str, ...] = (
    *(f"p{a}" for a in AXES),
    *(f"q{a}" for a in "wxyz"),
    *(f"{kind}_angle{i}" for i in CORNERS for kind in ("leg", "wheel")),
)
VELOCITY: tuple[str, ...] = (
    *(f"u{a}" for a in AXES),
    *(f"w{a}" for a in AXES),
    *(f"joint_rate{j}" for i in CORNERS for j in (i, FIRST_WHEEL + i)),
)
#: MuJoCo's results by lane: ``qfrc_constraint`` and the contact sensors (force on the wheel, floor frame).
CONSTRAINT: tuple[str, ...] = tuple(f"constraint_{name}" for name in VELOCITY)
CONTACT: tuple[str, ...] = tuple(f"floor_{a}{c}" for c in CONTACTS for a in AXES)
#: Generalised forces of formulas.
FORMULA: tuple[str, ...] = tuple(f"formula_{name}" for name in COORDINATES)

_KEPT = ("voltage", "share", "rotor_free", "rotor_gain", "ripple", "creep", "rotor_friction")
#: Kept from step to step beside MuJoCo's own state; the second part describes the last step, the third sums over the tick.
STATE: tuple[str, ...] = (
    *drive.STATE,
    *(f"gyro_{a}" for a in AXES),
    *(f"acceleration_{a}" for a in AXES),
    *(f"own_force_{a}{c}" for c in CONTACTS for a in "xy"),
    *(f"shear_{a}{c}" for c in CONTACTS for a in "xy"),
    *(f"place{c}" for c in CONTACTS),
    *(f"rolling_torque{i}" for i in CORNERS),
    *(f"old_spin{i}" for i in CORNERS),
    *(f"old_{v}{a}" for v in "uw" for a in AXES),
    *(f"old_rate{j}" for j in range(8)),
    *(f"{name}{j}" for j in range(8) for name in _KEPT),
    *(f"heading_{a}{c}" for c in CONTACTS for a in AXES),
    *(f"normal_{a}{c}" for c in CONTACTS for a in AXES),
    *(f"leg_arm_{a}{c}" for c in CONTACTS for a in AXES),
    *(f"rolling_radius{c}" for c in CONTACTS),
    *(f"force_{a}{c}" for c in CONTACTS for a in AXES),
    *(f"{name}{j}" for j in range(8) for name in ("motor_torque", "current_torque", "gear_torque")),
    *(f"slip_displacement_{a}{i}" for i in CORNERS for a in "xy"),
    "mechanical_energy",
    "electrical_energy",
    *body.SPOT_STATE,
)
TICK_SUMS: tuple[str, ...] = STATE[-len(body.SPOT_STATE) - 10 : -len(body.SPOT_STATE)]

#: Half the length (m) of the capsule that touches the floor with one end, and how far its axis leans up from the floor (rad).
CAPSULE_HALF_LENGTH = 0.01
CAPSULE_LEAN = math.pi / 6
#: MuJoCo's smallest friction coefficient.
LEAST_MU = 1e-5


def over(added: Out, lanes: Lanes) -> Lanes:
    """Lay lanes over others."""
    return ChainMap(added, lanes)  # pyright: ignore[reportArgumentType]  # nothing writes to them


def with_engine_rates(lanes: Lanes) -> Lanes:
    """Add the quasi-velocities of the engine: body-frame velocity of the body origin, absolute leg and wheel rates."""
    body = to_body(rotation_rows(lanes), vector(lanes, "u"))
    added: Out = {f"v{a}": value for a, value in zip(AXES, body, strict=True)}
    for i in CORNERS:
        added[f"leg_rate{i}"] = lanes["wy"] + lanes[f"joint_rate{i}"]
        added[f"wheel_rate{i}"] = added[f"leg_rate{i}"] + lanes[f"joint_rate{FIRST_WHEEL + i}"]
    return over(added, lanes)


def drift(lanes: Lanes, duration: Value) -> Out:
    """Move positions for ``duration`` at constant rates, forwards or backwards."""
    moved = engine.drift(with_engine_rates(lanes), duration)
    out: Out = {name: moved[name] for name in POSITION}
    out |= {f"p{a}": lanes[f"p{a}"] + duration * lanes[f"u{a}"] for a in AXES}
    for j in range(8):
        name = f"{'leg' if j < FIRST_WHEEL else 'wheel'}_angle{j % FIRST_WHEEL}"
        out[name] = lanes[name] + duration * lanes[f"joint_rate{j}"]
    return out | _drift_of_rotors(lanes, duration)


def _drift_of_rotors(lanes: Lanes, duration: Value) -> Out:
    lead = {f"rotor_lead{j}": lanes[f"rotor_rate{j}"] - lanes[f"joint_rate{j}"] for j in range(8)}
    return {name: lanes[name] + duration * rate for name, rate in lead.items()}


# ---- before a step ---------------------------------------------------------------------------------------------------


def before(lanes: Lanes, time: Value, step: Value, features: frozenset[str] = FEATURES) -> Out:
    """Servos, loads, and this step's model fields."""
    lanes = with_engine_rates(lanes)
    rows = rotation_rows(lanes)
    level = axes_on(rows[2])
    out: Out = {f"old_{v}{a}": lanes[f"{v}{a}"] for v in "uw" for a in AXES}
    applied = _loads(lanes, rows)
    joints = [_joint(lanes, j) for j in range(8)]
    commanded, voltages = drive.command(lanes, joints, time, step, FEATURES)
    out |= commanded
    for j, joint in enumerate(joints):
        pushed = drive.push(lanes, j, voltages[j], joint, step, 0.5 * step, FEATURES)
        _push_joint(lanes, j, voltages[j], joint, pushed, step, applied, out)
    for i in CORNERS:
        contacts = contacts_of(lanes, i, rows, level, ops.sin_cos(lanes[f"leg_angle{i}"]), features)
        kept = remembered(lanes, contacts, ("own_force_x", "own_force_y", "shear_x", "shear_y"), "force_z")
        out |= {name: value for name, value in kept.items() if name.startswith("place")}
        lanes = over(kept, lanes)
        pushed = [_push_contact(lanes, contact, rows, step, applied, out) for contact in contacts]
        normal, swing, spin = (reduce(add, each) for each in zip(*pushed, strict=True))
        _turn_wheel(lanes, i, normal, swing, spin, step, applied, out)
    out |= {f"applied_{name}": value for name, value in applied.items()}
    return out


def _joint(lanes: Lanes, j: int) -> drive.Joint:
    if j >= FIRST_WHEEL:
        angle = lanes[f"wheel_angle{j - FIRST_WHEEL}"]
        return drive.Joint(angle, lanes[f"joint_rate{j}"], angle)
    return drive.Joint(lanes[f"leg_angle{j}"], lanes[f"joint_rate{j}"], lanes[f"leg_angle{j}"] + lanes[f"zero_offset{j}"])


def _loads(lanes: Lanes, rows: list[Vector]) -> Out:
    """Applied generalised forces so far: external force, tether, formulas."""
    pull = [lanes["external_x"], lanes["external_y"], 0.0]
    for k, a in enumerate("xy"):
        pull[k] = pull[k] - lanes["tether_stiffness"] * (lanes[f"p{a}"] - lanes[f"anchor_{a}"])
    in_body = vector(lanes, "formula_body_force_")
    applied: Out = {}
    for k, a in enumerate(AXES):
        applied[f"u{a}"] = pull[k] + (lanes[f"formula_floor_force_{a}"] + dot(rows[k], in_body))
    for a, name in zip(AXES, ("roll", "pitch", "yaw"), strict=True):
        applied[f"w{a}"] = lanes[f"formula_body_torque_{name}"]
    names = list(COORDINATES)
    applied |= {f"joint_rate{j}": lanes[f"formula_{names[j]}"] for j in range(8)}
    return applied


def _push_joint(
    lanes: Lanes, j: int, voltage: Value, joint: drive.Joint, pushed: drive.Push, step: Value, applied: Out, out: Out
) -> None:
    """Motor torque, damping (see the module) and dry friction of joint ``j``; a gear with play rubs on its rotor, here."""
    name, play = f"joint_rate{j}", lanes[f"half_play{j}"]
    impulse, friction = drive.friction_on_rotor(pushed, joint.rate)
    impulse = ops.where_positive(play, impulse, pushed.impulse)
    applied[name] = applied[name] + (impulse - pushed.damping * joint.rate) * (1.0 / step)
    out[f"armature_{name}"] = lanes[f"joint_armature{j}"] + pushed.damping
    out[f"gear_bound_{name}"] = ops.where_positive(play, 0.0, pushed.bound * (1.0 / step))
    out[f"rotor_friction{j}"] = ops.where_positive(play, friction, 0.0)
    out[f"voltage{j}"], out[f"old_rate{j}"] = voltage, joint.rate
    out |= drive.kept_for_finish(pushed, j)


def _push_contact(lanes: Lanes, contact: Contact, rows: list[Vector], step: Value, applied: Out, out: Out) -> Vector:
    """Everything between a wheel and the floor at one contact but rolling resistance.

    Returns:
        The normal force (N), and the torque (N m) of the creep force about hip and axle.
    """
    c, i, (n, heading, lateral, _) = contact.number, contact.wheel, contact.axes
    leg, rim, point = contact.leg, contact.rim, contact.point
    arm = [leg[k] + rim[k] for k in range(3)]
    velocity = _point_velocity(lanes, i, point, arm, rim)
    gap = contact.gap(lanes)
    rise, out[f"rolling_radius{c}"] = rolling_contact(lanes, contact, FEATURES)
    assert rise is not None  # FEATURES know of tyres that flatten
    _place_sphere(lanes, contact, gap, dot(n, rise), out)
    if contact.depth is not None:
        _place_plane(lanes, contact, rows, out)
    approach = dot(n, velocity)
    point, arm, rim = ([x + y for x, y in zip(whole, rise, strict=True)] for whole in (point, arm, rim))
    velocity = _point_velocity(lanes, i, point, arm, rim)

    for k, a in enumerate(AXES):
        out[f"heading_{a}{c}"] = dot(rows[k], heading)
        if contact.depth is not None:
            out[f"normal_{a}{c}"] = dot(rows[k], n)
    for a, e in zip(AXES, (heading, lateral, n), strict=True):
        out[f"leg_arm_{a}{c}"] = arm[2] * e[0] - arm[0] * e[2]

    slip = [dot(heading, velocity), dot(lateral, velocity)]
    speed = ops.sqrt(slip[0] * slip[0] + slip[1] * slip[1])
    place = [lanes[f"p{a}"] + dot(rows[k], point) for k, a in enumerate("xy")]
    mu = ground.friction(lanes, i, place[0], place[1], speed, FEATURES)
    creeps, is_elastic = lanes[f"creep_speed{i}"], lanes[f"tread_stiffness{i}"]
    for a, value in (("x", mu.mu_x), ("y", mu.mu_y)):
        least = ops.where_positive(creeps, LEAST_MU, ops.maximum(value, LEAST_MU))
        out[f"friction_{a}{c}"] = ops.where_positive(is_elastic, LEAST_MU, least)

    push = ops.maximum(-(lanes[f"stiffness{i}"] * gap) - lanes[f"damping{i}"] * approach, 0.0)
    normal = ops.where_positive(-gap, push, 0.0)
    spin_inertia = lanes[f"wheel_spin{i}"] + out[f"armature_joint_rate{FIRST_WHEEL + i}"]
    creep = creep_force(lanes, contact, mu, normal, slip, speed, spin_inertia, step)
    elastic = tread_force(lanes, contact, mu, normal, slip, out[f"rolling_radius{c}"], spin_inertia, step, out)
    for k, a in enumerate("xy"):
        creep[k] = ops.where_positive(is_elastic, elastic[k], ops.where_positive(creeps, creep[k], 0.0))
        out[f"own_force_{a}{c}"] = creep[k]
    force = [creep[0] * heading[k] + creep[1] * lateral[k] for k in range(3)]
    for k, a in enumerate(AXES):
        applied[f"u{a}"] = applied[f"u{a}"] + dot(rows[k], force)
    for name, value in zip(("wx", "wy", "wz"), cross(point, force), strict=True):
        applied[name] = applied[name] + value
    return [normal, arm[2] * force[0] - arm[0] * force[2], rim[2] * force[0] - rim[0] * force[2]]


def _turn_wheel(lanes: Lanes, i: int, normal: Value, swing: Value, spin: Value, step: Value, applied: Out, out: Out) -> None:
    """Torques about hip and axle of wheel ``i``, which carries ``normal`` (N): of creep, and of rolling resistance."""
    rolling = rolling_torque(lanes, i, normal, lanes[f"wheel_spin{i}"] + lanes[f"joint_armature{FIRST_WHEEL + i}"], step)
    out[f"rolling_torque{i}"], out[f"old_spin{i}"] = rolling, lanes[f"wheel_rate{i}"]
    applied["wy"] = applied["wy"] + rolling
    applied[f"joint_rate{i}"] = applied[f"joint_rate{i}"] + (swing + rolling)
    applied[f"joint_rate{FIRST_WHEEL + i}"] = applied[f"joint_rate{FIRST_WHEEL + i}"] + (spin + rolling)


def _point_velocity(lanes: Lanes, i: int, point: Vector, arm: Vector, rim: Vector) -> Vector:
    """Velocity of the contact point of wheel ``i``, body frame."""
    turned = cross(vector(lanes, "w"), point)
    leg_rate, wheel_rate = lanes[f"joint_rate{i}"], lanes[f"joint_rate{FIRST_WHEEL + i}"]
    swing = [leg_rate * arm[2] + wheel_rate * rim[2], 0.0, -(leg_rate * arm[0] + wheel_rate * rim[0])]
    return [lanes[f"v{a}"] + turned[k] + swing[k] for k, a in enumerate(AXES)]


def _place_sphere(lanes: Lanes, contact: Contact, gap: Value, rise: Value, out: Out) -> None:
    """Place the capsule whose lower end stands for the wheel at a contact, in the wheel's frame.

    On a level floor the disc's lowest point lies a/cos(tilt) straight below a point of the axle that is a tan(tilt) off the
    wheel's plane. A sphere around it with radius a/cos(tilt) - gap overlaps the floor by twice -gap, halfway of which lies the
    disc's lowest point; the margin takes one -gap off again. Smaller by twice ``rise``, it is touched that much higher. High
    above the floor the gap is cut short, which keeps the radius positive. On relief the sphere is as large, and stands along
    the contact's normal over the point that is deepest.
    """
    c, i, (n, _, _, scale) = contact.number, contact.wheel, contact.axes
    sine, cosine = ops.sin_cos(lanes[f"leg_angle{i}"] + lanes[f"wheel_angle{i}"])
    reach = lanes[f"radius{i}"]
    if contact.depth is None:
        reach = reach * scale  # scale = 1/cos(tilt)
    level = [scale * ((1.0 if k == 1 else 0.0) - n[1] * n[k]) for k in range(3)]  # the axle's direction, laid on the floor
    axis = [math.cos(CAPSULE_LEAN) * level[k] + math.sin(CAPSULE_LEAN) * n[k] for k in range(3)]
    centre = [CAPSULE_HALF_LENGTH * x for x in axis]
    if contact.depth is None:
        centre[1] = centre[1] + reach * n[1]
    else:
        centre = [centre[k] + (contact.rim[k] + reach * n[k]) for k in range(3)]
    near = ops.minimum(gap, 0.5 * reach)
    out[f"geom_radius{c}"], out[f"margin{c}"] = reach - near - 2.0 * rise, near + 2.0 * rise
    for a, value in zip(AXES, _to_wheel(centre, sine, cosine), strict=True):
        out[f"geom_{a}{c}"] = value
    x, y, z = _to_wheel(axis, sine, cosine)
    w = ops.sqrt(0.5 + 0.5 * z)  # the shortest turn from z to the axis, whose y component keeps it away from -z
    if contact.depth is not None:
        w = ops.maximum(w, 1e-6)
    half = 0.5 / w
    out |= {f"geom_qw{c}": w, f"geom_qx{c}": -(y * half), f"geom_qy{c}": x * half}


def _place_plane(lanes: Lanes, contact: Contact, rows: list[Vector], out: Out) -> None:
    """Lay the plane that stands for the floor at a contact."""
    c, n, point = contact.number, contact.axes[0], contact.point
    normal = [dot(row, n) for row in rows]
    for k, a in enumerate(AXES):
        out[f"plane_{a}{c}"] = lanes[f"p{a}"] + dot(rows[k], point) + contact.depth * normal[k]
    w = ops.sqrt(0.5 + 0.5 * normal[2])
    half = 0.5 / w
    out |= {f"plane_qw{c}": w, f"plane_qx{c}": -(normal[1] * half), f"plane_qy{c}": normal[0] * half, f"plane_qz{c}": 0.0}


def _to_wheel(a: Vector, sine: Value, cosine: Value) -> Vector:
    """Turn a body-frame vector into the frame of a wheel that stands at an angle about y."""
    return [cosine * a[0] - sine * a[2], a[1], sine * a[0] + cosine * a[2]]


# ---- body and legs on the floor --------------------------------------------------------------------------------------


def nearness(lanes: Lanes, features: frozenset[str]) -> Out:
    """Return whether body or legs may touch the floor, and sums of pushes to begin with."""
    return body.nearness(lanes, features) | dict.fromkeys(body.PUSHES, 0.0)


def push_of_base(lanes: Lanes, features: frozenset[str]) -> Out:
    """Let the base push body and legs."""
    return body.push_of_base(with_engine_rates(lanes), features)


def push_of_piece(lanes: Lanes) -> Out:
    """Let a piece push body and legs."""
    return body.push_of_piece(with_engine_rates(lanes))


def touch(lanes: Lanes, step: Value, features: frozenset[str]) -> Out:
    """Add the forces of the floor on body and legs to the applied ones."""
    out, push, torque, legs = body.hold(with_engine_rates(lanes), step, features)
    more = dict(zip(VELOCITY, (*push, *torque), strict=False)) | {f"joint_rate{i}": leg for i, leg in enumerate(legs)}
    return out | {f"applied_{name}": lanes[f"applied_{name}"] + value for name, value in more.items()}


# ---- after a step ----------------------------------------------------------------------------------------------------


def after(lanes: Lanes, step: Value, features: frozenset[str] = FEATURES) -> Out:
    """Forces, torques, energies, slip and the inertial sensors' low-pass of the step that was just made."""
    lanes = with_engine_rates(lanes)
    out: Out = {}
    for i in CORNERS:
        _read_wheel(lanes, i, features, out)
    _add_slip(lanes, step, features, out)
    mechanical, electrical = lanes["mechanical_energy"], lanes["electrical_energy"]
    for j in range(8):
        rates = lanes[f"old_rate{j}"], lanes[f"joint_rate{j}"]
        friction = lanes[f"rotor_friction{j}"]
        done = drive.finish(lanes, j, lanes[f"voltage{j}"], *rates, friction, step, FEATURES)
        mechanical, electrical = mechanical + done.pop(f"work{j}"), electrical + done.pop(f"electrical_work{j}")
        crept = done.pop(f"crept{j}") * (1.0 / step)
        out |= done
        torque = ops.where_positive(lanes[f"half_play{j}"], friction * (1.0 / step), out[f"gear_torque{j}"])
        out[f"gear_torque{j}"] = torque + crept
    out["mechanical_energy"], out["electrical_energy"] = mechanical, electrical
    out |= _drift_of_rotors(over(out, lanes), step)
    push = [(lanes[f"u{a}"] - lanes[f"old_u{a}"]) * (1.0 / step) - lanes[f"gravity_{a}"] for a in AXES]
    specific_force = to_body(rotation_rows(lanes), push)
    for k, a in enumerate(AXES):
        mean_rate = 0.5 * (lanes[f"old_w{a}"] + lanes[f"w{a}"])
        for name, value in ((f"acceleration_{a}", specific_force[k]), (f"gyro_{a}", mean_rate)):
            out[name] = lanes[name] + lanes["low_pass"] * (value - lanes[name])
    return out


def _read_wheel(lanes: Lanes, i: int, features: frozenset[str], out: Out) -> None:
    """Contact forces on wheel ``i``; gear friction is what the constraints do to a joint beyond them."""
    leg, wheel = lanes[f"constraint_joint_rate{i}"], lanes[f"constraint_joint_rate{FIRST_WHEEL + i}"]
    for c in contact_numbers(i, features):
        along, across, normal = _force_along_axes(lanes, c, features)
        moment = lanes[f"leg_arm_x{c}"] * along + lanes[f"leg_arm_y{c}"] * across + lanes[f"leg_arm_z{c}"] * normal
        leg, wheel = leg - moment, wheel + lanes[f"rolling_radius{c}"] * along
        out[f"force_x{c}"], out[f"force_y{c}"] = along + lanes[f"own_force_x{c}"], across + lanes[f"own_force_y{c}"]
        out[f"force_z{c}"] = normal
    out[f"gear_torque{i}"], out[f"gear_torque{FIRST_WHEEL + i}"] = leg, wheel


def _force_along_axes(lanes: Lanes, c: int, features: frozenset[str]) -> Vector:
    """MuJoCo's force at contact ``c`` along heading, axle and normal, N."""
    floor = [lanes[f"floor_{a}{c}"] for a in AXES]
    if "relief" not in features:
        cosine, sine = lanes[f"heading_x{c}"], lanes[f"heading_y{c}"]
        return [cosine * floor[0] + sine * floor[1], cosine * floor[1] - sine * floor[0], floor[2]]
    heading, normal = ([lanes[f"{name}_{a}{c}"] for a in AXES] for name in ("heading", "normal"))
    return [dot(floor, heading), dot(floor, cross(normal, heading)), dot(floor, normal)]


def _add_slip(lanes: Lanes, step: Value, features: frozenset[str], out: Out) -> None:
    rows = rotation_rows(lanes)
    level = axes_on(rows[2])
    twist = [*vector(lanes, "v"), *vector(lanes, "w")]
    for i in CORNERS:
        contact = contacts_of(lanes, i, rows, level, ops.sin_cos(lanes[f"leg_angle{i}"]), features)[0]
        slip = slip_velocity(lanes, contact, twist, FEATURES)
        for a, speed in zip("xy", slip, strict=True):
            out[f"slip_displacement_{a}{i}"] = lanes[f"slip_displacement_{a}{i}"] + step * speed


# ---- observation at the end of a control tick ------------------------------------------------------------------------


def observe(lanes: Lanes, features: frozenset[str] = FEATURES) -> Out:
    """Columns of the truth matrix, then the raw sensor channels: the engine's observation of the same state."""
    lanes = with_engine_rates(lanes)
    renamed: Out = {f"friction_{a}{c}": lanes[f"force_{a}{c}"] for c in CONTACTS for a in "xy"}
    renamed |= {f"normal{c}": lanes[f"force_z{c}"] for c in CONTACTS}
    renamed |= {f"gear_friction{j}": lanes[f"gear_torque{j}"] for j in range(8)}
    renamed |= {f"rolling_friction{i}": lanes[f"rolling_torque{i}"] for i in CORNERS}
    out = engine.observe(over(renamed, lanes), 1.0, features)  # impulses over a step of 1 are forces
    for j in range(8):
        out[f"joint_velocity_{j}"] = out[f"raw_velocity_{j}"] = lanes[f"joint_rate{j}"]
    return out


def formula_inputs(lanes: Lanes, features: frozenset[str] = FEATURES) -> Out:
    """What formula forces may depend on, at the start of a step (``plants.forces.INPUTS``)."""
    seen = observe(lanes, features)
    seen["supply_voltage"] = seen["raw_supply"]
    return {name: seen[name] for name in INPUTS_OF_FORMULAS}


# ---- under a wheel: rolling resistance and tyre creep, which MuJoCo does not have ------------------------------------


#: Gains of the integral hold of rolling resistance on the spin and on its change, in wheel inertia over the step.
HOLD_SPIN = 0.2
HOLD_CHANGE = 0.8
#: Above this many steps of braking by its bound, rolling resistance brakes fully.
HOLD_REACH = 8.0
#: Slip speed (m/s) below which a direction of slip means nothing.
LEAST_SLIP = 1e-9


def _relaxed(old: Value, target: Value, stiffness: Value) -> Value:
    """A force that falls steeply with the rate it acts on, explicit but stable at any step.

    ``target`` is the force at the present rate, ``stiffness`` = -d force/d rate * step / apparent mass. The rate after the step
    follows from the force: force = target + stiffness (old - force). Exact where the force is steady; where it changes it lags
    by ``stiffness`` steps. For an apparent mass that is off by a factor c the scheme is stable for all c > 1/4.
    """
    return (target + stiffness * old) * (1.0 / (1.0 + stiffness))


def rolling_torque(lanes: Lanes, i: int, normal: Value, inertia: Value, step: Value) -> Value:
    """Rolling resistance: brakes the absolute spin with at most c N a; at rest it holds.

    Below the spin that the bound takes away in HOLD_REACH steps, the torque follows the spin, and its change, until there is
    none (an integral hold): a load below the bound does not turn the wheel. Stable for every apparent inertia from the wheel's
    own, k = 1, up: z^2 - (2 - k) z + 1 - HOLD_CHANGE k = 0 with k = own/apparent inertia.
    """
    spin, old = lanes[f"wheel_rate{i}"], lanes[f"old_spin{i}"]
    bound = lanes[f"rolling{i}"] * lanes[f"radius{i}"] * normal
    change = HOLD_SPIN * spin + HOLD_CHANGE * (spin - old)
    hold = ops.clip(lanes[f"rolling_torque{i}"] - (inertia * change) * (1.0 / step), -bound, bound)
    turns = inertia * ops.absolute(spin) - HOLD_REACH * (step * bound)
    return ops.where_positive(turns, -(bound * ops.sign(spin)), hold)


def creep_force(
    lanes: Lanes,
    contact: Contact,
    mu: ground.Friction,
    normal: Value,
    slip: Vector,
    speed: Value,
    spin_inertia: Value,
    step: Value,
) -> Vector:
    """Tyre creep: N tanh(speed/creep_speed) along (mu_x^2 s_x, mu_y^2 s_y), against the slip."""
    c, i = contact.number, contact.wheel
    share, _ = ground.creep_share(lanes, i, speed)
    ease = ops.sqrt(mu.mu_x * mu.mu_x * (slip[0] * slip[0]) + mu.mu_y * mu.mu_y * (slip[1] * slip[1])) + LEAST_SLIP * mu.mu_x
    inverse_spin = lanes[f"radius{i}"] * lanes[f"radius{i}"] * (1.0 / spin_inertia)
    lightness = [lanes[f"contact_lightness_x{i}"] + inverse_spin, lanes[f"contact_lightness_y{i}"]]
    slope = normal * share * (1.0 / (ease + 1e-30))
    force: Vector = []
    for k, (a, m) in enumerate((("x", mu.mu_x), ("y", mu.mu_y))):
        own = m * m * slope
        force.append(_relaxed(lanes[f"own_force_{a}{c}"], -(own * slip[k]), step * (own * lightness[k])))
    x, y = force[0] * mu.inverse_mu_x, force[1] * mu.inverse_mu_y
    shrink = ops.minimum(normal / ops.sqrt(x * x + y * y + 1e-30), 1.0)
    return [shrink * f for f in force]


def tread_force(
    lanes: Lanes,
    contact: Contact,
    mu: ground.Friction,
    normal: Value,
    slip: Vector,
    radius: Value,
    spin_inertia: Value,
    step: Value,
    out: Out,
) -> Vector:
    """Force (N) of an elastic tread along heading and axle (:func:`wlr_gym.physics.plants.ground.tread`), and its new shear.

    The shear first follows the slip that the last step has left; what this step adds is taken as in :func:`_relaxed`.
    """
    c, i = contact.number, contact.wheel
    found = ground.tread(lanes, i, normal, ops.absolute(radius * lanes[f"wheel_rate{i}"]), step)
    inverse_spin = lanes[f"radius{i}"] * lanes[f"radius{i}"] * (1.0 / spin_inertia)
    lightness = [lanes[f"contact_lightness_x{i}"] + inverse_spin, lanes[f"contact_lightness_y{i}"]]
    drag = step * found.held + lanes[f"tread_damping{i}"]
    inverse_stiffness = 1.0 / ops.maximum(found.stiffness, 1e-9)
    shear = [(lanes[f"shear_{a}{c}"] + step * slip[k]) * (found.held * inverse_stiffness) for k, a in enumerate("xy")]
    force: Vector = []
    for k, a in enumerate("xy"):
        target = -(found.held * shear[k] + drag * slip[k])
        force.append(_relaxed(lanes[f"own_force_{a}{c}"], target, step * lightness[k] * drag))
    x, y = force[0] * mu.inverse_mu_x, force[1] * mu.inverse_mu_y
    shrink = ops.minimum(normal / ops.sqrt(x * x + y * y + 1e-30), 1.0)
    for k, a in enumerate("xy"):
        force[k] = shrink * force[k]
        strained = ops.where_positive(1.0 - shrink, -(force[k] * inverse_stiffness), shear[k])
        out[f"shear_{a}{c}"] = ops.where_positive(normal, strained, 0.0)
    return force
