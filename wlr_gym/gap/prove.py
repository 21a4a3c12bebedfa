"""Proof on runs that took no part: how far are replays from measurements, before and after?

All numbers are root mean square residuals in units of sensor noise, over the channels of a run. A perfect model does not reach
1.0: every window of a replay starts from measured, hence noisy, values. What it does reach is found by replaying data that the
fitted model itself made, with the same sensors (:func:`noise_floor`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.analysis import ChannelGap, GapFigures, RunGap
from wlr_gym.gap.fit import Model
from wlr_gym.gap.problem import Problem

Array = NDArray[np.float64]

#: Bootstrap samples of the held-out runs.
SAMPLES = 2000


def mean_squares(residuals: Sequence[Array], cap: float) -> Array:
    """Return the mean square (runs, channels) of residuals, one (rows, channels) array per run; NaN where not measured.

    Residuals beyond ``cap`` count as that: one lost wheel must not hide all else.
    """
    with np.errstate(invalid="ignore"):
        squares = [np.nansum(np.minimum(r * r, cap**2), axis=0) / np.isfinite(r).sum(axis=0) for r in residuals]
    return np.stack(squares)


def mean_of_runs(squares: Array) -> Array:
    """Return the mean over runs (channels) of mean squares; NaN where no run measured a channel."""
    measured = np.isfinite(squares).sum(axis=0)
    return np.where(measured > 0, np.nansum(squares, axis=0) / np.maximum(measured, 1), np.nan)


def level(squares: Array) -> float:
    """Return the root mean over channels (and runs) of mean squares."""
    return float(np.sqrt(np.nanmean(squares)))


def prove(
    problem: Problem, fitted: Sequence[int], heldout: Sequence[int], models: Sequence[Model], floor: float
) -> tuple[GapFigures, tuple[RunGap, ...], tuple[ChannelGap, ...]]:
    """Compare three models on fitted and held-out runs.

    Args:
        problem: the system.
        fitted, heldout: runs.
        models: as its file says; calibrated; with the effects.
        floor: level that a perfect model reaches.
    """
    settings = [model.setting for model in models]
    found = problem.residuals(settings, [*fitted, *heldout])
    squares = [mean_squares([r[k] for r in found], problem.cap) for k in range(3)]
    inside, outside = slice(0, len(fitted)), slice(len(fitted), None)
    before, calibrated, after = (level(s[outside]) for s in squares)
    figures = GapFigures(
        problem.metric,
        level(squares[0][inside]),
        level(squares[2][inside]),
        before,
        calibrated,
        after,
        floor,
        reduction(squares[1][outside], squares[2][outside], floor),
        _interval(squares[1][outside], squares[2][outside], floor),
    )
    names = [problem.runs[k] for k in (*fitted, *heldout)]
    gaps = tuple(RunGap(name, k >= len(fitted), *(level(s[k]) for s in squares)) for k, name in enumerate(names))
    channels = tuple(
        ChannelGap(signal.name, signal.unit, signal.noise, *(float(np.sqrt(mean_of_runs(s[outside])[c])) for s in squares))
        for c, signal in enumerate(problem.signals)
        if np.isfinite(squares[0][outside][:, c]).any()
    )
    return figures, gaps, channels


def reduction(calibrated: Array, after: Array, floor: float) -> float:
    """Return the share of the gap above the floor that the effects close, 0..1."""
    room = level(calibrated) - floor
    return float(np.clip((level(calibrated) - level(after)) / room, 0.0, 1.0)) if room > 1e-9 else 0.0


def _interval(calibrated: Array, after: Array, floor: float) -> tuple[float, float]:
    """95 % interval of the reduction: runs drawn with replacement; one run tells none."""
    if len(calibrated) < 2:
        return math.nan, math.nan
    rng = np.random.default_rng(0)
    picks = rng.integers(0, len(calibrated), (SAMPLES, len(calibrated)))
    drawn = [reduction(calibrated[pick], after[pick], floor) for pick in picks]
    low, high = np.percentile(drawn, [2.5, 97.5])
    return float(low), float(high)
