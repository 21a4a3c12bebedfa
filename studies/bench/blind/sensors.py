"""What the robot's logger would have written: clock, encoders, efforts, IMU, camera, supply."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from studies.bench.blind.copies import JOINTS, Copy
from studies.bench.blind.drive import SAMPLE
from studies.bench.blind.truth import Hidden

Array = NDArray[np.float64]
JITTER = 1e-3  # s, of a tick and of a camera frame's age
LOST = 1 / 300  # share of ticks
#: One count of the current register, A.
CURRENT_COUNT = 2.69e-3
#: One count of the load register, share of the stall torque.
LOAD_COUNT = 1e-3
#: One count of the voltage register, V.
VOLT_COUNT = 0.1


def ticks(duration: float, rate: float, rng: np.random.Generator) -> Array:
    """Return the host clock at every tick that is not lost, s."""
    nominal = np.arange(1, int(duration * rate)) / rate
    kept = nominal[rng.random(len(nominal)) >= LOST]
    times = kept - 1 / rate + 0.005 + JITTER * np.clip(rng.standard_normal(len(kept)), -4, 4)
    return np.maximum(times, 1e-4)


def log(
    records: Array, times: Array, setpoints: Array, copy: Copy, hidden: Hidden, robot: dict[str, Any], rng: np.random.Generator
) -> pd.DataFrame:
    """Turn the records of a simulated run into the table of a measured one.

    Args:
        records: as of ``simulation.simulate``.
        times: (n,) host clock of the rows, s.
        setpoints: (n, 8) written in these rows.
    """
    sensors = robot["sensors"]
    now = _at(records, times)
    table: dict[str, Array] = {"t": times}
    table |= {f"cmd_{joint}": setpoints[:, j] for j, joint in enumerate(JOINTS)}
    table |= _encoders(now, records[0], copy, hidden, sensors)
    table |= _efforts(now, copy, robot, rng)
    table |= _inertial(now, copy, hidden, sensors["imu"], rng)
    table |= _camera(records, times, copy, hidden, sensors["camera"], rng)
    volts = now[:, 37] + sensors["volt_noise"] * rng.standard_normal(len(times))
    table["volt"] = _count(volts, VOLT_COUNT)
    return pd.DataFrame(table)


def _at(records: Array, times: Array) -> Array:
    """Interpolate the records at times, holding the ends."""
    place = np.clip(times / SAMPLE, 0, len(records) - 1.000001)
    low = place.astype(int)
    share = (place - low)[:, None]
    return (1 - share) * records[low] + share * records[low + 1]


def _count(values: Array, size: float) -> Array:
    return np.rint(values / size) * size


def _encoders(now: Array, first: Array, copy: Copy, hidden: Hidden, sensors: dict[str, Any]) -> dict[str, Array]:
    count = sensors["encoder"]
    table = {}
    for j, joint in enumerate(JOINTS):
        zero = copy.joint_zero[j] + hidden.zero[j] if j < 4 else -first[7 + j]
        table[f"pos_{joint}"] = _count(now[:, 7 + j] + zero, count["position"])
    return table | {f"vel_{joint}": _count(now[:, 15 + j], count["velocity"]) for j, joint in enumerate(JOINTS)}


def _efforts(now: Array, copy: Copy, robot: dict[str, Any], rng: np.random.Generator) -> dict[str, Array]:
    noise, table = robot["sensors"]["effort"], {}
    for j, joint in enumerate(JOINTS):
        constant = copy.nominal_torque_constant[j]
        sigma = noise["leg_noise"] if j < 4 else noise["wheel_noise"]
        size = CURRENT_COUNT * constant if j < 4 else LOAD_COUNT * robot["servo"]["wheel"]["stall_torque"]
        effort = now[:, 23 + j] * constant + sigma * rng.standard_normal(len(now))
        table[f"eff_{joint}"] = _count(effort, size)
    return table


def _inertial(now: Array, copy: Copy, hidden: Hidden, imu: dict[str, float], rng: np.random.Generator) -> dict[str, Array]:
    turn = _mounting(*hidden.imu)
    gyro = now[:, 31:34] @ turn + copy.gyro_bias + hidden.gyro_bias
    accel = now[:, 34:37] @ turn + copy.accel_bias
    gyro += imu["gyro_noise"] * rng.standard_normal(gyro.shape)
    accel += imu["accel_noise"] * rng.standard_normal(accel.shape)
    return {f"gyro_{axis}": gyro[:, k] for k, axis in enumerate("xyz")} | {
        f"acc_{axis}": accel[:, k] for k, axis in enumerate("xyz")
    }


def _mounting(roll: float, pitch: float, yaw: float) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll): from sensor to body. A row vector times it is its transpose times a column."""
    (cr, sr), (cp, sp), (cy, sy) = [(np.cos(angle), np.sin(angle)) for angle in (roll, pitch, yaw)]
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def _heading(records: Array) -> Array:
    w, x, y, z = records[:, 3:7].T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _nose_down(records: Array) -> Array:
    w, x, y, z = records[:, 3:7].T
    return np.arcsin(np.clip(2 * (w * y - x * z), -1, 1))


def _camera(
    records: Array, times: Array, copy: Copy, hidden: Hidden, camera: dict[str, float], rng: np.random.Generator
) -> dict[str, Array]:
    """A frame every 1/30 s belongs to the first tick after it; its pose is as old as the set's age, with a little jitter."""
    frames = np.floor(times * camera["rate"] + rng.random())
    fresh = np.diff(frames, prepend=-1) > 0
    age = copy.camera_age + hidden.camera_delay + JITTER * rng.standard_normal(len(times))
    seen = times - np.maximum(age, 0)
    unrolled = records[:, :7].copy()
    pose = np.column_stack([unrolled[:, :3], np.unwrap(_heading(records)), _nose_down(records)])
    pose = np.stack([np.interp(seen, SAMPLE * np.arange(len(pose)), column) for column in pose.T], axis=1)
    start = np.array([*records[0, :2], _heading(records[:1])[0]])
    east, north = (pose[:, :2] - start[:2]).T
    # zeroed at the start, where the floor frame's x is the robot's heading; the camera sees that frame turned by its mounting
    angle = start[2] + copy.camera_yaw + hidden.camera_yaw
    x, y = np.cos(angle) * east + np.sin(angle) * north, -np.sin(angle) * east + np.cos(angle) * north
    clean = {"cam_x": x * hidden.camera_scale, "cam_y": y * hidden.camera_scale, "cam_yaw": pose[:, 3] - start[2]}
    clean |= {"cam_z": pose[:, 2], "cam_pitch": pose[:, 4]}
    table = {}
    for name, values in clean.items():
        sigma = camera["yaw_noise"] if name in ("cam_yaw", "cam_pitch") else camera["position_noise"]
        table[name] = np.where(fresh, values + sigma * rng.standard_normal(len(times)), np.nan)
    return table
