"""Log an episode of a simulated robot as a run: the same columns that the robot's own log has, and how it was simulated."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import write_text
from wlr_gym.data.format import COMMANDS, Profile, RunMeta
from wlr_gym.data.runs import ParameterChange, Simulation, departures, start_of, write_run
from wlr_gym.data.sensors import channels, sensed_columns
from wlr_gym.learning.evaluation.rollout import roll_out
from wlr_gym.physics.effects import EFFECTS
from wlr_gym.physics.floor import floor_noted
from wlr_gym.robot import FIRST_WHEEL
from wlr_gym.robot.parameters import Parameters

if TYPE_CHECKING:
    from wlr_gym.envs.core import Core
    from wlr_gym.learning.evaluation.rollout import Rollout
    from wlr_gym.policy import Policy


class EpisodeRecorder:
    """Logs one robot of a batch, from the episode it has just begun to that episode's end.

    ```python
    env.reset(seed=3)
    recorder = EpisodeRecorder(env.unwrapped.core)
    ...
    env.step(action); recorder.note()
    ...
    recorder.save("runs/run_01.parquet")
    ```

    A batch that resets a robot within its last step (``SameStep``, Stable-Baselines3) has that step no more: it is not logged.

    Args:
        core: the batch.
        robot: which of its robots.

    Raises:
        InputError: the robot is not at the start of an episode.
    """

    def __init__(self, core: Core, robot: int = 0) -> None:
        if not core.episodes.begun[robot] or core.episodes.steps[robot] != 0:
            raise InputError(f"robot {robot} of the batch: a recorder starts right after a reset")
        self.core, self.robot = core, robot
        self._parameters = core.parameters.values[robot].copy()
        nominal = Parameters.nominal(core.task.robot).values[0]
        self._at_first = departures(self._parameters, nominal)
        self._start = start_of(core.state, robot)
        self._seed = int(core.episodes.seeds[robot])
        self._columns = sensed_columns(core.task.robot)
        self._readings = [channels(core.sensors, robot, self._columns)]
        self._goals: list[np.ndarray] = []
        self._changes: list[ParameterChange] = []

    def note(self) -> None:
        """Log the step just taken; once the episode is over nothing more is logged."""
        core, robot, row = self.core, self.robot, len(self._goals) + 1
        if core.episodes.steps[robot] != row or core.episodes.seeds[robot] != self._seed:
            return
        torque_on = True if core.actions.torque_on is None else core.actions.torque_on[robot]
        self._goals.append(np.where(torque_on, core.actions.setpoints[robot], np.nan))
        self._readings.append(channels(core.sensors, robot, self._columns))
        parameters = core.parameters.values[robot]
        if core.robots.changed[robot]:
            self._changes.append(ParameterChange(row=row, parameters=departures(parameters, self._parameters)))
            self._parameters = parameters.copy()

    def save(self, path: str | Path, notes: str | None = None) -> Path:
        """Write the run, its ``meta.yaml`` and its record; see docs/run_format.md."""
        core, rows = self.core, len(self._goals)
        period = core.task.config.control_period
        table = {"t": period * np.arange(rows)}
        table |= dict(zip(COMMANDS, np.reshape(self._goals, (rows, len(COMMANDS))).T, strict=True))
        table |= dict(zip(self._columns, np.array(self._readings[:rows]).reshape(rows, len(self._columns)).T, strict=True))
        options = core.plant.options
        simulation = Simulation(
            backend=core.settings.backend,
            control_period=period,
            physics_step=options.physics_step,
            precision=options.precision,
            sensor_noise=options.sensor_noise,
            seed=self._seed,
            parameters=self._at_first,
            changes=tuple(change for change in self._changes if change.row < rows),
            formulas=[effect.content() for effect in core.patch.effects if effect.name not in EFFECTS],
            start=self._start,
        )
        parameters = Parameters(self._parameters[None])
        velocity, acceleration = (parameters[f"servo.profile_{name}"][0] for name in ("velocity", "acceleration"))
        profile = Profile(
            leg_velocity=float(velocity[0]),
            leg_acceleration=float(acceleration[0]),
            wheel_acceleration=float(acceleration[FIRST_WHEEL]),
        )
        meta = RunMeta(profile=profile, notes=notes, floor=floor_noted(core.floor))
        return write_run(path, table, meta, simulation, core.task.robot)


def record_episodes(core: Core, policy: Policy, folder: Path, first_seed: int = 0) -> list[Path]:
    """Play one episode per robot of ``core``, seeds as in ``roll_out``, and write each as ``folder/run_<n>.parquet``."""
    recorders: list[EpisodeRecorder] = []
    roll_out(
        core,
        policy,
        first_seed,
        on_tick=lambda: [recorder.note() for recorder in recorders],
        on_start=lambda: recorders.extend(EpisodeRecorder(core, robot) for robot in range(core.count)),
    )
    digits = max(2, len(str(core.count)))
    return [recorder.save(folder / f"run_{k:0{digits}d}.parquet") for k, recorder in enumerate(recorders, 1)]


def write_samples(path: Path, rollout: Rollout) -> None:
    """Write what randomisation drew as CSV: one row per episode, its seed first."""
    lines = [",".join(["seed", *(f'"{name}"' for name in rollout.sampled)])]
    rows = zip(rollout.seeds.tolist(), rollout.samples.tolist(), strict=True)
    lines += [",".join(map(repr, [seed, *values])) for seed, values in rows]
    write_text(path, "\n".join(lines) + "\n")
