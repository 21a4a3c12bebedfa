"""Slip, defined once. Every arithmetic here is vectorised numpy in SI units and safe at standstill.

Frame of a wheel at its contact point: t_x along its heading, horizontal in the floor; t_y to its left in the floor.

- slip velocity (s_x, s_y): velocity of the wheel's material contact point over the floor. s_x = v_x - r omega, where v_x is
  the speed of the wheel along its heading and omega its *absolute* spin rate (body pitch rate + leg rate + wheel rate):
  the encoder alone, which reads relative to the leg, does not tell slip. s_x > 0 skids forward (braking), s_x < 0 spins.
- slip ratio, slip angle: see :func:`slip_ratio`, :func:`slip_angle`.
- slip displacement: slip velocity integrated over time; slip distance: slip speed integrated over time.

Source: Korayem, Nikseresht, Asadi 2024, equations (3)-(6), with the signs of the slip made explicit and the missing leg and
pitch rates added to the rolling term.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.robot.parameter_table import CORNER_SIGNS, LEG_SLICE, WHEEL_SLICE
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: m/s. Below this speed slip ratio and slip angle fade to 0 instead of dividing noise by noise: the wheel encoder's velocity
#: count is 0.8 mm/s at the rim, which here is 4 % slip.
LOW_SPEED = 0.02
_AXLE = np.array([0.0, 1.0, 0.0])


def slip_ratio(heading_speed: ArrayLike, rolling_speed: ArrayLike, low_speed: float = LOW_SPEED) -> Array:
    """Return (r omega - v_x) / max(|v_x|, |r omega|, low_speed), element by element.

    0 rolls freely, -1 is a locked wheel, +1 spins on the spot, beyond that (up to 2) it turns against its travel. Dividing by
    the larger speed bounds it; ``low_speed`` fades it to 0 at standstill.

    Args:
        heading_speed: v_x of the wheel along its heading, m/s.
        rolling_speed: r omega with the absolute spin rate, m/s (:func:`rolling_speed`).
        low_speed: m/s, > 0.
    """
    travel, rolling = np.asarray(heading_speed, np.float64), np.asarray(rolling_speed, np.float64)
    return (rolling - travel) / np.maximum(np.maximum(np.abs(travel), np.abs(rolling)), low_speed)


def slip_angle(heading_speed: ArrayLike, lateral_slip_velocity: ArrayLike, low_speed: float = LOW_SPEED) -> Array:
    """Return the angle (rad) from the wheel's heading line to its direction of travel, positive to the left.

    atan(s_y / max(|v_x|, low_speed)): in (-pi/2, pi/2), the same for driving forwards and backwards, 0 at standstill.
    """
    along = np.maximum(np.abs(np.asarray(heading_speed, np.float64)), low_speed)
    return np.arctan(np.asarray(lateral_slip_velocity, np.float64) / along)


def slip_speed(slip_velocity: ArrayLike) -> Array:
    """Return the length (m/s) of slip velocities (..., 2)."""
    velocity = np.asarray(slip_velocity, np.float64)
    return np.hypot(velocity[..., 0], velocity[..., 1])


def accumulate(values: ArrayLike, time: ArrayLike) -> Array:
    """Return the running time integral of ``values`` (T, ...) over ``time`` (T,) in s, starting at 0 (trapezoid rule).

    Of slip velocities it is the accumulated slip displacement (m), of slip speeds the slip distance (m).
    """
    values = np.asarray(values, np.float64)
    steps = np.diff(np.asarray(time, np.float64)).reshape(-1, *[1] * (values.ndim - 1))
    pieces = 0.5 * (values[1:] + values[:-1]) * steps
    return np.concatenate([np.zeros_like(values[:1]), np.cumsum(pieces, axis=0)])


def no_slip_error(travel: ArrayLike, no_slip_travel: ArrayLike) -> Array:
    """Return 1 - travel / no_slip_travel: the share of the predicted path that ignoring slip gets wrong.

    This is the paper's measure ("11.5 %" in its first test, "5 %" in its second): positive = the robot falls short, negative
    = it goes further. NaN where the prediction is 0.

    Args:
        travel: distance the body really moved along its heading, m.
        no_slip_travel: distance its wheels and legs would have moved it without slip, m.
    """
    travel, predicted = np.asarray(travel, np.float64), np.asarray(no_slip_travel, np.float64)
    return 1.0 - travel / np.where(predicted == 0, np.nan, predicted)


def rolling_speed(parameters: Parameters, angular_velocity_in_body: Array, joint_velocity: Array) -> Array:
    """Return r omega (N, 4) in m/s of every wheel: radius times absolute spin rate about its axle.

    Args:
        parameters: batch of N.
        angular_velocity_in_body: (N, 3) rad/s.
        joint_velocity: (N, 8) rad/s, wheels relative to their leg.
    """
    spin = angular_velocity_in_body[:, 1:2] + joint_velocity[:, LEG_SLICE] + joint_velocity[:, WHEEL_SLICE]
    return parameters["wheel.radius"] * spin


def contact_slip_velocity(
    parameters: Parameters,
    quaternion: Array,
    linear_velocity_in_body: Array,
    angular_velocity_in_body: Array,
    joint_position: Array,
    joint_velocity: Array,
) -> Array:
    """Return the slip velocity (N, 4, 2) in m/s of every wheel: of its contact point along t_x and t_y.

    The wheel is a thin disc on a plane floor whose normal is the world's z; the contact point is the disc's lowest point,
    r_c = hip + l e + d. Its material velocity is v + omega x r_c + q' y x (l e + d) + p' y x d, with e along the leg and d
    from the axle to the contact, q' the leg's and p' the wheel's rate, y the axle.

    Args:
        parameters: batch of N (``hip.position``, ``leg.length``, ``wheel.radius``).
        quaternion: (N, 4) body to floor frame, (w, x, y, z), unit length.
        linear_velocity_in_body: (N, 3) of the body origin, m/s.
        angular_velocity_in_body: (N, 3) rad/s.
        joint_position, joint_velocity: (N, 8) true angles (rad) and rates (rad/s) in joint order.
    """
    w, x, y, z = quaternion.T
    normal = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1)  # the world's z axis
    down = normal - normal[:, 1:2] * _AXLE
    down = down / -np.linalg.norm(down, axis=1, keepdims=True)
    heading = np.cross(down, _AXLE)
    left = np.cross(normal, heading)

    angle = joint_position[:, LEG_SLICE]
    along_leg = np.stack([np.cos(angle), np.zeros_like(angle), -np.sin(angle)], axis=-1)
    leg = parameters["leg.length"][:, :, None] * along_leg
    to_contact = parameters["wheel.radius"][:, :, None] * down[:, None, :]
    signs = np.array([(*sign, 1.0) for sign in CORNER_SIGNS])
    contact = parameters["hip.position"][:, None, :] * signs + leg + to_contact
    velocity = (
        linear_velocity_in_body[:, None, :]
        + np.cross(angular_velocity_in_body[:, None, :], contact)
        + joint_velocity[:, LEG_SLICE, None] * np.cross(_AXLE, leg + to_contact)
        + joint_velocity[:, WHEEL_SLICE, None] * np.cross(_AXLE, to_contact)
    )
    return np.stack([np.einsum("nwk,nk->nw", velocity, axis) for axis in (heading, left)], axis=-1)
