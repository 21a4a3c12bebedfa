"""Values of the parameter table for a batch of robots: randomisation and effects write them, the gap workflow fits them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.robot.description import Robot
from wlr_gym.robot.parameter_table import ELEMENTS, SPECS, TABLE, range_in_words, spec_of, unknown_parameter

Array = NDArray[np.float64]

_COLUMN = {element: column for column, element in enumerate(ELEMENTS)}
_SLICES = {spec.name: slice(_COLUMN[spec.elements[0]], _COLUMN[spec.elements[-1]] + 1) for spec in TABLE}
#: Bounds of every element, in the order of the table.
LOW = np.array([spec.low for spec in TABLE for _ in spec.elements])
HIGH = np.array([spec.high for spec in TABLE for _ in spec.elements])


class Parameters:
    """Physical parameters of a batch of robots: matrix ``values`` of shape (N, len(ELEMENTS)), float64.

    ``parameters["wheel.radius"]`` is a writable view: shape (N,) for a scalar, (N, size) otherwise;
    ``parameters["wheel.radius[wheel_lf]"]`` is a writable view of shape (N,).
    """

    def __init__(self, values: Array) -> None:
        self.values: NDArray[np.float64] = np.ascontiguousarray(values, dtype=np.float64)
        if self.values.ndim != 2 or self.values.shape[1] != len(ELEMENTS):
            raise InputError(f"parameter matrix has shape {self.values.shape}, expected (N, {len(ELEMENTS)})")

    @classmethod
    def nominal(cls, robot: Robot, count: int = 1) -> Parameters:
        """Return the nominal parameters of ``robot`` for ``count`` robots."""
        row = np.array([value for spec in TABLE for value in spec.nominal(robot)], dtype=np.float64)
        return cls(np.tile(row, (count, 1)))

    def __len__(self) -> int:
        return self.values.shape[0]

    def __getitem__(self, name: str) -> Array:
        if name in _SLICES:
            view = self.values[:, _SLICES[name]]
            return view[:, 0] if not SPECS[name].labels else view
        if name in _COLUMN:
            return self.values[:, _COLUMN[name]]
        raise unknown_parameter(name)

    def __setitem__(self, name: str, value: ArrayLike) -> None:
        target = self[name]
        try:
            target[...] = value
        except (TypeError, ValueError) as error:
            raise InputError(f"parameter '{name}' takes numbers of shape {target.shape}: {error}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(SPECS)

    def copy(self) -> Parameters:
        """Return an independent copy."""
        return Parameters(self.values.copy())

    def validate(self) -> None:
        """Raise :class:`InputError` naming the first element that is not finite or outside its bounds."""
        bad = ~((self.values >= LOW) & (self.values <= HIGH))
        if not bad.any():
            self._validate_payload()
            return
        row, column = np.argwhere(bad)[0]
        raise InputError(
            f"parameter {ELEMENTS[column]} = {self.values[row, column]:g} (robot {row} of the batch) is outside "
            f"{range_in_words(float(LOW[column]), float(HIGH[column]), spec_of(ELEMENTS[column]).unit)}"
        )

    def _validate_payload(self) -> None:
        """Refuse an inertia that no masses have."""
        inertia = self["payload.inertia"]
        if not inertia.any():
            return
        xx, yy, zz, xy, xz, yz = inertia.T
        moments = np.linalg.eigvalsh(np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3))
        excess = 2.0 * moments.max(axis=1) - moments.sum(axis=1)
        wrong = np.maximum(excess, -moments.min(axis=1)) > 1e-9 * np.abs(moments).max(axis=1)
        if wrong.any():
            robot = int(np.argmax(wrong))
            raise InputError(
                f"parameter payload.inertia (robot {robot} of the batch) has principal moments {moments[robot].tolist()} "
                "kg m2: no masses have them (none may be negative, none above the sum of the other two)"
            )
