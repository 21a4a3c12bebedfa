"""Calibrate what measures: the robot's ``joints``, ``imu``, ``flow``, a ``camera``; ``targets`` are its sheets to print."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.cli import OK
from wlr_gym.cli.calibrate_flow import FlowOptions, calibrate_flow
from wlr_gym.cli.calibrate_robot import ImuOptions, JointsOptions, ServoOptions, calibrate_imu, calibrate_joints, set_up_servo
from wlr_gym.cli.options import ForceOption, JsonOption, require_counts
from wlr_gym.cli.results import print_json

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from wlr_gym.perception.markers.calibration import Board, Readout
    from wlr_gym.perception.markers.camera import Camera
    from wlr_gym.perception.vision.video import Frames


#: Share of the time that looking for the board takes, about; the computation of the lens takes the rest.
_SEARCH = 0.8


@dataclass(frozen=True)
class CameraOptions(JsonOption, ForceOption):
    """Calibrate a camera from views of the printed board.

    Attributes:
        images: folder of images, or a video, of the board: 15 or more views, tilted, in every corner of the image, sharp. In a
            video a board that moves tells a rolling shutter.
        out: camera file to write (YAML).
        board: what it is: charuco (as written by wlr calibrate targets), charuco-legacy (as OpenCV drew them before 4.6), or
            chessboard.
        columns: squares of the board along its longer side.
        rows: squares along its shorter side.
        square: side of a square as measured on the print, m.
        marker: side of a ChArUco board's markers, m; left out, 0.7 of a square.
        dictionary: of a ChArUco board's markers, as OpenCV names it without DICT_.
        every: use every n-th frame of a video.
        readout: time from the first row's exposure to the last row's, s, where it is known; 0 = global shutter.
    """

    images: Annotated[str, tyro.conf.Positional]
    out: Path
    board: Literal["charuco", "charuco-legacy", "chessboard"] = "charuco"
    columns: int = 9
    rows: int = 6
    square: float = 0.028
    marker: float | None = None
    dictionary: str = "5X5_100"
    every: int = 15
    readout: float | None = None


@dataclass(frozen=True)
class TargetsOptions(JsonOption, ForceOption):
    """Write the sheets to print, as PDF and SVG to scale: markers on the robot, markers on the floor, calibration board.

    Attributes:
        out: folder; made if it is not there.
        markers: markers on the robot: name in configs/vision/ or path.
        floor: markers on the floor: name in configs/vision/ or path.
    """

    out: Path
    markers: str = "body"
    floor: str = "floor"


#: Command -> its options, and what it does.
COMMANDS = {
    "camera": (CameraOptions, "lens of a camera, from views of a board"),
    "targets": (TargetsOptions, "sheets to print: markers and calibration board"),
    "servo": (ServoOptions, "id and baud rate of a new servo"),
    "joints": (JointsOptions, "sign and zero of each servo, by hand"),
    "imu": (ImuOptions, "biases, scale and mounting of the IMU"),
    "flow": (FlowOptions, "scale and mounting of the optical-flow sensor"),
}


def run(options: CameraOptions | TargetsOptions | ServoOptions | JointsOptions | ImuOptions | FlowOptions) -> int:
    """Do what the sub-command says; 0 when done."""
    if isinstance(options, ServoOptions):
        return set_up_servo(options)
    if isinstance(options, JointsOptions):
        return calibrate_joints(options)
    if isinstance(options, ImuOptions):
        return calibrate_imu(options)
    if isinstance(options, FlowOptions):
        return calibrate_flow(options)
    require_package("cv2", "vision")
    return _targets(options) if isinstance(options, TargetsOptions) else _camera(options)


def _camera(options: CameraOptions) -> int:
    from wlr_gym.base.files import refuse_existing
    from wlr_gym.perception.markers.calibration import Board
    from wlr_gym.perception.markers.camera import save_camera
    from wlr_gym.perception.vision.video import Frames

    if not 0.001 < options.square < 0.5:
        raise InputError(f"--square {options.square:g}: expected metres, as measured on the print (28 mm = 0.028)")
    require_counts(options, "columns", "rows", least=3)
    require_counts(options, "every")
    if options.readout is not None and not -0.1 < options.readout < 0.1:
        raise InputError(f"--readout {options.readout:g}: expected seconds, less than 0.1 (20 ms = 0.02)")
    if options.out.suffix not in {".yaml", ".yml"} or not options.out.parent.is_dir():
        raise InputError(f"--out {options.out}: expected a .yaml file in a folder that exists")
    refuse_existing(options.out, options.force)
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
    from rich.console import Console

    from wlr_gym.base.progress import progress
    from wlr_gym.perception.markers.calibration import Readout, calibrate, calibrate_film

    with progress(Console(highlight=False)) as tell:
        named = _named(options.images, frames, lambda doing, share: tell("", doing, share))
        if not Path(options.images).is_dir():
            return calibrate_film(named, board, options.every, options.readout)
        camera = calibrate(((name, image) for name, _, image in named), board)
        return camera.model_copy(update={"readout": options.readout}), Readout()


def _named(source: str, frames: Frames, tell: Callable[[str, float], None]) -> Iterator[tuple[str, float, NDArray[np.uint8]]]:
    """Yield name, time and picture of each frame, and tell how many are done."""
    for frame in frames:
        tell(f"looking for the board: picture {frame.index + 1}", _SEARCH * min(frame.index / max(frames.announced, 1), 1.0))
        yield f"{source}, frame {frame.index}", frame.time, frame.image
    tell("computing the lens", _SEARCH)


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


def _targets(options: TargetsOptions) -> int:
    from wlr_gym.base.files import make_output_folder, refuse_existing
    from wlr_gym.perception.markers.calibration import Board
    from wlr_gym.perception.markers.targets import load_target
    from wlr_gym.perception.vision.sheets import board_page, target_pages, write_pages

    body, floor = load_target(options.markers), load_target(options.floor)
    for name in (f"{body.name}_markers", f"{floor.name}_markers", "calibration_board"):
        refuse_existing(options.out / f"{name}.pdf", options.force)
    make_output_folder(options.out)
    paths = write_pages(options.out, f"{body.name}_markers", target_pages(body))
    paths += write_pages(options.out, f"{floor.name}_markers", target_pages(floor))
    paths += write_pages(options.out, "calibration_board", [board_page(Board())])
    print(f"in {options.out}: {', '.join(path.name for path in paths)}")
    print("print at 100 %, then measure the ruler on every page")
    if options.json:
        print_json(paths)
    return OK
