"""Options that several commands share: numbers in their range, a patch, results, a robot and its wiring."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from wlr_gym.base.checks import LARGEST_SEED, Interval
from wlr_gym.base.errors import InputError
from wlr_gym.base.files import refuse_existing
from wlr_gym.base.provenance import CONFIG_FILE, PROVENANCE_FILE
from wlr_gym.base.text import pairs

if TYPE_CHECKING:
    from wlr_gym.data.format import RunMeta
    from wlr_gym.hardware.camera.reading import CameraFile
    from wlr_gym.hardware.config import Hardware
    from wlr_gym.hardware.link import Link
    from wlr_gym.hardware.plant import RobotPlant
    from wlr_gym.physics.effects import Patch
    from wlr_gym.robot import Robot

#: Numbers that many options take.
Count = Annotated[int, Interval(least=1)]
Seconds = Annotated[float, Interval("s", above=0.0)]
Seed = Annotated[int, Interval(least=0, most=LARGEST_SEED)]
#: Options that mean nothing to a simulator.
_ROBOT_ONLY = ("hardware", "port", "emulated", "camera", "yes")


@dataclass(frozen=True, kw_only=True)
class PatchOption:
    """``--effects`` of every command that simulates."""

    effects: tuple[str, ...] = ()
    """Patch files, or names in configs/effects/: what is added to the nominal model; see: wlr effects."""

    def patch(self) -> Patch:
        """Return all given patches as one.

        Raises:
            InputError: see :func:`wlr_gym.physics.effects.load_patch`.
        """
        from wlr_gym.physics.effects import load_patch

        return load_patch(list(self.effects))


@dataclass(frozen=True, kw_only=True)
class JsonOption:
    """``--json`` of every command that prints results."""

    json: bool = False
    """Print the results as JSON; everything else goes to the standard error."""


@dataclass(frozen=True, kw_only=True)
class ForceOption:
    """``--force`` of every command that writes results under a given name."""

    force: bool = False
    """Replace results that are there."""

    def refuse_results(self, folder: Path, own: str) -> None:
        """Refuse, without ``--force``, to write over the results of this command, its ``own`` file, or among those of another.

        Raises:
            InputError: they are there.
        """
        from wlr_gym.data.format import META_FILE

        refuse_existing(folder / own, self.force)
        for name in (CONFIG_FILE, PROVENANCE_FILE, META_FILE):
            if (folder / name).exists() and not self.force:
                what = f"'{name}' of another command is in it"
                raise InputError(f"--out {folder}: {what}; choose another folder, or write into it with --force")


@dataclass(frozen=True, kw_only=True)
class SensorsOption:
    """``--sensors`` of commands that make robots."""

    sensors: tuple[Literal["camera", "flow", "none"], ...] | None = None
    """Which of the sensors that not every robot has the robots have: camera, flow (optical flow), or none; default: as the
    robot's file says."""

    def present(self) -> tuple[str, ...] | None:
        """Return the sensors; None = as the robot's file says.

        Raises:
            InputError: none, and others beside it.
        """
        if self.sensors and len(self.sensors) > 1 and "none" in self.sensors:
            raise InputError(f"--sensors {' '.join(self.sensors)}: expected none alone, or camera, flow or both")
        return None if self.sensors is None else tuple(name for name in self.sensors if name != "none")


def handed(options: Any, function: Callable[..., Any], **others: Any) -> dict[str, Any]:
    """Return the options that a function takes, by the names of its parameters; ``others`` stand for, or beside, those."""
    return {name: getattr(options, name) for name in inspect.signature(function).parameters if hasattr(options, name)} | others


def refuse_given(options: Any, names: Iterable[str], why: str) -> None:
    """Refuse options that do not go with others.

    Args:
        options: of the command.
        names: of the fields that must be as they are by default.
        why: added to the message.

    Raises:
        InputError: naming the first that is given.
    """
    for one in fields(options):
        if one.name in names and getattr(options, one.name) != one.default:
            place = one.name.upper() if "Positional" in str(one.type) else f"--{one.name.replace('_', '-')}"
            raise InputError(f"{place}: {why}")


def require_simulator(backend: str, robot: str) -> None:
    """Raise :class:`InputError` where ``--backend`` is no simulator; ``robot`` says what a real robot is for."""
    from wlr_gym.physics.plants import REAL, check_simulator

    if backend in REAL:
        raise InputError(f"--backend {backend}: {robot}")
    check_simulator(backend, "--backend")


def note_untrained(sources: Iterable[str]) -> None:
    """Say which of some policies is one before any training."""
    from wlr_gym.policy import untrained

    for words in filter(None, map(untrained, sources)):
        print(f"note: {words}", file=sys.stderr)


def settings_of(options: Any) -> dict[str, Any]:
    """Return the options of a command as ``config.yaml`` has them."""
    return {name: str(value) if isinstance(value, Path) else value for name, value in asdict(options).items()}


def environment_of(env: str | None, policy: str | Path) -> str:
    """Return the given environment id; else the one a policy was trained in; else ``WLR-Velocity-v0``.

    Raises:
        InputError: see :func:`wlr_gym.policy.trained_environment`.
    """
    from wlr_gym.policy import trained_environment

    return env or trained_environment(policy) or "WLR-Velocity-v0"


def ray_address(words: tuple[str, ...] | None) -> str | None:
    """Return what ``--ray`` means: None = no Ray, ``local`` = one that is started here, otherwise the address of a cluster."""
    if words is not None and len(words) > 1:
        raise InputError(f"--ray {' '.join(words)}: expected one address, or none")
    return None if words is None else (words or ("local",))[0]


# ---- the robot -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class WiredRobotOption:
    """Which robot, and how it is wired; a real one, for work that is done at a real robot only."""

    hardware: str = "nominal"
    """Hardware file (wiring, mounting, safety limits), or name in configs/hardware/."""
    port: tuple[str, ...] = ()
    """Other ports than the hardware file's, such as legs=/dev/ttyUSB1 imu=/dev/ttyACM0."""
    robot: str | None = None
    """Robot file, or name in configs/robot/; default: the one that the hardware file names."""
    emulated = False  # an option of RobotOption
    camera = None  # an option of CameraOption

    def ports(self) -> dict[str, str]:
        """Return the ports of ``--port``: name -> device.

        Raises:
            InputError: a port that is not name=value, or ports of a robot that has none.
        """
        ports = port_pairs(self.port)
        if ports and self.emulated:
            raise InputError("--port and --emulated: one or the other; the emulated robot of this process has no ports")
        return ports

    def load_hardware(self) -> Hardware:
        """Return the hardware, with the ports of ``--port``.

        Raises:
            InputError: unknown or broken file, a port that is not name=value, or a name that is no bus.
        """
        from wlr_gym.hardware.config import load_hardware, with_ports

        return with_ports(load_hardware(self.hardware), self.ports())

    def robot_name(self) -> str:
        """Return the robot file that is asked for, else the one that the hardware file names, else ``nominal``."""
        return str(self.robot or self.load_hardware().robot or "nominal")

    def load(self) -> tuple[Robot, Hardware]:
        """Return the robot and its hardware; see :meth:`load_hardware`."""
        from wlr_gym.hardware.config import require_leg_range
        from wlr_gym.robot import load_robot

        robot, hardware = load_robot(self.robot_name()), self.load_hardware()
        require_leg_range(hardware, robot, self.hardware)
        if self.emulated:
            from wlr_gym.hardware.emulator.link import with_flow_port

            hardware = with_flow_port(robot, hardware)
        return robot, hardware

    def link(self, changed: Hardware | None = None) -> Link:
        """Return connections to a robot that does not move, closed; a slow computer is no dead servo then.

        Args:
            changed: hardware instead of the one of :meth:`load`.
        """
        from wlr_gym.hardware.safety.limiter import CALM_PATIENCE

        robot, hardware = self.load()
        link = self.link_to(robot, changed or hardware)
        link.servos.set_patience(CALM_PATIENCE)
        return link

    def link_to(self, robot: Robot, hardware: Hardware) -> Link:
        """Return connections to a robot, closed."""
        camera = self.camera_file()
        if self.emulated:
            from wlr_gym.hardware.emulator import Machine
            from wlr_gym.hardware.emulator.link import emulated_link, with_flow_port

            return emulated_link(Machine(robot, with_flow_port(robot, hardware)), camera)
        from wlr_gym.hardware.link import serial_link

        return serial_link(robot, hardware, camera)

    def camera_file(self) -> CameraFile | None:
        """Return the camera of ``--camera``; None = there is none.

        Raises:
            InputError: unknown or broken file, or an emulated camera for a real robot.
        """
        from wlr_gym.hardware.camera.reading import load_camera_file

        if self.camera == "emulated" and not self.emulated:
            raise InputError(
                "--camera emulated: it films an emulated robot by rendering; add --emulated, or name your camera's file"
            )
        return None if self.camera is None else load_camera_file(self.camera)

    def refuse_effects(self, patch: Patch) -> None:
        """Refuse effects for a real robot.

        Raises:
            InputError: there are some.
        """
        if patch.effects and not self.emulated:
            raise InputError("--effects: a real robot has its own; they are for simulators and the emulated robot")

    def plant_of(self, robot: Robot, log: Path, meta: RunMeta, patch: Patch, seed: int = 0) -> RobotPlant:
        """Return the robot as a plant, torque off; every start is logged in a new run of ``log``.

        Args:
            robot: the robot.
            log: folder of the runs.
            meta: of the runs.
            patch: what an emulated robot has that its file does not say.
            seed: of an emulated robot's noise.

        Raises:
            InputError: options that make no sense, files that cannot be read.
        """
        from wlr_gym.hardware.plant import RobotPlant
        from wlr_gym.physics.plants.base import RobotOptions

        self.refuse_effects(patch)
        self.camera_file()
        ports = self.ports()
        options = RobotOptions(self.hardware, ports, self.emulated, log=log, effects=patch, camera=self.camera, seed=seed)
        return RobotPlant(robot, 1, hardware=options, meta=meta)


@dataclass(frozen=True, kw_only=True)
class RobotOption(WiredRobotOption):
    """Which robot, how it is wired, and whether it is a real one."""

    emulated: bool = False
    """An emulated robot in this process and in emulated time, instead of the ports."""

    def refuse_robot_options(self, remedy: str) -> None:
        """Refuse options that are about the robot where none is driven; ``remedy`` says what to do."""
        refuse_given(self, _ROBOT_ONLY, f"it is about the robot: {remedy}")


@dataclass(frozen=True, kw_only=True)
class CameraOption(RobotOption):
    """Which robot, how it is wired, and which camera sees it."""

    camera: str | None = None
    """Camera above the floor: file or name in configs/camera/; over an emulated robot, its frames are rendered."""


def port_pairs(words: Sequence[str]) -> dict[str, str]:
    """Return bus name, ``imu`` or ``flow`` -> device of ``--port``.

    Raises:
        InputError: a word that is not ``name=value``.
    """
    return pairs("--port", words, "legs=/dev/ttyUSB1")


def noise_seed(folder: Path, seed: int | None) -> int:
    """Return the seed of an emulated robot's noise in the next run of a folder, one that ``--noise-seed`` takes.

    It follows from ``seed`` and the run's number; without a seed it is drawn anew.
    """
    from wlr_gym.base.random import spawn_seeds
    from wlr_gym.data.record import next_run

    return int(spawn_seeds(seed, 1, next_run(folder).stem)[0]) % (LARGEST_SEED + 1)
