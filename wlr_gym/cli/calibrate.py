"""Calibrate what measures: the robot's ``joints``, ``imu``, ``flow``, a ``camera``; ``targets`` are its sheets to print.

``servo`` sets up a new servo. No motor is driven.
"""

from __future__ import annotations

import contextlib
import datetime
import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, ParamSpec, TypeVar

import numpy as np
from rich.console import Console
from tyro.conf import Positional

from wlr_gym.base.errors import InputError, Interval, check_name, require_package
from wlr_gym.base.files import check_new_file, make_output_folder, refuse_existing
from wlr_gym.base.paths import find_config
from wlr_gym.base.progress import progress
from wlr_gym.base.text import tally
from wlr_gym.cli import FAILED, OK
from wlr_gym.cli.options import Count, ForceOption, HardwareOption, JsonOption, MarkersOption, RobotOption, WiredRobotOption
from wlr_gym.cli.terminal import NobodyThereError, ask_terminal, print_json
from wlr_gym.hardware import calibration as find
from wlr_gym.hardware.calibration import RestPose, save_hardware, with_calibration
from wlr_gym.hardware.config import Hardware, ImuCalibration, Mounting, load_hardware
from wlr_gym.hardware.dynamixel.protocol import NoAnswerError, RefusedError
from wlr_gym.hardware.dynamixel.tables import BAUD_RATES
from wlr_gym.hardware.flow_comparison import calibrate_flow as fit_flow
from wlr_gym.hardware.imu import to_body
from wlr_gym.hardware.servos import FACTORY_RATE, Servos, check_new_servo, find_servos, set_up
from wlr_gym.perception.markers.targets import load_target
from wlr_gym.robot import JOINTS, LEGS, Robot, full_name, load_robot

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from wlr_gym.hardware.link import Link
    from wlr_gym.perception.markers.calibration import Board, Readout
    from wlr_gym.perception.markers.camera import Camera
    from wlr_gym.perception.vision.video import Frames

#: Shows a text, waits for Enter, returns what was typed.
Ask = Callable[[str], str]
Options = ParamSpec("Options")
Result = TypeVar("Result")
#: Squares of a board along a side.
_Squares = Annotated[int, Interval(least=3)]
#: Share of the time that looking for the board takes, about; the computation of the lens takes the rest.
_SEARCH = 0.8
#: Which side of the sensor points up, in the order of the poses.
_UP = ("z up (as it stands)", "z down", "x up", "x down", "y up", "y down")


@dataclass(frozen=True)
class CameraOptions(JsonOption, ForceOption):
    """Calibrate the lens of a camera from views of the printed board."""

    images: Positional[str]
    """Folder of images, or a video, of the board: 15 or more views, tilted, in every corner of the image, sharp. In a video a
    board that moves tells a rolling shutter."""
    out: Path
    """Camera file to write (YAML)."""
    board: Literal["charuco", "charuco-legacy", "chessboard"] = "charuco"
    """What it is: charuco (as written by wlr calibrate targets), charuco-legacy (as OpenCV drew them before 4.6), or
    chessboard."""
    columns: _Squares = 9
    """Squares of the board along its longer side."""
    rows: _Squares = 6
    """Squares along its shorter side."""
    square: Annotated[float, Interval("m, as measured on the print (28 mm = 0.028)", above=0.001, below=0.5)] = 0.028
    """Side of a square as measured on the print, m."""
    marker: float | None = None
    """Side of a ChArUco board's markers, m; left out, 0.7 of a square."""
    dictionary: str = "5X5_100"
    """Dictionary of a ChArUco board's markers, as OpenCV names it without DICT_."""
    every: Count = 15
    """Use every n-th frame of a video."""
    readout: Annotated[float, Interval("s (20 ms = 0.02)", above=-0.1, below=0.1)] | None = None
    """Time from the first row's exposure to the last row's, s, where it is known; 0 = global shutter."""


@dataclass(frozen=True)
class TargetsOptions(JsonOption, ForceOption, MarkersOption):
    """Write the sheets to print, as PDF and SVG to scale: markers on the robot, markers on the floor, calibration board."""

    out: Path
    """Folder; made if it is not there."""


@dataclass(frozen=True)
class ServoOptions(JsonOption, WiredRobotOption):
    """Give a new servo its id, registers and baud rate. Connect it alone, with power, to the adapter of its bus."""

    joint: Positional[str]
    """Which one it is to be."""


@dataclass(frozen=True, kw_only=True)
class HardwareFileOption:
    """``--out`` of what is written into a hardware file."""

    out: Path
    """Hardware file to write; may be the one of --hardware."""


@dataclass(frozen=True)
class JointsOptions(JsonOption, WiredRobotOption, HardwareFileOption):
    """Find sign and zero of each servo by moving the robot by hand, torque off. Put it on a stand, wheels off the ground."""

    only: tuple[str, ...] = ()
    """Joints to calibrate; the others stay as they are."""


@dataclass(frozen=True)
class ImuOptions(JsonOption, RobotOption, HardwareFileOption):
    """Find biases, scale and mounting of the IMU of a robot that stands still."""

    poses: Literal[1, 6] = 1
    """1 = gyroscope's bias, and accelerometer's offset on a level floor; 6 = its offset and scale from six sides up."""
    mounting: bool = False
    """Find how the sensor is mounted, from a level pose and one with the nose down."""
    seconds: Annotated[float, Interval("s", least=0.5, most=60.0)] = 3.0
    """How long to listen per pose, s."""


@dataclass(frozen=True)
class FlowOptions(JsonOption, HardwareOption, HardwareFileOption):
    """Find scale and mounting of the optical-flow sensor from a straight run on a floor that grips, driven or pushed.

    Record it with: wlr record --excitation straight
    """

    run: Positional[Path]
    """The run."""
    distance: float | None = None
    """Way straight ahead by a tape measure, m (negative: back); default: what the wheels rolled."""
    yes: bool = False
    """Do not ask before the file is written."""


def calibrate_camera(options: CameraOptions) -> int:
    """Find lens and shutter, and write the camera file."""
    require_package("cv2", "vision")
    from wlr_gym.perception.markers.calibration import Board
    from wlr_gym.perception.markers.camera import save_camera
    from wlr_gym.perception.vision.video import Frames

    check_new_file(options.out, options.force, endings=(".yaml", ".yml"))
    board = Board(options.columns, options.rows, options.square, options.board, options.marker, options.dictionary)
    frames = Frames(options.images)
    camera, told = _calibrated(options, frames, board)
    save_camera(options.out, camera)
    quality = camera.quality
    assert quality is not None
    print(
        f"{camera.width} x {camera.height} px, {quality.views} views ({quality.rejected} left out), corners off by "
        f"{quality.rms:.2f} px rms, {100 * quality.coverage:.0f} % of the image covered\n"
        f"focal length {camera.focal[0]:.1f}, {camera.focal[1]:.1f} px (± {max(quality.focal_std):.1f}); centre "
        f"{camera.centre[0]:.1f}, {camera.centre[1]:.1f} px (± {max(quality.centre_std):.1f})"
    )
    print(_shutter(camera, told))
    if frames.missing:
        print(f"the video is cut off or damaged: its last {frames.missing} frames could not be decoded")
    if quality.rms > 0.5:
        print("corners off by more than 0.5 px: blurred views, a board that is not flat, or a lens this model does not fit")
    print(f"written: {options.out}")
    if options.json:
        print_json({"camera": options.out, "quality": quality})
    return OK


def _calibrated(options: CameraOptions, frames: Frames, board: Board) -> tuple[Camera, Readout]:
    from wlr_gym.perception.markers.calibration import Readout, calibrate, calibrate_film

    with progress(Console(highlight=False)) as tell:

        def named() -> Iterator[tuple[str, float, NDArray[np.uint8]]]:
            for frame in frames:
                done = _SEARCH * min(frame.index / max(frames.announced, 1), 1.0)
                tell("", f"looking for the board: picture {frame.index + 1}", done)
                yield f"{options.images}, frame {frame.index}", frame.time, frame.image
            tell("", "computing the lens", _SEARCH)

        if not Path(options.images).is_dir():
            return calibrate_film(named(), board, options.every, options.readout)
        camera = calibrate(((name, image) for name, _, image in named()), board)
        return camera.model_copy(update={"readout": options.readout}), Readout()


def _shutter(camera: Camera, told: Readout) -> str:
    """What is known of the shutter, in words."""
    found = f" (found {1e3 * told.value:.1f} ± {1e3 * told.std:.1f} ms)" if math.isfinite(told.std) else ""
    if camera.readout is None:
        return (
            f"readout not known{found}: films of the robot tell it themselves, a live camera needs it. Calibrate from a video "
            "in which the board moves to and fro, up and down, or give --readout (0 for a global shutter)"
        )
    known = found if found and told.std else " (given)"
    if camera.readout == 0:
        return f"global shutter{known}"
    return f"rolling shutter: {1e3 * camera.readout:.1f} ms from the first row to the last{known}"


def write_targets(options: TargetsOptions) -> int:
    """Write the sheets into a folder."""
    require_package("cv2", "vision")
    from wlr_gym.perception.markers.calibration import Board
    from wlr_gym.perception.vision.sheets import board_page, target_pages, write_pages

    body, floor = load_target(options.markers), load_target(options.floor)
    sheets = {f"{target.name}_markers": target_pages(target) for target in (body, floor)}
    sheets["calibration_board"] = {"calibration_board": board_page(Board())}
    for name in sheets:
        refuse_existing(options.out / f"{name}.pdf", options.force)
    make_output_folder(options.out)
    paths = [path for name, pages in sheets.items() for path in write_pages(options.out, name, pages)]
    print(f"in {options.out}: {', '.join(path.name for path in paths)}")
    print("print at 100 %, then measure the ruler on every page")
    if options.json:
        print_json(paths)
    return OK


# ---- the dialogue ----------------------------------------------------------------------------------------------------


class _StoppedError(Exception):
    """The operator does not want to continue."""


def _dialogue(command: Callable[Options, int]) -> Callable[Options, int]:
    """Let a command return 1 when the operator stops it; trouble with the hardware is an :class:`InputError`: nothing moves."""

    @functools.wraps(command)
    def run(*args: Options.args, **kwargs: Options.kwargs) -> int:
        try:
            return command(*args, **kwargs)
        except _StoppedError:
            print("stopped: nothing was written")
            return FAILED
        except BrokenPipeError:  # nobody reads what is printed
            raise
        except (NoAnswerError, RefusedError, ConnectionError) as error:
            raise InputError(f"{error}; see wlr doctor") from None

    return run


def _answer(ask: Ask, text: str) -> str:
    answer = ask(text).strip().lower()
    if answer in ("q", "quit"):
        raise _StoppedError
    return answer


def _require_yes(ask: Ask, text: str) -> None:
    if _answer(ask, f"{text} [y/N]") not in ("y", "yes"):
        raise _StoppedError


def _until_good(look: Callable[[], Result]) -> Result:
    """Ask again while what was seen makes no sense; the operator can end it at every question."""
    while True:
        try:
            return look()
        except NobodyThereError:
            raise
        except InputError as error:
            print(f"{error}. Once more.")


def source_of(hardware: str, out: Path) -> Path:
    """Return the file the hardware comes from; refuse to write over another one."""
    source = find_config("hardware", hardware)
    if out.exists() and not out.samefile(source):
        raise InputError(f"--out {out}: is there already; name it with --hardware to change it")
    check_new_file(out, force=True, endings=(".yaml", ".yml"))
    return source


def save_calibration(
    out: Path, source: Path, change: Callable[[Hardware], Hardware], section: str, note: str, ask: Ask
) -> None:
    """Ask, and write the file with what was found: ``change`` is made to what it says, not to ports of the command line."""
    _require_yes(ask, f"Write {out}?")
    save_hardware(out, source, change(load_hardware(source)), section, note)
    print(f"written: {out}")


def today() -> str:
    return datetime.datetime.now().astimezone().date().isoformat()


# ---- servos ----------------------------------------------------------------------------------------------------------


@_dialogue
def set_up_servo(options: ServoOptions, ask: Ask = ask_terminal) -> int:
    """Find the one servo that is connected, say what will be written, ask, write and look again; 1 when the operator stops."""
    check_name("joint", options.joint, JOINTS)
    robot, hardware = options.load()
    name, bus = next((name, bus) for name, bus in hardware.buses.items() if options.joint in bus.joints)
    id = robot.dynamixel_ids[options.joint]
    print(f"searching {bus.port} ...")
    likely = (FACTORY_RATE, bus.baud_rate)
    others = [rate for rate in BAUD_RATES if rate not in likely]
    servo = check_new_servo(find_servos(name, bus.port, likely) or find_servos(name, bus.port, others), bus, options.joint)
    print(f"found: {servo}\n{options.joint} gets id {id}, {bus.baud_rate} bit/s, {tally(bus.eeprom)}")
    _require_yes(ask, "Write it?")
    set_up(name, bus, servo, id)
    print(f"done: id {id} answers at {bus.baud_rate} bit/s; put a label on it")
    if options.json:
        print_json({"joint": options.joint, "bus": name, "id": id, "baud_rate": bus.baud_rate, "registers": bus.eeprom})
    return OK


@_dialogue
def calibrate_joints(options: JointsOptions, ask: Ask = ask_terminal) -> int:
    """Ask for each joint, show what was found, and write the file; 1 when the operator stops."""

    for joint in options.only:
        check_name("joint", joint, JOINTS)
    robot, hardware = options.load()
    source = source_of(options.hardware, options.out)
    with contextlib.closing(options.link()) as link:
        servos = link.servos
        servos.open()
        if on := [joint for joint in JOINTS if servos.get(joint, "torque_enable")]:
            _require_yes(ask, f"Motors are on: {', '.join(on)}. Off, the robot drops: hold it. Switch them off?")
            if left := servos.torque_off():
                raise InputError(f"{', '.join(left)}: torque does not go off; cut the supply")
        print("Put the robot on a stand, wheels off the ground. Enter continues, s skips a joint, q ends without a file.")
        wanted = [joint for joint in JOINTS if joint in (options.only or JOINTS)]
        found = {joint: _calibrate(joint, robot, hardware, servos, ask) for joint in wanted}
    mountings = {joint: mounting for joint, mounting in found.items() if mounting is not None}
    for joint, new in mountings.items():
        old = hardware.joints[joint]
        print(f"{joint:9} sign {old.sign:+d} -> {new.sign:+d}, zero {old.zero} -> {new.zero}")
    note = f"Signs and zeros by wlr calibrate joints, {today()}: count = zero + sign * angle / (size of a count)."
    save_calibration(options.out, source, lambda file: find.with_mountings(file, mountings), "joints", note, ask)
    if options.json:
        print_json({"hardware": options.out, "joints": {name: one.model_dump() for name, one in mountings.items()}})
    return OK


def _calibrate(joint: str, robot: Robot, hardware: Hardware, servos: Servos, ask: Ask) -> Mounting | None:
    """Return how one joint is mounted; None = skipped."""
    name = full_name(joint)
    move = "swing its foot to the back by 30 deg" if joint in LEGS else "roll it forward by a quarter turn"

    def look() -> Mounting | None:
        if _answer(ask, f"{name}: hold it still, then Enter.") == "s":
            return None
        before = _counts(servos)
        _answer(ask, f"{name}: {move} and hold it there, then Enter.")
        turn = servos.table(joint).counts.turn
        sign, zero = find.find_sign(joint, before, _counts(servos), turn), hardware.joints[joint].zero
        if joint in LEGS:
            _answer(ask, f"{name}: hold it straight down, wheel's centre under the hip, then Enter.")
            straight_down = float(_counts(servos)[JOINTS.index(joint)])
            zero = find.find_zero(joint, sign, straight_down, robot.leg_limits, turn)
        return Mounting(sign=-1 if sign < 0 else 1, zero=zero)

    return _until_good(look)


def _counts(servos: Servos) -> NDArray[np.float64]:
    """Return Present Position of all joints in counts, the average of 20 reads."""
    return np.mean([[servos.get(joint, "present_position") for joint in JOINTS] for _ in range(20)], axis=0)


# ---- sensors ---------------------------------------------------------------------------------------------------------


@_dialogue
def calibrate_imu(options: ImuOptions, ask: Ask = ask_terminal) -> int:
    """Ask for each pose, show what was found, and write the file; 1 when the operator stops."""
    _, hardware = options.load()
    source = source_of(options.hardware, options.out)
    with contextlib.closing(options.link(with_calibration(hardware, ImuCalibration()))) as link:
        link.imu.open()
        print("Enter continues, q ends without a file.")
        calibration = _find_calibration(options, hardware.imu.calibration, link, ask)
        _require_board(link, hardware)
    for name, value in calibration.model_dump(exclude_unset=True).items():
        print(f"{name:13} {value}")
    note = f"IMU calibrated by wlr calibrate imu, {today()}: mounting * scale * (measured - offset), SI units."
    save_calibration(options.out, source, lambda file: with_calibration(file, calibration), "imu", note, ask)
    if options.json:
        print_json({"hardware": options.out, "imu": calibration.model_dump(mode="json")})
    return OK


def _require_board(link: Link, hardware: Hardware) -> None:
    """Print what the IMU's board says of itself; refuse one with other ranges than the file: all would be off by a factor."""
    from wlr_gym.hardware.imu import ImuStream
    from wlr_gym.hardware.safety.preflight import check_board

    for check in check_board(link.imu, hardware.imu, link.clock) if isinstance(link.imu, ImuStream) else ():
        print(f"{check.what:13} {check.found}" if check.ok else check)
        if check.is_fatal and not check.ok:
            raise InputError(f"imu {check.what}: {check.found}, expected {check.expected}. {check.remedy}")


def _find_calibration(options: ImuOptions, known: ImuCalibration, link: Link, ask: Ask) -> ImuCalibration:
    from wlr_gym.hardware.safety.preflight import sample_imu

    def pose(text: str) -> RestPose:
        def look() -> RestPose:
            _answer(ask, text)
            samples = sample_imu(link.imu, link.clock, options.seconds)
            return find.rest_pose(samples.gyro, samples.accelerometer, samples.temperature)

        return _until_good(look)

    level = "Block the body level (the legs hold nothing) and let go of it, then Enter."
    if options.poses == 6:
        side = "Side {} of 6: turn the robot so that the sensor's axes point {}; keep it still, then Enter."
        poses = [pose(side.format(k, up)) for k, up in enumerate(_UP, 1)]
        offset, scale = find.six_positions(poses)
    else:
        poses = [pose(level)]
        offset, scale = known.accel_offset, known.accel_scale
    mounting = known.mounting
    if options.mounting:
        stood = pose(level) if options.poses == 6 else poses[0]
        tilted = pose("Lift the rear: nose down by 10 deg or more, without roll; keep it still, then Enter.")
        mounting = find.mounting(*(np.array(scale) * (one.accelerometer - np.array(offset)) for one in (stood, tilted)))
    elif options.poses == 1:
        offset = find.level_offset(poses[0], known, to_body(known))
    return known.model_copy(
        update={
            "gyro_bias": find.gyro_bias(*poses),
            "accel_offset": offset,
            "accel_scale": scale,
            "mounting": mounting,
            "temperature": round(float(np.mean([one.temperature for one in poses])), 1),
            "date": today(),
        }
    )


@_dialogue
def calibrate_flow(options: FlowOptions) -> int:
    """Show what was found, ask, and write the file; 1 when the operator stops."""
    from wlr_gym.data.runs import read_run

    hardware = load_hardware(options.hardware)
    robot = load_robot(options.robot or hardware.robot or "nominal")
    if hardware.flow is None:
        raise InputError(
            f"--hardware {options.hardware}: names no flow sensor; expected a section flow, such as flow: {{port: ...}}"
        )
    source = source_of(options.hardware, options.out)
    before = hardware.flow.calibration
    fit = fit_flow(read_run(options.run), robot, before, options.distance)
    found = fit.calibration.model_copy(update={"date": today()})
    against = "the wheels" if options.distance is None else "the tape measure"
    print(f"{fit.way:.2f} m in {fit.windows} windows, against {against}")
    print(f"scale     {before.scale:.4f} -> {found.scale:.4f} +- {fit.scale_sigma:.4f}")
    print(f"mount_yaw {before.mount_yaw:.4f} -> {found.mount_yaw:.4f} +- {fit.yaw_sigma:.4f} rad")
    note = f"Flow sensor calibrated by wlr calibrate flow, {today()}: scale, and rotation about body z from body to sensor."
    ask = (lambda text: "y") if options.yes else ask_terminal
    save_calibration(options.out, source, lambda file: with_calibration(file, found), "flow", note, ask)
    if options.json:
        sigma = {"scale": fit.scale_sigma, "mount_yaw": fit.yaw_sigma}
        print_json({"hardware": options.out, "flow": found.model_dump(mode="json"), "sigma": sigma, "way": fit.way})
    return OK


#: Command -> its options, and what it does.
COMMANDS = {
    "camera": (CameraOptions, calibrate_camera),
    "targets": (TargetsOptions, write_targets),
    "servo": (ServoOptions, set_up_servo),
    "joints": (JointsOptions, calibrate_joints),
    "imu": (ImuOptions, calibrate_imu),
    "flow": (FlowOptions, calibrate_flow),
}
