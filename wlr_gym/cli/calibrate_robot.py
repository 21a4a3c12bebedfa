"""``wlr calibrate servo``, ``joints`` and ``imu``: set up a new servo, or end in a hardware file. None drives a motor."""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import numpy as np
import tyro

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.paths import find_config
from wlr_gym.base.text import tally
from wlr_gym.cli import FAILED, OK
from wlr_gym.cli.options import JsonOption
from wlr_gym.cli.results import print_json
from wlr_gym.cli.robot_options import NobodyThereError, RobotOption, WiredRobotOption, ask_terminal
from wlr_gym.robot import JOINTS, LEGS, full_name

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from wlr_gym.hardware.calibration import RestPose
    from wlr_gym.hardware.config import Hardware, ImuCalibration, Mounting
    from wlr_gym.hardware.link import Link
    from wlr_gym.hardware.servos import Servos
    from wlr_gym.robot import Robot

#: Shows a text, waits for Enter, returns what was typed.
Ask = Callable[[str], str]
Result = TypeVar("Result")

#: Which side of the sensor points up, in the order of the poses.
_UP = ("z up (as it stands)", "z down", "x up", "x down", "y up", "y down")


@dataclass(frozen=True)
class JointsOptions(JsonOption, WiredRobotOption):
    """Find sign and zero of each servo by moving the robot by hand, torque off. Put it on a stand, wheels off the ground.

    Attributes:
        out: hardware file to write; may be the one of --hardware.
        only: joints to calibrate; the others stay as they are.
    """

    out: Path
    only: tuple[str, ...] = ()


@dataclass(frozen=True)
class ImuOptions(JsonOption, RobotOption):
    """Calibrate the IMU of a robot that stands still.

    Attributes:
        out: hardware file to write; may be the one of --hardware.
        poses: 1 = gyroscope's bias, and accelerometer's offset on a level floor; 6 = its offset and scale from six sides up.
        mounting: find how the sensor is mounted, from a level pose and one with the nose down.
        seconds: how long to listen per pose, s.
    """

    out: Path
    poses: int = 1
    mounting: bool = False
    seconds: float = 3.0


@dataclass(frozen=True)
class ServoOptions(JsonOption, WiredRobotOption):
    """Give a new servo its id, registers and baud rate. Connect it alone, with power, to the adapter of its bus.

    Attributes:
        joint: which one it is to be.
    """

    joint: Annotated[str, tyro.conf.Positional]


class _StoppedError(Exception):
    """The operator does not want to continue."""


def set_up_servo(options: ServoOptions, ask: Ask = ask_terminal) -> int:
    """Find the one servo that is connected, say what will be written, ask, write and look again; 1 when the operator stops.

    Raises:
        InputError: unknown joint, none or several servos, another model, a servo that does not take it.
    """
    from wlr_gym.hardware.dynamixel.tables import BAUD_RATES
    from wlr_gym.hardware.servos import FACTORY_RATE, check_new_servo, find_servos, set_up

    if options.joint not in JOINTS:
        raise unknown_name("joint", options.joint, JOINTS)
    robot, hardware = options.load()
    name, bus = next((name, bus) for name, bus in hardware.buses.items() if options.joint in bus.joints)
    id = robot.dynamixel_ids[options.joint]
    print(f"searching {bus.port} ...")
    likely = (FACTORY_RATE, bus.baud_rate)
    others = [rate for rate in BAUD_RATES if rate not in likely]
    with _dialogue():
        found = find_servos(name, bus.port, likely) or find_servos(name, bus.port, others)
    servo = check_new_servo(found, bus, options.joint)
    registers = tally(bus.eeprom)
    print(f"found: {servo}\n{options.joint} gets id {id}, {bus.baud_rate} bit/s, {registers}")
    try:
        if not _yes(ask, "Write it?"):
            return _stopped()
    except _StoppedError:
        return _stopped()
    with _dialogue():
        set_up(name, bus, servo, id)
    print(f"done: id {id} answers at {bus.baud_rate} bit/s; put a label on it")
    if options.json:
        print_json({"joint": options.joint, "bus": name, "id": id, "baud_rate": bus.baud_rate, "registers": bus.eeprom})
    return OK


def calibrate_joints(options: JointsOptions, ask: Ask = ask_terminal) -> int:
    """Ask for each joint, show what was found, and write the file; 1 when the operator stops.

    Raises:
        InputError: unknown joint or file, a servo that does not answer.
    """
    for joint in options.only:
        if joint not in JOINTS:
            raise unknown_name("joint", joint, JOINTS)
    robot, hardware = options.load()
    source = source_of(options.hardware, options.out)
    link = options.link()
    try:
        with _dialogue():
            link.servos.open()
            return _calibrate_joints(options, robot, hardware, source, link, ask)
    except _StoppedError:
        return _stopped()
    finally:
        link.close()


def _calibrate_joints(options: JointsOptions, robot: Robot, hardware: Hardware, source: Path, link: Link, ask: Ask) -> int:
    from wlr_gym.hardware.calibration import with_mountings

    _require_torque_off(link.servos, ask)
    print("Put the robot on a stand, wheels off the ground. Enter continues, s skips a joint, q ends without a file.")
    wanted = options.only or JOINTS
    found = {joint: _calibrate(joint, robot, hardware, link.servos, ask) for joint in JOINTS if joint in wanted}
    mountings = {joint: mounting for joint, mounting in found.items() if mounting is not None}
    for joint, new in mountings.items():
        old = hardware.joints[joint]
        print(f"{joint:9} sign {old.sign:+d} -> {new.sign:+d}, zero {old.zero} -> {new.zero}")
    note = f"Signs and zeros by wlr calibrate joints, {today()}: count = zero + sign * angle / (size of a count)."
    code = save_calibration(options.out, source, lambda file: with_mountings(file, mountings), "joints", note, ask)
    if options.json and code == OK:
        print_json({"hardware": options.out, "joints": {name: one.model_dump() for name, one in mountings.items()}})
    return code


def _require_torque_off(servos: Servos, ask: Ask) -> None:
    """Have all motors off; what is on is switched off only when the operator holds the robot and says so."""
    on = [joint for joint in JOINTS if servos.get(joint, "torque_enable")]
    if not on:
        return
    if not _yes(ask, f"Motors are on: {', '.join(on)}. Off, the robot drops: hold it. Switch them off?"):
        raise _StoppedError
    if left := servos.torque_off():
        raise InputError(f"{', '.join(left)}: torque does not go off; cut the supply")


def _calibrate(joint: str, robot: Robot, hardware: Hardware, servos: Servos, ask: Ask) -> Mounting | None:
    """Return how one joint is mounted; None = skipped."""
    from wlr_gym.hardware.calibration import find_sign, find_zero
    from wlr_gym.hardware.config import Mounting

    name = full_name(joint)
    move = "swing its foot to the back by 30 deg" if joint in LEGS else "roll it forward by a quarter turn"

    def look() -> Mounting | None:
        if _answer(ask, f"{name}: hold it still, then Enter.") == "s":
            return None
        before = _counts(servos)
        _answer(ask, f"{name}: {move} and hold it there, then Enter.")
        turn = servos.table(joint).counts.turn
        sign = find_sign(joint, before, _counts(servos), turn)
        if joint not in LEGS:
            return Mounting(sign=-1 if sign < 0 else 1, zero=hardware.joints[joint].zero)
        _answer(ask, f"{name}: hold it straight down, wheel's centre under the hip, then Enter.")
        straight_down = float(_counts(servos)[JOINTS.index(joint)])
        zero = find_zero(joint, sign, straight_down, robot.leg_limits, turn)
        return Mounting(sign=-1 if sign < 0 else 1, zero=zero)

    return _until_good(look)


def _counts(servos: Servos) -> NDArray[np.float64]:
    """Return Present Position of all joints in counts, the average of 20 reads."""
    return np.mean([[servos.get(joint, "present_position") for joint in JOINTS] for _ in range(20)], axis=0)


def calibrate_imu(options: ImuOptions, ask: Ask = ask_terminal) -> int:
    """Ask for each pose, show what was found, and write the file; 1 when the operator stops.

    Raises:
        InputError: unknown file, options that make no sense, an IMU that says nothing.
    """
    from wlr_gym.hardware.calibration import with_imu_calibration
    from wlr_gym.hardware.config import ImuCalibration

    if options.poses not in (1, 6):
        raise InputError(f"--poses {options.poses}: expected 1 or 6")
    if not 0.5 <= options.seconds <= 60.0:
        raise InputError(f"--seconds {options.seconds:g}: expected 0.5 to 60")
    _, hardware = options.load()
    source = source_of(options.hardware, options.out)
    link = options.link(with_imu_calibration(hardware, ImuCalibration()))
    try:
        with _dialogue():
            link.imu.open()
            print("Enter continues, q ends without a file.")
            calibration = _find_calibration(options, hardware.imu.calibration, link, ask)
        for name, value in calibration.model_dump(exclude_unset=True).items():
            print(f"{name:13} {value}")
        note = f"IMU calibrated by wlr calibrate imu, {today()}: mounting * scale * (measured - offset), SI units."
        code = save_calibration(options.out, source, lambda file: with_imu_calibration(file, calibration), "imu", note, ask)
        if options.json and code == OK:
            print_json({"hardware": options.out, "imu": calibration.model_dump(mode="json")})
        return code
    except _StoppedError:
        return _stopped()
    finally:
        link.close()


def _find_calibration(options: ImuOptions, known: ImuCalibration, link: Link, ask: Ask) -> ImuCalibration:
    from wlr_gym.hardware import calibration as find
    from wlr_gym.hardware.imu import to_body

    level = "Block the body level (the legs hold nothing) and let go of it, then Enter."
    if options.poses == 6:
        side = "Side {} of 6: turn the robot so that the sensor's axes point {}; keep it still, then Enter."
        poses = [_pose(options, link, ask, side.format(k, up)) for k, up in enumerate(_UP, 1)]
        offset, scale = find.six_positions(poses)
    else:
        poses = [_pose(options, link, ask, level)]
        offset, scale = known.accel_offset, known.accel_scale
    mounting = known.mounting
    if options.mounting:
        stood = _pose(options, link, ask, level) if options.poses == 6 else poses[0]
        nose_down = "Lift the rear: nose down by 10 deg or more, without roll; keep it still, then Enter."
        tilted = _pose(options, link, ask, nose_down)
        mounting = find.mounting(*(np.array(scale) * (pose.accelerometer - np.array(offset)) for pose in (stood, tilted)))
    elif options.poses == 1:
        offset = find.level_offset(poses[0], known, to_body(known))
    return known.model_copy(
        update={
            "gyro_bias": find.gyro_bias(find.mean_pose(poses)),
            "accel_offset": offset,
            "accel_scale": scale,
            "mounting": mounting,
            "temperature": round(float(np.mean([pose.temperature for pose in poses])), 1),
            "date": today(),
        }
    )


def _pose(options: ImuOptions, link: Link, ask: Ask, text: str) -> RestPose:
    from wlr_gym.hardware.calibration import rest_pose
    from wlr_gym.hardware.safety.preflight import sample_imu

    def look() -> RestPose:
        _answer(ask, text)
        samples = sample_imu(link.imu, link.clock, options.seconds)
        return rest_pose(samples.gyro, samples.accelerometer, samples.temperature)

    return _until_good(look)


@contextlib.contextmanager
def _dialogue() -> Iterator[None]:
    """Turn trouble with the hardware into an :class:`InputError`: nothing moves, so there is nothing to save."""
    from wlr_gym.hardware.dynamixel.protocol import NoAnswerError, RefusedError

    try:
        yield
    except (NoAnswerError, RefusedError, ConnectionError) as error:
        raise InputError(f"{error}; see wlr doctor") from None


# ---- the dialogue ----------------------------------------------------------------------------------------------------


def _until_good(look: Callable[[], Result]) -> Result:
    """Ask again while what was seen makes no sense; the operator can end it at every question."""
    while True:
        try:
            return look()
        except NobodyThereError:
            raise
        except InputError as error:
            print(f"{error}. Once more.")


def _answer(ask: Ask, text: str) -> str:
    answer = ask(text).strip().lower()
    if answer in ("q", "quit"):
        raise _StoppedError
    return answer


def _yes(ask: Ask, text: str) -> bool:
    return _answer(ask, f"{text} [y/N]") in ("y", "yes")


def source_of(hardware: str, out: Path) -> Path:
    """Return the file the hardware comes from; refuse to write over another one."""
    source = find_config("hardware", hardware)
    if out.suffix not in {".yaml", ".yml"} or not out.parent.is_dir():
        raise InputError(f"--out {out}: expected a .yaml file in a folder that exists")
    if out.exists() and not out.samefile(source):
        raise InputError(f"--out {out}: is there already; name it with --hardware to change it")
    return source


def save_calibration(out: Path, source: Path, change: Callable[[Hardware], Hardware], section: str, note: str, ask: Ask) -> int:
    """Ask, and write the file with what was found: ``change`` is made to what it says, not to ports of the command line."""
    from wlr_gym.hardware.calibration import save_hardware
    from wlr_gym.hardware.config import load_hardware

    if not _yes(ask, f"Write {out}?"):
        return _stopped()
    save_hardware(out, source, change(load_hardware(source)), section, note)
    print(f"written: {out}")
    return OK


def _stopped() -> int:
    print("stopped: nothing was written")
    return FAILED


def today() -> str:
    return datetime.datetime.now().astimezone().date().isoformat()
