"""The kick's Gauss problem: mass matrix, free motion, friction rows and their bounds, at the middle position of a step.

Legs and wheels are taken out of the system, so that a 6x6 base matrix is left; its Cholesky factor whitens the friction rows,
which :mod:`wlr_gym.physics.plants.gibbs_appell.gauss` then solves.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from wlr_gym.physics.codegen import ops
from wlr_gym.physics.codegen.ops import Lanes, Out, Value, Vector
from wlr_gym.physics.model.equations import assembly_terms, platform_terms
from wlr_gym.physics.plants import drive, ground
from wlr_gym.physics.plants.contacts import (
    AXES,
    CORNERS,
    Contact,
    axes_on,
    contact_place,
    contacts_of,
    dot,
    remembered,
    rolling_contact,
    rotation_rows,
    slip_velocity,
    to_body,
    vector,
)
from wlr_gym.physics.plants.gibbs_appell.kinematics import ASSEMBLY, PLATFORM, joints_of
from wlr_gym.robot import FIRST_WHEEL, JOINTS

#: What a contact keeps from step to step.
_KEPT = ("normal", "last_gap_rate", "friction_x", "friction_y", "multiplier")
_KEPT_BY_TREAD = ("shear_x", "shear_y")


@dataclass
class Corner:
    """One leg with its wheel while the Gauss problem is being set up.

    Attributes:
        coupling: leg-rate column of the mass matrix against the six base rows.
        leg_leg, leg_wheel, wheel_wheel: its own 2x2 block.
        leg_bias, wheel_bias: velocity-dependent inertia terms.
        contacts: of the wheel.
        block, inverse: the 2x2 block with implicit damping as (11, 12, 22), and its inverse.
        free: free motion of the pair for a resting base.
    """

    coupling: Vector
    leg_leg: Value
    leg_wheel: Value
    wheel_wheel: Value
    leg_bias: Value
    wheel_bias: Value
    trig: tuple[Value, Value]
    contacts: list[Contact] = field(default_factory=list)
    block: tuple[Value, Value, Value] = (0.0, 0.0, 0.0)
    inverse: tuple[Value, Value, Value] = (0.0, 0.0, 0.0)
    free: tuple[Value, Value] = (0.0, 0.0)


def kick_setup(lanes: Lanes, time: Value, step: Value, features: frozenset[str]) -> Out:
    """Build the Gauss problem of one substep: reduced base matrix, free motion, friction rows, impulse bounds."""
    rows = rotation_rows(lanes)
    level = axes_on(rows[2])
    gravity = to_body(rows, vector(lanes, "gravity_"))
    v, w = vector(lanes, "v"), vector(lanes, "w")
    u_base = [*(v[k] + step * gravity[k] for k in range(3)), *w]  # uniform gravity accelerates every point alike
    w_mid = [1.5 * w[k] - 0.5 * lanes[f"last_w{a}"] for k, a in enumerate(AXES)]
    joints = joints_of(lanes, features)
    out, voltages = drive.command(lanes, joints, time, step, features)
    mass, bias, corners = _inertia(lanes, w_mid)

    momentum: list[Value] = [dot(mass[r], u_base) - step * bias[r] for r in range(6)]
    _push_of_surroundings(lanes, rows, step, features, momentum)
    reduced = [row[:] for row in mass]
    for i, corner in enumerate(corners):
        leg_rate, wheel_rate = lanes[f"leg_rate{i}"], lanes[f"wheel_rate{i}"]
        for r in range(6):
            momentum[r] = momentum[r] + corner.coupling[r] * leg_rate
        own = [
            dot(corner.coupling, u_base) + corner.leg_leg * leg_rate + corner.leg_wheel * wheel_rate - step * corner.leg_bias,
            corner.leg_wheel * leg_rate + corner.wheel_wheel * wheel_rate - step * corner.wheel_bias,
        ]
        corner.contacts = contacts_of(lanes, i, rows, level, corner.trig, features)
        kept = remembered(lanes, corner.contacts, _KEPT + (_KEPT_BY_TREAD if "brush" in features else ()), "normal")
        out |= {name: value for name, value in kept.items() if name.startswith(("place", "multiplier", "shear"))}
        lanes = ChainMap(kept, lanes)  # pyright: ignore[reportArgumentType]  # nothing writes to them
        for contact in corner.contacts:
            _push_of_floor(lanes, contact, [*v, *w], step, momentum, own, out)
        damping = _push_of_motors(lanes, i, voltages, joints, step, features, momentum, own, out)
        for contact in corner.contacts:
            _friction_under_wheel(lanes, contact, rows, [*v, *w], features, out)
            if "brush" in features:
                _tread_under_wheel(lanes, contact, step, features, out)
        _eliminate(corner, damping, own, momentum, reduced)

    lower, inverse_diagonal = _cholesky(reduced)

    def whiten(b: Vector) -> Vector:
        x: Vector = []
        for r in range(6):
            s = b[r]
            for k in range(r):
                s = s - lower[r][k] * x[k]
            x.append(s * inverse_diagonal[r])
        return x

    base = whiten(momentum)
    hinge = whiten([0.0, 0.0, 0.0, 0.0, -1.0, 0.0])
    for i, corner in enumerate(corners):
        white = whiten(corner.coupling)
        for r in range(6):
            out[f"coupling{i}_{r}"] = corner.coupling[r]
        out[f"i11_{i}"], out[f"i12_{i}"] = corner.inverse[0], corner.inverse[1]
        out[f"a11_{i}"], out[f"a12_{i}"], out[f"a22_{i}"] = corner.block
        out[f"y_leg{i}"], out[f"y_wheel{i}"] = corner.free
        _warm_start(lanes, i, corner.contacts, step, features, out)
        # friction rows: (base part, leg entry, wheel entry, impulse)
        local = {
            f"leg{i}": (hinge, 1.0, 0.0, out[f"share{i}"] * out[f"gear_friction{i}"]),
            f"wheel{i}": ([0.0] * 6, -1.0, 1.0, out[f"share{FIRST_WHEEL + i}"] * out[f"gear_friction{FIRST_WHEEL + i}"]),
        }
        if "rolling_resistance" in features:
            local[f"rolling{i}"] = ([0.0] * 6, 0.0, 1.0, out[f"rolling_friction{i}"])
        for contact in corner.contacts:
            c, (_, heading, lateral, _) = contact.number, contact.axes
            rise, radius = rolling_contact(lanes, contact, features)
            out[f"rolling_radius{c}"] = radius
            for e, name, wheel_entry in ((heading, "x", -radius), (lateral, "y", 0.0)):
                base_row, leg_entry = contact.row(e, rise)
                local[f"{name}{c}"] = (whiten(base_row), leg_entry, wheel_entry, out[f"friction_{name}{c}"])
                out[f"leg_entry_{name}{c}"] = leg_entry
        _friction_rows(lanes, i, corner, white, local, base, out)
    for r in range(6):
        out[f"base{r}"] = base[r]
        out[f"inverse_diagonal{r}"] = inverse_diagonal[r]
        for c in range(r):
            out[f"lower{r}{c}"] = lower[r][c]
    return out


def _inertia(lanes: Lanes, w_mid: Vector) -> tuple[list[list[Value]], list[Value], list[Corner]]:
    """Mass matrix and bias of the base, and the four corners, from the generated Gibbs-Appell equations."""
    mass: list[list[Value]] = [[0.0 for _ in range(6)] for _ in range(6)]
    bias: list[Value] = [0.0] * 6
    platform_mass, platform_bias = platform_terms(*(lanes[name] for name in PLATFORM), *w_mid)
    _accumulate(mass, bias, platform_mass, platform_bias)
    corners: list[Corner] = []
    for i in CORNERS:
        sine, cosine = ops.sin_cos(lanes[f"leg_angle{i}"])
        mid_rates = [1.5 * lanes[f"{name}{i}"] - 0.5 * lanes[f"last_{name}{i}"] for name in ("leg_rate", "wheel_rate")]
        arguments = [*(lanes[f"{name}{i}"] for name in ASSEMBLY), sine, cosine, *w_mid, *mid_rates]
        base_mass, base_bias, coupling, *own = assembly_terms(*arguments)
        _accumulate(mass, bias, base_mass, base_bias)
        corners.append(Corner([coupling.get(r, 0.0) for r in range(6)], *own, trig=(sine, cosine)))
    return mass, bias, corners


def _push_of_floor(lanes: Lanes, contact: Contact, twist: Vector, step: Value, momentum: Vector, own: Vector, out: Out) -> None:
    """Add the normal impulse of a contact."""
    c, i = contact.number, contact.wheel
    base_row, leg_entry = contact.row(contact.axes[0])
    normal, gap_rate = _normal_force(lanes, contact, dot(base_row, twist) + leg_entry * lanes[f"leg_rate{i}"])
    out[f"normal{c}"], out[f"last_gap_rate{c}"] = normal, gap_rate
    for r in range(6):
        momentum[r] = momentum[r] + (step * normal) * base_row[r]
    own[0] = own[0] + (step * normal) * leg_entry


def _push_of_surroundings(
    lanes: Lanes, rows: Sequence[Sequence[Value]], step: Value, features: frozenset[str], momentum: Vector
) -> None:
    """Add the impulses of external force, tether and formula forces on the body."""
    pull = [lanes[f"external_{a}"] - lanes["tether_stiffness"] * (lanes[f"p{a}"] - lanes[f"anchor_{a}"]) for a in "xy"]
    force = to_body(rows, [*pull, 0.0])
    for k in range(3):
        momentum[k] = momentum[k] + step * force[k]
    if "forces" not in features:
        return
    on_floor = to_body(rows, [lanes[f"formula_floor_force_{a}"] for a in AXES])
    for k, (a, turn) in enumerate(zip(AXES, ("roll", "pitch", "yaw"), strict=True)):
        momentum[k] = momentum[k] + step * (lanes[f"formula_body_force_{a}"] + on_floor[k])
        momentum[3 + k] = momentum[3 + k] + step * lanes[f"formula_body_torque_{turn}"]


def _push_of_motors(
    lanes: Lanes,
    i: int,
    voltages: Vector,
    joints: Sequence[drive.Joint],
    step: Value,
    features: frozenset[str],
    momentum: Vector,
    own: Vector,
    out: Out,
) -> tuple[Value, Value]:
    """Add the explicit impulses on both joints of leg ``i``; return their implicit damping (times the step)."""
    pushes: list[drive.Push] = []
    for j in (i, FIRST_WHEEL + i):
        pushed = drive.push(lanes, j, voltages[j], joints[j], step, step, features)
        pushes.append(pushed)
        out[f"drive{j}"], out[f"friction_bound{j}"] = voltages[j], pushed.bound
        out |= drive.kept_for_finish(pushed, j)
    leg, wheel = pushes
    momentum[4] = momentum[4] - leg.impulse
    own[0] = own[0] + leg.impulse - wheel.impulse
    own[1] = own[1] + wheel.impulse
    if "forces" in features:
        leg_torque, wheel_torque = (lanes[f"formula_{JOINTS[j]}"] for j in (i, FIRST_WHEEL + i))
        momentum[4] = momentum[4] - step * leg_torque
        own[0] = own[0] + step * (leg_torque - wheel_torque)
        own[1] = own[1] + step * wheel_torque
    return leg.damping, wheel.damping


def _friction_under_wheel(
    lanes: Lanes, contact: Contact, rows: Sequence[Sequence[Value]], twist: Vector, features: frozenset[str], out: Out
) -> None:
    """Find the friction coefficients of a contact, at its place and slip at the start of the kick."""
    place: list[Value] = [0.0, 0.0]
    speed: Value = 0.0
    if "ground" in features:
        place = contact_place(lanes, rows, contact)
        slip = slip_velocity(lanes, contact, twist, features)
        speed = ops.sqrt(slip[0] * slip[0] + slip[1] * slip[1])
    found, c = ground.friction(lanes, contact.wheel, place[0], place[1], speed, features), contact.number
    out[f"acting_mu_x{c}"], out[f"acting_mu_y{c}"] = found.mu_x, found.mu_y
    out[f"acting_inverse_mu_x{c}"], out[f"acting_inverse_mu_y{c}"] = found.inverse_mu_x, found.inverse_mu_y


def _tread_under_wheel(lanes: Lanes, contact: Contact, step: Value, features: frozenset[str], out: Out) -> None:
    """Stiffness of the tread at a contact, and the slip that its present shear stands for."""
    c, i = contact.number, contact.wheel
    _, radius = rolling_contact(lanes, contact, features)
    found = ground.tread(lanes, i, out[f"normal{c}"], ops.absolute(radius * lanes[f"wheel_rate{i}"]), step)
    out[f"tread{c}"], out[f"held{c}"], out[f"softness{c}"] = found.stiffness, found.held, found.softness
    for a in "xy":
        out[f"shear_slip_{a}{c}"] = (found.softness * step) * (found.held * lanes[f"shear_{a}{c}"])


def _eliminate(corner: Corner, damping: tuple[Value, Value], own: Vector, momentum: Vector, reduced: list[list[Value]]) -> None:
    """Take leg and wheel out of the system: Schur complement onto the base."""
    leg_damping, wheel_damping = damping
    on_base = ops.rounded(leg_damping)  # a constant where the gear is rigid; rounded like one where it has play
    reduced[4][4] = reduced[4][4] + on_base
    corner.coupling = [*corner.coupling[:4], corner.coupling[4] - on_base, corner.coupling[5]]
    a11 = corner.leg_leg + leg_damping + wheel_damping
    a12 = corner.leg_wheel - wheel_damping
    a22 = corner.wheel_wheel + wheel_damping
    determinant = 1.0 / (a11 * a22 - a12 * a12)
    i11, i12, i22 = a22 * determinant, -(a12 * determinant), a11 * determinant
    corner.block, corner.inverse = (a11, a12, a22), (i11, i12, i22)
    corner.free = (i11 * own[0] + i12 * own[1], i12 * own[0] + i22 * own[1])
    scaled = [i11 * x for x in corner.coupling]
    for r in range(6):
        momentum[r] = momentum[r] - corner.coupling[r] * corner.free[0]
        for c in range(r + 1):
            reduced[r][c] = reduced[r][c] - scaled[r] * corner.coupling[c]


def _friction_rows(
    lanes: Lanes,
    i: int,
    corner: Corner,
    white: Vector,
    local: Mapping[str, tuple[Vector, Value, Value, Value]],
    base: Vector,
    out: Out,
) -> None:
    """Whitened rows of all friction at one leg, their gains, and the effect of the warm-started impulses."""
    i11, i12, i22 = corner.inverse
    for name, (white_base, leg_entry, wheel_entry, impulse) in local.items():
        on_leg, on_wheel = i12 * wheel_entry, i22 * wheel_entry
        if not isinstance(wheel_entry, float):  # a constant where both gears are rigid: not to be fused where one has play
            on_leg, on_wheel = ops.rounded(on_leg), ops.rounded(on_wheel)
        g_leg = i11 * leg_entry + on_leg
        g_wheel = i12 * leg_entry + on_wheel
        z = [white_base[r] - g_leg * white[r] for r in range(6)]
        gain = dot(z, z) + leg_entry * ops.rounded(g_leg) + wheel_entry * ops.rounded(g_wheel)
        out[f"g_leg_{name}"], out[f"g_wheel_{name}"] = g_leg, g_wheel
        for r in range(6):
            out[f"z_{name}_{r}"] = z[r]
            base[r] = base[r] + z[r] * impulse
        out[f"y_leg{i}"] = out[f"y_leg{i}"] + g_leg * impulse
        out[f"y_wheel{i}"] = out[f"y_wheel{i}"] + g_wheel * impulse
        out[f"gain_{name}"] = gain
        if (joint := {"leg": i, "wheel": FIRST_WHEEL + i}.get(name[:-1])) is not None:
            share = out[f"share{joint}"]
            gain = share * share * gain + out[f"rotor_gain{joint}"]
        if name[0] not in "xy":
            out[f"inverse_gain_{name}"] = 1.0 / gain
    for contact in corner.contacts:
        c = contact.number
        cross_gain = dot([out[f"z_x{c}_{r}"] for r in range(6)], [out[f"z_y{c}_{r}"] for r in range(6)])
        own_gain = cross_gain + out[f"leg_entry_x{c}"] * out[f"g_leg_y{c}"]
        out[f"gain_xy{c}"] = own_gain - out[f"rolling_radius{c}"] * out[f"g_wheel_y{c}"]
    if len(corner.contacts) == 2:
        _coupling_of_contacts(i, out)


def _coupling_of_contacts(i: int, out: Out) -> None:
    """Slip along ``a`` at the first contact of wheel ``i`` by an impulse along ``b`` at its second, and the other way round."""
    for a in "xy":
        for b in "xy":
            gain = dot([out[f"z_{a}{i}_{r}"] for r in range(6)], [out[f"z_{b}{i + 4}_{r}"] for r in range(6)])
            gain = gain + out[f"leg_entry_{a}{i}"] * out[f"g_leg_{b}{i + 4}"]
            if a == "x":
                gain = gain - out[f"rolling_radius{i}"] * out[f"g_wheel_{b}{i + 4}"]
            out[f"coupling_{a}{b}{i}"] = gain


def _accumulate(
    mass: list[list[Value]], bias: list[Value], more_mass: Mapping[tuple[int, int], Value], more_bias: Mapping[int, Value]
) -> None:
    for (r, c), value in more_mass.items():
        mass[r][c] = mass[r][c] + value
        if r != c:
            mass[c][r] = mass[c][r] + value
    for r, value in more_bias.items():
        bias[r] = bias[r] + value


def _normal_force(lanes: Lanes, contact: Contact, gap_rate: Value) -> tuple[Value, Value]:
    """Spring and damper at the middle position, never pulling. Returns the force (N) and the present gap rate (m/s)."""
    c, i = contact.number, contact.wheel
    gap = contact.gap(lanes)
    look_ahead = lanes[f"look_ahead{i}"]
    if contact.depth is not None:  # a place that was not touched has had no rate: the normal may be another
        look_ahead = ops.where_positive(lanes[f"normal{c}"], look_ahead, 0.0)
    mid_rate = gap_rate + look_ahead * (gap_rate - lanes[f"last_gap_rate{c}"])
    push = ops.maximum(-(lanes[f"stiffness{i}"] * gap) - lanes[f"damping{i}"] * mid_rate, 0.0)
    return ops.where_positive(-gap, push, 0.0), gap_rate


def _warm_start(lanes: Lanes, i: int, contacts: Sequence[Contact], step: Value, features: frozenset[str], out: Out) -> None:
    """Start from the last step's impulses, shrunk into this step's bounds: descent must begin at an admissible point."""
    for j in (i, FIRST_WHEEL + i):
        bound = out[f"friction_bound{j}"]
        out[f"gear_friction{j}"] = ops.clip(lanes[f"gear_friction{j}"], -bound, bound)
    if "rolling_resistance" in features:
        normal = out[f"normal{i}"]
        for contact in contacts[1:]:
            normal = normal + out[f"normal{contact.number}"]
        bound = (step * lanes[f"rolling{i}"]) * (lanes[f"radius{i}"] * normal)
        out[f"bound_rolling{i}"] = bound
        out[f"rolling_friction{i}"] = ops.clip(lanes[f"rolling_friction{i}"], -bound, bound)
    for c in (contact.number for contact in contacts):
        out[f"bound{c}"] = step * out[f"normal{c}"]
        if c >= len(CORNERS):  # what it has become while nothing touched there depends on the robots beside
            out[f"multiplier{c}"] = ops.where_positive(lanes[f"normal{c}"], lanes[f"multiplier{c}"], 0.0)
        x, y = (lanes[f"friction_{a}{c}"] * out[f"acting_inverse_mu_{a}{c}"] for a in "xy")
        shrink = ops.minimum(out[f"bound{c}"] / ops.sqrt(x * x + y * y + 1e-30), 1.0)
        for a in "xy":
            limit = out[f"acting_mu_{a}{c}"] * out[f"bound{c}"]
            out[f"friction_{a}{c}"] = ops.clip(lanes[f"friction_{a}{c}"] * shrink, -limit, limit)


def _cholesky(matrix: list[list[Value]]) -> tuple[list[list[Value]], list[Value]]:
    """Lower Cholesky factor without its diagonal, and the inverse of the diagonal."""
    size = len(matrix)
    lower: list[list[Value]] = [[0.0] * size for _ in range(size)]
    inverse_diagonal: list[Value] = [0.0] * size
    for r in range(size):
        for c in range(r + 1):
            s = matrix[r][c]
            for k in range(c):
                s = s - lower[r][k] * lower[c][k]
            if r == c:
                inverse_diagonal[r] = 1.0 / ops.sqrt(s)
            else:
                lower[r][c] = s * inverse_diagonal[c]
    return lower, inverse_diagonal


# ---- friction: one pass of exact block coordinate descent over contacts, gears and rolling resistance ----------------


def kick_sweep(lanes: Lanes, features: frozenset[str], pairs: bool = False) -> Out:
    """One pass of block coordinate descent over all friction impulses, front axle then rear axle.

    Left and right wheel of an axle are solved from the same starting point and the joint step is scaled to the minimum of
    the objective along it. The objective is convex, so every pass descends; and a mirrored robot gets mirrored impulses,
    which solving left before right would not give.

    Args:
        lanes: of the step.
        features: families that are traced.
        pairs: wheels have two contacts. Where no wheel touches at its second, the impulses are those without, to the bit.
    """
    base: Vector = [lanes[f"base{r}"] for r in range(6)]
    out: Out = {}
    for left, right in ((0, 1), (2, 3)):
        sides = [_leg_block(lanes, i, base, features, pairs) for i in (left, right)]
        change = [(sides[0][0][r] - base[r]) + (sides[1][0][r] - base[r]) for r in range(6)]
        slope, curvature = dot(base, change), dot(change, change)
        moved = []
        for i, (_, y, impulses) in zip((left, right), sides, strict=True):
            start = [lanes[f"y_leg{i}"], lanes[f"y_wheel{i}"]]
            dy = [y[0] - start[0], y[1] - start[1]]
            pull = [
                lanes[f"a11_{i}"] * dy[0] + lanes[f"a12_{i}"] * dy[1],
                lanes[f"a12_{i}"] * dy[0] + lanes[f"a22_{i}"] * dy[1],
            ]
            slope = slope + dot(start, pull)
            curvature = curvature + dot(dy, pull)
            more_slope, more_curvature = _beside_the_bodies(lanes, i, impulses, features, pairs)
            slope, curvature = slope + more_slope, curvature + more_curvature
            moved.append((i, start, dy, impulses))
        scale = ops.clip(-slope / (curvature + 1e-30), 0.0, 1.0)
        base = [base[r] + scale * change[r] for r in range(6)]
        for i, start, dy, impulses in moved:
            out[f"y_leg{i}"], out[f"y_wheel{i}"] = start[0] + scale * dy[0], start[1] + scale * dy[1]
            out |= {f"multiplier{c}": impulses.pop(f"multiplier{c}") for c in _numbers(i, pairs)}
            out |= {name: lanes[name] + scale * (new - lanes[name]) for name, new in impulses.items()}
    for r in range(6):
        out[f"base{r}"] = base[r]
    return out


def _numbers(i: int, pairs: bool) -> list[int]:
    return [i, i + 4] if pairs else [i]


def _leg_block(lanes: Lanes, i: int, base: Vector, features: frozenset[str], pairs: bool) -> tuple[Vector, Vector, Out]:
    """Solve the friction rows of one leg in turn: gear of the leg, gear of the wheel, rolling resistance, contact."""
    out: Out = {}
    y = [lanes[f"y_leg{i}"], lanes[f"y_wheel{i}"]]
    for name, leg_entry, wheel_entry, j in ((f"leg{i}", 1.0, 0.0, i), (f"wheel{i}", -1.0, 1.0, FIRST_WHEEL + i)):
        old, bound, share = lanes[f"gear_friction{j}"], lanes[f"friction_bound{j}"], lanes[f"share{j}"]
        z = [lanes[f"z_{name}_{r}"] for r in range(6)]
        rate = share * (dot(z, base) + leg_entry * y[0] + wheel_entry * y[1])
        rate = rate + (lanes[f"rotor_free{j}"] + lanes[f"rotor_gain{j}"] * old)
        new = ops.clip(old - rate * lanes[f"inverse_gain_{name}"], -bound, bound)
        base, y = _apply(lanes, name, z, share * (new - old), base, y)
        out[f"gear_friction{j}"] = new
    if "rolling_resistance" in features:
        old, bound = lanes[f"rolling_friction{i}"], lanes[f"bound_rolling{i}"]
        z = [lanes[f"z_rolling{i}_{r}"] for r in range(6)]
        rate = dot(z, base) + y[1]
        new = ops.clip(old - rate * lanes[f"inverse_gain_rolling{i}"], -bound, bound)
        base, y = _apply(lanes, f"rolling{i}", z, new - old, base, y)
        out[f"rolling_friction{i}"] = new
    if pairs:
        base, y = _contact_pair(lanes, i, base, y, features, out)
    else:
        base, y = _contact_block(lanes, i, base, y, features, out)
    return base, y, out


def _beside_the_bodies(lanes: Lanes, i: int, new: Out, features: frozenset[str], pairs: bool) -> tuple[Value, Value]:
    """Slope and curvature of the objective along a joint step that the bodies' motion does not show.

    Rotors with play turn on their own; a creeping tyre's dissipation, taken at its present multiplier, is |p|^2/2 times that;
    an elastic tread stores what it gives way.
    """
    slope: Value = 0.0
    curvature: Value = 0.0
    for j in (i, FIRST_WHEEL + i):
        old, gain = lanes[f"gear_friction{j}"], lanes[f"rotor_gain{j}"]
        change = new[f"gear_friction{j}"] - old
        slope = slope + (lanes[f"rotor_free{j}"] + gain * old) * change
        curvature = curvature + gain * (change * change)
    for c in _numbers(i, pairs) if "compliance" in features else ():
        multiplier = ops.where_positive(lanes[f"creep_speed{i}"], new[f"multiplier{c}"], 0.0)
        for a in "xy":
            inverse = lanes[f"acting_inverse_mu_{a}{c}"]
            old = inverse * lanes[f"friction_{a}{c}"]
            change = inverse * new[f"friction_{a}{c}"] - old
            slope = slope + multiplier * (old * change)
            curvature = curvature + multiplier * (change * change)
    for c in _numbers(i, pairs) if "brush" in features else ():  # strain energy of the tread
        softness = lanes[f"softness{c}"]
        for a in "xy":
            old = lanes[f"friction_{a}{c}"]
            change = new[f"friction_{a}{c}"] - old
            slope = slope + (softness * old + lanes[f"shear_slip_{a}{c}"]) * change
            curvature = curvature + softness * (change * change)
    return slope, curvature


def _apply(lanes: Lanes, name: str, z: Vector, change: Value, base: Vector, y: Vector) -> tuple[Vector, Vector]:
    return (
        [base[r] + z[r] * change for r in range(6)],
        [y[0] + lanes[f"g_leg_{name}"] * change, y[1] + lanes[f"g_wheel_{name}"] * change],
    )


#: Rounds over the two contacts of a wheel in one pass. They share the wheel's light spin, so that solving them one after the
#: other takes away a third to two thirds of what is left.
PAIR_ROUNDS = 2


def _slip_of(lanes: Lanes, c: int, base: Vector, y: Vector) -> Vector:
    """Slip (m/s) of contact ``c`` along heading and axle under the present impulses."""
    zx, zy = ([lanes[f"z_{a}{c}_{r}"] for r in range(6)] for a in "xy")
    slip_x = dot(zx, base) + lanes[f"leg_entry_x{c}"] * y[0] - lanes[f"rolling_radius{c}"] * y[1]
    return [slip_x, dot(zy, base) + lanes[f"leg_entry_y{c}"] * y[0]]


def _contact_block(lanes: Lanes, i: int, base: Vector, y: Vector, features: frozenset[str], out: Out) -> tuple[Vector, Vector]:
    """Solve the one contact of wheel ``i``."""
    slip = _slip_of(lanes, i, base, y)
    new, out[f"multiplier{i}"] = _friction_block(lanes, i, slip, lanes[f"multiplier{i}"], features)
    if "relief" in features:  # as where there are pairs, among which it is chosen
        new = [ops.rounded(value) for value in new]
    return _move_contact(lanes, i, new, base, y, out)


def _contact_pair(lanes: Lanes, i: int, base: Vector, y: Vector, features: frozenset[str], out: Out) -> tuple[Vector, Vector]:
    """Solve both contacts of wheel ``i`` in turn, :data:`PAIR_ROUNDS` times, each knowing what the other has changed."""
    pair = (i, i + 4)
    slips = {c: _slip_of(lanes, c, base, y) for c in pair}
    new: dict[int, Vector] = {c: [lanes[f"friction_{a}{c}"] for a in "xy"] for c in pair}
    multipliers = {c: lanes[f"multiplier{c}"] for c in pair}
    for turn in range(PAIR_ROUNDS):
        for c, other in (pair, pair[::-1]):
            change = [new[other][k] - lanes[f"friction_{a}{other}"] for k, a in enumerate("xy")]
            gains = [[lanes[f"coupling_{a}{b}{i}" if c == i else f"coupling_{b}{a}{i}"] for b in "xy"] for a in "xy"]
            slip = [slips[c][k] + dot(gains[k], change) for k in range(2)]
            better, multiplier = _friction_block(lanes, c, slip, multipliers[c], features)
            if turn:  # alone, a contact is solved once
                touches = lanes[f"bound{other}"]
                better = [ops.where_positive(touches, better[k], new[c][k]) for k in range(2)]
                multiplier = ops.where_positive(touches, multiplier, multipliers[c])
            new[c], multipliers[c] = better, multiplier
    for c in pair:
        out[f"multiplier{c}"] = multipliers[c]
        base, y = _move_contact(lanes, c, new[c], base, y, out)
    return base, y


def _move_contact(lanes: Lanes, c: int, new: Vector, base: Vector, y: Vector, out: Out) -> tuple[Vector, Vector]:
    """Put new friction impulses of contact ``c`` in the place of the old ones."""
    zx, zy = ([lanes[f"z_{a}{c}_{r}"] for r in range(6)] for a in "xy")
    out[f"friction_x{c}"], out[f"friction_y{c}"] = new
    base, y = _apply(lanes, f"x{c}", zx, new[0] - lanes[f"friction_x{c}"], base, y)
    return _apply(lanes, f"y{c}", zy, new[1] - lanes[f"friction_y{c}"], base, y)


def _friction_block(lanes: Lanes, c: int, slip: Vector, multiplier: Value, features: frozenset[str]) -> tuple[Vector, Value]:
    """Exact 2x2 friction block of contact ``c``: maximum dissipation on the ellipse (mu_x N, mu_y N).

    In impulses scaled by mu, min 1/2 p'Ap + b'p over |p| <= step N. On the circle (A + multiplier) p = -b; the
    multiplier is improved by one Newton step on 1/|p| per sweep and carried from step to step. With creep the multiplier is
    that at which |p| = step N tanh(slip speed/creep_speed).

    Args:
        lanes: of the sweep.
        c: contact.
        slip: under the impulses of the lanes, m/s.
        multiplier: so far.
        features: families that are traced.

    Returns:
        The new impulses along heading and axle (N s), and the new multiplier.
    """
    i = c % len(CORNERS)
    mu_x, mu_y, bound = lanes[f"acting_mu_x{c}"], lanes[f"acting_mu_y{c}"], lanes[f"bound{c}"]
    old_x, old_y = lanes[f"friction_x{c}"], lanes[f"friction_y{c}"]
    gain_x, gain_y, gain_xy = lanes[f"gain_x{c}"], lanes[f"gain_y{c}"], lanes[f"gain_xy{c}"]
    b_x = mu_x * (slip[0] - gain_x * old_x - gain_xy * old_y)
    b_y = mu_y * (slip[1] - gain_xy * old_x - gain_y * old_y)
    a11 = mu_x * mu_x * gain_x + 1e-9
    a22 = mu_y * mu_y * gain_y + 1e-9
    if "brush" in features:
        b_x, b_y = b_x + mu_x * lanes[f"shear_slip_x{c}"], b_y + mu_y * lanes[f"shear_slip_y{c}"]
        a11, a22 = a11 + mu_x * mu_x * lanes[f"softness{c}"], a22 + mu_y * mu_y * lanes[f"softness{c}"]
    a12 = mu_x * mu_y * gain_xy

    def impulse(multiplier: Value) -> tuple[Value, Value, Value, Value, Value]:
        c11, c22 = a11 + multiplier, a22 + multiplier
        inverse = 1.0 / (c11 * c22 - a12 * a12)
        return (a12 * b_y - c22 * b_x) * inverse, (a12 * b_x - c11 * b_y) * inverse, c11, c22, inverse

    least: Value = 0.0
    if "compliance" in features:  # the slope of tanh at rest
        least = ops.minimum(lanes[f"creep_speed{i}"] * ops.minimum(mu_x, mu_y) / (bound + 1e-9), 1e6)
        multiplier = ops.maximum(multiplier, least)
    p_x, p_y, c11, c22, inverse = impulse(multiplier)
    square = p_x * p_x + p_y * p_y + 1e-30
    curvature = (p_x * p_x * c22 - 2.0 * (a12 * p_x * p_y) + p_y * p_y * c11) * inverse + 1e-30
    better = multiplier + square * (ops.sqrt(square) - bound) / (curvature * (bound + 1e-9))
    if "compliance" in features:
        creeping = _creep_multiplier(lanes, c, multiplier, (p_x, p_y), square, curvature)
        better = ops.where_positive(lanes[f"creep_speed{i}"], creeping, better)
    multiplier = ops.clip(better, least, 1e6)
    p_x, p_y, *_ = impulse(multiplier)
    shrink = ops.minimum(bound / ops.sqrt(p_x * p_x + p_y * p_y + 1e-30), 1.0)
    return [mu_x * p_x * shrink, mu_y * p_y * shrink], multiplier


def _creep_multiplier(
    lanes: Lanes, c: int, multiplier: Value, p: tuple[Value, Value], square: Value, curvature: Value
) -> Value:
    """One Newton step on 1/|p| = 1/(step N tanh(slip speed/creep_speed)), where the slip is -multiplier p/mu.

    The slope of the slip speed is that of equal mu along both axes; unequal ones only make convergence linear.
    """
    size = ops.sqrt(square)
    unscaled = [p[k] * lanes[f"acting_inverse_mu_{a}{c}"] for k, a in enumerate("xy")]
    reach = ops.sqrt(unscaled[0] * unscaled[0] + unscaled[1] * unscaled[1])
    share, slope = ground.creep_share(lanes, c % len(CORNERS), multiplier * reach)
    target = lanes[f"bound{c}"] * share + 1e-30
    rise = lanes[f"bound{c}"] * slope * reach * ops.maximum(1.0 - multiplier * curvature / square, 0.0)
    return multiplier + (size - target) / (target * curvature / square + size * rise / target)
