"""One control step, in the order of the data: check, decide and limit, write; log; wait for the deadline, read."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.link import Link
from wlr_gym.hardware.operator import Operator
from wlr_gym.hardware.safety.camera import camera_statistics
from wlr_gym.hardware.safety.limiter import CommandLimiter
from wlr_gym.hardware.safety.rules import Decision
from wlr_gym.hardware.safety.state import Level, RobotStatus
from wlr_gym.hardware.sensing import Sensing
from wlr_gym.hardware.timing import Pacer

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StepRecord:
    """What one control step saw, decided and sent.

    Attributes:
        status: what was known of the robot.
        decision: of the command limiter.
        setpoints: (8,) as the servos' registers hold them, rad and rad/s; NaN = motor off.
        count: readings of the joints so far.
    """

    status: RobotStatus
    decision: Decision
    setpoints: Array
    count: int


class ControlStep:
    """The two halves of a control step, :meth:`send` and :meth:`receive`.

    Args:
        limiter: decides, limits and writes.
        link: its sensors are read.
        operator: what is asked for; served in the spare time.
        pacer: deadlines and statistics.

    Attributes:
        status: what was last read; None = nothing yet.
    """

    def __init__(self, limiter: CommandLimiter, link: Link, operator: Operator, pacer: Pacer) -> None:
        self.status: RobotStatus | None = None
        self._limiter, self._operator, self._pacer = limiter, operator, pacer
        self._clock, self._flow = pacer.clock, link.flow
        self._sensing = Sensing(limiter, link.imu, pacer.clock, pacer.period, link.camera, link.flow)
        self._idle = 0.0
        self._read_at = 0.0

    @property
    def known(self) -> RobotStatus:
        """What was last read.

        Raises:
            InputError: nothing yet.
        """
        if self.status is None:
            raise InputError("the robot has not been started")
        return self.status

    def sensor_statistics(self) -> dict[str, Any]:
        """Return what came of camera and optical flow, under their names, of those there are."""
        watch, flow = self._sensing.watch, self._flow
        camera = {} if watch is None else {"camera": camera_statistics(watch)}
        return camera if flow is None else {**camera, "flow": asdict(flow.statistics)}

    def begin_run(self) -> RobotStatus:
        """Let a run begin: the camera's poses count from here. Return what is known."""
        if (watch := self._sensing.watch) is not None:
            watch.begin_run()
            self.status = replace(self.known, camera=watch.status)
        return self.known

    def first(self) -> None:
        """Read everything, with torque off.

        Raises:
            NotReadyError: a joint or the IMU does not answer, or the body leans.
        """
        self.status = self._sensing.first()

    def begin(self) -> None:
        """Start the pacer and read: the control steps follow."""
        self._idle = 0.0
        self._pacer.start()
        self.status = self._sensing.next(self.known)

    def send(
        self, wanted: object, torque_on: NDArray[np.bool_] | None, trouble: str = "", *, is_answer: bool = False
    ) -> StepRecord:
        """Check what was last read, decide, limit and write.

        Args:
            wanted: (8,) setpoints, rad and rad/s; anything else is refused by the rules.
            torque_on: (8,) motors that are on; None = all.
            trouble: why the log failed; empty = it did not.
            is_answer: somebody answers what was read (a policy): time thinking and latency.
        """
        if is_answer:
            self._pacer.note("think", self._clock.now() - self._read_at)
        status = self._checked(trouble)
        with self._pacer.timed("write"):
            decision = self._limiter.write(wanted, status, torque_on)
        if is_answer:
            self._pacer.note("latency", self._clock.now() - self._read_at)
        is_on = self._limiter.torque_on & (decision.level < Level.OFF)
        return StepRecord(status, decision, np.where(is_on, self._limiter.written, np.nan), self._sensing.count)

    def _checked(self, trouble: str) -> RobotStatus:
        """Return what was last read, with what deadlines, operator and log say now."""
        known, pacer, operator = self.known, self._pacer, self._operator
        return replace(
            known,
            late_ticks=pacer.late_ticks,
            late_share=pacer.late_share,
            operator_silence=operator.silence,
            idle=max(self._idle, self._clock.now() - known.time),
            trouble=trouble or operator.trouble,
            asked_to_stop=operator.asked_to_stop,
            asked_off=operator.asked_off,
        )

    def receive(self) -> None:
        """Serve the operator in the time that is left, wait for the deadline, read."""
        sent = self._clock.now()
        self._operator.serve()
        self._pacer.wait()
        self._idle = self._clock.now() - sent
        with self._pacer.timed("read"):
            self.status = self._sensing.next(self.known)
        self._read_at = self._clock.now()
