"""Forces under a wheel that MuJoCo does not have: rolling resistance and tyre creep; see ``step.py``."""

from __future__ import annotations

from wlr_gym.physics.codegen import ops
from wlr_gym.physics.codegen.ops import Lanes, Value, Vector
from wlr_gym.physics.plants import ground

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
    lanes: Lanes, i: int, mu: ground.Friction, normal: Value, slip: Vector, speed: Value, spin_inertia: Value, step: Value
) -> Vector:
    """Tyre creep: N tanh(speed/creep_speed) along (mu_x^2 s_x, mu_y^2 s_y), against the slip."""
    share, _ = ground.creep_share(lanes, i, speed)
    ease = ops.sqrt(mu.mu_x * mu.mu_x * (slip[0] * slip[0]) + mu.mu_y * mu.mu_y * (slip[1] * slip[1])) + LEAST_SLIP * mu.mu_x
    inverse_spin = lanes[f"radius{i}"] * lanes[f"radius{i}"] * (1.0 / spin_inertia)
    lightness = [lanes[f"contact_lightness_x{i}"] + inverse_spin, lanes[f"contact_lightness_y{i}"]]
    slope = normal * share * (1.0 / (ease + 1e-30))
    force: Vector = []
    for k, (a, m) in enumerate((("x", mu.mu_x), ("y", mu.mu_y))):
        own = m * m * slope
        force.append(_relaxed(lanes[f"own_force_{a}{i}"], -(own * slip[k]), step * (own * lightness[k])))
    x, y = force[0] * mu.inverse_mu_x, force[1] * mu.inverse_mu_y
    shrink = ops.minimum(normal / ops.sqrt(x * x + y * y + 1e-30), 1.0)
    return [shrink * f for f in force]
