"""Runs of the engine itself, recorded tick by tick, not with the code that replays them."""

from pathlib import Path

import numpy as np
import pandas

from wlr_gym.data import Profile, Run, RunMeta
from wlr_gym.data.format import CHANNELS, COMMANDS
from wlr_gym.data.replay import profile_parameters
from wlr_gym.data.run_states import euler_angles
from wlr_gym.data.sensors import noise_parts
from wlr_gym.gap.robot.replay import PHYSICS_STEP
from wlr_gym.gap.robot.windows import CLOCK
from wlr_gym.physics.effects import apply_patch, load_patch
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, standing_state
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()
META = RunMeta(profile=Profile(wheel_acceleration=11.0, leg_velocity=1.5, leg_acceleration=15.0))
LEG = 1.4


def posture_and_turns(t):
    """Drive, turn and change posture."""
    moving = max(t - 0.4, 0.0)
    setpoints = np.zeros(8)
    setpoints[:4] = LEG + 0.25 * np.sin(1.9 * moving) * np.array([1.0, 1.0, -1.0, -1.0])
    setpoints[4:] = 3.5 * np.sin(1.7 * moving) + np.array([-0.8, 0.8, -0.8, 0.8]) * np.sin(1.1 * moving)
    return setpoints


def free_rear_wheels(t):
    """The same, rear wheels off for a while."""
    setpoints = posture_and_turns(t)
    if 1.5 < t < 2.5:
        setpoints[6:] = np.nan
    return setpoints


def abrupt(t):
    """Setpoints that jump."""
    setpoints = np.full(8, LEG)
    setpoints[4:] = 0.0 if t < 0.4 else 4.0 * np.sign(np.sin(5.0 * (t - 0.4)))
    return setpoints


def nominal(effects=(), meta=META):
    """Parameters of the robot with a profile and effects."""
    return apply_patch(load_patch(list(effects)), profile_parameters(Parameters.nominal(ROBOT), meta.profile))


def record(
    commands,
    rows,
    effects=(),
    *,
    tick=CLOCK,
    step=None,
    meta=META,
    noise=None,
    backend="gibbs_appell",
    name="run_01",
    **changes,
):
    """Record a run.

    Args:
        commands: setpoints (8) as a function of time.
        rows: (T,) times of the rows, whole ticks.
        effects: in the robot.
        tick: s between two steps of the plant; the setpoints of a row act from that very moment.
        step: s, physics step; None = the replay's, or the tick where that is shorter.
        noise: seed of the sensors' noise; None = exact sensors.
        changes: parameters of the robot.
    """
    parameters = nominal(effects, meta)
    for key, value in changes.items():
        parameters[key.replace("__", ".")] = value
    options = PlantOptions(control_period=tick, physics_step=step or min(tick, PHYSICS_STEP), sensor_noise=False)
    plant = make_plant(backend, ROBOT, 1, options, load_patch(list(effects)).forces)
    state = standing_state(ROBOT, parameters, LEG)
    shift = parameters["joint.zero_offset"]
    state.joint_position[:, :4] -= shift
    state.reference_position[:, :4] -= shift
    readings = plant.reset(parameters=parameters, state=state)
    first = np.nan_to_num(commands(0.0))[None]
    for _ in range(round(1.0 / tick)):
        readings = plant.step(first)
    wheels = readings.joint_position[0, 4:].copy()
    due = np.rint(np.asarray(rows) / tick).astype(int)
    table, poses, setpoints = [], [], first[0]
    try:
        for k in range(due[-1] + 1):
            truth = plant.truth()
            yaw, pitch, _ = euler_angles(truth.quaternion)
            poses.append([*truth.position[0, :2], yaw[0], truth.position[0, 2], pitch[0]])
            if k in due:
                setpoints = commands(rows[len(table)])
                joints = [readings.joint_position[0] - np.append(np.zeros(4), wheels), readings.joint_velocity[0]]
                imu = [readings.joint_effort[0], readings.gyro[0], readings.accelerometer[0], readings.supply_voltage]
                table.append(np.concatenate([setpoints, *joints, *imu]))
            on = np.isfinite(setpoints)[None]
            readings = plant.step(np.nan_to_num(setpoints)[None], None if on.all() else on)
    finally:
        plant.close()
    direct = [c for c in CHANNELS if not c.startswith("cam")]
    frame = pandas.DataFrame(np.array(table), columns=[*COMMANDS, *direct])
    frame.insert(0, "t", np.asarray(rows, float))
    shown = _camera(np.array(poses), np.asarray(rows) - parameters["camera.delay"][0], tick, parameters)
    for column, values in zip(("cam_x", "cam_y", "cam_yaw", "cam_z", "cam_pitch"), shown.T, strict=True):
        frame[column] = values
    if noise is not None:
        _add_noise(frame, noise)
    return Run(frame, meta, Path(f"{name}.parquet"))


def _camera(poses, times, tick, parameters):
    ticks = tick * np.arange(len(poses))
    poses[:, 2] = np.unwrap(poses[:, 2])
    shown = np.stack([np.interp(times, ticks, column) for column in poses.T], axis=1)
    turn, scale = -parameters["camera.mount_yaw"][0], parameters["camera.scale"][0]
    x, y = shown[:, 0].copy(), shown[:, 1].copy()
    shown[:, 0] = scale * (np.cos(turn) * x - np.sin(turn) * y)
    shown[:, 1] = scale * (np.sin(turn) * x + np.cos(turn) * y)
    return shown


def _add_noise(frame, seed):
    rng = np.random.default_rng(seed)
    for name, (sigma, count) in noise_parts(ROBOT).items():
        noisy = frame[name] + sigma * rng.standard_normal(len(frame))
        frame[name] = np.round(noisy / count) * count if count > 0.0 else noisy
    frame.loc[::3, ["cam_x", "cam_y", "cam_yaw"]] = np.nan


def spaced(seconds, period=0.02, offset=0.0):
    """Row times from 0, the later ones ``offset`` off the grid."""
    rows = period * np.arange(round(seconds / period) + 1)
    return np.append(rows[:1], rows[1:] + offset)
