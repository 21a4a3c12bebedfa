"""The live status of a robot that drives: its joints, and what supervision sees, beside the limits it holds it to."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from wlr_gym.robot import JOINTS

if TYPE_CHECKING:
    from wlr_gym.envs.core import Core
    from wlr_gym.hardware.loop import ControlLoop
    from wlr_gym.hardware.safety.rules import RobotStatus


class RobotView:
    """What a driver wants to see now.

    Args:
        loop: drives the robot.
        core: what it is asked to follow.
    """

    def __init__(self, loop: ControlLoop, core: Core) -> None:
        self._loop, self._core = loop, core
        self._seen: Counter[str] = Counter()

    def table(self) -> Any:
        """Return a table of the joints, and below it the command and what supervision sees."""
        from rich.table import Table

        loop, core = self._loop, self._core
        phase = loop.phase.name.lower().replace("_", " ")
        table = Table(box=None, title=f"{phase}  {core.time[0]:.1f} s", title_justify="left", caption_justify="left")
        for name in ("joint", "angle rad", "setpoint", "speed rad/s", "effort N m", "degC", "V"):
            table.add_column(name, justify="left" if name == "joint" else "right")
        status = loop.status
        if status is None:
            return table
        columns = (status.position, loop.setpoints, status.velocity, status.effort, status.temperature, status.voltage)
        for k, joint in enumerate(JOINTS):
            numbers = (f"{column[k]:.2f}" for column in columns)
            table.add_row(joint, *numbers, style="red" if status.silence[k] > 0 else "")
        command = "  ".join(f"{name} {value:+.2f}" for name, value in zip(core.task.commands, core.command[0], strict=True))
        camera = [] if status.camera is None else [camera_state(status)]
        table.caption = "\n".join([command, supervised(loop, status), *camera, self._interventions()])
        return table

    def _interventions(self) -> str:
        """What the command limiter changed or stopped since the last look, and in all."""
        counts = self._loop.interventions
        now = ", ".join(sorted(counts - self._seen)) or "nothing"
        in_all = ", ".join(f"{rule} {count}" for rule, count in counts.most_common()) or "none"
        self._seen = counts.copy()
        return f"command limiter acts on: {now}; steps in all: {in_all}"


def supervised(loop: ControlLoop, status: RobotStatus) -> str:
    """Return what the safety rules look at, each with its limit."""
    from wlr_gym.hardware.safety.rules import ratings_of, tilt_of

    limits = loop.limits
    load = np.abs(status.effort) / ratings_of(loop.robot, loop.pacer.period).stall_torque
    strained, hottest, lowest = int(load.argmax()), int(status.temperature.argmax()), int(status.voltage.argmin())
    seen = [
        f"load {load[strained]:.0%} ({JOINTS[strained]}, limit {limits.load:.0%})",
        f"{status.temperature[hottest]:.0f} degC ({JOINTS[hottest]}, limit {limits.hot:g})",
        f"{status.voltage[lowest]:.1f} V ({JOINTS[lowest]}, limit {limits.low_voltage:g})",
        f"tilt {tilt_of(status.up):.2f} rad (limit {limits.tilt:g})",
        f"servos silent {status.silence.max():.2f} s (limit {limits.silence:g})",
        f"IMU {status.imu_silence:.2f} s (limit {limits.imu_silence:g})",
        f"late {loop.pacer.late_ticks} in a row (limit {limits.late}), {loop.pacer.late_share:.0%} "
        f"(limit {limits.late_share:.0%}), missed {loop.pacer.missed}",
    ]
    if limits.deadman is not None:
        seen.append(f"operator silent {loop.operator.silence:.1f} s (limit {limits.deadman:g})")
    return "  ".join(seen)


def camera_state(status: RobotStatus) -> str:
    """Return what the camera says now."""
    camera = status.camera
    assert camera is not None
    x, y, yaw = camera.pose
    found = f"camera: x {x:+.3f} m  y {y:+.3f} m  yaw {yaw:+.3f} rad, {1e3 * (status.time - camera.time):.0f} ms old"
    if camera.doubt:
        found += f"; {camera.doubt}"
    if not camera.reason:
        return found
    return f"{found}; {'wrong: ' if camera.is_wrong else 'no pose: '}{camera.reason}"


def camera_line(found: dict[str, Any]) -> str:
    """Return what came of a camera in a run, from the control loop's statistics."""
    line = f"camera: {found['frames']} frames, {found['rate']:.1f} per second, {found['poses']} poses"
    if latency := found.get("latency"):
        tail = f"(99 %: {latency['p99']:.0f}, max {latency['max']:.0f})"
        line += f"; from exposure to the control step {latency['p50']:.0f} ms {tail}"
    if lag := found.get("lag"):
        line += f"; pictures older than their stamps by {lag['ms']:.0f} +- {lag['std']:.0f} ms, by the gyroscope"
    reasons = ", ".join(
        f"{reason} {count}" for reason, count in sorted(found["without_pose"].items(), key=lambda item: -item[1])
    )
    doubt = f"; {found['doubt']}" if "doubt" in found else ""
    return f"{line}; frames without a believed pose: {reasons or 'none'}{doubt}"
