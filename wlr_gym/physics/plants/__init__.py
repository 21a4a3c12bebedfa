"""Plants: what can be driven. Simulators here; the real robot joins through the same contract (``base.Plant``).

Its room, ``hardware``, lies above this one: it is looked up by name when it is asked for, and never imported.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.physics.plants.base import Plant, PlantOptions, RobotOptions
from wlr_gym.robot import RobotSource, load_robot

if TYPE_CHECKING:
    from wlr_gym.physics.plants.forces import Force

#: Backend -> "module:class", imported when it is first made.
BACKENDS = {
    "gibbs_appell": "wlr_gym.physics.plants.gibbs_appell.plant:GibbsAppellPlant",
    "mujoco": "wlr_gym.physics.plants.mujoco.plant:MujocoPlant",
    "dynamixel": "wlr_gym.hardware.plant:RobotPlant",
}
#: Backends that are no simulators: the real robot.
REAL = ("dynamixel",)
SIMULATORS = tuple(name for name in BACKENDS if name not in REAL)


def make_plant(
    backend: str,
    robot: RobotSource,
    count: int,
    options: PlantOptions | None = None,
    forces: Sequence[Force] = (),
    hardware: RobotOptions | None = None,
) -> Plant:
    """Make a plant by backend name.

    Args:
        backend: one of :data:`BACKENDS`.
        robot: the robot, its name in ``configs/robot/``, its file or that file's content.
        count: number of robots.
        options: step sizes, precision, threads.
        forces: formula forces that act on every robot (simulators only).
        hardware: which real robot, and how it is connected (``dynamixel`` only).

    Raises:
        InputError: unknown backend (the message lists the valid ones), impossible robot, bad options.
    """
    check_backend(backend)
    made_by = _class_of(backend)
    given: dict[str, Any] = {"forces": tuple(forces)} if forces else {}
    if hardware is not None:
        given["hardware"] = hardware
    for word, fits in (("forces", SIMULATORS), ("hardware", REAL)):
        if word in given and backend not in fits:
            raise InputError(f"backend '{backend}' takes no {word}; {', '.join(fits)} would")
    return made_by(load_robot(robot, check=False), count, options, **given)  # a plant refuses what it cannot simulate


def _class_of(backend: str) -> Any:
    entry = BACKENDS[backend]
    module, _, name = entry.partition(":")
    where = f"BACKENDS['{backend}'] = '{entry}'"
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if not f"{module}.".startswith(f"{error.name}."):  # one that the module itself needs
            raise
        raise InputError(f"{where}: no module '{error.name}'; expected 'module:class'") from None
    if not hasattr(found, name):
        raise unknown_name("class", name, [one for one, kind in vars(found).items() if isinstance(kind, type)], where)
    return getattr(found, name)


def robot_file(hardware: RobotOptions) -> str | None:
    """Return the robot file that a real robot's hardware file names; None = none."""
    return importlib.import_module("wlr_gym.hardware.config").load_hardware(hardware.hardware).robot


def check_simulator(backend: str, where: str = "") -> None:
    """Raise :class:`InputError` for a backend that is no simulator; ``where`` names what gave it, such as ``--backend``."""
    if backend not in SIMULATORS:
        raise unknown_name("backend", backend, SIMULATORS, where)


def check_backend(backend: str) -> None:
    """Raise :class:`InputError` for a backend that does not exist, before anything is made or written for it."""
    if backend not in BACKENDS:
        raise unknown_name("backend", backend, BACKENDS)
