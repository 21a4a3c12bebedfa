"""The calibration of the robot, ours and that of ``mujoco.sysid``, on the same runs, numbers, channels, noise and bounds.

The runs are of neither side's simulation: the MuJoCo plant, with the true servo law, which the peer's actuators approximate,
and with MuJoCo's contacts, which our engine does not have, at half the step that both fit with. Free are numbers that a MuJoCo
model has and the runs show. Each side simulates whole runs from the rest the robot begins in; the residuals are one function
for both.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
import pandas
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from studies.bench.mujoco_loop import build_servo_model
from studies.bench.sysid_contest import Contest, PeerProblem, PeerRun, contest_between
from wlr_gym.base.random import generator
from wlr_gym.data.format import CHANNELS, COMMANDS, RunMeta
from wlr_gym.data.run_states import start_state
from wlr_gym.data.runs import Run
from wlr_gym.data.sensors import SENSED, channels
from wlr_gym.gap.problem import Setting
from wlr_gym.gap.robot.problem import RobotProblem
from wlr_gym.gap.robot.windows import LEAD, anchored_residuals
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, standing_state
from wlr_gym.robot import JOINTS, WHEEL_SLICE, WHEELS, load_robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Beginnings of the names of the numbers that are fitted.
FREE = ("body.mass", "body.com_offset", "wheel.radius", "servo.armature", "servo.coulomb_friction")
#: Channels that are compared.
COMPARED = tuple(name for name in CHANNELS if name.startswith(("pos_", "vel_")) or name in ("cam_x", "cam_y", "cam_yaw"))
RUNS = 2
#: s between two rows of a run.
PERIOD = 0.02
#: s, step that both sides fit with.
STEP = 0.001
#: s that the robot stands before a run begins.
REST = 0.5
#: MuJoCo orders joints along the tree: leg, wheel, leg, wheel, ...
_JOINTS = np.array([0, 2, 4, 6, 1, 3, 5, 7])


class FewNumbers(RobotProblem):
    """The robot's problem with the numbers and channels that both sides have, and one window: the whole run."""

    def __init__(self, runs: Sequence[Run]) -> None:
        super().__init__(runs, window=math.inf)
        self._knobs = tuple(knob for knob in self._knobs if knob.quantity.name.startswith(FREE))
        self.quantities = tuple(knob.quantity for knob in self._knobs)
        self.noise = self._noise
        for measured in self._measured:
            measured[:, [CHANNELS.index(name) for name in CHANNELS if name not in COMPARED]] = np.nan

    def table(self, values: Array) -> Parameters:
        """Return the parameters (1 robot) with these numbers."""
        return self.parameters([Setting(values)])


def robot_contest(seconds: float) -> Contest:
    """Return the contest over runs of this length (s)."""
    problem, truth = make_robot(seconds)
    return contest_between(f"robot, {RUNS} runs of {seconds:g} s", problem, truth, peer_of(problem))


def make_robot(seconds: float) -> tuple[FewNumbers, Array]:
    """Return the problem of runs of this length (s), and the numbers behind them."""
    rng = generator(0, "bench", "sysid robot")
    still = FewNumbers([_recorded(Parameters.nominal(load_robot()), 1.0, 0, rng)])
    truth = np.array([q.nominal + q.sigma * rng.uniform(-1.0, 1.0) for q in still.quantities])
    return FewNumbers([_recorded(still.table(truth), seconds, k, rng) for k in range(RUNS)]), truth


def _recorded(parameters: Parameters, seconds: float, run: int, rng: np.random.Generator) -> Run:
    robot, rows = load_robot(), round(seconds / PERIOD) + 1
    setpoints = _goals(PERIOD * np.arange(rows, dtype=np.float64), robot.home.leg_angle, rng)
    with closing(make_plant("mujoco", robot, 1, PlantOptions(PERIOD, 0.5 * STEP))) as plant:
        readings = plant.reset(np.array([run], np.uint64), parameters, state=standing_state(robot, parameters))
        for _ in range(round(REST / PERIOD)):
            readings = plant.step(setpoints[:1])
        table = np.empty((rows, len(SENSED)))
        for row, goal in enumerate(setpoints):
            table[row] = channels(readings, 0)
            readings = plant.step(goal[None])
    table[:, WHEEL_SLICE] -= table[0, WHEEL_SLICE]
    frame = pandas.DataFrame(np.hstack([setpoints, table]), columns=[*COMMANDS, *SENSED])
    frame.insert(0, "t", PERIOD * np.arange(rows))
    return Run(frame, RunMeta(), Path(f"run_{run}.parquet"))


def _goals(t: Array, home: float, rng: np.random.Generator) -> Array:
    """Smooth setpoints (rows, 8) that begin at rest: legs one by one, both sides' wheels."""
    begin = np.clip(t - 0.3, 0.0, 1.0)
    waves = [_wave(t, rng) for _ in range(6)]
    legs = [home + 0.25 * begin * wave for wave in waves[:4]]
    left, right = (4.0 * begin * wave for wave in waves[4:])
    return np.stack([*legs, *(left if "_l" in joint else right for joint in WHEELS)], axis=1)


def _wave(t: Array, rng: np.random.Generator) -> Array:
    frequency, phase = rng.uniform(0.2, 1.5, 3), rng.random(3)
    return np.sin(2 * np.pi * (np.outer(t, frequency) + phase)).sum(axis=1) / 3.0


# ---- the peer --------------------------------------------------------------------------------------------------------


def peer_of(problem: FewNumbers) -> PeerProblem:
    """Return the same problem for ``mujoco.sysid``."""

    @lru_cache(maxsize=2 * len(problem.quantities))
    def compiled(numbers: bytes) -> mujoco.MjModel:
        model = build_servo_model(problem.robot, problem.table(np.frombuffer(numbers)), STEP, "matched")
        model.dof_solref[:] = 2.0 * STEP, 1.0  # as stiff as the step allows: MuJoCo's gear friction creeps
        return model

    def build(values: Array) -> mujoco.MjModel:
        return compiled(values.tobytes())  # the runs share a model

    return PeerProblem(problem.quantities, [_peer_run(problem, run, build) for run in range(RUNS)])


def _peer_run(problem: FewNumbers, run: int, build: Callable[[Array], mujoco.MjModel]) -> PeerRun:
    nominal = problem.table(np.array([quantity.nominal for quantity in problem.quantities]))
    t, measured = problem.times(run), problem.measured(run)
    lead = round(LEAD / STEP)
    steps = lead + round(t[-1] / STEP)
    arrival = lead + np.rint((t + nominal["command.delay"][0].max()) / STEP)
    row = np.maximum(np.searchsorted(arrival, np.arange(steps + 1), side="right") - 1, 0)
    setpoints = problem.clocks[run].setpoints[row]
    model = build(np.array([quantity.nominal for quantity in problem.quantities]))
    rows = lead - 1 + np.rint(t / STEP).astype(int)  # states are those after each step
    shown = rows - round(nominal["camera.delay"][0] / STEP)
    window = [slice(0, len(t))]

    def residual(values: Array, state: Array) -> Array:
        found = anchored_residuals(t, measured, _channels(state, rows, shown, model)[None], problem.noise, window)[0]
        return np.nan_to_num(found)

    control = np.hstack([setpoints, setpoints[:, WHEEL_SLICE]])
    return PeerRun(
        model, build, STEP * np.arange(steps + 1), control, _start(problem.clocks[run].run, problem, nominal, model), residual
    )


def _start(run: Run, problem: FewNumbers, nominal: Parameters, model: mujoco.MjModel) -> Array:
    """Full physics state (time, positions, rates, references) where our replays begin too, the wheels' tension as measured."""
    begin, data = start_state(run, problem.robot, nominal), mujoco.MjData(model)
    data.qpos[:3], data.qpos[3:7] = begin.position[0], begin.quaternion[0]
    data.qpos[7:][_JOINTS] = begin.joint_position[0]
    data.act[:] = begin.reference_position[0, WHEEL_SLICE]
    return np.concatenate([[0.0], data.qpos, data.qvel, data.act])


def _channels(state: Array, rows: NDArray[np.intp], shown: NDArray[np.intp], model: mujoco.MjModel) -> Array:
    """Return what the sensors read (rows, len(CHANNELS)); NaN where it is not compared."""
    pose, rate = state[:, 1 : 1 + model.nq], state[:, 1 + model.nq :]
    found = np.full((len(rows), len(CHANNELS)), np.nan)
    at = {name: k for k, name in enumerate(CHANNELS)}
    found[:, [at[f"pos_{joint}"] for joint in JOINTS]] = pose[rows][:, 7:][:, _JOINTS]
    found[:, [at[f"vel_{joint}"] for joint in JOINTS]] = rate[rows][:, 6 : model.nv][:, _JOINTS]
    found[:, at["cam_x"]], found[:, at["cam_y"]] = pose[shown, 0], pose[shown, 1]
    found[:, at["cam_yaw"]] = Rotation.from_quat(pose[shown, 3:7], scalar_first=True).as_euler("ZYX")[:, 0]
    return found
