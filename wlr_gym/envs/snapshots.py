"""Snapshots of environments: what a batch of robots must have alike to take one, and where its state lives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.snapshot import RowStore, Snapshot, check_fit, read_rows, take_snapshot, write_snapshot
from wlr_gym.envs.core import Core

#: Names of the plant's arrays in a snapshot begin with this.
PLANT = "plant/"


class Snapshots:
    """Takes snapshots of the robots of a core, and sets robots back.

    Args:
        core: of the environment.

    Raises:
        InputError: a plant whose state cannot be set.
    """

    def __init__(self, core: Core) -> None:
        if not core.plant.capabilities.can_set_state:
            raise InputError(f"backend '{core.settings.backend}': its robots cannot be saved and set back; simulators can")
        self._core = core
        self._fits = {
            "task": core.task.config.model_dump(mode="json"),
            "randomization": core.randomization.config.model_dump(mode="json"),
            "effects": core.patch.content(),
            "free_wheels": core.settings.free_wheels,
            "observation": core.settings.observation,
        }
        parts = (core.episodes, core.robots, core.actions, core.commands, core.pipeline, core.observer)
        self._stores: dict[str, RowStore] = {
            "start": core.start,
            "end_time": core.end_time,
            "computed": core.computed,
            "presence": core.presence,
        }
        self._stores |= {f"score_{name}": values for name, values in core.scores._asdict().items()}
        self._stores |= {name: store for part in parts if part is not None for name, store in part.stores().items()}

    def take(self, rows: int | Sequence[int] | NDArray[Any] | None) -> Snapshot:
        """Return the snapshot of some robots; see :meth:`wlr_gym.envs.methods.TaskMethods.get_state`."""
        index = read_rows(rows, self._core.count)
        self._core.episodes.require_begun("get_state()", index)
        plant = self._core.plant.get_state(index)
        own = take_snapshot(self._stores, index, self._fits)
        arrays = {PLANT + name: values for name, values in plant.arrays.items()}
        return Snapshot({**plant.fits, **own.fits}, {**own.arrays, **arrays})

    def put(self, snapshot: Snapshot, rows: int | Sequence[int] | NDArray[Any] | None) -> None:
        """Put robots into the state of a snapshot; see :meth:`wlr_gym.envs.methods.TaskMethods.set_state`."""
        core = self._core
        index = read_rows(rows, core.count)
        check_fit(snapshot, index, self._fits, self._stores)
        arrays = {name.removeprefix(PLANT): values for name, values in snapshot.arrays.items() if name.startswith(PLANT)}
        core.sensors = core.plant.set_state(Snapshot(snapshot.fits, arrays), index)
        write_snapshot(snapshot, self._stores, index)
        core.episodes.note_begun(np.isin(np.arange(core.count), index))
