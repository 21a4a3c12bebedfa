"""Words behind a command to its options, by tyro, and the options that several commands share.

A field of a dataclass is an option, the string below it is its help. Tyro checks types and choices, says what is wrong, lays
out help and completes in shells. A number's range is declared with its field (:class:`wlr_gym.base.errors.Interval`).
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import operator
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

from wlr_gym.base.errors import LARGEST_SEED, InputError, Interval, check_ranges
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
    from wlr_gym.physics.floor import Floor
    from wlr_gym.robot import Robot

#: Shells that commands and options are completed in.
SHELLS = ("bash", "zsh", "fish")


def parse(kind: Any, program: str, words: Sequence[str], description: str = "") -> Any:
    """Return the options that the words say.

    Args:
        kind: dataclass of the options, or what :func:`one_of` returns.
        program: what help calls it.
        words: behind it.
        description: what it does; empty = the documentation of ``kind``.

    Raises:
        InputError: an option that is given twice, or a number out of its range.
        SystemExit: with 0 after help; with 2 after another mistake, which tyro has told.
    """
    import tyro
    from tyro.constructors import ConstructorRegistry

    words = [re.sub(r"(^|=)~(?=/)", lambda found: found[1] + os.path.expanduser("~"), word) for word in words]  # --out=~/runs
    names = [word.partition("=")[0].replace("_", "-") for word in words if re.match(r"--[A-Za-z]", word)]
    for name in names:
        if names.count(name) > 1:  # tyro takes the last one and drops the others without a word
            raise InputError(f"{name} is given twice; all its values go behind one: {name} FIRST SECOND")
    registry = ConstructorRegistry()
    registry.struct_rule(_fields_shown)
    style = (tyro.conf.DisallowNone, tyro.conf.PositionalMetavarFromFieldName, tyro.conf.OmitSubcommandPrefixes)
    wrapper = textwrap.TextWrapper(shutil.get_terminal_size().columns, subsequent_indent="  ")  # tyro joins other lines
    text = "\n".join(map(wrapper.fill, _plain(description or _summary(kind)).split("\n")))
    options = tyro.cli(kind, prog=program, description=text, args=list(words), config=style, registry=registry)
    check_ranges(options)
    return options


def one_of(commands: Mapping[str, Any]) -> Any:
    """Return what :func:`parse` takes for one of several commands.

    Args:
        commands: name -> dataclass of its options, or the same again where it has commands of its own; under an empty name:
            options that it takes beside them.
    """
    import tyro

    def member(name: str, kind: Any) -> Any:
        if not isinstance(kind, Mapping):
            return Annotated[kind, tyro.conf.subcommand(name, description=_plain(_summary(kind)))]
        words = one_of({word: one for word, one in kind.items() if word})
        if "" not in kind:
            both = dataclasses.make_dataclass(name.capitalize(), [("command", words)])
        else:
            nothing = Annotated[None, tyro.conf.subcommand("--help")]  # completion offers the name of "none of them"
            word = ("command", words | nothing, dataclasses.field(default=None, kw_only=True))
            both = dataclasses.make_dataclass(name.capitalize(), [word], bases=(kind[""],), frozen=True)
        return Annotated[both, tyro.conf.subcommand(name, description="")]

    return functools.reduce(operator.or_, (member(name, kind) for name, kind in commands.items()))


def _fields_shown(info: Any) -> Any:
    """Show a command's own options before those that it shares; a default only where the text does not say what happens."""
    import docstring_parser
    import tyro
    from tyro.constructors import StructConstructorSpec, StructFieldSpec

    if not dataclasses.is_dataclass(info.type) or info.type.__module__.startswith("tyro."):  # it wraps some types in one
        return None
    kind: Any = info.type
    texts: dict[str, str] = {}
    for one in reversed(kind.__mro__[:-1]):
        params = docstring_parser.parse_from_object(one).params
        texts |= {param.arg_name: param.description for param in params if param.description}
    hints, fields = get_type_hints(kind, include_extras=True), {field.name: field for field in dataclasses.fields(kind)}
    found = []
    for name in dict.fromkeys(name for one in kind.__mro__ for name in inspect.get_annotations(one) if name in fields):
        default = fields[name].default
        hidden = [tyro.conf.arg(help_behavior_hint="")] if default is None or default is False or default == () else []
        single = [tyro.conf.FlagCreatePairsOff] if default is False else []
        hint: Any = Annotated[(hints[name], *hidden, *single)] if hidden else hints[name]
        value = tyro.constructors.MISSING if default is dataclasses.MISSING else default
        found.append(StructFieldSpec(name, hint, value, _plain(texts.get(name, ""))))
    return StructConstructorSpec(kind, tuple(found))


def _summary(kind: type) -> str:
    """Return what a class's documentation says before its attributes."""
    return (inspect.getdoc(kind) or "").partition("Attributes:")[0].strip()


def _plain(text: str) -> str:
    """Return a documentation's text without markup, a paragraph in one line."""
    paragraphs = re.split(r"\n\s*\n", text.replace("``", "").replace("**", "").strip())
    return "\n\n".join(" ".join(one.split()) for one in paragraphs)


# --- shared options: numbers in their range, a patch, results ---------------------------------------------------------


#: Numbers that many options take.
Count = Annotated[int, Interval(least=1)]
Seconds = Annotated[float, Interval("s", above=0.0)]
Seed = Annotated[int, Interval(least=0, most=LARGEST_SEED)]
#: A word of ``--port``.
PORT = "legs=/dev/ttyUSB1"
#: Options that mean nothing to a simulator.
_ROBOT_ONLY = ("hardware", "port", "emulated", "camera", "yes")


@dataclass(frozen=True, kw_only=True)
class PatchOption:
    """``--effects`` of every command that simulates."""

    effects: tuple[str, ...] = ()
    """Patch files, or names in configs/effects/: what is added to the nominal model; see: wlr effects."""

    def patch(self) -> Patch:
        """Return all given patches as one; see :func:`wlr_gym.physics.effects.load_patch`."""
        from wlr_gym.physics.effects import load_patch

        return load_patch(list(self.effects))


@dataclass(frozen=True, kw_only=True)
class FloorOption:
    """``--floor`` of every command that simulates."""

    floor: str | None = None
    """What is driven on: name in configs/floor/ (see: wlr robot floors) or path; default: a plane, or the floor of the task or
    of the runs."""

    def load_floor(self, robot: Robot | None = None) -> Floor | None:
        """Return the floor; None = none was given. See :func:`wlr_gym.physics.floor.load_floor`."""
        from wlr_gym.physics.floor import load_floor

        return None if self.floor is None else load_floor(self.floor, robot)

    def floor_content(self) -> dict[str, Any]:
        """Return what ``config.yaml`` says beside the options: the floor by its content; nothing where none was given."""
        floor = self.load_floor()
        return {} if floor is None else {"floor": floor.content()}


@dataclass(frozen=True, kw_only=True)
class JsonOption:
    """``--json`` of every command that prints results."""

    json: bool = False
    """Print the results as JSON; everything else goes to the standard error."""


@dataclass(frozen=True, kw_only=True)
class ProgressOption:
    """``--no-progress`` of commands that take long."""

    progress: bool = True
    """Show progress and the remaining time."""


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
class OutOption(ForceOption):
    """``--out`` of commands that write a folder of results."""

    out: Path
    """Folder for the results; made if it is not there."""


@dataclass(frozen=True, kw_only=True)
class RunsRobotOption:
    """``--robot`` of commands that read measured runs."""

    robot: str | None = None
    """Robot file, or name in configs/robot/; default: the one that meta.yaml names, else the nominal one."""


@dataclass(frozen=True, kw_only=True)
class MarkersOption:
    """``--markers`` and ``--floor`` of commands about the marker sheets."""

    markers: str = "body"
    """Markers on the robot: name in configs/vision/ or path."""
    floor: str = "floor"
    """Markers on the floor: name in configs/vision/ or path."""


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
    """Return the given environment id; else the one a policy was trained in; else ``WLR-Velocity-v0``."""
    from wlr_gym.policy import trained_environment

    return env or trained_environment(policy) or "WLR-Velocity-v0"


def ray_address(words: tuple[str, ...] | None) -> str | None:
    """Return what ``--ray`` means: None = no Ray, ``local`` = one that is started here, otherwise the address of a cluster."""
    if words is not None and len(words) > 1:
        raise InputError(f"--ray {' '.join(words)}: expected one address, or none")
    return None if words is None else (words or ("local",))[0]


# --- shared options: the robot and its wiring --------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class HardwareOption:
    """Which robot, and what it is made of."""

    hardware: str = "nominal"
    """Hardware file (wiring, mounting, safety limits), or name in configs/hardware/."""
    robot: str | None = None
    """Robot file, or name in configs/robot/; default: the one that the hardware file names."""


@dataclass(frozen=True, kw_only=True)
class WiredRobotOption(HardwareOption):
    """Which robot, and how it is wired; a real one, for work that is done at a real robot only."""

    port: tuple[str, ...] = ()
    """Other ports than the hardware file's, such as legs=/dev/ttyUSB1 imu=/dev/ttyACM0."""
    emulated = False  # an option of RobotOption
    camera = None  # an option of CameraOption

    def ports(self) -> dict[str, str]:
        """Return the ports of ``--port``: bus name, ``imu`` or ``flow`` -> device.

        Raises:
            InputError: a port that is not name=value, or ports of a robot that has none.
        """
        ports = pairs("--port", self.port, PORT)
        if ports and self.emulated:
            raise InputError("--port and --emulated: one or the other; the emulated robot of this process has no ports")
        return ports

    def load_hardware(self) -> Hardware:
        """Return the hardware, with the ports of ``--port``."""
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

        ``changed`` is hardware instead of the one of :meth:`load`.
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
            films = "--camera emulated: it films an emulated robot by rendering"
            raise InputError(f"{films}; add --emulated, or name your camera's file")
        return None if self.camera is None else load_camera_file(self.camera)

    def refuse_effects(self, patch: Patch) -> None:
        """Raise :class:`InputError` where a real robot is to have effects."""
        if patch.effects and not self.emulated:
            raise InputError("--effects: a real robot has its own; they are for simulators and the emulated robot")

    def plant_of(self, robot: Robot, log: Path, meta: RunMeta, patch: Patch, seed: int = 0) -> RobotPlant:
        """Return the robot as a plant, torque off; every start is logged in a new run of ``log``.

        Args:
            robot: the robot.
            log: folder of the runs.
            meta: of the runs; an emulated robot drives on its floor.
            patch: what an emulated robot has that its file does not say.
            seed: of an emulated robot's noise.
        """
        from wlr_gym.hardware.plant import RobotPlant
        from wlr_gym.physics.plants.base import RobotOptions

        self.refuse_effects(patch)
        self.camera_file()
        options = RobotOptions(
            self.hardware, self.ports(), self.emulated, log=log, effects=patch, floor=meta.floor, camera=self.camera, seed=seed
        )
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


def noise_seed(folder: Path, seed: int | None) -> int:
    """Return the seed of an emulated robot's noise in the next run of a folder, one that ``--noise-seed`` takes.

    It follows from ``seed`` and the run's number; without a seed it is drawn anew.
    """
    from wlr_gym.base.random import spawn_seeds
    from wlr_gym.data.runs import next_run

    return int(spawn_seeds(seed, 1, next_run(folder).stem)[0]) % (LARGEST_SEED + 1)
