"""Reads servos and IMU, and keeps what was last known of a joint or sensor that does not answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wlr_gym.hardware.imu.driver import Imu, ImuReading
from wlr_gym.hardware.imu.frames import STANDARD_GRAVITY
from wlr_gym.hardware.imu.reading import ImuGoneError
from wlr_gym.hardware.safety.limiter import CommandLimiter
from wlr_gym.hardware.safety.rules import VERTICAL_BAND, RobotStatus, next_up, plausible, tilt_of
from wlr_gym.hardware.servos import JointReadings
from wlr_gym.hardware.timing import Clock
from wlr_gym.robot import JOINTS

#: Control steps between readings of voltage and temperature.
HEALTH_STEPS = 5
#: s the IMU may take until its first reading.
IMU_TIME = 0.5


class NotReadyError(RuntimeError):
    """The robot is not as it must be before it is driven; the message says what is wrong."""


class Sensing:
    """What is known of the robot, reading by reading.

    Args:
        limiter: reads the servos.
        imu: of the robot; open.
        clock: of the run.
        period: s of a control step.

    Attributes:
        count: readings of the joints since :meth:`first`.
    """

    def __init__(self, limiter: CommandLimiter, imu: Imu, clock: Clock, period: float) -> None:
        self.count = 0
        self._limiter, self._imu, self._clock, self._period = limiter, imu, clock, period

    def first(self) -> RobotStatus:
        """Wait for the IMU; read everything once.

        Raises:
            NotReadyError: a joint or the IMU does not answer, or the body leans.
        """
        reading = self._first_imu_reading()
        readings = self._limiter.read()
        if not readings.answered.all():
            readings = self._limiter.read()
        if not readings.answered.all():
            silent = ", ".join(JOINTS[k] for k in np.flatnonzero(~readings.answered))
            raise NotReadyError(f"no answer from {silent}")
        up = self._standing(reading)
        voltage, temperature = self._limiter.read_health()
        self.count = 0
        return RobotStatus(
            time=self._clock.now(),
            position=readings.position,
            velocity=readings.velocity,
            effort=readings.effort,
            silence=np.zeros(len(JOINTS)),
            alert=readings.alert,
            restarted=np.zeros(len(JOINTS), bool),
            voltage=np.where(np.isnan(voltage), self._limiter.robot.servo.supply_voltage, voltage),
            temperature=np.where(np.isnan(temperature), 0.0, temperature),
            gyro=reading.gyro,
            accelerometer=reading.accelerometer,
            imu_silence=reading.age,
            up=up,
        )

    def _first_imu_reading(self) -> ImuReading:
        end = self._clock.now() + IMU_TIME
        while (reading := self._imu.read()) is None or reading.age > self._limiter.limits.imu_silence:
            if self._clock.now() > end:
                raise NotReadyError("imu: no reading; check its port and power")
            self._clock.wait_until(self._clock.now() + self._period)
        return reading

    def _standing(self, reading: ImuReading) -> np.ndarray:
        """Return the vertical (3,) in the body frame of a robot that stands."""
        size = float(np.linalg.norm(reading.accelerometer))
        if abs(size - STANDARD_GRAVITY) > VERTICAL_BAND:
            raise NotReadyError(
                f"imu: the accelerometer reads {size:.1f} m/s2, expected {STANDARD_GRAVITY:.1f} at rest: no tilt would be seen"
            )
        up = reading.accelerometer / size
        tilt, limit = tilt_of(up), self._limiter.limits.tilt
        if tilt > limit:
            raise NotReadyError(f"imu: the body leans by {tilt:.2f} rad, limit {limit:g}: it must stand, and be level")
        return up

    def next(self, before: RobotStatus) -> RobotStatus:
        """Read servos and IMU; what does not answer stays as it was, and its silence grows."""
        now = self._clock.now()
        elapsed = now - before.time
        lost = ""
        status = replace(before, time=now)
        try:
            status = self._next_joints(before, now)
        except ConnectionError as error:
            lost = str(error)
        try:
            reading = self._imu.read()
        except ImuGoneError:
            reading = None
        if reading is None:
            return replace(status, lost=lost, imu_silence=before.imu_silence + elapsed)
        return replace(
            status,
            lost=lost,
            gyro=reading.gyro,
            accelerometer=reading.accelerometer,
            imu_silence=reading.age,
            up=next_up(before.up, reading.gyro, reading.accelerometer, elapsed),
        )

    def _next_joints(self, before: RobotStatus, now: float) -> RobotStatus:
        readings = self._limiter.read()
        if not readings.answered.all() and not before.silence.any():
            readings = filled(readings, self._limiter.read())  # once, while there is time: a lost packet costs nothing then
        position = np.nan_to_num(readings.position, nan=np.inf)
        good = readings.answered & plausible(self._limiter.ratings, before, position, now)
        silence = before.silence + (now - before.time)
        heard_nothing = good & (before.silence > 0.0) & (before.silence + now - before.time > self._limiter.limits.watchdog)
        latched = self._limiter.latched(JOINTS[k] for k in np.flatnonzero(heard_nothing))
        self.count += 1
        voltage, temperature = before.voltage, before.temperature
        if self.count % HEALTH_STEPS == 0 and good.all():
            fresh = self._limiter.read_health()
            voltage = np.where(np.isnan(fresh[0]), voltage, fresh[0])
            temperature = np.where(np.isnan(fresh[1]), temperature, fresh[1])
        return replace(
            before,
            time=now,
            position=np.where(good, readings.position, before.position),
            velocity=np.where(good, readings.velocity, before.velocity),
            effort=np.where(good, readings.effort, before.effort),
            silence=np.where(good, 0.0, silence),
            alert=readings.alert,
            restarted=readings.restarted,
            voltage=voltage,
            temperature=temperature,
            latched=", ".join(latched) or before.latched,
        )


def filled(readings: JointReadings, again: JointReadings) -> JointReadings:
    """Return readings with the joints that did not answer taken from a second one."""
    fill = ~readings.answered
    return replace(
        readings,
        position=np.where(fill, again.position, readings.position),
        velocity=np.where(fill, again.velocity, readings.velocity),
        effort=np.where(fill, again.effort, readings.effort),
        answered=np.where(fill, again.answered, readings.answered),
        alert=readings.alert | again.alert,
        restarted=readings.restarted | again.restarted,
    )
