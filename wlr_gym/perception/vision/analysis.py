"""From a video and the run it shows to run columns ``cam_*``, a slip table, a summary and plots."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import tee
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, check_name
from wlr_gym.base.files import replace_file, write_json
from wlr_gym.base.plots import BLUE, COLOURS, GREY, legend_below, new_figure, save, tidy
from wlr_gym.data.format import check_speeds
from wlr_gym.data.run_states import rest_pose
from wlr_gym.data.runs import Run, floor_of, own_robot, robot_of, write_run
from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.detection import detect
from wlr_gym.perception.markers.pose import sheet_fault
from wlr_gym.perception.markers.targets import Target
from wlr_gym.perception.vision.alignment import Alignment, align, joint_signals
from wlr_gym.perception.vision.motion import smoothed_poses
from wlr_gym.perception.vision.self_calibration import (
    UNSURE,
    SelfCalibration,
    calibration_findings,
    self_calibrated,
    without_repeats,
)
from wlr_gym.perception.vision.slip import SlipResult, measure_slip
from wlr_gym.perception.vision.tracking import IMPOSSIBLE, LOST, MOVED, OK, PARTIAL, REPEATED, Sample, VideoFrame, track
from wlr_gym.perception.vision.video import Frames
from wlr_gym.physics.floor import lay_floor
from wlr_gym.physics.plants import relief
from wlr_gym.physics.plants.sensors import rotation
from wlr_gym.robot import LEG_SLICE, WHEELS, Robot
from wlr_gym.robot.parameter_table import CORNER_NAMES
from wlr_gym.robot.parameters import Parameters

if TYPE_CHECKING:
    import pandas

Array = NDArray[np.float64]

ORIGINS = ("start", "floor")
_POSE = ("x", "y", "z", "yaw", "pitch", "roll")
#: px; above this the calibration, the print or the target file do not fit what is seen.
POOR_FIT = 0.3
#: m; the body's height by the camera may differ by this from what its legs say.
HEIGHT_TOLERANCE = 0.005
#: s without a row of the run after which its slip is no longer known to its sigma.
_LONGEST_PAUSE = 0.11
_START = 0.3  # s of the first poses that make the start pose
_AT_REST = 0.01  # m/s; a robot faster than this is not at rest


@dataclass(frozen=True, eq=False)
class VideoAnalysis:
    """What a video says about a run.

    Attributes:
        run: with the columns ``cam_*``. samples: one per frame. alignment: None when the offset was given.
        offset: servo time = camera time + offset, s. slip: per row. robot: geometry used. origin: of the ``cam_*`` columns.
        height_error: m, body height by the camera minus that by the legs, median: shows a wrong print scale.
        missing_frames: that the video announces but that could not be decoded. findings: what is odd, in words.
        calibration: marker places and shutter that the film told.
    """

    run: Run
    samples: tuple[Sample, ...]
    alignment: Alignment | None
    offset: float
    slip: SlipResult
    robot: Robot
    origin: str
    height_error: float
    missing_frames: int
    findings: tuple[str, ...]
    calibration: SelfCalibration | None = None

    def summary(self) -> dict[str, Any]:
        """Return the main numbers as plain JSON types."""
        slip, counts = self.slip, Counter(sample.status for sample in self.samples)
        residuals = [sample.residual for sample in self.samples if math.isfinite(sample.residual)]
        wheels = {
            wheel: {
                "longitudinal_slip_m": float(slip.slip[-1, w, 0]), "longitudinal_std_m": float(slip.slip_std[-1, w, 0]),
                "longitudinal_std_from_radius_m": float(slip.slip_radius_std[-1, w]),
                "lateral_slip_m": float(slip.slip[-1, w, 1]), "lateral_std_m": float(slip.slip_std[-1, w, 1]),
                "longitudinal_std_from_layout_m": float(slip.slip_layout_std[-1, w, 0]),
                "lateral_std_from_layout_m": float(slip.slip_layout_std[-1, w, 1]),
            }
            for w, wheel in enumerate(WHEELS)
        }  # fmt: skip
        return {
            "frames": len(self.samples),
            "missing_frames": self.missing_frames,
            "status": {name: counts.get(name, 0) for name in (OK, PARTIAL, LOST, MOVED, IMPOSSIBLE, REPEATED)},
            "outliers": int(slip.outliers.sum()),
            "median_residual_px": float(np.median(residuals)),
            "offset_s": self.offset,
            "offset_std_s": self.alignment.std if self.alignment else None,
            "offset_by_signal_s": {name: part[0] for name, part in self.alignment.parts.items()} if self.alignment else {},
            "origin": self.origin,
            "height_error_m": self.height_error,
            "readout_s": self.calibration.readout if self.calibration else None,
            "markers_moved_m": self.calibration.moved.tolist() if self.calibration else [],
            "seconds": float(slip.time[-1] - slip.time[0]),
            "body_longitudinal_slip_m": float(slip.body_slip[-1, 0]),
            "body_lateral_slip_m": float(slip.body_slip[-1, 1]),
            "no_slip_error": slip.no_slip_error,
            "wheels": wheels,
            "slip_covariance_m2": slip.covariance.tolist(),
            "findings": list(self.findings),
        }


def analyse(
    frames: Iterable[VideoFrame],
    run: Run,
    camera: Camera,
    body: Target,
    floor: Target,
    robot: Robot | str | None = None,
    offset: float | None = None,
    origin: str = "start",
    watch: Callable[[VideoFrame, Sample], None] | None = None,
    around: float = 0.0,
) -> VideoAnalysis:
    """Track the robot through a video and measure pose and slip.

    Args:
        frames: of the video. run: what the robot logged meanwhile. camera: calibration. body, floor: targets.
        robot: None = the one the run's meta data name.
        offset: s, servo time minus camera time; None = found from the motion.
        origin: frame of the ``cam_*`` columns: ``start`` (pose at the start is 0, 0, 0, as in simulated runs) or ``floor``.
        watch: called with every frame and its sample, in order.
        around: s, where ``offset`` is looked for, within 1 s.

    Raises:
        InputError: a floor with relief, wrong image size, no floor frame, too few poses, no motion to align on, video and run
            apart.
    """
    check_name("origin", origin, ORIGINS)
    found = robot_of(run, robot)
    check_speeds({name: run[name] for name in run.table}, found, str(run.path))
    _require_level(run, found)
    parameters = Parameters.nominal(found)
    for_tracking, for_watching = tee(frames)  # they are apart no longer than until the floor is located
    tracked: list[Sample] = []
    first = None  # to say what is in it when the robot is not
    for frame, sample in zip(for_watching, track(for_tracking, camera, body, floor), strict=False):
        first = first or frame
        tracked.append(sample)
        if watch is not None:
            watch(frame, sample)
    seen = sum(math.isfinite(sample.pose[0]) for sample in tracked)
    if first is None or seen < 10:
        counts = ", ".join(f"{count} {name}" for name, count in Counter(sample.status for sample in tracked).items())
        why = sheet_fault(detect(first.image, camera) if first else [], body, camera)
        raise InputError(f"only {seen} of {len(tracked)} frames have a pose of the robot ({counts}); in the first frame {why}")
    samples, calibration = self_calibrated(tuple(without_repeats(tracked)), camera, body, floor)
    alignment = None
    if offset is None:
        time, poses = np.array([s.time for s in samples]), np.stack([s.pose for s in samples])
        alignment = align(time, poses, run, found, parameters, around)
        offset = alignment.offset
    known = alignment.std if alignment else 0.0
    layout = calibration.adjustment.scale_std, calibration.adjustment.heading_std
    slip = measure_slip(samples, offset, run, found, parameters, known, layout)
    table = camera_columns(samples, offset, run, origin, slip.outliers)
    measured = Run(table, run.meta, run.path, run.findings)
    legs = joint_signals(run, slip.time, found)[0][:, LEG_SLICE] - parameters["joint.zero_offset"]
    height_error = float(np.median(slip.pose[:, 2] - rest_pose(parameters, legs)[:, 0]))
    missing = frames.missing if isinstance(frames, Frames) else 0
    findings = *_findings(samples, slip, height_error, missing), *calibration_findings(calibration), *slip.contradictions
    return VideoAnalysis(
        measured, samples, alignment, offset, slip, found, origin, height_error, missing, findings, calibration
    )


def _require_level(run: Run, robot: Robot) -> None:
    """Refuse a floor with relief: height, tilt and contacts of the robot are taken from its legs, as on a plane."""
    found = floor_of(run)
    if relief.families(lay_floor(found, Parameters.nominal(robot))):
        raise InputError(f"{run.path}: its floor, '{found.name}', has relief: expected a flat one; slip in films needs a plane")


def camera_columns(
    samples: Sequence[Sample], offset: float, run: Run, origin: str, outliers: NDArray[np.bool_]
) -> pandas.DataFrame:
    """Return the run's table with the columns ``cam_*``: each frame's own measurement, in the row nearest to it.

    It is moved to the row's time by the smoothed rate (at most half a control step), so the columns have no delay; rows
    without a frame are NaN. Position is that of the run's ``marker_offset`` in the body (0 = body origin G).
    """
    t = run["t"]
    good = np.array([math.isfinite(s.pose[0]) for s in samples]) & ~outliers
    kept = [sample for sample, fine in zip(samples, good, strict=True) if fine]
    time = np.array([s.time for s in kept]) + offset
    poses = np.stack([s.pose for s in kept])
    poses[:, 3] = np.unwrap(poses[:, 3])
    rates = np.stack([signal.rate for signal in smoothed_poses(kept, time, time)], axis=1)
    marker = np.asarray(run.meta.marker_offset)
    place = poses[:, :3] + np.einsum("nij,j->ni", rotation(*poses[:, 3:].T), marker)
    after = np.clip(np.searchsorted(t, time), 1, len(t) - 1)
    rows = after - (time - t[after - 1] <= t[after] - time)
    late = t[rows] - time
    inside = (time > t[0] - 0.01) & (time < t[-1] + 0.01)
    values = np.column_stack([place[:, :2], poses[:, 3], place[:, 2], poses[:, 4]]) + late[:, None] * rates[:, [0, 1, 3, 2, 4]]
    if origin == "start":
        x, y, yaw = values[time <= time[0] + _START, :3].mean(axis=0)
        c, s = math.cos(yaw), math.sin(yaw)
        dx, dy = values[:, 0] - x, values[:, 1] - y
        values[:, :3] = np.column_stack([c * dx + s * dy, c * dy - s * dx, values[:, 2] - yaw])
    order = np.argsort(-np.abs(late))  # of two frames near one row the nearer is written last
    order = order[inside[order]]
    columns = np.full((len(t), 5), np.nan)
    columns[rows[order]] = values[order]
    return run.table.assign(**dict(zip(("cam_x", "cam_y", "cam_yaw", "cam_z", "cam_pitch"), columns.T, strict=True)))


def save_video_analysis(analysis: VideoAnalysis, folder: Path) -> list[Path]:
    """Write run, slip table, samples, summary and plots into ``folder``; return their paths."""
    run = analysis.run
    robot = own_robot(run.meta, run.path.parent)
    paths = [write_run(folder / f"{run.name}.parquet", run.table, run.meta, robot=robot)]
    for file, table in (("slip.csv", analysis.slip.table()), ("frames.csv", frame_table(analysis.samples, analysis.offset))):
        replace_file(folder / file, lambda temporary, table=table: table.to_csv(temporary, index=False, float_format="%.9g"))
    write_json(folder / "summary.json", analysis.summary())
    paths += [folder / name for name in ("slip.csv", "frames.csv", "summary.json")]
    return [*paths, save(_draw_pose(analysis), folder / "pose.png"), save(_draw_slip(analysis), folder / "slip.png")]


def frame_table(samples: Sequence[Sample], offset: float) -> pandas.DataFrame:
    """One row per frame: number, time on both clocks, status, pose, 1 sigma, markers used, residual."""
    import pandas

    poses, std = np.stack([s.pose for s in samples]), np.sqrt([np.diag(s.covariance) for s in samples])
    frames = [(s.index, s.time, s.time + offset, s.status) for s in samples]
    table = pandas.DataFrame(frames, columns=["frame", "camera_time", "t", "status"])
    table[list(_POSE)] = poses
    table[[f"{name}_std" for name in _POSE]] = std
    return table.assign(markers=[s.markers for s in samples], residual_px=[s.residual for s in samples])


def _findings(samples: Sequence[Sample], slip: SlipResult, height_error: float, missing: int = 0) -> Iterator[str]:
    counts = Counter(sample.status for sample in samples)
    if missing:
        yield (
            f"the video is cut off or damaged: it announces {missing + len(samples)} frames, of which {len(samples)} could be "
            "decoded; what the others show is not in the results"
        )
    if counts[MOVED]:
        first = next(sample for sample in samples if sample.status == MOVED)
        yield (
            f"the camera moved, and the floor was not to be located: {counts[MOVED]} frames from {first.index} on "
            f"({first.time:.2f} s) have no pose"
        )
    if counts[LOST]:
        yield f"{counts[LOST]} frames without the robot's markers (hidden, blurred or out of view)"
    if counts[REPEATED]:
        yield f"{counts[REPEATED]} frames repeat the picture before, and were left out"
    if counts[IMPOSSIBLE]:
        yield f"{counts[IMPOSSIBLE]} frames gave a pose that cannot be, and were left out"
    if slip.outliers.any():
        yield f"{int(slip.outliers.sum())} frames contradict their neighbours, and were left out"
    if not slip.covered.all():
        yield f"{int((~slip.covered).sum())} rows are further than 0.15 s from a pose: interpolated, see the column 'covered'"
    pauses = np.diff(slip.time)
    if pauses.max() > _LONGEST_PAUSE:
        pause = f"for {pauses.max():.2f} s after {slip.time[np.argmax(pauses)]:.2f} s"
        yield f"the run has no rows {pause}: legs and wheels are interpolated there; {UNSURE}"
    residual = float(np.median([sample.residual for sample in samples if math.isfinite(sample.residual)]))
    if residual > POOR_FIT:
        yield f"markers miss their places by {residual:.2f} px: calibration, print scale or target file do not fit"
    if abs(height_error) > HEIGHT_TOLERANCE:
        yield (
            f"the body stands {1e3 * height_error:+.0f} mm off what its legs say: print scale, marker height, calibration or "
            "leg zeros are wrong; a wrong scale also falsifies slip"
        )
    first = slip.time <= slip.time[0] + _START
    if np.hypot(*slip.rate[first, :2].T).min() > _AT_REST:
        yield "the robot already moves when the video starts: with --origin start, cam_* are 0 there, not at the run's start"
    steps = np.diff([sample.time for sample in samples])
    dropped = int(np.sum(np.round(steps / np.median(steps)) - 1)) if len(steps) else 0
    if dropped > 0:
        yield f"about {dropped} frames were dropped by the camera"


# --- plots ------------------------------------------------------------------------------------------------------------

#: Width and line of each wheel, so that curves that coincide are all seen: front wide, rear narrow, right dashed.
_LINES = ((2.6, "-"), (2.6, "--"), (1.1, "-"), (1.1, "--"))


def _draw_pose(analysis: VideoAnalysis) -> Any:
    figure = new_figure(9.0, 9.5)
    panels = figure.subplots(5, 1, sharex=True)
    slip, time = analysis.slip, np.array([s.time for s in analysis.samples]) + analysis.offset
    poses = np.stack([s.pose for s in analysis.samples])
    poses[:, 3] = np.unwrap(np.nan_to_num(poses[:, 3])) + 0 * poses[:, 3]
    for k, (axes, name) in enumerate(zip(panels, ("x", "y", "z", "yaw", "pitch"), strict=True)):
        unit, factor = ("mm", 1e3) if k < 3 else ("deg", 180 / math.pi)
        axes.plot(time, factor * poses[:, k], ".", color=GREY, markersize=3, label="frames")
        axes.plot(slip.time, factor * slip.pose[:, k], color=BLUE, linewidth=1.1, label="smoothed")
        std = f"1 sigma of a smoothed pose: {factor * np.median(slip.pose_std[:, k]):.2g} {unit}"
        axes.set_title(f"{name} of the body in the floor frame; {std}", fontsize=9, loc="left")
        axes.set_ylabel(f"{name} ({unit})")
        tidy(axes)
    panels[-1].set_xlabel("time (s)")
    legend_below(figure)
    figure.suptitle(f"{analysis.run.name}: pose from the camera", fontsize=13)
    return figure


def _draw_slip(analysis: VideoAnalysis) -> Any:
    figure = new_figure(9.0, 6.5)
    panels = figure.subplots(3, 1, sharex=True)
    slip = analysis.slip
    spread = 2.0 * np.hypot(slip.slip_std, slip.slip_layout_std)
    spread[..., 0] = np.hypot(spread[..., 0], 2.0 * slip.slip_radius_std)
    for w, (wheel, colour, (width, line)) in enumerate(zip(CORNER_NAMES.values(), COLOURS, _LINES, strict=False)):
        for a, axes in enumerate(panels[:2]):
            middle, band = 1e3 * slip.slip[:, w, a], 1e3 * spread[:, w, a]
            axes.plot(slip.time, middle, line, color=colour, linewidth=width, label=wheel)
            axes.fill_between(slip.time, middle - band, middle + band, color=colour, alpha=0.3, linewidth=0.5)
        panels[2].plot(slip.time, slip.ratio[:, w], line, color=colour, linewidth=width)
    along, across = (f"{1e3 * wide:.2g} mm at the end" for wide in spread[-1].max(axis=0))
    slip_signs = "+ skids forward (turns too little), - spins (turns too much)"
    ratio_signs = "signs the other way round: +1 spins on the spot, -1 is locked, beyond them turns against its travel"
    titles = {
        "longitudinal slip (mm)": f"accumulated longitudinal slip: {slip_signs}\n"
        f"band: 2 sigma with wheel radius and marker layout, up to {along}",
        "lateral slip (mm)": f"accumulated lateral slip: + to the left; band: 2 sigma with marker layout, up to {across}",
        "slip ratio (-)": f"slip ratio, {ratio_signs}",
    }
    for axes, (unit, title) in zip(panels, titles.items(), strict=True):
        axes.set_title(title, fontsize=9, loc="left")
        axes.set_ylabel(unit)
        tidy(axes)
    panels[-1].set_xlabel("time (s)")
    legend_below(figure)
    figure.suptitle(f"{analysis.run.name}: slip of the wheels", fontsize=13)
    return figure
