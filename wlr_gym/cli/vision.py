"""Measure pose and slip from a video of the robot with ring markers; writes run columns cam_*, a slip table, plots, a video.

Writes the run with cam_* columns, slip.csv (per row), frames.csv (per frame), summary.json, pose.png, slip.png, annotated.mp4.
A live camera (its number) is filmed first, to film.avi and film.csv, until Ctrl-C; the run is read after that.

``wlr vision check PHOTO`` looks at the marker sheets in one photograph; see: wlr vision check --help.
"""

from __future__ import annotations

import math
import shutil
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from rich.console import Console
from tyro.conf import Positional

from wlr_gym.base.errors import InputError, Interval, require_package
from wlr_gym.base.files import contents
from wlr_gym.base.progress import progress
from wlr_gym.base.provenance import record_provenance
from wlr_gym.cli import FAILED, OK
from wlr_gym.cli.options import JsonOption, MarkersOption, OutOption, RunsRobotOption, Seconds, settings_of
from wlr_gym.cli.terminal import print_json, print_table
from wlr_gym.perception.markers.targets import Target, load_target

if TYPE_CHECKING:
    from wlr_gym.data import Run
    from wlr_gym.perception.markers.camera import Camera
    from wlr_gym.perception.vision.analysis import VideoAnalysis
    from wlr_gym.perception.vision.sheets import SheetCheck
    from wlr_gym.perception.vision.tracking import Sample, VideoFrame


@dataclass(frozen=True)
class VisionOptions(JsonOption, OutOption, RunsRobotOption, MarkersOption):
    video: Positional[str]
    """Video file, folder of images, or number of a live camera: filmed until Ctrl-C, or --seconds."""
    run: Path
    """What the robot logged meanwhile (CSV or Parquet); with a live camera it may appear while it films."""
    camera: Path
    """Calibration file; make one with: wlr calibrate camera."""
    offset: float | None = None
    """Servo time minus camera time, s; default: found from the motion."""
    around: float = 0.0
    """Where the offset is looked for: servo time minus camera time to within 1 s, s."""
    origin: str = "start"
    """Frame of cam_*: start (0, 0, 0 at the start, as in simulated runs) or floor."""
    rate: Annotated[float, Interval("Hz", above=0.0)] | None = None
    """Rate of evenly spaced frames, Hz; default: the times in the video."""
    times: Path | None = None
    """CSV with one time (s) per frame, before --rate."""
    seconds: Seconds | None = None
    """How much of the video to use, s; default: all."""
    annotate: bool = True
    """Write annotated.mp4."""


@dataclass(frozen=True)
class VisionCheckOptions(JsonOption, MarkersOption):
    """Check print and layout of the marker sheets from one photograph: which are there, stretch of the print, what misfits."""

    photo: Positional[Path]
    """Picture, taken by the calibrated camera, focus and size as in the calibration."""
    camera: Path
    """Calibration file; make one with: wlr calibrate camera."""
    only: Literal["markers", "floor"] | None = None
    """Which of them the photograph shows, when it is one: markers or floor."""


def run(options: VisionOptions) -> int:
    """Analyse, print, write; 0 when done.

    Raises:
        InputError: unreadable video, run, camera or target; wrong image size; no floor frame; nothing to align on.
    """
    require_package("cv2", "vision")

    from wlr_gym.data import read_run
    from wlr_gym.perception.markers.camera import load_camera
    from wlr_gym.perception.vision.analysis import save_video_analysis
    from wlr_gym.perception.vision.video import film

    if Path(options.video).is_dir() and options.rate is None and options.times is None:
        raise InputError(f"{options.video}: images do not say when they were taken: give --rate (Hz) or --times")
    live = options.video.isdigit() and not Path(options.video).exists()
    if live and (options.times is not None or options.rate is not None):
        raise InputError("--times, --rate: a live camera's frames have the times at which they come")
    measured = None if live else read_run(options.run)
    camera, body, floor = load_camera(options.camera), load_target(options.markers), load_target(options.floor)
    if options.out.resolve() == options.run.resolve().parent:
        raise InputError(f"--out {options.out}: is the run's own folder; the run would be overwritten")
    options.refuse_results(options.out, "summary.json")
    fresh = not contents(options.out)
    console = Console(highlight=False, soft_wrap=True)
    try:
        if live:
            end = "Ctrl-C ends it" if options.seconds is None else f"{options.seconds:g} s"
            console.print(f"filming with camera {options.video}; {end}")
            video, times = film(int(options.video), options.out, camera, options.seconds)
            console.print(
                f"filmed: {video}; to analyse it again, give it in place of the camera's number, with --times {times}"
            )
            options = replace(options, video=str(video), times=times)
        analysis = _analyse(options, measured or read_run(options.run), camera, body, floor, console)
    except BaseException:
        if fresh and not (options.out / "film.avi").exists():  # a refusal leaves no folder behind; a film stays
            for path in contents(options.out):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        raise
    paths = save_video_analysis(analysis, options.out)
    record_provenance(options.out, settings_of(options) | {"robot": analysis.robot.name})
    if options.json:
        print_json(analysis.summary())
    else:
        _print(analysis, console)
    console.print(f"in {options.out}: {', '.join(path.name for path in paths)}{', annotated.mp4' if options.annotate else ''}")
    return OK


def _analyse(
    options: VisionOptions, measured: Run, camera: Camera, body: Target, floor: Target, console: Console
) -> VideoAnalysis:
    """Analyse, tell how far it is, and write ``annotated.mp4`` on the way."""
    from wlr_gym.perception.vision.analysis import analyse
    from wlr_gym.perception.vision.video import AnnotatedVideo, Frames

    frames = Frames(options.video, options.rate, options.times, options.seconds)
    writer = AnnotatedVideo(options.out / "annotated.mp4", body, frames) if options.annotate else nullcontext()
    length = min(float(np.ptp(measured["t"])), options.seconds or math.inf)  # a film is about as long as its run
    began: list[float] = []
    with writer as video, progress(console) as tell:

        def watch(frame: VideoFrame, sample: Sample) -> None:
            began[:] = began or [frame.time]
            if video is not None:
                video.add(frame, sample)
            if frame.index % 30 == 0:
                share = min((frame.time - began[0]) / length, 0.99)
                tell("", f"tracking: frame {frame.index}, {sample.status}", share)

        return analyse(
            frames, measured, camera, body, floor, options.robot, options.offset, options.origin, watch, options.around
        )


def _print(analysis: VideoAnalysis, console: Console) -> None:
    found = analysis.summary()
    for finding in found["findings"]:
        console.print(finding, style="yellow")
    status = ", ".join(f"{count} {name}" for name, count in found["status"].items() if count)
    known = f" ± {1e3 * found['offset_std_s']:.1f}" if found["offset_std_s"] else " (given)"
    console.print(f"{found['frames']} frames ({status}); clocks differ by {1e3 * found['offset_s']:.1f}{known} ms")
    rows = []
    for wheel, in_m in found["wheels"].items():
        w = {name: 1e3 * value for name, value in in_m.items()}
        along, across = (f"{w[f'{axis}_slip_m']:+.2f} ± {w[f'{axis}_std_m']:.2f}" for axis in ("longitudinal", "lateral"))
        layout = f"{w['longitudinal_std_from_layout_m']:.2f}, {w['lateral_std_from_layout_m']:.2f}"
        rows.append((wheel, along, f"{w['longitudinal_std_from_radius_m']:.2f}", across, layout))
    longitudinal, lateral = (f"{1e3 * found[f'body_{axis}_slip_m']:+.2f}" for axis in ("longitudinal", "lateral"))
    headings = ("wheel", "longitudinal", "± from radius", "lateral", "± from layout")
    title = f"Slip over {found['seconds']:.1f} s, mm ± 1 sigma"
    print_table(console, headings, [*rows, ("body", longitudinal, "", lateral, "")], title)
    console.print(f"share of the predicted path that ignoring slip gets wrong: {100 * found['no_slip_error']:.2f} %")


# ---- the sheets ----------------------------------------------------------------------------------------------------------


def check_photo(options: VisionCheckOptions) -> int:
    """Check and print; 0 when everything fits.

    Raises:
        InputError: unreadable photograph, camera or target; wrong image size.
    """
    require_package("cv2", "vision")

    from wlr_gym.perception.markers.camera import load_camera
    from wlr_gym.perception.vision.sheets import check_sheets
    from wlr_gym.perception.vision.video import read_image

    files = {"markers": options.markers, "floor": options.floor}
    targets = [load_target(file) for name, file in files.items() if options.only in (None, name)]
    camera = load_camera(options.camera)
    image = read_image(options.photo) if options.photo.is_file() else None
    if image is None:
        raise InputError(f"{options.photo}: no such picture, or it cannot be read as one")
    checks = check_sheets(image, camera, targets)
    if options.json:  # m, shares
        names = ("seen", "fault", "stretch", "stretch_std", "difference_std", "misfit", "warnings")
        print_json(
            [
                {"target": check.target.name, "markers": len(check.target.markers)}
                | {name: getattr(check, name) for name in names}
                for check in checks
            ]
        )
    for check in checks:
        print(_line(check))
        print("".join(f"  {warning}\n" for warning in check.warnings), end="")
    return FAILED if any(check.warnings for check in checks) else OK


def _line(check: SheetCheck) -> str:
    head = f"{check.target.name}: {check.seen} of {len(check.target.markers)} markers"
    if check.fault:
        return f"{head}; not found"
    text = f"{head}, off their places by {1e3 * check.misfit:.2f} mm rms (as far as one photograph shows it)"
    if check.stretch is None or check.stretch_std is None:
        return text
    (x, y), (x_std, y_std) = 100 * check.stretch, 100 * check.stretch_std
    if check.target.caliper is None:
        return (
            f"{text}; x stretched by {x - y:+.2f} ± {100 * check.difference_std:.2f} % more than y (the scale itself needs a "
            "caliper reading in the target file)"
        )
    return f"{text}; stretched by {x:+.2f} ± {x_std:.2f} % along x, {y:+.2f} ± {y_std:.2f} % along y"


#: Word behind the command -> its options, and what it does.
COMMANDS = {"check": (VisionCheckOptions, check_photo)}
