"""The kick's friction: one pass of exact block coordinate descent over contacts, gears and rolling resistance."""

from __future__ import annotations

from wlr_gym.physics.codegen import ops
from wlr_gym.physics.codegen.ops import Lanes, Out, Value, Vector
from wlr_gym.physics.plants import ground
from wlr_gym.physics.plants.gibbs_appell.kinematics import dot
from wlr_gym.robot import FIRST_WHEEL


def kick_sweep(lanes: Lanes, features: frozenset[str]) -> Out:
    """One pass of block coordinate descent over all friction impulses, front axle then rear axle.

    Left and right wheel of an axle are solved from the same starting point and the joint step is scaled to the minimum of
    the objective along it. The objective is convex, so every pass descends; and a mirrored robot gets mirrored impulses,
    which solving left before right would not give.
    """
    base: Vector = [lanes[f"base{r}"] for r in range(6)]
    out: Out = {}
    for left, right in ((0, 1), (2, 3)):
        sides = [_leg_block(lanes, i, base, features) for i in (left, right)]
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
            more_slope, more_curvature = _beside_the_bodies(lanes, i, impulses, features)
            slope, curvature = slope + more_slope, curvature + more_curvature
            moved.append((i, start, dy, impulses))
        scale = ops.clip(-slope / (curvature + 1e-30), 0.0, 1.0)
        base = [base[r] + scale * change[r] for r in range(6)]
        for i, start, dy, impulses in moved:
            out[f"y_leg{i}"], out[f"y_wheel{i}"] = start[0] + scale * dy[0], start[1] + scale * dy[1]
            out[f"multiplier{i}"] = impulses.pop(f"multiplier{i}")
            out |= {name: lanes[name] + scale * (new - lanes[name]) for name, new in impulses.items()}
    for r in range(6):
        out[f"base{r}"] = base[r]
    return out


def _leg_block(lanes: Lanes, i: int, base: Vector, features: frozenset[str]) -> tuple[Vector, Vector, Out]:
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
    base, y = _contact_block(lanes, i, base, y, features, out)
    return base, y, out


def _beside_the_bodies(lanes: Lanes, i: int, new: Out, features: frozenset[str]) -> tuple[Value, Value]:
    """Slope and curvature of the objective along a joint step that the bodies' motion does not show.

    Rotors with play turn on their own; a creeping tyre's dissipation, taken at its present multiplier, is |p|^2/2 times that.
    """
    slope: Value = 0.0
    curvature: Value = 0.0
    for j in (i, FIRST_WHEEL + i):
        old, gain = lanes[f"gear_friction{j}"], lanes[f"rotor_gain{j}"]
        change = new[f"gear_friction{j}"] - old
        slope = slope + (lanes[f"rotor_free{j}"] + gain * old) * change
        curvature = curvature + gain * (change * change)
    if "compliance" in features:
        multiplier = ops.where_positive(lanes[f"creep_speed{i}"], new[f"multiplier{i}"], 0.0)
        for a in "xy":
            inverse = lanes[f"acting_inverse_mu_{a}{i}"]
            old = inverse * lanes[f"friction_{a}{i}"]
            change = inverse * new[f"friction_{a}{i}"] - old
            slope = slope + multiplier * (old * change)
            curvature = curvature + multiplier * (change * change)
    return slope, curvature


def _apply(lanes: Lanes, name: str, z: Vector, change: Value, base: Vector, y: Vector) -> tuple[Vector, Vector]:
    return (
        [base[r] + z[r] * change for r in range(6)],
        [y[0] + lanes[f"g_leg_{name}"] * change, y[1] + lanes[f"g_wheel_{name}"] * change],
    )


def _contact_block(lanes: Lanes, i: int, base: Vector, y: Vector, features: frozenset[str], out: Out) -> tuple[Vector, Vector]:
    """Exact 2x2 friction block of wheel ``i``: maximum dissipation on the ellipse (mu_x N, mu_y N).

    In impulses scaled by mu, min 1/2 p'Ap + b'p over |p| <= step N. On the circle (A + multiplier) p = -b; the
    multiplier is improved by one Newton step on 1/|p| per sweep and carried from step to step. With creep the multiplier is
    that at which |p| = step N tanh(slip speed/creep_speed).
    """
    zx, zy = ([lanes[f"z_{a}{i}_{r}"] for r in range(6)] for a in "xy")
    slip_x = dot(zx, base) + lanes[f"leg_entry_x{i}"] * y[0] - lanes[f"rolling_radius{i}"] * y[1]
    slip_y = dot(zy, base) + lanes[f"leg_entry_y{i}"] * y[0]
    mu_x, mu_y, bound = lanes[f"acting_mu_x{i}"], lanes[f"acting_mu_y{i}"], lanes[f"bound{i}"]
    old_x, old_y = lanes[f"friction_x{i}"], lanes[f"friction_y{i}"]
    gain_x, gain_y, gain_xy = lanes[f"gain_x{i}"], lanes[f"gain_y{i}"], lanes[f"gain_xy{i}"]
    b_x = mu_x * (slip_x - gain_x * old_x - gain_xy * old_y)
    b_y = mu_y * (slip_y - gain_xy * old_x - gain_y * old_y)
    a11 = mu_x * mu_x * gain_x + 1e-9
    a22 = mu_y * mu_y * gain_y + 1e-9
    a12 = mu_x * mu_y * gain_xy

    def impulse(multiplier: Value) -> tuple[Value, Value, Value, Value, Value]:
        c11, c22 = a11 + multiplier, a22 + multiplier
        inverse = 1.0 / (c11 * c22 - a12 * a12)
        return (a12 * b_y - c22 * b_x) * inverse, (a12 * b_x - c11 * b_y) * inverse, c11, c22, inverse

    multiplier = lanes[f"multiplier{i}"]
    least: Value = 0.0
    if "compliance" in features:  # the slope of tanh at rest
        least = ops.minimum(lanes[f"creep_speed{i}"] * ops.minimum(mu_x, mu_y) / (bound + 1e-9), 1e6)
        multiplier = ops.maximum(multiplier, least)
    p_x, p_y, c11, c22, inverse = impulse(multiplier)
    square = p_x * p_x + p_y * p_y + 1e-30
    curvature = (p_x * p_x * c22 - 2.0 * (a12 * p_x * p_y) + p_y * p_y * c11) * inverse + 1e-30
    better = multiplier + square * (ops.sqrt(square) - bound) / (curvature * (bound + 1e-9))
    if "compliance" in features:
        creeping = _creep_multiplier(lanes, i, multiplier, (p_x, p_y), square, curvature)
        better = ops.where_positive(lanes[f"creep_speed{i}"], creeping, better)
    multiplier = ops.clip(better, least, 1e6)
    p_x, p_y, *_ = impulse(multiplier)
    shrink = ops.minimum(bound / ops.sqrt(p_x * p_x + p_y * p_y + 1e-30), 1.0)
    new_x, new_y = mu_x * p_x * shrink, mu_y * p_y * shrink
    out[f"multiplier{i}"] = multiplier
    out[f"friction_x{i}"], out[f"friction_y{i}"] = new_x, new_y
    base, y = _apply(lanes, f"x{i}", zx, new_x - old_x, base, y)
    return _apply(lanes, f"y{i}", zy, new_y - old_y, base, y)


def _creep_multiplier(
    lanes: Lanes, i: int, multiplier: Value, p: tuple[Value, Value], square: Value, curvature: Value
) -> Value:
    """One Newton step on 1/|p| = 1/(step N tanh(slip speed/creep_speed)), where the slip is -multiplier p/mu.

    The slope of the slip speed is that of equal mu along both axes; unequal ones only make convergence linear.
    """
    size = ops.sqrt(square)
    unscaled = [p[k] * lanes[f"acting_inverse_mu_{a}{i}"] for k, a in enumerate("xy")]
    reach = ops.sqrt(unscaled[0] * unscaled[0] + unscaled[1] * unscaled[1])
    share, slope = ground.creep_share(lanes, i, multiplier * reach)
    target = lanes[f"bound{i}"] * share + 1e-30
    rise = lanes[f"bound{i}"] * slope * reach * ops.maximum(1.0 - multiplier * curvature / square, 0.0)
    return multiplier + (size - target) / (target * curvature / square + size * rise / target)
