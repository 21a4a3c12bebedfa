"""Statics of a rigid robot: which forces within friction cones carry it, by least squares; nothing of the simulators."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from rig import MASS, RADIUS, ROBOT, WEIGHT
from scipy.optimize import nnls

from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

_NOMINAL = Parameters.nominal(ROBOT)
HALF_BASE = ROBOT.hip_position.x
LEG = ROBOT.leg.length


def centre_over_axles() -> float:
    """Return how far the robot's centre of mass lies above its axles, legs straight down, m."""
    body, legs = float(_NOMINAL["body.mass"][0]), float(_NOMINAL["leg.mass"].sum())
    down = legs * float(_NOMINAL["leg.com_along_leg"][0, 0]) + float(_NOMINAL["wheel.mass"].sum()) * LEG
    return LEG + ROBOT.hip_position.z + (body * float(_NOMINAL["body.com_offset"][0, 2]) - down) / MASS


def is_carried(points: Sequence[Array], normals: Sequence[Array], centre: Array, friction: float) -> bool:
    """Return whether contacts (x, z) with friction can hold a weight at a centre of mass in equilibrium."""
    columns = []
    for point, normal in zip(points, normals, strict=True):
        along = np.array([normal[1], -normal[0]])
        for edge in (normal + friction * along, normal - friction * along):  # of the friction cone
            arm = point - centre
            columns.append([edge[0], edge[1], arm[0] * edge[1] - arm[1] * edge[0]])
    _, missing = nnls(np.array(columns).T, np.array([0.0, WEIGHT, 0.0]))
    return missing < 1e-9 * WEIGHT


def climbs(height: float, friction: float, edge_radius: float) -> bool:
    """Return whether a robot with straight, rigid legs is carried all the way up a kerb, its front and then its rear wheels.

    The wheel that climbs turns about the edge; the others stand level, on the floor or on top. The robot pitches as they do.
    """
    far, corner = RADIUS + edge_radius, height - edge_radius
    steepest = np.arccos(np.clip((RADIUS - corner) / far, -1.0, 1.0))
    for front_climbs in (True, False):
        other = RADIUS if front_climbs else height + RADIUS
        for angle in np.linspace(steepest, 0.0, 40):
            centre = np.array([-far * np.sin(angle), corner + far * np.cos(angle)])
            normal = np.array([-np.sin(angle), np.cos(angle)])
            rise = centre[1] - other if front_climbs else other - centre[1]
            forward = np.array([np.sqrt(1.0 - (rise / (2 * HALF_BASE)) ** 2), rise / (2 * HALF_BASE)])
            middle = centre + (-HALF_BASE if front_climbs else HALF_BASE) * forward
            mass = middle + centre_over_axles() * np.array([-forward[1], forward[0]])
            level = middle + (-HALF_BASE if front_climbs else HALF_BASE) * forward - [0.0, RADIUS]
            if not is_carried([centre - RADIUS * normal, level], [normal, np.array([0.0, 1.0])], mass, friction):
                return False
    return True


def highest_kerb(friction: float, edge_radius: float) -> float:
    """Return the highest kerb that a robot with straight legs is carried up by statics, m."""
    low, high = 0.002, 0.99 * RADIUS
    while high - low > 1e-5:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if climbs(middle, friction, edge_radius) else (low, middle)
    return low


def wheel_loads(places: Array, centre: Array, weight: float) -> Array:
    """Return the loads (N) of three points (3, 2) on the ground that carry a weight at a centre (2,)."""
    return np.asarray(np.linalg.solve(np.vstack([np.ones(3), places.T]), [weight, *(weight * centre)]), float)
