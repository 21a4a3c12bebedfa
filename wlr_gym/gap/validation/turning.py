"""Residuals that are periodic in the angle of a joint that turns without end.

A wheel of the model is round and its encoder centred: but for a ripple of its torque, nothing depends on its angle. A residual
that does after calibration is a missing effect (a wheel out of round, an encoder off its centre, a bent axle); its law is not
identified.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.analysis import Turning
from wlr_gym.gap.problem import Problem

Array = NDArray[np.float64]

#: Periods per turn that are tried.
ORDERS = (1, 2, 3)
#: How far beside them a dependence on the place on the floor, which a wheel's angle follows too, would be seen.
BESIDE = 0.4
#: Parts of a run, each predicted from the others.
PARTS = 4
#: Turns that a joint must make in a run.
LEAST_TURNS = 2.5
#: Rows of such a run.
LEAST_ROWS = 100
#: Runs in which it does.
LEAST_RUNS = 3
#: Bootstrap samples of the runs.
SAMPLES = 500
#: Selection frequency: share of them that must show it.
LEAST_CONFIDENCE = 0.9
#: Share of a signal's squared residual that must be periodic in the angle.
LEAST_SHARE = 0.1


def turning(problem: Problem, residuals: Sequence[Array], features: Sequence[Mapping[str, Array]]) -> Turning | None:
    """Return the signal whose residual is most periodic in its joint's angle, or None.

    Args:
        problem: the system.
        residuals: of the final model, one (rows, signals) per run.
        features: simulated angles among them, one mapping of (rows,) per run.
    """
    names = [signal.name for signal in problem.signals]
    found = [
        _best_order(joint, signal, [r[:, names.index(signal)] for r in residuals], [f[angle] for f in features])
        for joint, (angle, signals) in problem.turning.items()
        for signal in signals
        if signal in names
    ]
    clear = [one for one in found if one is not None and one.share > LEAST_SHARE and one.confidence > LEAST_CONFIDENCE]
    return max(clear, key=lambda one: one.share, default=None)


def _best_order(joint: str, signal: str, residuals: Sequence[Array], angles: Sequence[Array]) -> Turning | None:
    runs = []
    for residual, angle in zip(residuals, angles, strict=True):
        known = np.isfinite(residual) & np.isfinite(angle)
        if known.sum() >= LEAST_ROWS and np.ptp(angle[known]) >= 2.0 * np.pi * LEAST_TURNS:
            runs.append((residual[known] - residual[known].mean(), angle[known]))
    if len(runs) < LEAST_RUNS:
        return None
    best, falls = max(((order, _falls(runs, order)) for order in ORDERS), key=lambda pair: _share(pair[1]))
    picks = np.random.default_rng(0).integers(0, len(runs), (SAMPLES, len(runs)))
    frequency = float(np.mean([_share(falls[:, pick]) > LEAST_SHARE for pick in picks]))
    amplitudes = [np.hypot(*_wave(residual, _waves(angle, best))) for residual, angle in runs]
    return Turning(joint, signal, best, _share(falls), float(np.sqrt(np.mean(np.square(amplitudes)))), frequency)


def _falls(runs: Sequence[tuple[Array, Array]], order: int) -> Array:
    """Squared residuals (5, runs): how far they fall with this order, with those beside it, with a wave in time, and all."""
    falls = [[_predicted(*run, other) for run in runs] for other in (order, order - BESIDE, order + BESIDE)]
    in_time = [_predicted(residual, _steady(angle), order) for residual, angle in runs]
    return np.array([*falls, in_time, [float(residual @ residual) for residual, _ in runs]])


def _steady(angle: Array) -> Array:
    """The same turning at one speed: a clock's."""
    rows = np.arange(len(angle))
    return np.asarray(np.polyval(np.polyfit(rows, angle, 1), rows), np.float64)


def _share(falls: Array) -> float:
    """Share that is periodic in the angle, less what orders that no turning part has, or time, predict as well."""
    here, *beside, total = falls.sum(axis=1)
    return float((here - max(*beside, 0.0)) / total) if total > 0.0 else 0.0


def _predicted(residual: Array, angle: Array, order: float) -> float:
    """How far the squared residuals of a run fall by a wave over the angle, each part's from the run's other parts."""
    waves, fall = _waves(angle, order), 0.0
    for part in np.array_split(np.arange(len(residual)), PARTS):
        rest = np.ones(len(residual), bool)
        rest[part] = False
        left = residual[part] - waves[part] @ _wave(residual[rest], waves[rest])
        fall += float(residual[part] @ residual[part] - left @ left)
    return fall


def _waves(angle: Array, order: float) -> Array:
    waves = np.stack([np.sin(order * angle), np.cos(order * angle)], axis=1)
    return waves - waves.mean(axis=0)


def _wave(residual: Array, waves: Array) -> Array:
    """Least-squares amplitudes (2) of sine and cosine."""
    return np.asarray(np.linalg.lstsq(waves, residual, rcond=None)[0], np.float64)
