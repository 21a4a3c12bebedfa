"""A picture of what camera, optical flow and observer saw on one time axis, beside the truth.

``python -m studies.bench.camera_figure FIGURE.png`` drives an emulated robot in emulated time and draws it.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from studies.bench.camera_chain import ChainDrive, ChainSetting, chain_camera, drive_chain
from wlr_gym.base.plots import BLUE, GREEN, GREY, ORANGE, legend_below, new_figure, save, tidy
from wlr_gym.perception.observer import ESTIMATE_LAYOUT
from wlr_gym.physics.plants.base import SENSOR_LAYOUT
from wlr_gym.robot import WHEELS

#: s of the drive that is drawn, from when on the lens is covered, and for how long.
_SECONDS, _COVERED, _FOR = 12.0, 5.0, 3.0
#: The truth is wide and pale: what lies on it hides no more than its middle.
_TRUTH: dict[str, Any] = {"color": "0.6", "lw": 4.0, "label": "truth"}
_SEEN, _ESTIMATE, _FLOW = ORANGE, BLUE, GREEN


def draw_chain(drive: ChainDrive, path: Path, title: str) -> None:
    """Draw a drive: errors of position and heading, forward speed, slip of one wheel, age of the camera's pose.

    Args:
        drive: what was seen. path: of the picture. title: of it.
    """
    figure = new_figure(8.0, 6.8)
    axes = figure.subplots(5, 1, sharex=True, height_ratios=(2, 2, 3, 3, 1.5))
    _draw_pose_error(axes[0], drive, 0, "error of x\n(mm)")
    _draw_pose_error(axes[1], drive, 2, "error of the\nheading (mrad)")
    _draw_speed(axes[2], drive)
    _draw_slip(axes[3], drive)
    axes[4].plot(drive.time, 1e3 * drive.sensed("camera_age"), color=_SEEN, lw=1.0)
    axes[4].set_ylabel("age of the\npose (ms)")
    axes[4].set_yscale("log")
    axes[4].yaxis.set_major_formatter("{x:g}")
    axes[4].set_xlabel("time (s)")
    blind = np.array([bool(reason) for reason in drive.reasons])
    for axis in axes:
        shade = {"transform": axis.get_xaxis_transform(), "color": "0.92", "lw": 0, "zorder": 0}
        axis.fill_between(drive.time, 0, 1, where=blind, label="no pose", **shade)
        tidy(axis)
        axis.set_xlim(0, drive.time[-1])
    axes[0].set_title(title, fontsize=10)
    figure.align_ylabels(axes)
    legend_below(figure, columns=3)
    save(figure, path)


def _estimate(drive: ChainDrive, name: str) -> Any:
    return ESTIMATE_LAYOUT.view(drive.estimate, name)


def _draw_pose_error(axis: Any, drive: ChainDrive, k: int, label: str) -> None:
    """One component of the pose, less the truth: the estimate, and every frame against when it was exposed."""
    true = drive.true_pose()[:, k]
    estimate = _estimate(drive, "yaw") if k == 2 else _estimate(drive, "position")[:, k]
    is_new = drive.sensed("camera_is_new") > 0.5
    exposed = (drive.time - drive.sensed("camera_age"))[is_new]
    seen = drive.sensed("camera_pose")[is_new, k] - np.interp(exposed, drive.time, true)
    axis.plot(exposed, 1e3 * seen, ".", color=_SEEN, ms=3, label="camera, when exposed")
    axis.plot(drive.time, 1e3 * (estimate - true), color=_ESTIMATE, lw=1.2, label="observer")
    axis.axhline(0.0, color="black", lw=0.6)
    axis.set_ylabel(label)


def _draw_band(axis: Any, time: Any, values: Any, sigma: Any) -> None:
    axis.fill_between(time, values - 2 * sigma, values + 2 * sigma, color=_ESTIMATE, alpha=0.2, lw=0, label="2 sigma")
    axis.plot(time, values, color=_ESTIMATE, lw=1.2, label="observer")


def _draw_speed(axis: Any, drive: ChainDrive) -> None:
    speed, sigma = (_estimate(drive, f"linear_velocity_{name}")[:, 0] for name in ("in_body", "sigma"))
    axis.plot(drive.time, drive.true("linear_velocity_in_body")[:, 0], **_TRUTH)
    _draw_band(axis, drive.time, speed, sigma)
    axis.plot(drive.time, drive.command[:, 0], "--", color=GREY, lw=1.0, label="command")
    if "flow" in SENSOR_LAYOUT.channels and (is_new := drive.sensed("flow_is_new") > 0.5).any():
        turned = drive.sensed("flow")[:, 0] + drive.sensed("gyro")[:, 1]
        height = drive.true("position")[:, 2]
        axis.plot(drive.time[is_new], (turned * height)[is_new], ".", color=_FLOW, ms=2, label="flow times height")
    axis.set_ylabel("forward speed\n(m/s)")
    axis.set_ylim(*_limits(drive.true("linear_velocity_in_body")[:, 0], speed))


def _draw_slip(axis: Any, drive: ChainDrive, wheel: int = 0) -> None:
    slip, sigma = (_estimate(drive, name)[:, 2 * wheel] for name in ("slip_velocity", "slip_sigma"))
    true = drive.true("slip_velocity")[:, 2 * wheel]
    axis.plot(drive.time, true, **_TRUTH)
    _draw_band(axis, drive.time, slip, sigma)
    axis.set_ylabel(f"slip of {WHEELS[wheel]}\n(m/s)")
    axis.set_ylim(*_limits(true, slip))


def _limits(*series: Any) -> tuple[float, float]:
    low, high = (function([function(values) for values in series]) for function in (np.min, np.max))
    margin = 0.25 * max(high - low, 0.01)
    return float(low - margin), float(high + margin)


def main(arguments: list[str]) -> int:
    """Drive and draw; 0 when done."""
    fault = f"camera_covered after={_COVERED:g} duration={_FOR:g}"
    setting = ChainSetting("velocity_slip_aware", "split", chain_camera(), _SECONDS, (fault,))
    drive = drive_chain(setting, 9000)
    title = "Emulated robot on a split floor; rendered frames, 40 ms latency, 10 % lost; lens covered from 5 to 8 s"
    draw_chain(drive, Path(arguments[0]), title)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
