"""Options of every command that connects to the robot, real or emulated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wlr_gym.base.errors import InputError
from wlr_gym.base.seeds import LARGEST_SEED
from wlr_gym.base.text import pairs

if TYPE_CHECKING:
    from rich.console import Console

    from wlr_gym.data.excitations import Motion
    from wlr_gym.data.format import RunMeta
    from wlr_gym.hardware.camera.reading import CameraFile
    from wlr_gym.hardware.config import Hardware
    from wlr_gym.hardware.link import Link
    from wlr_gym.hardware.plant import RobotPlant
    from wlr_gym.physics.effects import Patch
    from wlr_gym.robot import Robot


#: Options that mean nothing to a simulator.
_ROBOT_ONLY = ("hardware", "port", "emulated", "camera", "yes")


def noise_seed(folder: Path, seed: int | None) -> int:
    """Return the seed of an emulated robot's noise in the next run of a folder, one that ``--noise-seed`` takes.

    It follows from ``seed`` and the run's number; without a seed it is drawn anew.
    """
    from wlr_gym.base.random import spawn_seeds
    from wlr_gym.data.record import next_run

    return int(spawn_seeds(seed, 1, next_run(folder).stem)[0]) % (LARGEST_SEED + 1)


@dataclass(frozen=True, kw_only=True)
class WiringOption:
    """How a real robot is wired."""

    hardware: str = "nominal"
    """Hardware file (wiring, mounting, safety limits), or name in configs/hardware/."""
    port: tuple[str, ...] = ()
    """Other ports than the hardware file's, such as legs=/dev/ttyUSB1 imu=/dev/ttyACM0."""
    emulated = False  # an option of HardwareOption: some work is done at a real robot only

    def load_hardware(self) -> Hardware:
        """Return the hardware, with the ports of ``--port``.

        Raises:
            InputError: unknown or broken file, a port that is not name=value, or a name that is no bus.
        """
        from wlr_gym.hardware.config import load_hardware, with_ports

        ports = port_pairs(self.port)
        if ports and self.emulated:
            raise InputError("--port and --emulated: one or the other; the emulated robot of this process has no ports")
        return with_ports(load_hardware(self.hardware), ports)

    def robot_name(self, asked: str | Path | None) -> str:
        """Return the robot file that is asked for, else the one that the hardware file names, else ``nominal``."""
        return str(asked or self.load_hardware().robot or "nominal")

    def link_to(self, robot: Robot, hardware: Hardware, patch: Patch | None = None, seed: int = 0) -> Link:
        """Return connections to a robot, closed.

        Args:
            robot, hardware: of the robot.
            patch: what an emulated one has that the nominal one lacks.
            seed: of an emulated one's noise.

        Raises:
            InputError: a patch for a real robot.
        """
        camera = self.camera_file()
        if self.emulated:
            from wlr_gym.hardware.emulator import Machine, MachineOptions
            from wlr_gym.hardware.emulator.link import emulated_link, emulated_robot, with_flow_port

            hardware = with_flow_port(robot, hardware)
            if patch is None:
                return emulated_link(Machine(robot, hardware, MachineOptions(seed=seed)), camera)
            return emulated_robot(robot, hardware, patch, camera=camera, seed=seed)
        from wlr_gym.hardware.link import serial_link

        if patch is not None and patch.effects:
            raise InputError("--effects: a real robot has its own; they are for simulators and the emulated robot")
        return serial_link(robot, hardware, camera)

    def camera_file(self) -> CameraFile | None:
        """Return the camera above the floor; None = the command has none."""
        return None

    def plant_of(self, robot: Robot, log: Path, meta: RunMeta, patch: Patch, seed: int = 0) -> RobotPlant:
        """Return the robot as a plant, torque off; every start is logged in a new run of ``log``. ``seed``: :meth:`link_to`."""
        from wlr_gym.hardware.plant import RobotPlant
        from wlr_gym.physics.plants.base import PlantOptions, RobotOptions

        hardware = self.load_hardware()
        options = RobotOptions(hardware=self.hardware, ports=port_pairs(self.port), log=log)
        return RobotPlant(robot, 1, PlantOptions(), options, link=self.link_to(robot, hardware, patch, seed), meta=meta)


@dataclass(frozen=True, kw_only=True)
class HardwareOption(WiringOption):
    """How the robot is wired, and whether it is a real one."""

    emulated: bool = False
    """An emulated robot in this process and in emulated time, instead of the ports."""

    def refuse_robot_options(self, remedy: str) -> None:
        """Refuse options that are about the robot where none is driven; ``remedy`` says what to do.

        Raises:
            InputError: one is given.
        """
        for one in fields(self):
            if one.name in _ROBOT_ONLY and getattr(self, one.name) != one.default:
                raise InputError(f"--{one.name} is about the robot: {remedy}")


@dataclass(frozen=True, kw_only=True)
class WiredRobotOption(WiringOption):
    """Which real robot, and how it is wired."""

    robot: str | None = None
    """Robot file, or name in configs/robot/; default: the one that the hardware file names."""

    def load(self) -> tuple[Robot, Hardware]:
        """Return the robot and its hardware, with the ports of ``--port``; see :meth:`load_hardware`."""
        from wlr_gym.hardware.config import require_leg_range
        from wlr_gym.robot import load_robot

        robot, hardware = load_robot(self.robot_name(self.robot)), self.load_hardware()
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


@dataclass(frozen=True, kw_only=True)
class RobotOption(WiredRobotOption, HardwareOption):
    """Which robot, how it is wired, and whether it is a real one."""


@dataclass(frozen=True, kw_only=True)
class CameraOption(RobotOption):
    """Which robot, how it is wired, and which camera sees it."""

    camera: str | None = None
    """Camera above the floor: file or name in configs/camera/; over an emulated robot, its frames are rendered."""

    def camera_file(self) -> CameraFile | None:
        """Return the camera of ``--camera``; None = there is none.

        Raises:
            InputError: unknown or broken file, or an emulated camera for a real robot.
        """
        return read_camera(self.camera, self.emulated)


def read_camera(source: str | None, is_emulated: bool) -> CameraFile | None:
    """Return the camera of ``--camera``; see :meth:`CameraOption.camera_file`."""
    from wlr_gym.hardware.camera.reading import load_camera_file

    if source == "emulated" and not is_emulated:
        raise InputError(
            "--camera emulated: it films an emulated robot by rendering; add --emulated, or name your camera's file"
        )
    return None if source is None else load_camera_file(source)


def camera_note(environment: Mapping[str, Any]) -> str:
    """Return what to expect of a policy without a camera that had one in most of its training; empty = nothing.

    Args:
        environment: its contract's.
    """
    from wlr_gym.policy import camera_share, misses_camera

    if not misses_camera(environment):
        return ""
    share = camera_share(environment)
    had = "the slip observer is meant to have" if share >= 1.0 else f"in {share:.0%} of its training the policy had"
    return f"{had} a camera, and none is named (--camera): expect worse tracking"


def confirm(motion: Motion, robot: Robot, hardware: Hardware, console: Console) -> None:
    """Say what the robot is about to do, and wait for Enter; before every motion: after one it lies elsewhere, torque off.

    Raises:
        InputError: a port is not there, or nobody is.
    """
    from wlr_gym.hardware.operator import KEYS_SAID
    from wlr_gym.hardware.safety.preflight import require_ports

    require_ports(hardware)
    travel = motion.travel(robot.wheel.radius)
    rolled = f"{travel[-1]:+.1f} m in all, from {travel.min():+.1f} to {travel.max():+.1f} m on the way (+ is forward)"
    console.print(f"The robot will stand up and drive {motion.name}: {motion.duration:.0f} s; it rolls {rolled}.")
    console.print(KEYS_SAID, style="dim")
    wait_for_enter(console, "Free floor, or wheels off the ground? Hand on the switch?")


def wait_for_enter(console: Console, question: str, action: str = "start the robot", otherwise: str = ", or say --yes") -> None:
    """Ask the operator, and wait for Enter.

    Args:
        console: to ask on.
        question: what is asked.
        action: what Enter does.
        otherwise: what else can be done where nobody is there.

    Raises:
        InputError: nobody there.
        KeyboardInterrupt: anything else was typed, such as "n".
    """
    try:
        answer = console.input(f"[bold]{question} Enter to {action}, Ctrl-C not to. ")
    except EOFError:
        raise InputError(f"nobody there to {action}: run it on a terminal{otherwise}") from None
    if answer.strip().lower() not in ("", "y", "yes"):
        raise KeyboardInterrupt(f"asked not to {action}")


class NobodyThereError(InputError):
    """Questions cannot be answered."""


def ask_terminal(text: str, what: str = "calibration") -> str:
    """Ask on the terminal; ``what`` is the dialogue that the question is of.

    Raises:
        NobodyThereError: the input is at its end.
    """
    try:
        return input(text + " ")
    except EOFError:
        raise NobodyThereError(f"{what} is a dialogue: run it on a terminal, or pipe its answers in") from None


def port_pairs(words: Sequence[str]) -> dict[str, str]:
    """Return bus name, ``imu`` or ``flow`` -> device of ``--port``.

    Raises:
        InputError: a word that is not ``name=value``.
    """
    return pairs("--port", words, "legs=/dev/ttyUSB1")
