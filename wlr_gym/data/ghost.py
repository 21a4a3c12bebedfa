"""A run replayed row by row, as fast as it comes: what a page shows beside the measured robot."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.read import Run
from wlr_gym.data.replay import CLOCK, camera_frame, readings, tick_setpoints
from wlr_gym.data.run_states import measured_state, start_state
from wlr_gym.physics.effects import Patch
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, Truth
from wlr_gym.robot import WHEEL_SLICE, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: s around an anchor whose samples are looked at.
_AROUND = 1.0


def replayed_rows(
    run: Run, robot: Robot, parameters: Parameters, backend: str, patch: Patch | None, segment: float
) -> Iterator[tuple[Parameters, Truth, Array]]:
    """Yield parameters (1), truth (1) and the channels :data:`wlr_gym.data.format.CHANNELS` of a replay at each row of the run.

    As in :func:`wlr_gym.data.replay.replay` the plant ticks on a clock of its own, and each row's setpoint acts from that row's
    time on; every ``segment`` s the plant starts anew from the measured state, at once and not as one batch.

    Args:
        run: the run.
        robot, parameters: (1) that it is replayed with, see :func:`wlr_gym.data.replay.prepare`.
        backend: a simulator.
        patch: formulas that act in the plant; None = none.
        segment: s; inf = only the beginning is measured.
    """
    t, offset = run["t"], np.asarray(run.meta.marker_offset)
    ticks = np.rint((t - t[0]) / CLOCK).astype(int)
    setpoints, torque_on = tick_setpoints(run, parameters, t[:1], int(ticks[-1]), CLOCK)
    undelayed = parameters.copy()
    undelayed["command.delay"] = 0.0  # the setpoints come delayed
    plant = make_plant(backend, robot, 1, PlantOptions(control_period=CLOCK, sensor_noise=False), patch.forces if patch else ())
    state, begin = start_state(run, robot, parameters), 0
    try:
        sensors = plant.reset(parameters=undelayed, state=replace(state, time=np.zeros(1)))
        shift = state.joint_position[:, WHEEL_SLICE] - sensors.joint_position[:, WHEEL_SLICE]
        for row in range(len(t)):
            for tick in range(ticks[row - 1] if row else 0, ticks[row]):
                sensors = plant.step(setpoints[tick], torque_on[tick])
            if t[row] - t[begin] >= segment:
                begin = row
                state = measured_state(_near(run, row), t[row : row + 1], plant.mechanical_state(), parameters)
                sensors = plant.reset(parameters=undelayed, state=replace(state, time=t[row : row + 1] - t[0]))
                shift = state.joint_position[:, WHEEL_SLICE] - sensors.joint_position[:, WHEEL_SLICE]
            truth = plant.truth()
            channels = readings(sensors, truth, shift, offset)[None]
            camera_frame(channels, parameters)
            yield parameters, truth, channels[0, 0]
    finally:
        plant.close()


def _near(run: Run, row: int) -> Run:
    t = run["t"]
    first, last = np.searchsorted(t, [t[row] - _AROUND, t[row] + _AROUND])
    return replace(run, table=run.table.iloc[int(first) : int(last)])
