"""An optical-flow sensor under the body: counts of image shift over the floor, as the reading it gives at a control tick.

It looks along body -z and measures how fast the floor turns about it, rad/s along its own x and y (nominally the body's):
flow_x = v_x/h - w_y, flow_y = v_y/h + w_x, with the velocity v of its lens over the floor, the body's angular velocity w, and
the distance h from the lens to the floor along its axis. The floor is the plane z = 0 of the floor frame, on a slope too.

Frames come at a rate of their own. A reading is what was counted between the last frame before the tick and the last before the
tick before, over the time between these two frames: drivers that poll faster than the frames know it
(:mod:`wlr_gym.hardware.flow`). Both are linear in the pose between two ticks.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.random import normals4, stream_number, words4
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Parameters that a robot's sensor remembers, in the order of the first columns of its state.
ERRORS = ("flow.present", "flow.scale", "flow.mount_yaw", "flow.dropout", "flow.poor_floor")
_PRESENT, _SCALE, _MOUNT_YAW, _DROPOUT, _POOR_FLOOR = range(len(ERRORS))
_PHASE = 5
_SEEN = 6
_PLACE = 7
_TURN = 10
_CARRIED = 14
_SHOWN = 16
_QUALITY = 18
_END = 19
#: Columns of a robot's state. Beyond ``_PHASE``: tick, place and attitude when last looked; image shift since the last frame;
#: shown flow and quality, and when its interval ended.
WIDTH = 20
#: First column of a robot's state that a reset clears.
MEMORY = _SEEN

#: Entries of the settings: place of the lens, one count, frame rate, noises, quality and limits.
SETTINGS = 12
_LENS, _COUNT, _RATE, _NOISE, _SPEED_NOISE = 0, 3, 4, 5, 6
_MEAN_QUALITY, _QUALITY_NOISE, _LEAST_QUALITY, _LEAST_HEIGHT, _GREATEST_RATE = 7, 8, 9, 10, 11

#: Edge of the squares of floor that have a texture of their own (m).
CELL = 0.2
#: Whole cells added, so that their numbers are positive near the start.
_CELLS = 1 << 20
#: Share of the texture below which its noise grows no more.
_LEAST_TEXTURE = 0.1
#: Of the body's z axis on the floor's normal: below it the sensor does not look at the floor.
_LEAST_COSINE = 0.2
_NOISE_STREAM = stream_number("flow")
_DROPOUT_STREAM = stream_number("flow dropout")
_PHASE_STREAM = stream_number("flow phase")
_TEXTURE_STREAM = stream_number("flow texture")


def flow_settings(robot: Robot, sensor_noise: bool) -> Array:
    """Return what :func:`measure_flow` reads of a robot's file, (SETTINGS); without noise: neither noise nor rounding."""
    settings = np.zeros(SETTINGS)
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


@njit(cache=True, nogil=True)
def flow_phase(seed: Any) -> float:
    """Return the phase of a robot's frames, 0 to 1."""
    return float(np.int64(words4(seed, _PHASE_STREAM, 0, 0)[0])) * 2.0**-32


@njit(cache=True, nogil=True)
def _place(height: float, quaternion: Any, pose: Any, settings: Any, out: Any) -> None:
    """Write the lens's place in the floor frame, and the attitude, into ``out`` (7)."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    a, b, c = settings[_LENS], settings[_LENS + 1], settings[_LENS + 2]
    out[0] = pose[0] + (1.0 - 2.0 * (y * y + z * z)) * a + 2.0 * (x * y - w * z) * b + 2.0 * (x * z + w * y) * c
    out[1] = pose[1] + 2.0 * (x * y + w * z) * a + (1.0 - 2.0 * (x * x + z * z)) * b + 2.0 * (y * z - w * x) * c
    out[2] = height + 2.0 * (x * z - w * y) * a + 2.0 * (y * z + w * x) * b + (1.0 - 2.0 * (x * x + y * y)) * c
    out[3], out[4], out[5], out[6] = w, x, y, z


@njit(cache=True, nogil=True)
def _shift(before: Any, after: Any) -> Any:
    """Image shift (x, y; rad) between two places of the lens (7), and the distance to the floor along its axis (m).

    Displacement along the mean axes over the mean distance, and the turn of one attitude against the other: exact to second
    order in the turn. A distance of 0 says that the sensor does not look at the floor.
    """
    d = (after[0] - before[0], after[1] - before[1], after[2] - before[2])
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


@njit(cache=True, nogil=True)
def _texture(seed: Any, x: float, y: float, poor_floor: float) -> float:
    """Share of the quality that the floor's texture leaves at a place: 1, and 0 to 1 on its poor share."""
    if poor_floor <= 0.0:
        return 1.0
    cell_x, cell_y = math.floor(x / CELL) + _CELLS, math.floor(y / CELL) + _CELLS
    drawn = float(np.int64(words4(seed, _TEXTURE_STREAM, cell_x, cell_y)[0])) * 2.0**-32
    return drawn / poor_floor if drawn < poor_floor else 1.0


@njit(cache=True, nogil=True)
def measure_flow(
    seed: Any, tick: int, period: float, height: float, turn: Any, pose: Any, settings: Any, state: Any, out: Any
) -> None:
    """Look at the floor at a tick; write flow (x, y), quality, age and whether it is new into ``out`` (5).

    Args:
        seed: of the robot's noise.
        tick: 0 at the reset.
        period: of control (s).
        height: of the body origin over the floor (m).
        turn: (4) quaternion, body to floor frame.
        pose: (x, y, yaw) of the body origin in the floor frame.
        settings: see :func:`flow_settings`.
        state: (WIDTH) what the sensor remembers.
        out: (5).
    """
    now = tick * period
    is_new = 0.0
    if state[_PRESENT] > 0.5:
        place = np.empty(7)
        _place(height, turn, pose, settings, place)
        if tick > 0 and state[_SEEN] == tick - 1:
            is_new = _read(seed, tick, period, place, settings, state)
        state[_SEEN] = tick
        for k in range(7):
            state[_PLACE + k] = place[k]
    out[0], out[1], out[2] = state[_SHOWN], state[_SHOWN + 1], state[_QUALITY]
    out[3] = now - state[_END]
    out[4] = is_new


@njit(cache=True, nogil=True)
def _read(seed: Any, tick: int, period: float, place: Any, settings: Any, state: Any) -> float:
    """Count the shift since the last tick; read what the frames up to now give. Returns 1 when that is a new valid reading."""
    shift_x, shift_y, distance = _shift(state[_PLACE : _PLACE + 7], place)
    rate, phase = settings[_RATE], state[_PHASE]
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
    lost = float(np.int64(words4(seed, _DROPOUT_STREAM, tick, 0)[0])) * 2.0**-32 < state[_DROPOUT]
    too_fast = max(abs(x), abs(y)) > settings[_GREATEST_RATE]
    if lost or too_fast or distance < settings[_LEAST_HEIGHT] or distance == 0.0 or quality < settings[_LEAST_QUALITY]:
        state[_QUALITY] = 0.0
        return 0.0
    poorness = 1.0 / max(texture, _LEAST_TEXTURE)
    c, s = math.cos(state[_MOUNT_YAW]), math.sin(state[_MOUNT_YAW])
    state[_SHOWN] = _counted(state[_SCALE] * (c * x + s * y), interval, frames, n0 * poorness, settings)
    state[_SHOWN + 1] = _counted(state[_SCALE] * (c * y - s * x), interval, frames, n1 * poorness, settings)
    state[_QUALITY] = quality
    state[_END] = end
    return 1.0


@njit(cache=True, nogil=True)
def _counted(flow: float, interval: float, frames: int, normal: float, settings: Any) -> float:
    """Return ``flow`` (rad/s) with the noise of its frames, in whole counts; without a count it stays as it is."""
    count = settings[_COUNT]
    if count <= 0.0:
        return flow
    counts = flow * interval / count
    spread = math.sqrt(frames) * math.hypot(settings[_NOISE], settings[_SPEED_NOISE] * counts / frames)
    return (np.rint(counts + spread * normal) + 0.0) * count / interval
