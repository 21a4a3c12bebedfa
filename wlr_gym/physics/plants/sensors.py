"""What the robot's sensors make of the truth: one model for every simulator.

A simulator hands over one :data:`RAW_LAYOUT` row per robot and control tick; :class:`SensorModel` turns it into
``SENSOR_LAYOUT``. Noise is counter-based, so a robot reads the same bits alone or anywhere in a batch of any size.

Order of errors: mounting (``imu.mount``: what the IMU reads is in its own frame), then zero errors, scale and biases, then
noise, then register counts. The simulator itself low-passes
gyroscope and accelerometer (``imu.bandwidth``) inside its substeps.
"""

from __future__ import annotations

import math
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.compiled import compiled
from wlr_gym.base.errors import InputError
from wlr_gym.base.random import normals4, stream_number, words4
from wlr_gym.base.snapshot import RowStore
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, Channel, Layout, PlantOptions
from wlr_gym.physics.servo import effort_counts
from wlr_gym.robot import FIRST_WHEEL, JOINTS, WHEEL_SLICE, Robot
from wlr_gym.robot.parameter_table import SPECS, XYZ
from wlr_gym.robot.parameters import Parameters

# ---- optical flow under the body: counts of image shift, as the reading at a control tick ----------------------------

# The sensor looks along body -z and measures how fast the floor turns about it, rad/s along its own x and y (nominally the
# body's): flow_x = v_x/h - w_y, flow_y = v_y/h + w_x, with the velocity v of its lens over the floor, the body's angular
# velocity w, and the distance h from the lens to the floor along its axis. The floor is as high as under the body's origin,
# on a slope too. Frames come at a rate of their own. A reading is what was counted between the last frame before the tick and
# the last before the tick before, over the time between these two frames: drivers that poll faster than the frames know it
# (wlr_gym.hardware.flow). Both are linear in the pose between two ticks.


#: Parameters that a robot's sensor remembers, in the order of the first columns of its state.
FLOW_ERRORS = ("flow.present", "flow.scale", "flow.mount_yaw", "flow.dropout", "flow.poor_floor")
_PRESENT, _FLOW_SCALE, _FLOW_MOUNT_YAW, _DROPOUT, _POOR_FLOOR = range(len(FLOW_ERRORS))
#: First columns of a robot's state, and all of them. Beyond ``_FLOW_PHASE``, cleared by a reset: tick, place and attitude when
#: last looked (the floor's height there comes last); image shift since the last frame; shown flow and quality, and when its
#: interval ended.
_FLOW_PHASE, _SEEN, _PLACE, _CARRIED, _SHOWN, _QUALITY, _END, FLOW_WIDTH = accumulate((5, 1, 1, 8, 2, 2, 1, 1))

#: First entries of the settings, and all of them: place of the lens, one count, frame rate, noises, quality and limits.
(
    _LENS, _COUNT, _RATE, _NOISE, _SPEED_NOISE, _MEAN_QUALITY, _QUALITY_NOISE, _LEAST_QUALITY, _LEAST_HEIGHT, _GREATEST_RATE,
    FLOW_SETTINGS,
) = accumulate((0, 3, *[1] * 9))  # fmt: skip

#: Edge of the squares of floor that have a texture of their own (m).
CELL = 0.2
#: Whole cells added, so that their numbers are positive near the start.
_CELLS = 1 << 20
#: Share of the texture below which its noise grows no more.
_LEAST_TEXTURE = 0.1
#: Of the body's z axis on the floor's normal: below it the sensor does not look at the floor.
_LEAST_COSINE = 0.2
_NOISE_STREAM = stream_number("flow")
_FLOW_DROPOUT_STREAM = stream_number("flow dropout")
_FLOW_PHASE_STREAM = stream_number("flow phase")
_TEXTURE_STREAM = stream_number("flow texture")


def flow_settings(robot: Robot, sensor_noise: bool) -> Array:
    """Return what :func:`measure_flow` reads of a robot's file, (FLOW_SETTINGS); without noise: neither noise nor rounding."""
    settings = np.zeros(FLOW_SETTINGS)
    sensor = robot.sensors.flow
    if sensor is None:
        return settings
    settings[_LENS : _LENS + 3] = sensor.position
    settings[_RATE] = sensor.rate
    settings[_MEAN_QUALITY] = sensor.quality
    settings[_LEAST_QUALITY] = sensor.least_quality
    settings[_LEAST_HEIGHT] = sensor.least_height
    settings[_GREATEST_RATE] = sensor.greatest_rate
    if sensor_noise:
        settings[_COUNT] = sensor.count
        settings[_NOISE] = sensor.noise
        settings[_SPEED_NOISE] = sensor.speed_noise
        settings[_QUALITY_NOISE] = sensor.quality_noise
    return settings


def check_flow(robot: Robot, parameters: Parameters) -> None:
    """Refuse a sensor that the robot's file does not describe."""
    if robot.sensors.flow is None and parameters["flow.present"].any():
        raise InputError(
            f"flow.present = 1: the robot file of '{robot.name}' has no optical-flow sensor; expected a section sensors.flow"
        )


@compiled(inline="always")
def _uniform(seed: Any, stream: Any, counter: Any, block: Any) -> float:
    """A number from 0 to 1."""
    return float(np.int64(words4(seed, stream, counter, block)[0])) * 2.0**-32


@compiled
def _place(height: float, floor: float, quaternion: Any, pose: Any, settings: Any, out: Any) -> None:
    """Write the lens's place (x, y, and height over the floor), the attitude, and the floor's height into ``out`` (8)."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    a, b, c = settings[_LENS], settings[_LENS + 1], settings[_LENS + 2]
    out[0] = pose[0] + (1.0 - 2.0 * (y * y + z * z)) * a + 2.0 * (x * y - w * z) * b + 2.0 * (x * z + w * y) * c
    out[1] = pose[1] + 2.0 * (x * y + w * z) * a + (1.0 - 2.0 * (x * x + z * z)) * b + 2.0 * (y * z - w * x) * c
    out[2] = height + 2.0 * (x * z - w * y) * a + 2.0 * (y * z + w * x) * b + (1.0 - 2.0 * (x * x + y * y)) * c
    out[3], out[4], out[5], out[6] = w, x, y, z
    out[7] = floor


@compiled
def _shift(before: Any, after: Any) -> Any:
    """Image shift (x, y; rad) between two places of the lens (8), and the distance to the floor along its axis (m).

    Displacement along the mean axes over the mean distance, and the turn of one attitude against the other: exact to second
    order in the turn. A distance of 0 says that the sensor does not look at the floor.
    """
    d = (after[0] - before[0], after[1] - before[1], (after[2] + after[7]) - (before[2] + before[7]))
    along, across, distance = 0.0, 0.0, 0.0
    for place in (before, after):
        w, x, y, z = place[3], place[4], place[5], place[6]
        along += 0.5 * ((1.0 - 2.0 * (y * y + z * z)) * d[0] + 2.0 * (x * y + w * z) * d[1] + 2.0 * (x * z - w * y) * d[2])
        across += 0.5 * (2.0 * (x * y - w * z) * d[0] + (1.0 - 2.0 * (x * x + z * z)) * d[1] + 2.0 * (y * z + w * x) * d[2])
        cosine = 1.0 - 2.0 * (x * x + y * y)
        if cosine < _LEAST_COSINE or place[2] <= 0.0:
            return 0.0, 0.0, 0.0
        distance += 0.5 * place[2] / cosine
    w, x, y, z = before[3], before[4], before[5], before[6]
    a, b, c, e = after[3], after[4], after[5], after[6]
    whole = w * a + x * b + y * c + z * e
    half_x = w * b - x * a - y * e + z * c
    half_y = w * c - y * a - z * b + x * e
    half_z = w * e - z * a - x * c + y * b
    stretch = (2.0 if whole >= 0.0 else -2.0) * (1.0 + (half_x * half_x + half_y * half_y + half_z * half_z) / 6.0)
    return along / distance - stretch * half_y, across / distance + stretch * half_x, distance


@compiled
def _texture(seed: Any, x: float, y: float, poor_floor: float) -> float:
    """Share of the quality that the floor's texture leaves at a place: 1, and 0 to 1 on its poor share."""
    if poor_floor <= 0.0:
        return 1.0
    cell_x, cell_y = math.floor(x / CELL) + _CELLS, math.floor(y / CELL) + _CELLS
    drawn = _uniform(seed, _TEXTURE_STREAM, cell_x, cell_y)
    return drawn / poor_floor if drawn < poor_floor else 1.0


@compiled
def measure_flow(
    seed: Any, tick: int, period: float, height: float, floor: float, turn: Any, pose: Any, settings: Any, state: Any, out: Any
) -> None:
    """Look at the floor at a tick; write flow (x, y), quality, age and whether it is new into ``out`` (5).

    Args:
        seed: of the robot's noise.
        tick: 0 at the reset.
        period: of control (s).
        height: of the body origin over the floor (m). floor: height of that (m).
        turn: (4) quaternion, body to floor frame.
        pose: (x, y, yaw) of the body origin in the floor frame.
        settings: see :func:`flow_settings`.
        state: (FLOW_WIDTH) what the sensor remembers.
        out: (5).
    """
    now = tick * period
    is_new = 0.0
    if state[_PRESENT] > 0.5:
        place = np.empty(8)
        _place(height, floor, turn, pose, settings, place)
        if tick > 0 and state[_SEEN] == tick - 1:
            is_new = _read(seed, tick, period, place, settings, state)
        state[_SEEN] = tick
        for k in range(8):
            state[_PLACE + k] = place[k]
    out[0], out[1], out[2] = state[_SHOWN], state[_SHOWN + 1], state[_QUALITY]
    out[3] = now - state[_END]
    out[4] = is_new


@compiled
def _read(seed: Any, tick: int, period: float, place: Any, settings: Any, state: Any) -> float:
    """Count the shift since the last tick; read what the frames up to now give. Returns 1 when that is a new valid reading."""
    shift_x, shift_y, distance = _shift(state[_PLACE:_CARRIED], place)
    rate, phase = settings[_RATE], state[_FLOW_PHASE]
    frame = math.floor(tick * period * rate - phase)
    frames = frame - math.floor((tick - 1) * period * rate - phase)
    if frames == 0:
        state[_CARRIED] += shift_x
        state[_CARRIED + 1] += shift_y
        state[_QUALITY] = 0.0
        return 0.0
    end = (frame + phase) / rate
    part = end / period - (tick - 1)
    interval = frames / rate
    x, y = (state[_CARRIED] + part * shift_x) / interval, (state[_CARRIED + 1] + part * shift_y) / interval
    state[_CARRIED], state[_CARRIED + 1] = (1.0 - part) * shift_x, (1.0 - part) * shift_y
    n0, n1, n2, _ = normals4(seed, _NOISE_STREAM, tick, 0)
    texture = _texture(seed, place[0], place[1], state[_POOR_FLOOR])
    quality = min(settings[_MEAN_QUALITY] * texture + settings[_QUALITY_NOISE] * n2, 1.0)
    lost = _uniform(seed, _FLOW_DROPOUT_STREAM, tick, 0) < state[_DROPOUT]
    too_fast = max(abs(x), abs(y)) > settings[_GREATEST_RATE]
    if lost or too_fast or distance < settings[_LEAST_HEIGHT] or distance == 0.0 or quality < settings[_LEAST_QUALITY]:
        state[_QUALITY] = 0.0
        return 0.0
    poorness = 1.0 / max(texture, _LEAST_TEXTURE)
    c, s = math.cos(state[_FLOW_MOUNT_YAW]), math.sin(state[_FLOW_MOUNT_YAW])
    state[_SHOWN] = _counted(state[_FLOW_SCALE] * (c * x + s * y), interval, frames, n0 * poorness, settings)
    state[_SHOWN + 1] = _counted(state[_FLOW_SCALE] * (c * y - s * x), interval, frames, n1 * poorness, settings)
    state[_QUALITY] = quality
    state[_END] = end
    return 1.0


@compiled
def _counted(flow: float, interval: float, frames: int, normal: float, settings: Any) -> float:
    """Return ``flow`` (rad/s) with the noise of its frames, in whole counts; without a count it stays as it is."""
    count = settings[_COUNT]
    if count <= 0.0:
        return flow
    counts = flow * interval / count
    spread = math.sqrt(frames) * math.hypot(settings[_NOISE], settings[_SPEED_NOISE] * counts / frames)
    return (np.rint(counts + spread * normal) + 0.0) * count / interval


# ---- all sensors -----------------------------------------------------------------------------------------------------


Array = NDArray[np.float64]

RAW_LAYOUT = Layout(
    (
        Channel("joint_position", JOINTS, "rad", "true joint angles at the tick's end"),
        Channel("joint_velocity", JOINTS, "rad/s", "true joint rates, relative to the parent link"),
        Channel("joint_effort", JOINTS, "N m", "motor current times the nominal torque constant"),
        Channel("gyro", XYZ, "rad/s", "low-passed angular velocity, body frame"),
        Channel("accelerometer", XYZ, "m/s2", "low-passed specific force at the body origin, body frame"),
        Channel("supply_voltage", (), "V", "at the servos"),
        Channel("height", (), "m", "body origin over the floor at the tick's end"),
        Channel("floor", (), "m", "height of the floor under the body origin, in the floor frame"),
        Channel("quaternion", ("w", "x", "y", "z"), "-", "body to floor frame at the tick's end"),
        Channel("pose", ("x", "y", "yaw"), "m, m, rad", "body origin in the floor frame at the tick's end; yaw may wrap"),
    )
)

# First columns of the state matrix: what a robot's sensors remember.
_CALIBRATION = (
    "joint.zero_offset", "imu.gyro_bias", "imu.accel_bias",
    "camera.mount_yaw", "camera.scale", "camera.delay", "camera.present", "camera.dropout",
)  # fmt: skip
(
    _ZERO_OFFSET, _GYRO_BIAS, _ACCEL_BIAS, _MOUNT_YAW, _SCALE, _DELAY, _CAMERA_PRESENT, _CAMERA_DROPOUT, _IMU_TO_BODY,
    _WHEEL_ZERO, _START_POSE, _SHOWN_POSE, _EXPOSED, _PHASE, _FLOW, _POSES,
) = accumulate((0, 4, 3, 3, 1, 1, 1, 1, 1, 9, 4, 3, 3, 1, 1, FLOW_WIDTH))  # fmt: skip
# First entries of the settings vector.
(
    _PERIOD, _CAMERA_RATE, _NOISY, _POSITION_COUNT, _VELOCITY_COUNT, _VOLT_COUNT, _EFFORT_COUNTS, _VOLT_NOISE, _GYRO_NOISE,
    _ACCEL_NOISE, _CAMERA_NOISE, _YAW_NOISE, _EFFORT_NOISE, _FLOW_SETTINGS,
) = accumulate((0, *[1] * 6, len(JOINTS), *[1] * 5, len(JOINTS)))  # fmt: skip

# First columns of the signals, as plain numbers for the kernel.
_RAW_VELOCITY, _RAW_EFFORT, _RAW_GYRO, _RAW_ACCEL, _RAW_VOLT, _RAW_HEIGHT, _RAW_FLOOR, _RAW_TURN, _RAW_POSE = (
    RAW_LAYOUT.slices[name].start for name in (
        "joint_velocity", "joint_effort", "gyro", "accelerometer", "supply_voltage", "height", "floor", "quaternion", "pose",
    )
)  # fmt: skip
_OUT_VELOCITY, _OUT_EFFORT, _OUT_GYRO, _OUT_ACCEL, _OUT_VOLT, _OUT_CAMERA, _OUT_AGE, _OUT_FLOW = (
    SENSOR_LAYOUT.slices[name].start for name in (
        "joint_velocity", "joint_effort", "gyro", "accelerometer", "supply_voltage", "camera_pose", "joint_age", "flow",
    )
)  # fmt: skip
_TICK_STREAM = stream_number("sensors")
_CAMERA_STREAM = stream_number("camera")
_PHASE_STREAM = stream_number("camera phase")
_DROPOUT_STREAM = stream_number("camera dropout")


@compiled(inline="always")
def _rounded(value: float, count: float) -> float:
    """``value`` in whole counts (no negative zero); a count of 0 leaves it as it is."""
    return np.rint(value / count) * count + 0.0 if count > 0.0 else value


@compiled
def _camera(seed: Any, tick: int, pose: Any, settings: Any, state: Any, out: Any) -> None:
    """Store this tick's pose; show the newest frame that has arrived: exposed at (j + phase) / rate, ``delay`` earlier."""
    period, rate = settings[_PERIOD], settings[_CAMERA_RATE]
    length = (state.shape[0] - _POSES) // 3
    slot = _POSES + 3 * (tick % length)
    last = state[_POSES + 3 * ((tick - 1) % length) + 2] if tick > 0 else pose[2]
    turn = pose[2] - last
    state[slot] = pose[0]
    state[slot + 1] = pose[1]
    state[slot + 2] = last + turn - 2.0 * np.pi * np.rint(turn / (2.0 * np.pi))
    now = tick * period
    frame = math.floor((now - state[_DELAY]) * rate - state[_PHASE])
    before = math.floor(((tick - 1) * period - state[_DELAY]) * rate - state[_PHASE])
    is_new = False
    if state[_CAMERA_PRESENT] > 0.5 and (tick == 0 or not _is_lost(seed, frame, state[_CAMERA_DROPOUT])):
        state[_EXPOSED] = (frame + state[_PHASE]) / rate
        is_new = tick == 0 or frame > before
    if is_new:
        _expose(seed, frame, state[_EXPOSED] / period, length, settings, state)
    out[_OUT_CAMERA] = state[_SHOWN_POSE]
    out[_OUT_CAMERA + 1] = state[_SHOWN_POSE + 1]
    out[_OUT_CAMERA + 2] = state[_SHOWN_POSE + 2]
    out[_OUT_AGE] = 0.0
    out[_OUT_AGE + 1] = 0.0
    out[_OUT_AGE + 2] = now - state[_EXPOSED]
    out[_OUT_AGE + 3] = 1.0 if is_new else 0.0


@compiled(inline="always")
def _is_lost(seed: Any, frame: int, dropout: float) -> bool:
    """Whether the camera's frame of this number never arrives."""
    return dropout > 0.0 and _uniform(seed, _DROPOUT_STREAM, frame, 0) < dropout


@compiled
def _expose(seed: Any, frame: int, ticks: float, length: int, settings: Any, state: Any) -> None:
    """Compute the pose a frame shows: at ``ticks`` (linear between tick poses), from the start pose, in the camera's frame."""
    ticks = max(ticks, 0.0)
    whole = math.floor(ticks)
    part = ticks - whole
    a = _POSES + 3 * (whole % length)
    b = _POSES + 3 * ((whole + 1) % length) if part > 0.0 else a
    dx = state[a] + part * (state[b] - state[a]) - state[_START_POSE]
    dy = state[a + 1] + part * (state[b + 1] - state[a + 1]) - state[_START_POSE + 1]
    yaw = state[a + 2] + part * (state[b + 2] - state[a + 2]) - state[_START_POSE + 2]
    turn = state[_START_POSE + 2] + state[_MOUNT_YAW]
    c, s = math.cos(turn), math.sin(turn)
    state[_SHOWN_POSE] = state[_SCALE] * (c * dx + s * dy)
    state[_SHOWN_POSE + 1] = state[_SCALE] * (c * dy - s * dx)
    state[_SHOWN_POSE + 2] = yaw
    if settings[_NOISY] > 0.0:
        n0, n1, n2, _ = normals4(seed, _CAMERA_STREAM, frame, 0)
        state[_SHOWN_POSE] += settings[_CAMERA_NOISE] * n0
        state[_SHOWN_POSE + 1] += settings[_CAMERA_NOISE] * n1
        state[_SHOWN_POSE + 2] += settings[_YAW_NOISE] * n2


@compiled
def _add_noise(seed: Any, tick: int, settings: Any, out: Any) -> None:
    """Add Gaussian noise to efforts, IMU and voltage."""
    for block in range(2):
        four = normals4(seed, _TICK_STREAM, tick, block)
        for k in range(4):
            out[_OUT_EFFORT + 4 * block + k] += settings[_EFFORT_NOISE + 4 * block + k] * four[k]
    n0, n1, n2, n3 = normals4(seed, _TICK_STREAM, tick, 2)
    out[_OUT_GYRO] += settings[_GYRO_NOISE] * n0
    out[_OUT_GYRO + 1] += settings[_GYRO_NOISE] * n1
    out[_OUT_GYRO + 2] += settings[_GYRO_NOISE] * n2
    out[_OUT_VOLT] += settings[_VOLT_NOISE] * n3
    n0, n1, n2, _ = normals4(seed, _TICK_STREAM, tick, 3)
    out[_OUT_ACCEL] += settings[_ACCEL_NOISE] * n0
    out[_OUT_ACCEL + 1] += settings[_ACCEL_NOISE] * n1
    out[_OUT_ACCEL + 2] += settings[_ACCEL_NOISE] * n2


@compiled(inline="always")
def _in_imu_frame(state: Any, row: Any, first: int, axis: int) -> float:
    """Component ``axis`` in the IMU's frame of the body-frame vector in ``row[first:first + 3]`` (transposed rotation)."""
    r = _IMU_TO_BODY + axis
    return state[r] * row[first] + state[r + 3] * row[first + 1] + state[r + 6] * row[first + 2]


@compiled
def measure_rows(raw: Any, seeds: Any, ticks: Any, settings: Any, states: Any, outs: Any, start: Any, stop: Any) -> None:
    """Read the sensors of robots ``start`` to ``stop``: what :meth:`SensorModel.measure` does, for compiled loops."""
    for i in range(start, stop):
        row, state, out = raw[i], states[i], outs[i]
        for k in range(4):
            out[k] = row[k] + state[_ZERO_OFFSET + k]
            out[FIRST_WHEEL + k] = row[FIRST_WHEEL + k] - state[_WHEEL_ZERO + k]
        for k in range(3):
            out[_OUT_GYRO + k] = _in_imu_frame(state, row, _RAW_GYRO, k) + state[_GYRO_BIAS + k]
            out[_OUT_ACCEL + k] = _in_imu_frame(state, row, _RAW_ACCEL, k) + state[_ACCEL_BIAS + k]
        for k in range(8):
            out[_OUT_VELOCITY + k] = row[_RAW_VELOCITY + k]
            out[_OUT_EFFORT + k] = row[_RAW_EFFORT + k]
        out[_OUT_VOLT] = row[_RAW_VOLT]
        if settings[_NOISY] > 0.0:
            _add_noise(seeds[i], ticks[i], settings, out)
        for k in range(8):
            out[k] = _rounded(out[k], settings[_POSITION_COUNT])
            out[_OUT_VELOCITY + k] = _rounded(out[_OUT_VELOCITY + k], settings[_VELOCITY_COUNT])
            out[_OUT_EFFORT + k] = _rounded(out[_OUT_EFFORT + k], settings[_EFFORT_COUNTS + k])
        out[_OUT_VOLT] = _rounded(out[_OUT_VOLT], settings[_VOLT_COUNT])
        _camera(seeds[i], ticks[i], row[_RAW_POSE : _RAW_POSE + 3], settings, state, out)
        measure_flow(
            seeds[i],
            ticks[i],
            settings[_PERIOD],
            row[_RAW_HEIGHT],
            row[_RAW_FLOOR],
            row[_RAW_TURN : _RAW_TURN + 4],
            row[_RAW_POSE : _RAW_POSE + 3],
            settings[_FLOW_SETTINGS:],
            state[_FLOW:_POSES],
            out[_OUT_FLOW : _OUT_FLOW + 5],
        )
        ticks[i] += 1


@compiled
def _phase(seed: Any, stream: Any) -> float:
    """Phase of a robot's frames of camera or flow, 0 to 1."""
    return _uniform(seed, stream, 0, 0)


class SensorModel:
    """The sensors of ``count`` robots.

    Encoders: true angle (legs plus ``joint.zero_offset``, wheels from where they stood at reset) and rate in register
    counts. Efforts, gyroscope, accelerometer, voltage: bias, white noise, counts. Gyroscope and accelerometer read body-frame
    vectors turned into the IMU's frame (``imu.mount``); their biases are along the IMU's own axes. Camera: frames at
    ``camera.rate`` with a phase drawn per robot, shown at the first tick at least ``camera.delay`` after their exposure, and
    until the next; pose from the start pose (x and y in the start heading turned by ``camera.mount_yaw``, then times
    ``camera.scale``; yaw zeroed and unwrapped, not turned). Before the reset the robot is taken to have stood still.
    ``camera_is_new`` is 1 at the reset. Of the frames the share ``camera.dropout`` never arrives; without a camera
    (``camera.present`` 0) none does, and the age counts from the start. Optical flow: :mod:`wlr_gym.physics.plants.sensors`.

    With ``options.sensor_noise`` False there is neither noise nor rounding; biases, offsets, delays and frame times stay.
    Sources: robot file's ``sensors``; counts of effort and voltage from :mod:`wlr_gym.physics.servo`.
    """

    def __init__(self, robot: Robot, options: PlantOptions, count: int) -> None:
        history = math.ceil(SPECS["camera.delay"].high / options.control_period) + 3
        self.count = count
        self._settings = _settings(robot, options)
        self._seeds = np.zeros(count, np.uint64)
        self._ticks = np.zeros(count, np.int64)
        self._robot = robot
        self._states = np.zeros((count, _POSES + 3 * history))
        self._states[:, _SCALE] = self._states[:, _CAMERA_PRESENT] = 1.0
        self._states[:, _IMU_TO_BODY:_WHEEL_ZERO] = np.eye(3).ravel()

    def reset(
        self,
        raw: Array,
        out: Array,
        seeds: NDArray[np.uint64] | None = None,
        parameters: Parameters | None = None,
        mask: NDArray[np.bool_] | None = None,
    ) -> None:
        """Start the sensors of the masked robots anew and write their first readings into ``out``.

        Args:
            raw: (N, RAW_LAYOUT.width) truth at the start; rows outside ``mask`` are ignored.
            out: (N, SENSOR_LAYOUT.width); rows outside ``mask`` stay as they are.
            seeds: (N,) noise seeds; None keeps the present ones, which repeats their noise.
            parameters: (N) batch the sensor errors are read from; None keeps them.
            mask: (N,) which robots; None = all.
        """
        self._require(raw, out)
        rows = np.arange(self.count) if mask is None else np.flatnonzero(mask)
        if seeds is not None:
            self._seeds[rows] = np.asarray(seeds, np.uint64)[rows]
        if parameters is not None:
            self.set_errors(rows, parameters)
        self._ticks[rows] = 0
        self._states[rows, _WHEEL_ZERO:_START_POSE] = raw[rows, WHEEL_SLICE]
        self._states[rows, _START_POSE:_SHOWN_POSE] = raw[rows, _RAW_POSE:]
        self._states[rows, _SHOWN_POSE:_PHASE] = 0.0
        self._states[rows, _FLOW + _SEEN : _POSES] = 0.0
        for column, stream in ((_PHASE, _PHASE_STREAM), (_FLOW + _FLOW_PHASE, _FLOW_PHASE_STREAM)):
            self._states[rows, column] = [_phase(seed, stream) for seed in self._seeds[rows]]
        for i in rows:
            measure_rows(raw, *self.memory(), out, i, i + 1)

    def set_errors(self, rows: NDArray[np.intp], parameters: Parameters) -> None:
        """Take zero errors, biases, mounting errors, faults of camera and flow of robots ``rows``; nothing is forgotten."""
        check_flow(self._robot, parameters)
        errors = [parameters[name].reshape(self.count, -1)[rows] for name in _CALIBRATION]
        errors.append(imu_to_body(parameters)[rows].reshape(-1, 9))
        self._states[rows, :_WHEEL_ZERO] = np.concatenate(errors, axis=1)
        self._states[rows, _FLOW : _FLOW + len(FLOW_ERRORS)] = np.stack(
            [parameters[name][rows] for name in FLOW_ERRORS], axis=1
        )

    def memory(self) -> tuple[NDArray[np.uint64], NDArray[np.int64], Array, Array]:
        """Return noise seeds, counters, counts and noise levels, and states: what :func:`measure_rows` reads and writes."""
        return self._seeds, self._ticks, self._settings, self._states

    def stores(self) -> dict[str, RowStore]:
        """Return what the sensors remember: noise seeds and counters, errors, start pose, camera."""
        return {"noise_seeds": self._seeds, "ticks": self._ticks, "sensors": self._states}

    def measure(self, raw: Array, out: Array, start: int = 0, stop: int | None = None) -> None:
        """Read the sensors of robots ``start`` to ``stop`` one control tick on; the rest of ``out`` stays.

        Args:
            raw: (N, RAW_LAYOUT.width) truth at the tick's end, float64, C order.
            out: (N, SENSOR_LAYOUT.width), float64, C order. Threads may work on disjoint ranges at the same time.
        """
        self._require(raw, out)
        end = self.count if stop is None else stop
        measure_rows(raw, *self.memory(), out, start, end)

    def _require(self, raw: Array, out: Array) -> None:
        if raw.shape != (self.count, RAW_LAYOUT.width) or out.shape != (self.count, SENSOR_LAYOUT.width):
            raise InputError(
                f"sensors of {self.count} robots take raw ({self.count}, {RAW_LAYOUT.width}) and "
                f"out ({self.count}, {SENSOR_LAYOUT.width}), got {raw.shape} and {out.shape}"
            )


def imu_to_body(parameters: Parameters) -> Array:
    """Return the rotation of ``imu.mount`` from the IMU's to the body frame, (N, 3, 3); exactly the identity without one."""
    roll, pitch, yaw = parameters["imu.mount"].T
    return rotation(yaw, pitch, roll)


def rotation(yaw: Array, pitch: Array, roll: Array) -> Array:
    """Return the matrices (N, 3, 3) of Rz(yaw) Ry(pitch) Rx(roll)."""
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(a), np.sin(a)) for a in (yaw, pitch, roll))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _settings(robot: Robot, options: PlantOptions) -> Array:
    """Counts and noise levels as the vector the kernel reads; zero without sensor noise."""
    sensors = robot.sensors
    settings = np.zeros(_FLOW_SETTINGS + FLOW_SETTINGS)
    settings[_FLOW_SETTINGS:] = flow_settings(robot, options.sensor_noise)
    settings[_PERIOD] = options.control_period
    settings[_CAMERA_RATE] = sensors.camera.rate
    if not options.sensor_noise:
        return settings
    settings[_NOISY] = 1.0
    settings[_POSITION_COUNT] = sensors.encoder.position
    settings[_VELOCITY_COUNT] = sensors.encoder.velocity
    settings[_VOLT_COUNT] = sensors.volt_count
    settings[_EFFORT_COUNTS : _EFFORT_COUNTS + len(JOINTS)] = effort_counts(robot)
    settings[_VOLT_NOISE] = sensors.volt_noise
    settings[_GYRO_NOISE] = sensors.imu.gyro_noise
    settings[_ACCEL_NOISE] = sensors.imu.accel_noise
    settings[_CAMERA_NOISE] = sensors.camera.position_noise
    settings[_YAW_NOISE] = sensors.camera.yaw_noise
    settings[_EFFORT_NOISE:_FLOW_SETTINGS] = np.repeat([sensors.effort.leg_noise, sensors.effort.wheel_noise], 4)
    return settings
