"""Where the wheels of simulated robots touch the floor, in numbers: for pictures, logs and tests."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.model.dynamics import rotation_matrix
from wlr_gym.physics.plants import relief
from wlr_gym.physics.plants.base import Contacts, Plant, Truth
from wlr_gym.physics.plants.gibbs_appell.kinematics import AXES, CONTACTS, CORNERS, axes_on, contacts_of
from wlr_gym.robot import CORNER_SIGNS, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]


#: Returns the contacts (N) of a plant's robots now: :meth:`wlr_gym.physics.plants.simulator.Simulator.contacts`.
ContactsOf = Callable[[], Contacts]


def contacts_of_plant(plant: Plant) -> ContactsOf | None:
    """Return what tells the contacts of a plant's robots; None = it does not know them."""
    return getattr(plant, "contacts", None)


def contacts_at(robot: Robot, parameters: Parameters, truth: Truth, force: Array) -> Contacts:
    """Return the contacts of robots (N) in the poses of a truth.

    Args:
        robot: theirs.
        parameters: (N).
        truth: (N) where they are.
        force: (N, 8, 3) of the contacts, along their axes, N.
    """
    count, features = len(parameters), frozenset(relief.families(parameters))
    lanes = relief.pack(parameters, robot)
    lanes |= {f"p{a}": truth.position[:, k] for k, a in enumerate(AXES)}
    for i in CORNERS:
        hip = parameters["hip.position"] * [*CORNER_SIGNS[i], 1.0]
        lanes |= {f"hip_{a}{i}": hip[:, k] for k, a in enumerate(AXES)}
        lanes |= {f"length{i}": parameters["leg.length"][:, i], f"radius{i}": parameters["wheel.radius"][:, i]}
    turn = rotation_matrix(truth.quaternion)
    rows = [[turn[:, k, m] for m in range(3)] for k in range(3)]
    level = axes_on(rows[2])
    point, normal, heading, lateral = np.zeros((4, count, len(CONTACTS), 3))
    depth = np.full((count, len(CONTACTS)), -np.inf)
    for i in CORNERS:
        angle = truth.joint_position[:, i]
        for contact in contacts_of(lanes, i, rows, level, (np.sin(angle), np.cos(angle)), features):
            c = contact.number
            depth[:, c] = -contact.gap(lanes)
            for target, vector in zip((point, normal, heading, lateral), (contact.point, *contact.axes[:3]), strict=True):
                in_body = np.stack([np.broadcast_to(value, count) for value in vector], axis=1)
                target[:, c] = np.einsum("nij,nj->ni", turn, in_body)
            point[:, c] += truth.position
    return Contacts(point, depth, normal, heading, lateral, np.where(np.isfinite(depth)[:, :, None], force, 0.0))
