"""Plants: what can be driven. Simulators here; the real robot joins through the same contract (``base.Plant``)."""

from __future__ import annotations

import importlib
from collections.abc import Sequence

from wlr_gym.errors import unknown_name
from wlr_gym.plants.base import Plant, PlantOptions
from wlr_gym.plants.forces import Force
from wlr_gym.robot import Robot

#: Backend -> "module:class", imported when it is first made.
BACKENDS = {
    "gibbs_appell": "wlr_gym.plants.gibbs_appell.plant:GibbsAppellPlant",
    "mujoco": "wlr_gym.plants.mujoco.plant:MujocoPlant",
}


def make_plant(
    backend: str, robot: Robot, count: int, options: PlantOptions | None = None, forces: Sequence[Force] = ()
) -> Plant:
    """Make a plant by backend name.

    Args:
        backend: one of :data:`BACKENDS`.
        robot: the robot.
        count: number of robots.
        options: step sizes, precision, threads.
        forces: formula forces that act on every robot (simulators only).

    Raises:
        InputError: unknown backend (the message lists the valid ones), impossible robot, bad options.
    """
    check_backend(backend)
    module, _, name = BACKENDS[backend].partition(":")
    given = {"forces": tuple(forces)} if forces else {}
    return getattr(importlib.import_module(module), name)(robot, count, options, **given)


def check_backend(backend: str) -> None:
    """Raise :class:`InputError` for a backend that does not exist, before anything is made or written for it."""
    if backend not in BACKENDS:
        raise unknown_name("backend", backend, BACKENDS)
