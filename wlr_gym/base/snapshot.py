"""Snapshots: everything that decides what a batch of robots does next, as plain arrays with one row per robot."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError

Rows = NDArray[np.intp]


class RowStore(Protocol):
    """Where the state of N robots lives: an array (N, ...), or a view that is indexed like one by the numbers of robots."""

    def __getitem__(self, rows: Rows, /) -> NDArray[Any]:
        """Return a copy (M, ...) of some robots' rows."""
        ...

    def __setitem__(self, rows: Rows, values: NDArray[Any], /) -> None:
        """Write the rows (M, ...) of some robots, or one row (1, ...) to all of them."""
        ...


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The whole state of M robots at one moment: physics, sensors, filters, noise, delays, commands, randomisation, episode.

    What is inside is no public format: take it from ``get_state()``, hand it to ``set_state()``. It can be pickled. It is
    independent of the environment that it came from.

    Attributes:
        fits: what an environment must be like to take it: {setting: value}.
        arrays: the state, {name: (M, ...)}.
    """

    fits: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]

    def __len__(self) -> int:
        return len(next(iter(self.arrays.values())))

    def __repr__(self) -> str:
        return f"Snapshot({len(self)} robots, {self.nbytes / 1000:.0f} kB)"

    def __iter__(self) -> Iterator[Snapshot]:
        return (self[row] for row in range(len(self)))

    def __getitem__(self, rows: int | slice | Sequence[int] | NDArray[Any]) -> Snapshot:
        """Return the snapshot of one or some of its robots, in this order; a number may come more than once."""
        count = len(self)
        if isinstance(rows, slice):
            rows = range(*rows.indices(count))
        elif isinstance(rows, int) and -count <= rows < 0:
            rows += count
        index = _numbers(rows, count)
        return Snapshot(self.fits, {name: values[index] for name, values in self.arrays.items()})

    @property
    def nbytes(self) -> int:
        """Size of the state, bytes."""
        return sum(values.nbytes for values in self.arrays.values())


def take_snapshot(stores: Mapping[str, RowStore], rows: Rows, fits: Mapping[str, Any]) -> Snapshot:
    """Return the snapshot of the robots ``rows``."""
    return Snapshot(fits, {name: store[rows] for name, store in stores.items()})


def check_fit(snapshot: Snapshot, rows: Rows, fits: Mapping[str, Any], names: Iterable[str]) -> None:
    """Refuse a snapshot that robots ``rows`` of an environment with these settings cannot take."""
    if not isinstance(snapshot, Snapshot):
        raise InputError(f"set_state({type(snapshot).__name__}): expected what get_state() returned")
    for name, value in fits.items():
        if snapshot.fits.get(name) != value:
            place, theirs, ours = _first_difference(name, snapshot.fits.get(name), value)
            raise InputError(f"the snapshot is of another environment: its {place} is {theirs!r}, here {ours!r}")
    if missing := sorted(set(names) - set(snapshot.arrays)):
        raise InputError(
            f"the snapshot has no '{missing[0]}': it was not taken of such a thing (plants take those of plants, "
            "environments those of environments), or by another version of wlr_gym"
        )
    if len(snapshot) not in (1, rows.size):
        raise InputError(f"a snapshot of {len(snapshot)} robots for {rows.size}: expected one, or one for each")


def write_snapshot(snapshot: Snapshot, stores: Mapping[str, RowStore], rows: Rows) -> None:
    """Put robots ``rows`` into the state of a snapshot that fits them; a snapshot of one robot is the state of all of them."""
    for name, store in stores.items():
        store[rows] = snapshot.arrays[name]


def read_rows(rows: int | Sequence[int] | NDArray[Any] | None, count: int) -> Rows:
    """Return which of ``count`` robots are meant: their numbers, a mask, or None for all.

    Raises:
        InputError: neither numbers of robots, each once, nor a mask of all of them.
    """
    if rows is None:
        return np.arange(count)
    index = _numbers(rows, count)
    if np.unique(index).size != index.size:
        raise InputError(f"rows = {rows!r}: a robot is named twice")
    return index


def _numbers(rows: int | Sequence[int] | NDArray[Any], count: int) -> Rows:
    given = np.atleast_1d(np.asarray(rows))
    if given.dtype == np.bool_ and given.shape == (count,):
        if not given.any():
            raise InputError("rows: the mask names no robot")
        return np.flatnonzero(given)
    if given.ndim != 1 or given.dtype.kind not in "iu" or given.size == 0 or not ((given >= 0) & (given < count)).all():
        raise InputError(f"rows = {rows!r}: expected numbers from 0 to {count - 1}, or a mask of {count} booleans")
    return given.astype(np.intp)


def _first_difference(place: str, theirs: Any, ours: Any) -> tuple[str, Any, Any]:
    if isinstance(theirs, Mapping) and isinstance(ours, Mapping):
        for key in dict.fromkeys([*theirs, *ours]):
            if theirs.get(key) != ours.get(key):
                return _first_difference(f"{place}.{key}", theirs.get(key), ours.get(key))
    return place, theirs, ours
