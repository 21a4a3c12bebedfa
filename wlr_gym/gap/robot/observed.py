"""What a search for effects reads off the measured runs: where the floor was reached, and which waves the joints show."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.format import CHANNELS
from wlr_gym.physics.effects.effect import Observed
from wlr_gym.robot import JOINTS
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Periods per turn at which a wave is looked for.
ORDERS = range(1, 65)
#: Periods that a joint must go through before a wave can be told from a bend.
PERIODS = 1.5
#: Fewer rows show no wave.
LEAST_ROWS = 20


def observe(
    parameters: Parameters, measured: Sequence[Array], simulated: Sequence[Array], residuals: Sequence[Array]
) -> Observed:
    """Return what a search may read off a model and its runs.

    Args:
        parameters: (1) of the model.
        measured: (rows, signals) per run.
        simulated: the same by the model.
        residuals: of the model, (rows, signals) per run.
    """
    orders = {joint: order for joint in JOINTS if (order := wave_order(joint, measured, residuals)) is not None}
    return Observed(parameters, orders, _travel(simulated))


def _travel(simulated: Sequence[Array]) -> tuple[float, float]:
    """Where the robot has been: by the model, since not all runs have a camera."""
    x = np.concatenate([values[:, CHANNELS.index("cam_x")] for values in simulated])
    reached = x[np.isfinite(x)]  # a simulation may break down
    return (float(reached.min()), float(reached.max())) if reached.size else (0.0, 0.0)


def wave_order(joint: str, measured: Sequence[Array], residuals: Sequence[Array]) -> float | None:
    """Return the number of periods per turn that explains most of a joint's residuals of speed and effort.

    Only of those of which the joint has gone through :data:`PERIODS` in some run: part of a wave is any bend. None where it has
    hardly moved.
    """
    angle = CHANNELS.index(f"pos_{joint}")
    covered = max(
        (float(np.ptp(seen[known, angle])) for seen in measured if (known := np.isfinite(seen[:, angle])).any()), default=0
    )
    least = 2.0 * math.pi * PERIODS / max(covered, 1e-9)
    orders = [order for order in ORDERS if order >= least]
    if not orders:
        return None
    power = np.zeros(len(orders))
    for name in (f"vel_{joint}", f"eff_{joint}"):
        column = CHANNELS.index(name)
        for seen, residual in zip(measured, residuals, strict=True):
            known = np.isfinite(residual[:, column]) & np.isfinite(seen[:, angle])
            if known.sum() < LEAST_ROWS:
                continue
            waves = np.exp(1j * np.outer(orders, seen[known, angle]))
            waves -= waves.mean(axis=1, keepdims=True)
            left = residual[known, column] - residual[known, column].mean()
            power += np.abs(waves @ left) ** 2 / np.maximum((np.abs(waves) ** 2).sum(axis=1), 1e-9)
    return float(orders[int(np.argmax(power))])
