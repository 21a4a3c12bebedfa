"""The whole chain in emulated time: servo protocol, rendered frames, detector, observer, policy; beside the simulator.

Every episode has the robot, floor and commands that a simulated episode of the same seed has, so the two are paired.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.envs.core import Core
from wlr_gym.envs.tasks.success import limits_of, tracking_error
from wlr_gym.envs.tasks.terms.geometry import yaw_of
from wlr_gym.hardware.camera.config import CameraFile, load_camera_file
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.link import emulated_link
from wlr_gym.hardware.emulator.machine import Machine, MachineOptions
from wlr_gym.hardware.plant import RobotPlant
from wlr_gym.learning.evaluation.rollout import make_core, roll_out
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT
from wlr_gym.physics.plants.robot_options import RobotOptions
from wlr_gym.policy import environment_for, make_policy
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Where the policies that are measured were trained.
ENVIRONMENT = "WLR-Velocity-v0"
#: s of emulated time per tick.
_TICK = 0.002


@dataclass(frozen=True, eq=False)
class ChainDrive:
    """One episode on the emulated robot, a row per control step.

    Attributes:
        time: (T,) s. command: (T, C). sensors: (T, SENSOR_LAYOUT.width). truth: (T, TRUTH_LAYOUT.width).
        start: (3,) true x, y (m) and yaw (rad) at the run's start.
        estimate: (T, W) of the observer. reasons: (T,) why there is no camera pose; empty = nothing is wrong.
        reason: why the drive ended. errors: measure -> rms over the episode, SI units. camera: statistics of the loop.
    """

    time: Array
    command: Array
    sensors: Array
    truth: Array
    start: Array
    estimate: Array
    reasons: tuple[str, ...]
    reason: str
    errors: Mapping[str, float]
    camera: Mapping[str, Any]

    def sensed(self, name: str) -> Array:
        """Return a channel of the sensors, (T,) or (T, size)."""
        return SENSOR_LAYOUT.view(self.sensors, name)

    def true_pose(self) -> Array:
        """Return the true x, y, yaw (T, 3) from the start pose; yaw unwrapped."""
        position, quaternion = self.true("position"), self.true("quaternion")
        dx, dy = (position[:, :2] - self.start[:2]).T
        cosine, sine = np.cos(self.start[2]), np.sin(self.start[2])
        yaw = np.unwrap(np.concatenate([self.start[2:], yaw_of(*quaternion.T)]))[1:] - self.start[2]
        return np.stack([cosine * dx + sine * dy, cosine * dy - sine * dx, yaw], axis=1)

    def true(self, name: str) -> Array:
        """Return a channel of the truth, (T,) or (T, size)."""
        return TRUTH_LAYOUT.view(self.truth, name)


@dataclass(frozen=True)
class ChainSetting:
    """What is driven.

    Attributes:
        policy: its source. floor: randomisation that robots and floors are drawn from.
        camera: above the floor; None = there is none.
        seconds: of an episode. faults: lines of text, as ``wlr emulate`` takes them; they count from the run's start.
        extra: further keywords of the environment.
    """

    policy: str
    floor: str
    camera: CameraFile | None = None
    seconds: float = 20.0
    faults: tuple[str, ...] = ()
    extra: Mapping[str, Any] = field(default_factory=dict)


def chain_camera(latency: float = 0.04, dropout: float = 0.1, **scene: Any) -> CameraFile:
    """Return the emulated camera with a latency (s) and a share of lost frames."""
    file = load_camera_file("emulated")
    changes = {"latency": latency, "dropout": dropout} | scene
    return file.model_copy(update={"emulated": file.emulated.model_copy(update=changes)})


def simulated_core(setting: ChainSetting, episodes: int) -> Core:
    """Return the simulated robots of a setting."""
    keywords = {"randomization": setting.floor, "episode_length": setting.seconds, **setting.extra}
    return make_core(ENVIRONMENT, episodes, environment_for(setting.policy, keywords))


def simulated_errors(setting: ChainSetting, episodes: int, first_seed: int) -> Array:
    """Return the tracking errors (episodes,) in the simulator, with its own camera."""
    core = simulated_core(setting, episodes)
    try:
        rollout = roll_out(core, make_policy(setting.policy, core.contract()), first_seed)
        limits = limits_of(core.task.config)
        rms = np.sqrt((rollout.measured**2).sum(axis=0, where=rollout.active[:, :, None]) / rollout.active.sum(axis=0)[:, None])
        errors = {which: rms[:, list(core.task.measures).index(which[0])] for which in limits}
        return tracking_error(limits, errors, rollout.fell)
    finally:
        core.close()


def chain_errors(setting: ChainSetting, episodes: int, first_seed: int) -> Array:
    """Return the tracking errors (episodes,) of the whole chain; a run that did not end well counts as a fall."""
    found = [drive_chain(setting, seed) for seed in range(first_seed, first_seed + episodes)]
    core = simulated_core(setting, 1)
    limits = limits_of(core.task.config)
    core.close()
    errors = {which: np.array([drive.errors[which[0]] for drive in found]) for which in limits}
    return tracking_error(limits, errors, np.array([drive.reason != "time is over" for drive in found]))


def drive_chain(setting: ChainSetting, seed: int, log: Path | None = None) -> ChainDrive:
    """Drive one episode on an emulated robot that is as the simulated one of this seed is drawn.

    Floors that change with time are those of the start.
    """
    drawn = simulated_core(setting, 1)
    drawn.seed(0, seed)
    drawn.begin_episodes(drawn.everyone)
    parameters = Parameters(drawn.parameters.values.copy())
    drawn.close()
    keywords = {"backend": "dynamixel", "hardware": RobotOptions(emulated=True, camera=None), "episode_length": setting.seconds}
    core = make_core(ENVIRONMENT, 1, environment_for(setting.policy, {**keywords, **setting.extra}))
    core.plant.close()
    plant = core.plant
    assert isinstance(plant, RobotPlant)
    hardware = plant.loop.hardware
    machine = Machine(core.task.robot, hardware, MachineOptions(timing=NO_TIME, tick=_TICK, seed=seed), parameters=parameters)
    camera = None
    if setting.camera is not None:
        scene = setting.camera.emulated.model_copy(update={"seed": seed})
        camera = setting.camera.model_copy(update={"emulated": scene})
    core.plant = RobotPlant(core.task.robot, 1, plant.options, RobotOptions(log=log), emulated_link(machine, camera))
    try:
        return _watched(core, machine, setting, seed)
    finally:
        core.close()


def _watched(core: Core, machine: Machine, setting: ChainSetting, seed: int) -> ChainDrive:
    """Drive a core and keep what was read, estimated and true at every control step."""
    from wlr_gym.hardware.loop import StoppedError

    assert isinstance(core.plant, RobotPlant)
    loop, policy = core.plant.loop, make_policy(setting.policy, core.contract())
    core.seed(0, seed)
    policy.reset(core.everyone)
    rows: list[tuple[Array, ...]] = []
    reasons: list[str] = []
    began = np.zeros(3)
    try:
        core.begin_episodes(core.everyone)
        start, before = machine.time, machine.plant.truth()
        began = np.array([*before.position[0, :2], yaw_of(*before.quaternion[0])])
        for fault in setting.faults:
            machine.inject(fault)
        while not (core.terminated[0] or core.truncated[0]):
            command = core.command[0].copy()
            core.step(policy.act(core.observation), core.everyone)
            estimate = np.zeros(0) if core.observer is None else core.observer.values[0].copy()
            now, truth = np.array([machine.time - start]), machine.plant.truth().values[0].copy()
            rows.append((now, command, core.sensors.values[0].copy(), truth, estimate))
            status = loop.status
            reasons.append("" if status is None or status.camera is None else status.camera.reason)
        loop.stop("time is over")
    except StoppedError:
        pass
    time, command, sensors, truth, estimate = (np.array(column) for column in zip(*rows, strict=True))
    names = core.task.commands
    return ChainDrive(
        time[:, 0], command, sensors, truth, began, estimate, tuple(reasons), loop.reason,
        _errors(truth, dict(zip(names, command.T, strict=True))), loop.statistics().get("camera", {}),
    )  # fmt: skip


def _errors(truth: Array, commands: Mapping[str, Array]) -> dict[str, float]:
    """Rms of velocity and yaw rate beyond what was commanded."""
    speed = TRUTH_LAYOUT.view(truth, "linear_velocity_in_body")[:, 0] - commands["linear_velocity_x"]
    turn = TRUTH_LAYOUT.view(truth, "angular_velocity_in_body")[:, 2] - commands["yaw_rate"]
    return {"velocity_error": float(np.sqrt(np.mean(speed**2))), "yaw_rate_error": float(np.sqrt(np.mean(turn**2)))}
