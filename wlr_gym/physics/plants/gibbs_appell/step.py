"""One time step of the engine, written once as generic scalar arithmetic; ``kernel.py`` traces it into compiled code.

Quasi-velocities: body-frame velocity of the body origin v (3), body-frame angular velocity w (3), absolute leg pitch
rates (4), absolute wheel spin rates (4). The world frame is the floor frame; on a slope gravity is inclined.

The step (drift - kick - drift, Moreau's midpoint rule):

1. positions drift half a step with the old velocities;
2. the kick solves Gauss's principle at the middle position: the new velocities minimise the Gibbs function's quadratic
   form 1/2 (u - u*)' M (u - u*) + h D(u), where u* is the free motion and D the Coulomb dissipation of the four contacts
   (elliptic, in each wheel's heading frame), the eight gear frictions and rolling resistance. Minimised by exact block
   coordinate descent: 2x2 per contact, 1x1 per joint, warm started;
3. positions drift half a step with the new velocities.

Velocity-dependent inertia terms use the velocities extrapolated to the middle of the step, which makes smooth motion
second order. Normal forces come from the contact spring at the middle position and are therefore known before friction is
solved, so that the friction problem is convex and has one solution. Back-EMF and viscous friction are implicit with an
exponentially fitted weight: a free motor follows its closed form exactly at any step.

Here: the drifts, the end of the kick, and what is shown of the state. The kick's problem is set up and
solved in ``gauss.py``; ``kinematics.py`` has the geometry and the names.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from wlr_gym.physics.codegen import ops
from wlr_gym.physics.codegen.ops import Lanes, Out, Value, Vector
from wlr_gym.physics.plants import body, drive, ground, relief
from wlr_gym.physics.plants.contacts import (
    AXES,
    CORNERS,
    Contact,
    axes_on,
    contact_numbers,
    contact_place,
    contacts_of,
    cross,
    dot,
    rotation_rows,
    slip_velocity,
    to_body,
    vector,
)
from wlr_gym.physics.plants.gibbs_appell.kinematics import INPUTS_OF_FORMULAS, SINGLE, TURN, joints_of, wheel_angle
from wlr_gym.robot import FIRST_WHEEL


def drift(lanes: Lanes, duration: Value, features: frozenset[str] = frozenset()) -> Out:
    """Move positions for ``duration`` at constant rates; the body-frame velocity turns with the body (Cayley map)."""
    v, w = vector(lanes, "v"), vector(lanes, "w")
    rows = rotation_rows(lanes)
    out: Out = {f"p{a}": lanes[f"p{a}"] + duration * dot(rows[k], v) for k, a in enumerate(AXES)}
    half = [0.5 * duration * x for x in w]
    scale = 1.0 / ops.sqrt(1.0 + dot(half, half))
    e0, e = scale, [scale * x for x in half]
    q0, q = lanes["qw"], vector(lanes, "q")
    turned = cross(q, e)
    new = [q0 * e0 - dot(q, e), *(q0 * e[k] + q[k] * e0 + turned[k] for k in range(3))]
    norm = 1.5 - 0.5 * dot(new, new)  # one Newton step keeps the quaternion at unit length
    for name, value in zip("wxyz", new, strict=True):
        out[f"q{name}"] = value * norm
    if SINGLE in features:
        out |= _compensated(lanes, {f"p{a}": duration * dot(rows[k], v) for k, a in enumerate("xy")})
    t = [2.0 * x for x in cross(v, e)]  # v in the turned frame: rotate by the inverse increment
    t2 = cross(t, e)
    for k, a in enumerate(AXES):
        out[f"v{a}"] = v[k] + e0 * t[k] + t2[k]
    for i in CORNERS:
        out[f"leg_angle{i}"] = lanes[f"leg_angle{i}"] + duration * (lanes[f"leg_rate{i}"] - w[1])
        out[f"wheel_angle{i}"] = lanes[f"wheel_angle{i}"] + duration * (lanes[f"wheel_rate{i}"] - lanes[f"leg_rate{i}"])
    if "backlash" in features:
        for j, joint in enumerate(joints_of(lanes, features)):
            out[f"rotor_lead{j}"] = lanes[f"rotor_lead{j}"] + duration * (lanes[f"rotor_rate{j}"] - joint.rate)
    return out


def _compensated(lanes: Lanes, changes: Mapping[str, Value]) -> Out:
    """Add changes by Kahan's sum: far from the origin single precision rounds off much of what a step adds."""
    out: Out = {}
    for name, change in changes.items():
        wanted = change - lanes[f"rounding_{name}"]
        new = lanes[name] + wanted
        out |= {name: new, f"rounding_{name}": (new - lanes[name]) - wanted}
    return out


def kick_finish(lanes: Lanes, step: Value, features: frozenset[str]) -> Out:
    """Back-substitute the new velocities; motor torques, energies, slip and the inertial sensors' low-pass."""
    u: list[Value] = [0.0] * 6
    for r in reversed(range(6)):
        s = lanes[f"base{r}"]
        for k in range(r + 1, 6):
            s = s - lanes[f"lower{k}{r}"] * u[k]
        u[r] = s * lanes[f"inverse_diagonal{r}"]
    out: Out = {}
    new_rates: list[Value] = [0.0] * 8
    old_rates: list[Value] = [0.0] * 8
    for i in CORNERS:
        pull = dot([lanes[f"coupling{i}_{r}"] for r in range(6)], u)
        leg_rate = lanes[f"y_leg{i}"] - lanes[f"i11_{i}"] * pull
        wheel_rate = lanes[f"y_wheel{i}"] - lanes[f"i12_{i}"] * pull
        out[f"leg_rate{i}"], out[f"wheel_rate{i}"] = leg_rate, wheel_rate
        out[f"last_leg_rate{i}"], out[f"last_wheel_rate{i}"] = lanes[f"leg_rate{i}"], lanes[f"wheel_rate{i}"]
        new_rates[i], new_rates[FIRST_WHEEL + i] = leg_rate - u[4], wheel_rate - leg_rate
        old_rates[i] = lanes[f"leg_rate{i}"] - lanes["wy"]
        old_rates[FIRST_WHEEL + i] = lanes[f"wheel_rate{i}"] - lanes[f"leg_rate{i}"]
        for a, slip in zip("xy", _slip_after(lanes, i), strict=True):
            name = f"slip_displacement_{a}{i}"
            out[name] = lanes[name] + step * slip
    if "brush" in features:
        for i in CORNERS:
            for c in contact_numbers(i, features):
                out |= _strained_tread(lanes, c, step)
    mechanical, electrical = lanes["mechanical_energy"], lanes["electrical_energy"]
    for j in range(8):
        friction = lanes[f"gear_friction{j}"]
        done = drive.finish(lanes, j, lanes[f"drive{j}"], old_rates[j], new_rates[j], friction, step, features)
        mechanical = mechanical + done.pop(f"work{j}")
        electrical = electrical + done.pop(f"electrical_work{j}")
        out[f"gear_friction{j}"] = friction + done.pop(f"crept{j}")
        out |= done
    out["mechanical_energy"], out["electrical_energy"] = mechanical, electrical
    gravity = to_body(rotation_rows(lanes), vector(lanes, "gravity_"))
    for k, a in enumerate(AXES):
        out[f"v{a}"], out[f"w{a}"], out[f"last_w{a}"] = u[k], u[3 + k], lanes[f"w{a}"]
        specific_force = (u[k] - lanes[f"v{a}"]) * (1.0 / step) - gravity[k]
        out[f"acceleration_{a}"] = lanes[f"acceleration_{a}"] + lanes["low_pass"] * (
            specific_force - lanes[f"acceleration_{a}"]
        )
        mean_rate = 0.5 * (lanes[f"w{a}"] + u[3 + k])  # over the step: the rate at its end would come half a step early
        out[f"gyro_{a}"] = lanes[f"gyro_{a}"] + lanes["low_pass"] * (mean_rate - lanes[f"gyro_{a}"])
    return out


def touch(lanes: Lanes, step: Value, features: frozenset[str]) -> Out:
    """Add the impulses of body and legs on the floor to the Gauss problem that is set up; where nothing is near, none."""
    out, push, torque, legs = body.hold(lanes, step, features)
    momentum = [step * x for x in (*to_body(rotation_rows(lanes), push), *torque)]
    near = lanes["near"]
    for i, leg in enumerate(legs):  # a leg's rate is absolute: what turns it does not turn the body
        momentum[4] = momentum[4] - step * leg
        on_leg = lanes[f"i11_{i}"] * (step * leg)
        momentum = [momentum[r] - lanes[f"coupling{i}_{r}"] * on_leg for r in range(6)]
        for name, change in ((f"y_leg{i}", on_leg), (f"y_wheel{i}", lanes[f"i12_{i}"] * (step * leg))):
            out[name] = ops.where_positive(near, lanes[name] + change, lanes[name])
    white: Vector = []
    for r in range(6):
        rest = momentum[r]
        for k in range(r):
            rest = rest - lanes[f"lower{r}{k}"] * white[k]
        white.append(rest * lanes[f"inverse_diagonal{r}"])
        out[f"base{r}"] = ops.where_positive(near, lanes[f"base{r}"] + white[r], lanes[f"base{r}"])
    return out


def _slip_after(lanes: Lanes, c: int) -> Iterator[Value]:
    """Yield the slip (m/s) of contact ``c`` along heading and axle under the final impulses."""
    i = c % len(CORNERS)
    for a, wheel_entry in (("x", -lanes[f"rolling_radius{c}"]), ("y", 0.0)):
        z = [lanes[f"z_{a}{c}_{r}"] for r in range(6)]
        slip = dot(z, [lanes[f"base{r}"] for r in range(6)]) + lanes[f"leg_entry_{a}{c}"] * lanes[f"y_leg{i}"]
        yield slip + wheel_entry * lanes[f"y_wheel{i}"]


def _strained_tread(lanes: Lanes, c: int, step: Value) -> Out:
    """Shear of the tread at contact ``c`` after the step; where it slides, as much as the friction holds."""
    impulse = [lanes[f"friction_{a}{c}"] for a in "xy"]
    scaled = [impulse[k] * lanes[f"acting_inverse_mu_{a}{c}"] for k, a in enumerate("xy")]
    slides = ops.sqrt(scaled[0] * scaled[0] + scaled[1] * scaled[1]) - (1.0 - 1e-6) * lanes[f"bound{c}"]
    inverse = 1.0 / ops.maximum(lanes[f"tread{c}"], 1e-9)
    out: Out = {}
    for k, (a, slip) in enumerate(zip("xy", _slip_after(lanes, c), strict=True)):
        stuck = (lanes[f"shear_{a}{c}"] + step * slip) * (lanes[f"held{c}"] * inverse)
        strained = ops.where_positive(slides, -(impulse[k] * (1.0 / step)) * inverse, stuck)
        touches = ops.minimum(lanes[f"bound{c}"], lanes[f"tread{c}"])
        out[f"shear_{a}{c}"] = ops.where_positive(touches, strained, 0.0)
    return out


def observe(lanes: Lanes, step: Value, features: frozenset[str] = frozenset()) -> Out:
    """Columns of the truth matrix, in the order of TRUTH_LAYOUT, then the raw sensor channels."""
    rows = rotation_rows(lanes)
    level = axes_on(rows[2])
    v, w = vector(lanes, "v"), vector(lanes, "w")
    out: Out = {f"position_{a}": lanes[f"p{a}"] for a in AXES}
    out |= {f"quaternion_{a}": lanes[f"q{a}"] for a in "wxyz"}
    out |= {f"linear_velocity_in_body_{a}": lanes[f"v{a}"] for a in AXES}
    out |= {f"angular_velocity_in_body_{a}": lanes[f"w{a}"] for a in AXES}
    out |= {f"joint_position_{j}": lanes[f"{'leg' if j < FIRST_WHEEL else 'wheel'}_angle{j % FIRST_WHEEL}"] for j in range(8)}
    if SINGLE in features:
        wheels = {i: wheel_angle(lanes, i, features) + TURN * lanes[f"turns{i}"] for i in CORNERS}
        out |= {f"joint_position_{FIRST_WHEEL + i}": angle for i, angle in wheels.items()}
    out |= {f"joint_velocity_{i}": lanes[f"leg_rate{i}"] - w[1] for i in CORNERS}
    out |= {f"joint_velocity_{FIRST_WHEEL + i}": lanes[f"wheel_rate{i}"] - lanes[f"leg_rate{i}"] for i in CORNERS}
    out |= {f"motor_torque_{j}": lanes[f"motor_torque{j}"] for j in range(8)}
    out |= {f"friction_torque_{j}": lanes[f"gear_friction{j}"] * (1.0 / step) for j in range(8)}
    out |= {f"rolling_torque_{i}": lanes[f"rolling_friction{i}"] * (1.0 / step) for i in CORNERS}
    frictions: list[ground.Friction] = []
    for i in CORNERS:
        for a in "xy":
            out[f"contact_force_{i}_{a}"] = lanes[f"friction_{a}{i}"] * (1.0 / step)
        out[f"contact_force_{i}_z"] = lanes[f"normal{i}"]
    for i in CORNERS:  # where there are two contacts: the forces of both, along the axes of the deeper one, and its slip
        contact, *others = contacts_of(lanes, i, rows, level, ops.sin_cos(lanes[f"leg_angle{i}"]), features)
        for other in others:
            for a, share in zip(AXES, _turned(_force_at(lanes, other, step), other, contact), strict=True):
                out[f"contact_force_{i}_{a}"] = out[f"contact_force_{i}_{a}"] + share
        slip = slip_velocity(lanes, contact, [*v, *w], features)
        out[f"slip_velocity_{i}_x"], out[f"slip_velocity_{i}_y"] = slip
        place = contact_place(lanes, rows, contact)
        speed = ops.sqrt(slip[0] * slip[0] + slip[1] * slip[1])
        frictions.append(ground.friction(lanes, i, place[0], place[1], speed, features))
    out |= {f"slip_displacement_{i}_{a}": lanes[f"slip_displacement_{a}{i}"] for i in CORNERS for a in "xy"}
    for i, found in enumerate(frictions):
        out[f"effective_friction_{i}_x"], out[f"effective_friction_{i}_y"] = found.mu_x, found.mu_y
    # own names: outputs lie side by side, apart from the stored sums they show
    out["shown_mechanical_energy"], out["shown_electrical_energy"] = lanes["mechanical_energy"], lanes["electrical_energy"]
    out["body_clearance"] = _clearance(lanes, rows, features)
    # from here on: RAW_LAYOUT of plants/sensors.py; the heading's cosine and sine stand for its yaw
    out |= {f"raw_position_{j}": out[f"joint_position_{j}"] for j in range(8)}
    out |= {f"raw_velocity_{j}": out[f"joint_velocity_{j}"] for j in range(8)}
    effort = "current_torque" if "drive" in features else "motor_torque"
    out |= {f"raw_effort_{j}": lanes[f"{effort}{j}"] * lanes[f"effort_scale{j}"] for j in range(8)}
    out |= {f"raw_gyro_{a}": lanes[f"gyro_{a}"] for a in AXES}
    out |= {f"raw_acceleration_{a}": lanes[f"acceleration_{a}"] for a in AXES}
    out["raw_supply"] = drive.supply_voltage(lanes, features)
    height, floor = lanes["pz"], 0.0
    if "relief" in features:
        floor = relief.floor_height(lanes, lanes["px"], lanes["py"], features)
        height = height - floor
    out |= {"raw_height": height, "raw_floor": floor} | {f"raw_quaternion_{a}": lanes[f"q{a}"] for a in "wxyz"}
    out |= {"raw_x": lanes["px"], "raw_y": lanes["py"], "heading_cosine": rows[0][0], "heading_sine": rows[1][0]}
    return out


def _force_at(lanes: Lanes, contact: Contact, step: Value) -> Vector:
    """Force of the last step at a contact, along its heading, its lateral axis and its normal, N."""
    along = [lanes[f"friction_{a}{contact.number}"] * (1.0 / step) for a in "xy"]
    return [*along, lanes[f"normal{contact.number}"]]


def _turned(force: Vector, own: Contact, other: Contact) -> Vector:
    """Return a force along one contact's heading, lateral axis and normal along those of another."""
    (n, heading, lateral, _), (up, ahead, aside, _) = own.axes, other.axes
    in_body = [force[0] * heading[k] + force[1] * lateral[k] + force[2] * n[k] for k in range(3)]
    return [dot(in_body, axis) for axis in (ahead, aside, up)]


def _clearance(lanes: Lanes, rows: list[Vector], features: frozenset[str]) -> Value:
    """Height (m) above the floor of that lower corner of the body which is nearest to it."""
    n, half = rows[2], [lanes[f"half_size_{a}"] for a in AXES]
    if "relief" not in features:
        reach = [ops.absolute(n[k]) * half[k] for k in range(3)]
        return lanes["pz"] - reach[0] - reach[1] - reach[2]
    least: Value = 1e3
    lower = ops.where_positive(n[2], -half[2], half[2])
    for x, y in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):
        corner = [lanes[f"p{a}"] + dot(rows[k], [x * half[0], y * half[1], lower]) for k, a in enumerate(AXES)]
        least = ops.minimum(least, corner[2] - relief.floor_height(lanes, corner[0], corner[1], features))
    return least


def sense(lanes: Lanes, step: Value, features: frozenset[str]) -> Out:
    """What formula forces read at the start of a substep."""
    seen = observe(lanes, step, features)
    seen["supply_voltage"] = seen["raw_supply"]
    return {f"formula_input_{name}": seen[name] for name in INPUTS_OF_FORMULAS}
