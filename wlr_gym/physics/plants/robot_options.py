"""Which real robot ``backend="dynamixel"`` drives, and how it is connected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.seeds import LARGEST_NOISE_SEED, require_seed


@dataclass(frozen=True)
class RobotOptions:
    """Which real robot, and how it is connected (``backend="dynamixel"``).

    Attributes:
        hardware: name in ``configs/hardware/`` or path of a YAML file: wiring, mounting, safety limits.
        ports: bus name or ``imu`` -> device, where it differs from the file's.
        emulated: an emulated robot in this process and in emulated time, instead of ports.
        dry_run: do everything but write to the servos: nothing moves.
        log: folder for the logs of runs; None = none.
        guard: start the watchdog process, which switches torque off when this one is killed.
        deadman: s the operator may be silent; None = the hardware file's.
        effects: what the emulated robot has that its file does not say, as ``effects=`` of a simulator; no environment,
            policy or log is told of it.
        camera: above the floor: name in ``configs/camera/`` or path of a YAML file; None = there is none.
        poses: file that the emulated robot on ``ports`` writes its true pose into, for a camera that films it by rendering;
            None = the camera is a real one.
        seed: of the noise of an emulated robot.

    Raises:
        InputError: effects for a robot that is not emulated, a seed out of range.
    """

    hardware: str | Path = "nominal"
    ports: Mapping[str, str] = field(default_factory=dict)
    emulated: bool = False
    dry_run: bool = False
    log: Path | None = None
    guard: bool = True
    deadman: float | None = None
    effects: Any = None
    camera: str | Path | None = None
    poses: Path | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.effects and not self.emulated:
            raise InputError("effects: a real robot has its own; they are for simulators and the emulated robot")
        require_seed("seed", self.seed, LARGEST_NOISE_SEED)


def read_robot_options(given: object) -> RobotOptions:
    """Return options from options, the name or path of a hardware file, a mapping of fields, or None.

    Raises:
        InputError: something else, or an unknown field.
    """
    if given is None or isinstance(given, RobotOptions):
        return given or RobotOptions()
    if isinstance(given, str | Path):
        return RobotOptions(hardware=given)
    if not isinstance(given, Mapping):
        raise InputError(f"hardware = {given!r}: expected a name, a path or a mapping")
    valid = [item.name for item in fields(RobotOptions)]
    for name in given:
        if name not in valid:
            raise unknown_name("field", str(name), valid, "hardware")
    options = RobotOptions(**given)
    return options if options.log is None else replace(options, log=Path(options.log))
