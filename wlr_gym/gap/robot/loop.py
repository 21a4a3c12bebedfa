"""Replay a batch from one event to the next: setpoints arrive, robots move, readings are taken, tick by tick.

On the engine all of it is one compiled loop that other threads run beside: from Python a tick of 25 robots takes longer
around the engine than in it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from numba import typeof, types
from numpy.typing import NDArray

from wlr_gym.base.compiled import compiled
from wlr_gym.gap.robot.clock import CLOCK
from wlr_gym.gap.robot.recorder import Recorder, Tape, take
from wlr_gym.gap.robot.schedule import Schedule, arrive
from wlr_gym.physics.plants.base import Plant, Sensors
from wlr_gym.physics.plants.gibbs_appell.plant import CompiledTick, GibbsAppellPlant
from wlr_gym.physics.plants.sensors import measure_rows

#: First tick, last tick, which motors are on.
Follow: TypeAlias = Callable[[int, int, NDArray[np.bool_] | None], None]


def follower(plant: Plant, schedule: Schedule, recorder: Recorder, readings: Sensors) -> Follow:
    """Return what moves a batch from a tick to another and records what is read before each.

    Args:
        plant: the robots; its setpoints are those of ``schedule``.
        schedule: the setpoints.
        recorder: what takes the readings.
        readings: of the plant, which it overwrites.

    Returns:
        Function of first and last tick, and (robots, 8) which motors are on; None = all.
    """
    if not isinstance(plant, GibbsAppellPlant):
        idle = np.zeros((plant.count, 8))

        def step(first: int, last: int, torque_on: NDArray[np.bool_] | None) -> None:
            for tick in range(first, last):
                recorder.see(tick, readings, plant.truth())
                plant.step(idle, torque_on)

        return step
    loop = _loop(*plant.compiled_tick(), schedule, recorder.tape)

    def go(first: int, last: int, torque_on: NDArray[np.bool_] | None) -> None:
        function, batch = plant.compiled_tick()  # fewer robots, where runs are over
        batch.torque_on[...] = 1.0 if torque_on is None else torque_on
        loop(function, batch, schedule, recorder.tape, first, last)

    return go


def _loop(function: Any, batch: CompiledTick, schedule: Schedule, tape: Tape) -> Any:
    """The compiled loop, and the engine's function compiled for its arguments."""
    moved = (batch.lanes, batch.constants, schedule.newer, schedule.older, schedule.wait, batch.torque_on)
    moved = (*moved, batch.formula_values, batch.memory, batch.truth, batch.raw, 0, batch.tiles, batch.robots, batch.step)
    signature = types.void(*(typeof(argument) for argument in (*moved, batch.substeps, batch.sweeps)))
    function.compile(signature.args)
    return _compiled(signature, typeof(batch), typeof(schedule), typeof(tape))


@cache
def _compiled(signature: Any, batch: Any, schedule: Any, tape: Any) -> Any:
    """The loop for arguments of these types: one for all engine functions, which are called by their address.

    numba keeps it with the sensor model compiled in (``measure_rows``), and looks at this file only to tell whether it is old.
    """
    arguments = (types.FunctionType(signature), batch, schedule, tape, types.int64, types.int64)
    return compiled(_ticks, types.void(*arguments))


def _ticks(function: Any, batch: Any, schedule: Any, tape: Any, first: int, last: int) -> None:
    moved = min(batch.tiles * batch.width, batch.robots)
    for tick in range(first, last):
        take(tick, batch.readings, batch.truth, tape)
        arrive(tick * CLOCK, schedule)
        if batch.has_formulas:
            for i in range(batch.robots):
                batch.memory[i // batch.width, 0, i % batch.width] = batch.time[i]
        function(
            batch.lanes,
            batch.constants,
            schedule.newer,
            schedule.older,
            schedule.wait,
            batch.torque_on,
            batch.formula_values,
            batch.memory,
            batch.truth,
            batch.raw,
            0,
            batch.tiles,
            batch.robots,
            batch.step,
            batch.substeps,
            batch.sweeps,
        )
        measure_rows(batch.raw, batch.seeds, batch.ticks, batch.settings, batch.states, batch.readings, 0, moved)
        for i in range(batch.robots):
            batch.time[i] += batch.period
