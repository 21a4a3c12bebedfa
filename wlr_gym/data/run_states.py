"""Robot states of a run, from what it measures: where a replay starts, and where each of its segments starts again.

What the run measures is taken from it, smoothed; the rest (height, attitude, servo references) comes from a background state.
Where no camera saw the robot, it is where its wheels and its gyroscope took it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.runs import Run
from wlr_gym.physics.plants import relief
from wlr_gym.physics.plants.base import PlantState, settle, standing_state
from wlr_gym.physics.plants.contacts import slip_on_relief
from wlr_gym.physics.plants.sensors import imu_to_body, rotation
from wlr_gym.physics.servo import reference_per_effort, reference_per_rate
from wlr_gym.robot import CORNER_SIGNS, JOINTS, LEG_SLICE, LEGS, WHEEL_SLICE, WHEELS, Robot
from wlr_gym.robot.parameters import Parameters
from wlr_gym.robot.slip import contact_slip_velocity

Array = NDArray[np.float64]


def rest_pose(parameters: Parameters, legs: Array) -> Array:
    """Return height of the body origin, pitch and roll (N, 3) that put four wheels on a flat floor, least squares.

    Args:
        parameters: (N).
        legs: (N, 4) true leg angles, rad.
    """
    signs = np.array(CORNER_SIGNS)
    hip, length, radius = parameters["hip.position"], parameters["leg.length"], parameters["wheel.radius"]
    x = signs[:, 0] * hip[:, :1] + length * np.cos(legs)
    y = signs[:, 1] * hip[:, 1:2] + np.zeros_like(legs)
    z = hip[:, 2:] - length * np.sin(legs)
    pose = np.zeros((len(legs), 3))
    for _ in range(5):  # Gauss-Newton; the problem is almost linear
        height, pitch, roll = pose[:, :1], pose[:, 1:2], pose[:, 2:]
        up = np.sin(roll) * y + np.cos(roll) * z
        gap = height - np.sin(pitch) * x + np.cos(pitch) * up - radius
        along = np.cos(pitch) * (np.cos(roll) * y - np.sin(roll) * z)
        slope = np.stack([np.ones_like(x), -np.cos(pitch) * x - np.sin(pitch) * up, along], axis=2)
        pose = pose - np.einsum("nij,nj->ni", np.linalg.pinv(slope), gap)
    return pose


def euler_angles(q: Array) -> tuple[Array, Array, Array]:
    """Yaw, pitch and roll (N,) of quaternions (N, 4), (w, x, y, z): Rz(yaw) Ry(pitch) Rx(roll), body to floor frame."""
    w, x, y, z = q.T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    pitch = np.arcsin(np.clip(2 * (w * y - x * z), -1, 1))
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return yaw, pitch, roll


def quaternion(yaw: Array, pitch: Array, roll: Array) -> Array:
    """Quaternions (N, 4) of Rz(yaw) Ry(pitch) Rx(roll)."""
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(a / 2), np.sin(a / 2)) for a in (yaw, pitch, roll))
    w, x = cy * cp * cr + sy * sp * sr, cy * cp * sr - sy * sp * cr
    y, z = cy * sp * cr + sy * cp * sr, sy * cp * cr - cy * sp * sr
    return np.stack([w, x, y, z], axis=1)


# ---- states ----------------------------------------------------------------------------------------------------------


#: s; half width of the window over which a joint or gyro reading is smoothed.
JOINT_WINDOW = 0.07
#: s; the same for the camera, which is slower and noisier.
CAMERA_WINDOW = 0.2
#: rad; a joint that stays within this stands still.
REST = 0.004


def local_fit(t: Array, values: Array, at: Array, window: float, degree: int = 2) -> tuple[Array, Array]:
    """Smooth a sampled signal: value and slope at the times ``at`` of local polynomials (tricube weights over +-``window``).

    Missing samples are skipped; where fewer than three are left, the nearest three are used. Shapes: ``t`` and ``values``
    (T,), ``at`` and both results (K,).
    """
    known = np.isfinite(values)
    t, values = t[known], values[known]
    fits = np.zeros((len(at), 3))
    for k, time in enumerate(at):
        offset = t - time
        third = min(2, len(t) - 1)
        reach = max(window, 1.001 * float(np.partition(np.abs(offset), third)[third]))
        near = np.abs(offset) < reach
        root_weight = (1 - np.abs(offset[near] / reach) ** 3) ** 1.5
        powers = np.vander(offset[near] / reach, degree + 1, increasing=True)
        fits[k, : degree + 1] = np.linalg.lstsq(powers * root_weight[:, None], values[near] * root_weight, rcond=1e-8)[0]
        fits[k, 1] /= reach
    return fits[:, 0], fits[:, 1]


def starts_at_rest(run: Run) -> bool:
    """Whether no joint moves by more than two encoder counts or so in the first tenths of a second."""
    early = run["t"] <= run["t"][0] + CAMERA_WINDOW
    return all(np.ptp(run[f"pos_{joint}"][early]) < REST for joint in JOINTS)


def start_state(run: Run, robot: Robot, parameters: Parameters) -> PlantState:
    """Return the state (1 robot) at the run's first row: measured joints, legs on the floor, references at the setpoints.

    The integral of a wheel's speed controller is read off the effort and the rate that it holds.
    """
    background = standing_state(robot, parameters)
    first = run["t"][:1]
    legs = np.array([[run[f"cmd_{joint}"][0] for joint in LEGS]])
    moves = not starts_at_rest(run)
    degree = 2 if moves else 0
    measured = _joints(run, first, parameters, degree)[0]
    wanted = legs - parameters["joint.zero_offset"]
    background.reference_position[:, LEG_SLICE] = np.where(np.isnan(wanted), measured[:, LEG_SLICE], wanted)
    background.reference_position[:, WHEEL_SLICE] += _wheel_tension(run, robot, parameters)
    state = measured_state(run, first, background, parameters, degree)
    state.reference_velocity[:, WHEEL_SLICE] = state.joint_velocity[:, WHEEL_SLICE]
    if moves:
        held = reference_per_rate(robot, parameters) * state.joint_velocity
        state.reference_position[:, WHEEL_SLICE] += held[:, WHEEL_SLICE]
    settle(robot, parameters, state)
    return state


def measured_state(run: Run, times: Array, background: PlantState, parameters: Parameters, degree: int = 2) -> PlantState:
    """Return one state per time: measured where the run measures, else the background's.

    Measured: joint angles and rates; x, y, yaw and their rates from the camera, where a frame is near; body rates from the
    gyroscope. Height, pitch and roll are the background's, moved by what the difference between measured and background leg
    angles means for a body on four wheels. Servo references are the background's; a wheel's moves along with its angle.
    Rotors keep their place in the play of their gears.

    Args:
        run: the run.
        times: (K,) s on the run's clock.
        background: (K) states.
        parameters: (K) parameters.
        degree: of the smoothing polynomials; 0 where the robot stands still.
    """
    state = background.copy()
    state.joint_position, state.joint_velocity = _joints(run, times, parameters, degree)
    state.reference_position[:, WHEEL_SLICE] += state.joint_position[:, WHEEL_SLICE] - background.joint_position[:, WHEEL_SLICE]
    if state.rotor_rate is not None:
        state.rotor_rate += state.joint_velocity - background.joint_velocity

    yaw, pitch, roll = euler_angles(background.quaternion)
    measured_rest, background_rest = (rest_pose(parameters, s.joint_position[:, LEG_SLICE]) for s in (state, background))
    moved = measured_rest - background_rest
    state.position[:, 2] += moved[:, 0]
    pitch, roll = pitch + moved[:, 1], roll + moved[:, 2]
    velocity = np.einsum("nij,nj->ni", rotation(yaw, pitch, roll), background.linear_velocity_in_body)
    if all(name in run and np.isfinite(run[name]).sum() > 2 for name in ("gyro_x", "gyro_y", "gyro_z")):
        gyro = [local_fit(run["t"], run[f"gyro_{axis}"], times, JOINT_WINDOW, degree)[0] for axis in "xyz"]
        measured = np.stack(gyro, axis=1) - parameters["imu.gyro_bias"]
        state.angular_velocity_in_body = np.einsum("nij,nj->ni", imu_to_body(parameters), measured)
    seen = frame_near(run, times, parameters["camera.delay"][0]) if has_camera(run) else np.zeros(len(times), bool)
    if seen.any():
        (x, vx), (y, vy), (measured_yaw, _) = _camera(run, times, parameters, degree)
        state.position[seen, :2] = np.stack([x, y], axis=1)[seen]
        velocity[seen, :2] = np.stack([vx, vy], axis=1)[seen]
        yaw = np.where(seen, measured_yaw, yaw)
    turn = rotation(yaw, pitch, roll)
    state.quaternion = quaternion(yaw, pitch, roll)
    state.linear_velocity_in_body = np.einsum("nji,nj->ni", turn, velocity)
    offset = np.asarray(run.meta.marker_offset)
    state.position[seen, :2] -= (turn @ offset)[seen, :2]
    state.linear_velocity_in_body[seen] -= np.cross(state.angular_velocity_in_body, offset)[seen]
    return state


def slip_of(robot: Robot, parameters: Parameters, state: PlantState) -> Array:
    """Return the slip velocities (N, 4, 2) of wheels, m/s: of robots on the floor, also where that is not flat."""
    motion = (state.linear_velocity_in_body, state.angular_velocity_in_body, state.joint_position, state.joint_velocity)
    if relief.families(parameters):
        return slip_on_relief(robot, parameters, state)
    return contact_slip_velocity(parameters, state.quaternion, *motion)


def standing_at(setpoints: Array, robot: Robot, parameters: Parameters) -> PlantState:
    """Return every robot standing on the floor at its first leg setpoints, level where its parameters let it."""
    state = standing_state(robot, parameters)
    level = rest_pose(parameters, state.joint_position[:, LEG_SLICE])
    state.joint_position[:, LEG_SLICE] = setpoints[:, LEG_SLICE] - parameters["joint.zero_offset"]  # setpoints are readings
    state.reference_position[:, LEG_SLICE] = state.joint_position[:, LEG_SLICE]  # true angles, both
    pose = rest_pose(parameters, state.joint_position[:, LEG_SLICE])
    state.position[:, 2] += pose[:, 0] - level[:, 0]
    state.quaternion = quaternion(np.zeros(len(pose)), pose[:, 1], pose[:, 2])
    settle(robot, parameters, state)
    return state


def has_camera(run: Run) -> bool:
    """Whether the run holds a floor pose with at least three frames."""
    columns = ("cam_x", "cam_y", "cam_yaw")
    return all(name in run and np.isfinite(run[name]).sum() > 2 for name in columns)


def frame_near(run: Run, times: Array, delay: float = 0.0) -> NDArray[np.bool_]:
    """Whether a frame was exposed near each time (K,): farther from all frames a fit of the camera's pose is a guess."""
    exposed = run["t"][np.isfinite(run["cam_x"])] - delay
    reach = max(CAMERA_WINDOW, float(np.median(np.diff(exposed))))
    return np.abs(exposed[:, None] - times).min(axis=0) <= reach


def _joints(run: Run, times: Array, parameters: Parameters, degree: int) -> tuple[Array, Array]:
    """True joint angles and rates (K, 8) at the given times."""
    positions = np.zeros((len(times), 8))
    velocities = np.zeros((len(times), 8))
    for j, joint in enumerate(JOINTS):
        positions[:, j], velocities[:, j] = local_fit(run["t"], run[f"pos_{joint}"], times, JOINT_WINDOW, degree)
        if f"vel_{joint}" in run and np.isfinite(run[f"vel_{joint}"]).sum() > 2:
            velocities[:, j], _ = local_fit(run["t"], run[f"vel_{joint}"], times, JOINT_WINDOW, degree)
    positions[:, LEG_SLICE] -= parameters["joint.zero_offset"]
    return positions, velocities


def _camera(run: Run, times: Array, parameters: Parameters, degree: int) -> list[tuple[Array, Array]]:
    """Marker x, y and yaw in the floor frame, each with its rate, at the given times."""
    exposed = run["t"] - parameters["camera.delay"][0]
    x, y, yaw = (local_fit(exposed, seen, times, CAMERA_WINDOW, degree) for seen in camera_pose(run))
    mount, scale = parameters["camera.mount_yaw"][0], parameters["camera.scale"][0]
    cosine, sine = np.cos(mount) / scale, np.sin(mount) / scale
    turned_x, turned_y = ((cosine * x[k] - sine * y[k], sine * x[k] + cosine * y[k]) for k in (0, 1))
    return [(turned_x[0], turned_y[0]), (turned_x[1], turned_y[1]), yaw]


def camera_pose(run: Run) -> Array:
    """Return what the camera saw: x, y (m) and yaw (rad, without jumps of 2 pi), (3, rows); NaN between frames."""
    seen = np.stack([run["cam_x"], run["cam_y"], run["cam_yaw"]])
    known = np.isfinite(seen[2])
    seen[2, known] = np.unwrap(seen[2, known])
    return seen


def _wheel_tension(run: Run, robot: Robot, parameters: Parameters) -> Array:
    """Distance of the wheels' reference from their angle (1, 4) that gives the measured effort at rest.

    At rest are the rows of the first tenths of a second that were read before any setpoint asked a wheel to turn.
    """
    asked = np.any([np.nan_to_num(run[f"cmd_{joint}"]) != 0.0 for joint in WHEELS], axis=0)
    before = np.concatenate([[False], np.logical_or.accumulate(asked)[:-1]])
    still = (run["t"] <= run["t"][0] + CAMERA_WINDOW) & ~before
    effort = [np.mean(run[f"eff_{joint}"][still]) if f"eff_{joint}" in run else 0.0 for joint in WHEELS]
    return np.nan_to_num(effort) * reference_per_effort(robot, parameters)[:, WHEEL_SLICE]


# ---- odometry --------------------------------------------------------------------------------------------------------


def rolled_poses(run: Run, robot: Robot) -> Array:
    """Return x, y (m) and yaw (rad) of a robot that rolls without slip, (rows, 3); through each frame of the camera it passes.

    Between frames it moves as the wheels roll, along the heading that the gyroscope has turned to; without a gyroscope, that
    the wheels of both sides turn to, as if they did not skid.
    """
    t = run["t"]
    steps, turns = _rolled(run, robot).mean(axis=1), _turns(run, robot)
    poses = np.zeros((len(t), 3))
    poses[:, 2] = np.cumsum(turns)
    heading = poses[:, 2] - 0.5 * turns
    poses[:, :2] = np.cumsum(steps[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    if not has_camera(run):
        return poses
    frames = np.flatnonzero(np.isfinite(run["cam_x"] + run["cam_y"] + run["cam_yaw"]))
    seen = camera_pose(run).T
    last = np.maximum(np.searchsorted(frames, np.arange(len(t)), side="right") - 1, 0)
    anchors = frames[last]  # before the first frame: that one
    turned = seen[anchors, 2] - poses[anchors, 2]
    moved = poses[:, :2] - poses[anchors, :2]
    cosine, sine = np.cos(turned), np.sin(turned)
    x, y = cosine * moved[:, 0] - sine * moved[:, 1], sine * moved[:, 0] + cosine * moved[:, 1]
    return np.stack([seen[anchors, 0] + x, seen[anchors, 1] + y, poses[:, 2] + turned], axis=1)


def _rolled(run: Run, robot: Robot) -> Array:
    """Return how far each wheel has rolled against the body in each row's step (rows, 4), m."""
    angles = np.stack([run[f"pos_{wheel}"] + run[f"pos_{leg}"] for wheel, leg in zip(WHEELS, LEGS, strict=True)], axis=1)
    return robot.wheel.radius * np.diff(angles, axis=0, prepend=angles[:1])


def _turns(run: Run, robot: Robot) -> Array:
    if "gyro_z" in run and np.isfinite(run["gyro_z"]).any():
        known = np.isfinite(run["gyro_z"])
        rate = np.interp(run["t"], run["t"][known], run["gyro_z"][known])
        return rate * np.diff(run["t"], prepend=run["t"][0])
    sides = np.array([sign for _, sign in CORNER_SIGNS])
    return -(sides * _rolled(run, robot)).mean(axis=1) / robot.hip_position.y
