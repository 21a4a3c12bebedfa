"""What a control loop is connected to, and what it knows of the robot.

:class:`Link` holds servos, sensors and clock. :class:`Sensing` reads them, and keeps what was last known of a joint or sensor
that does not answer.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.camera.reading import CameraFile, CameraReader, LiveCamera
from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.flow import FlowStream
from wlr_gym.hardware.flow_comparison import FlowSupervision
from wlr_gym.hardware.imu import STANDARD_GRAVITY, Imu, ImuGoneError, ImuReading, make_imu
from wlr_gym.hardware.safety.camera import CameraWatch, camera_statistics
from wlr_gym.hardware.safety.joints import is_far, possible_way, unseen
from wlr_gym.hardware.safety.limiter import CommandLimiter
from wlr_gym.hardware.safety.preflight import NotReadyError
from wlr_gym.hardware.safety.rules import VERTICAL_BAND, next_up, tilt_of
from wlr_gym.hardware.safety.status import Array, Mask, RobotStatus
from wlr_gym.hardware.serial_frames import SharedPorts
from wlr_gym.hardware.servos import JointReadings, ServoRegisters, Servos
from wlr_gym.hardware.timing import Clock, MonotonicClock, time_asleep
from wlr_gym.robot import JOINTS, Robot


@dataclass
class Link:
    """Connections of one robot, closed at first."""

    servos: Servos
    imu: Imu
    clock: Clock  #: what deadlines and ages are told by
    is_serial: bool  #: there are real ports, which a watchdog process can open
    finish: Callable[[], None] = lambda: None  #: called after closing
    flow: FlowStream | None = None  #: optical-flow sensor; None = there is none
    camera: CameraReader | None = None  #: above the floor; None = there is none
    asleep: Callable[[], float] = lambda: 0.0  #: s for which the clock has stood because the computer was suspended
    seed: int | None = None  #: of an emulated robot's noise; None = not one of this process

    def _devices(self) -> list[Servos | Imu | FlowStream | CameraReader]:
        return [device for device in (self.servos, self.imu, self.flow, self.camera) if device is not None]

    def open(self) -> None:
        """Open all ports, or none; see :class:`wlr_gym.hardware.serial_frames.SerialDevice`."""
        with contextlib.ExitStack() as stack:
            for device in self._devices():
                device.open()
                stack.callback(device.close)
            stack.pop_all()

    def close(self) -> None:
        """Close all ports; servos stay as they are."""
        for device in self._devices():
            device.close()
        self.finish()


def serial_link(robot: Robot, hardware: Hardware, camera: CameraFile | None = None, poses: Path | None = None) -> Link:
    """Return a link over the hardware file's ports.

    Args:
        robot: the robot.
        hardware: wiring and mounting.
        camera: above the floor; None = there is none.
        poses: where an emulated robot writes its true pose, for a camera that films it by rendering; None = a real camera.
    """
    clock = MonotonicClock()
    servos = Servos(robot, hardware, hardware.safety.patience, clock.now)
    port, sensor = hardware.flow, robot.sensors.flow
    ports = SharedPorts()  # one board may have both sensors
    flow = None if port is None or sensor is None else FlowStream(port, sensor, clock.now, ports)
    eye = None if camera is None else LiveCamera(camera, robot, poses)
    return Link(
        servos, make_imu(hardware.imu, clock.now, ports), clock, is_serial=True, flow=flow, camera=eye, asleep=time_asleep
    )


# ---- what is known ----

#: Control steps between readings of voltage and temperature.
HEALTH_STEPS = 5
#: s that a reading may be old by which the robot is judged to stand.
ATTITUDE_AGE = 0.1
#: s the IMU may take until its first reading: an Arduino boots for 2 when its port is opened.
IMU_TIME = 3.0


class Sensing:
    """What is known of the robot, reading by reading.

    Args:
        limiter: reads the servos.
        link: its other sensors, open before they are read, and the clock of the run.
        period: s of a control step.

    Attributes:
        status: what was last read; None = nothing yet.
        count: readings of the joints since :meth:`first`.
        watch: judges the camera's readings; None = there is none.
    """

    def __init__(self, limiter: CommandLimiter, link: Link, period: float) -> None:
        self.status: RobotStatus | None = None
        self.count = 0
        self._limiter, self._link, self._clock, self._period = limiter, link, link.clock, period
        self.watch: CameraWatch | None = None if link.camera is None else CameraWatch(limiter.robot, link.camera.file.doubt)
        self._flow = None if link.flow is None else FlowSupervision(link.flow, limiter.robot)
        self._asleep = link.asleep()
        self._broken = 0  # packets until all joints answered last

    @property
    def known(self) -> RobotStatus:
        """What was last read; an :class:`InputError` before :meth:`first`."""
        if self.status is None:
            raise InputError("the robot has not been started")
        return self.status

    def statistics(self) -> dict[str, Any]:
        """Return what came of camera and optical flow, under their names, of those there are."""
        camera = {} if self.watch is None else {"camera": camera_statistics(self.watch)}
        return camera if self._link.flow is None else {**camera, "flow": asdict(self._link.flow.statistics)}

    def begin_run(self) -> RobotStatus:
        """Let a run begin: the camera's poses count from here. Return what is known."""
        if self.watch is not None:
            self.watch.begin_run()
            self.status = replace(self.known, camera=self.watch.status)
        return self.known

    def first(self) -> None:
        """Wait for the IMU; read everything once, with torque off.

        Raises:
            NotReadyError: a joint or the IMU does not answer, or the body leans.
        """
        reading = self._first_imu_reading()
        up = self._standing(reading)
        readings = self._limiter.read()
        if not readings.answered.all():
            readings = self._limiter.read()
        if not readings.answered.all():
            silent = ", ".join(JOINTS[k] for k in np.flatnonzero(~readings.answered))
            raise NotReadyError(f"no answer from {silent}")
        voltage, temperature = self._limiter.read_health()
        self.count, self._asleep = 0, self._link.asleep()
        self.status = RobotStatus(
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
            imu_counts=reading.counts,
            up=up,
            flow=None if self._flow is None else self._flow.first(),
        )

    def _first_imu_reading(self) -> ImuReading:
        end = self._clock.now() + IMU_TIME
        while (reading := self._link.imu.read()) is None or reading.age > min(ATTITUDE_AGE, self._limiter.limits.imu_silence):
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

    def next(self) -> None:
        """Read servos, IMU, flow and camera; what does not answer stays as it was, and its silence grows."""
        before, now, link = self.known, self._clock.now(), self._link
        elapsed = now - before.time
        try:
            status = replace(self._next_joints(before, now), lost="", asleep=link.asleep() - self._asleep)
        except ConnectionError as error:
            status = replace(before, time=now, lost=str(error))
        try:
            reading = link.imu.read()
        except ImuGoneError:
            reading = None
        if reading is None:
            status = replace(status, imu_silence=before.imu_silence + elapsed)
        else:
            gyro, force = reading.gyro, reading.accelerometer
            up = next_up(before.up, gyro, force, elapsed)
            status = replace(status, gyro=gyro, accelerometer=force, imu_silence=reading.age, up=up, imu_counts=reading.counts)
        if self._flow is not None:
            status = replace(status, flow=self._flow.next(status.position, status.velocity, before.gyro, elapsed))
        if link.camera is not None and self.watch is not None:
            now, joints = self._clock.now(), (status.position, status.velocity)
            seen = self.watch.next(now, joints, status.gyro, link.camera.read(now), link.camera.trouble)
            status = replace(status, camera=seen)
        self.status = status

    def _next_joints(self, before: RobotStatus, now: float) -> RobotStatus:
        limiter = self._limiter
        readings, hidden, ways = self._read_ways(before)
        far = readings.answered & is_far(*ways)
        is_far_again = far & before.suspect
        if (far & ~before.suspect).any() or not (readings.answered.all() or before.silence.any()):
            # once, while there is time: a lost packet costs nothing then, and a jump is true or not
            again, hidden, ways_again = self._read_ways(before)
            fill = (far | ~readings.answered) & again.answered
            far_again = again.answered & is_far(*ways_again)
            is_far_again |= far & far_again
            readings = filled(readings, again, fill)
            far = np.where(fill, far_again, far)
            ways = Ways(*(np.where(fill, these, those) for these, those in zip(ways_again, ways, strict=True)))
        good = readings.answered & ~far
        silence = before.silence + (now - before.time)
        self.count += 1
        if good.all():
            self._broken = limiter.broken_packets
        voltage, temperature = before.voltage, before.temperature
        if self.count % HEALTH_STEPS == 0 and good.all():
            fresh = limiter.read_health()
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
            registers=chosen(readings.answered, readings.registers, before.registers),
            broken=limiter.broken_packets - self._broken,
            suspect=far,
            unseen=hidden,
            jump=np.where(is_far_again & far, ways.way, 0.0),
            reach=np.abs(ways.told) + ways.off,
        )

    def _read_ways(self, before: RobotStatus) -> tuple[JointReadings, Array, Ways]:
        """Read the joints; return also for how long (8,) in s they were not seen, and what ways they made and can have made.

        By the time at which the answers are there: a program may wait long before it is given the processor to ask.
        """
        limiter, readings = self._limiter, self._limiter.read()
        hidden = unseen(limiter.ratings, before, self._clock.now())
        possible = possible_way(limiter.limits, limiter.ratings, before, readings, hidden)
        return readings, hidden, Ways(readings.position - before.position, *possible)


class Ways(NamedTuple):
    """Ways of the joints since they were last read, (8,) in rad: read, told by their speeds, and how far that may be off."""

    way: Array
    told: Array
    off: Array


def filled(readings: JointReadings, again: JointReadings, fill: Mask) -> JointReadings:
    """Return readings with those of some joints (8,) taken from a second one."""
    return replace(
        readings,
        position=np.where(fill, again.position, readings.position),
        velocity=np.where(fill, again.velocity, readings.velocity),
        effort=np.where(fill, again.effort, readings.effort),
        answered=np.where(fill, again.answered, readings.answered),
        alert=readings.alert | again.alert,
        restarted=readings.restarted | again.restarted,
        registers=chosen(fill, again.registers, readings.registers),
    )


def chosen(mask: Mask, these: ServoRegisters, those: ServoRegisters) -> ServoRegisters:
    """Return registers of some joints (8,), and those of the others."""
    return ServoRegisters(*(np.where(mask, this, that) for this, that in zip(these, those, strict=True)))
