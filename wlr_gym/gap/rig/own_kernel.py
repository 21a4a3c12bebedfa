"""The state equation of a system of one's own, compiled: one run, restarted where a window begins (Runge-Kutta, order four)."""

from __future__ import annotations

import math
import re
from collections import namedtuple
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numba.core.errors import NumbaError
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.gap.rig.own import Rig

Array = NDArray[np.float64]

#: What numba colours its messages with.
COLOURS = r"\x1b\[[0-9;]*m"

_DRIVER = """
def simulate(p, t, inputs, starts, begun, step, out):
    for i in range(len(t)):
        if starts[i] >= 0:
            {begin}
        u = U({inputs})
        {read} = readings(X({states}), u, p)
        {write}
        if i + 1 == len(t):
            break
        count = max(1, int(math.ceil((t[i + 1] - t[i]) / step - 1e-9)))
        h = (t[i + 1] - t[i]) / count
        for _ in range(count):
            {rates_1} = change(X({states}), u, p)
            {rates_2} = change(X({middle_1}), u, p)
            {rates_3} = change(X({middle_2}), u, p)
            {rates_4} = change(X({end}), u, p)
            {advance}
"""


class CompiledRig:
    """A rig's equations, compiled when they are first used."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.numbers: Any = namedtuple("p", list(rig.numbers))
        self._simulate: Callable[..., None] = _compiled(rig)

    def simulate(
        self,
        values: dict[str, float],
        t: Array,
        inputs: Array,
        starts: NDArray[np.int64],
        begun: Array,
        with_states: bool = False,
    ) -> Array:
        """Return what the columns would read (rows, columns); ``with_states``: and the states, after them.

        Args:
            values: all numbers by name.
            t: (rows,) s.
            inputs: (rows, inputs).
            starts: (rows,) row of ``begun`` to begin from, or -1; the first must not be -1.
            begun: (k, states).

        Raises:
            InputError: equations that cannot be compiled, with numba's reason.
        """
        out = np.empty((len(t), len(self.rig.columns) + len(self.rig.states)))
        try:
            self._simulate(self.numbers(**values), t, inputs, starts, begun, self.rig.step, out)
        except NumbaError as error:
            reason = " ".join(re.sub(COLOURS, "", str(error)).split())
            sizes = f"change ({len(self.rig.states)} rates) or readings ({len(self.rig.columns)} columns)"
            raise InputError(f"rig '{self.rig.name}': {sizes} cannot be compiled: {reason}") from error
        return out if with_states else out[:, : len(self.rig.columns)]


def _compiled(rig: Rig) -> Callable[..., None]:
    size, read = range(len(rig.states)), range(len(rig.columns))

    def listed(text: str, numbers: range = size, between: str = ", ") -> str:
        return between.join(text.format(k=k) for k in numbers)

    source = _DRIVER.format(
        begin=listed("s{k} = begun[starts[i], {k}]", between="; "),
        inputs=listed("inputs[i, {k}]", range(len(rig.inputs))),
        states=listed("s{k}"),
        read=listed("r{k}", read) + ",",
        write="; ".join([listed("out[i, {k}] = r{k}", read, "; "), *(f"out[i, {len(read) + k}] = s{k}" for k in size)]),
        middle_1=listed("s{k} + 0.5 * h * a{k}"),
        middle_2=listed("s{k} + 0.5 * h * b{k}"),
        end=listed("s{k} + h * c{k}"),
        advance=listed("s{k} += h / 6.0 * (a{k} + 2.0 * b{k} + 2.0 * c{k} + d{k})", between="; "),
        **{f"rates_{n}": listed(f"{letter}{{k}}") + "," for n, letter in enumerate("abcd", 1)},
    )
    scope: dict[str, Any] = {
        "math": math,
        "X": namedtuple("x", list(rig.states)),
        "U": namedtuple("u", list(rig.inputs)),
        "change": njit(rig.change),
        "readings": njit(rig.readings),
    }
    exec(compile(source, f"<rig {rig.name}>", "exec"), scope)  # the driver above, and names that were checked
    simulate: Any = njit(scope["simulate"])
    return simulate
