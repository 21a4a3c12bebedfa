"""How sure: intervals of the fitted numbers, confidence in a name, what else would explain the data, what would have shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from wlr_gym.gap.analysis import Detectable, Estimate
from wlr_gym.gap.estimation.fit import (
    PINNED,
    Fit,
    equations_by_run,
    on_bounds,
    prior_tightness,
    scaled_nominal,
    scaled_numbers,
    scales,
)
from wlr_gym.gap.problem import Candidate, Problem
from wlr_gym.gap.selection.hypothesis import MOST_HARM, Hypothesis
from wlr_gym.gap.selection.screening import LEAST_GAIN, Score, least_amplitude, least_gain
from wlr_gym.physics.effects import EFFECTS, EffectParameter

Array = NDArray[np.float64]

#: Bootstrap samples of the runs.
SAMPLES = 500
TWO_SIDED_95 = 1.96
#: Two explanations are equivalent if the second buys at least this share of what the first buys.
EQUIVALENT = 0.93
#: A rival that buys this share is as good unless the runs agree, by so many standard errors, that it is not.
RIVAL, AGREED = 0.75, 2.0


def two_sided_95(degrees: int) -> float:
    """Return Student's t: half of a 95 % interval in standard errors that so many degrees of freedom tell."""
    return float(stdtrit(degrees, 0.975))


def covariance(problem: Problem, fit: Fit) -> Array:
    """Return the covariance (numbers, numbers) of all numbers, in their units, as wide as 1.96 of its sigmas must be for 95 %.

    From the curvature of the likelihood; where leaving out one run after the other (jackknife, one Newton step each) shows more
    spread, which is what differs from run to run, the number's row and column are widened to that. A spread that a few runs
    tell is known to a few degrees of freedom only: it counts Student's t over 1.96 times.
    """
    curvature = fit.covariance()
    matrices, vectors = equations_by_run(fit)
    tight = prior_tightness(problem, fit.model)
    pull = tight * (scaled_numbers(problem, fit.model) - scaled_nominal(problem, fit.model))
    stiff = np.diag(tight + PINNED * on_bounds(problem, fit.model))
    whole, vector, runs = matrices.sum(axis=0), vectors.sum(axis=0), len(vectors)
    shifts = [
        -np.linalg.solve(whole - matrix + stiff, vector - own + pull) for matrix, own in zip(matrices, vectors, strict=True)
    ]
    spread = np.stack(shifts) - np.mean(shifts, axis=0)
    jackknife = (runs - 1) / runs * (spread**2).sum(axis=0)
    wider = np.sqrt(jackknife / np.maximum(np.diag(curvature), 1e-300))
    few = two_sided_95(runs - 1) / TWO_SIDED_95 if runs > 1 else 1.0
    scale = scales(problem, fit.model) * np.where(wider > 1.0, few * wider, 1.0)
    return curvature * np.outer(scale, scale)


def half_widths(problem: Problem, fit: Fit) -> Array:
    """Return half of the 95 % interval of every number (numbers), in its unit; see :func:`covariance`.

    A known number is never known less than beforehand, to 1.96 tolerances, unless it drifts; and on its bound no better.
    """
    halves = TWO_SIDED_95 * np.sqrt(np.diag(covariance(problem, fit)))
    beforehand = TWO_SIDED_95 * scales(problem, fit.model)
    drifts = np.array([quantity.drifts for quantity in problem.quantities])
    held = np.concatenate([~drifts, np.zeros(len(halves) - len(drifts), bool)])
    return np.where(on_bounds(problem, fit.model), beforehand, np.where(held, np.minimum(halves, beforehand), halves))


def estimates(problem: Problem, fit: Fit) -> list[dict[str, Estimate]]:
    """Return the parameters of each of the model's effects with 95 % intervals.

    To what the data leave open comes what two simulators of one system disagree by (``problem.disagreement``), the same share
    of all unknowns that say how large an effect is. An unknown that adds to known numbers is known no better than they are:
    data tell the sum, and only the small errors of simulated responses make it look otherwise.
    """
    spread = covariance(problem, fit)
    found, at = [], len(problem.quantities)
    for candidate, values in fit.model.effects:
        own = slice(at, at + len(values))
        sizes = [(v - u.neutral) * u.is_size for u, v in zip(candidate.unknowns, values, strict=True)]
        away = problem.disagreement * np.array(sizes)
        untold = np.diag(np.maximum(_untold(candidate) - np.diag(spread)[own], 0.0))
        found.append(_with_intervals(candidate, np.array(values), spread[own, own] + np.outer(away, away) + untold))
        at += len(values)
    return found


def _untold(candidate: Candidate) -> Array:
    """Least variance (unknowns) of what is told only as a sum with known numbers: that of their mean."""
    met = candidate.tolerances or (None,) * len(candidate.unknowns)
    return np.array([0.0 if one is None or one.replaces else one.size**2 / len(one.quantities) for one in met])


def _with_intervals(candidate: Candidate, values: Array, spread: Array) -> dict[str, Estimate]:
    """Parameters of one effect: their slopes in the fitted values carry the covariance over."""
    here = candidate.parameters(values.tolist())
    errors = np.sqrt(np.maximum(np.diag(spread), 0.0))
    slopes = {name: np.zeros(len(values)) for name in here}
    own = np.eye(len(values))
    for k, error in enumerate(errors):
        step = 0.1 * error + 1e-9
        if candidate.kept((values + step * own[k]).tolist())[k] < values[k] + 0.5 * step:  # at the edge of its range: inwards
            step = -step
        beside = candidate.parameters((values + step * own[k]).tolist())
        for name in here:
            slopes[name][k] = (beside[name] - here[name]) / step
    units = {unknown.name: unknown.unit for unknown in candidate.unknowns}
    if candidate.name in EFFECTS:
        units |= {name: spec.unit for name, spec in EFFECTS[candidate.name].parameters.items()}
    found = {}
    for name, value in here.items():
        half = TWO_SIDED_95 * float(np.sqrt(max(slopes[name] @ spread @ slopes[name], 0.0)))
        found[name] = Estimate(value, value - half, value + half, units.get(name, "-"))
    return found


def confidence(taken: Hypothesis, others: Sequence[Hypothesis], cost: float = 0.0) -> float:
    """Return the share of bootstrap samples of the runs in which the taken effect is accepted and no other name is better.

    What counts of a run is its part in the gain, as fitted to all runs: no sample is fitted anew. ``cost`` is that of the model
    without the effect.
    """
    rng = np.random.default_rng(0)
    rivals = [other for other in others if other.candidate.name != taken.candidate.name and not other.tolerable]
    picks = rng.integers(0, len(taken.by_run), (SAMPLES, len(taken.by_run)))
    parts = _parts(taken)[picks]
    gains = parts.sum(axis=1)
    agreed = -parts.clip(max=0.0).sum(axis=1) <= MOST_HARM * parts.clip(min=0.0).sum(axis=1)
    wins = agreed & (gains >= least_gain(len(taken.values), cost))
    for rival in rivals:
        wins &= gains >= _parts(rival)[picks].sum(axis=1)
    return float(wins.mean())


def _parts(hypothesis: Hypothesis) -> Array:
    """The runs' parts (runs) in the gain of a hypothesis: their falls of squares, scaled to it."""
    total = float(hypothesis.by_run.sum())
    return hypothesis.by_run * (hypothesis.gain / total) if total > 0.0 < hypothesis.gain else hypothesis.by_run


def equivalents(taken: Hypothesis, others: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the best hypothesis of every other name that buys nearly as much."""
    found: dict[str, Hypothesis] = {}
    for other in others:
        name = other.candidate.name
        possible = not other.at_bound and not other.tolerable
        if name != taken.candidate.name and possible and name not in found and _as_good(taken, other):
            found[name] = other
    return list(found.values())


def _as_good(taken: Hypothesis, other: Hypothesis) -> bool:
    """Whether another hypothesis buys nearly as much, or the runs do not agree that it buys less."""
    if other.gain > EQUIVALENT * taken.gain or taken.gain - other.gain < 0.25 * LEAST_GAIN:
        return True
    ahead = taken.by_run - other.by_run
    spread = float(ahead.std(ddof=1)) / np.sqrt(len(ahead)) if len(ahead) > 1 else 0.0
    return bool(other.gain > RIVAL * taken.gain and ahead.mean() < AGREED * spread)


def detectable(scores: Sequence[Score], cost: float = 0.0) -> dict[str, Detectable]:
    """Return the smallest severity of every effect that would have been accepted, at the place where it is hardest to see.

    Of an effect with directions of its own (x, y, z of a displaced mass) it is the one that shows best: in another it may hide
    at any size. First order: the gain of an effect grows with the square of its severity. ``cost`` is that of the model without
    it. Where no plausible size would show, its size is NaN. Formulas are left out: their laws have no size in common.
    """
    found: dict[str, tuple[float, Detectable]] = {}
    for score in scores:
        if len(score.candidate.where) > 1 or score.candidate.formula:
            continue
        start = score.start
        shown = np.diag(score.information)
        which = max((k for k in _sizes(score.candidate) if k < len(shown)), key=lambda k: float(shown[k]))
        amplitude = least_amplitude(score.candidate, score.information, which, cost)
        steps = np.zeros(len(start.directions))
        steps[min(which, len(steps) - 1)] = amplitude
        entry = _largest(score.candidate, start.values(steps))
        if not score.visible:
            amplitude, entry = np.inf, replace(entry, value=np.nan)
        if score.candidate.name not in found or amplitude > found[score.candidate.name][0]:
            found[score.candidate.name] = (amplitude, entry)
    return {name: entry for name, (_, entry) in sorted(found.items())}


def _vocabulary(candidate: Candidate) -> Mapping[str, EffectParameter]:
    """An effect's parameters, where the library knows it."""
    return EFFECTS[candidate.name].parameters if candidate.name in EFFECTS else {}


def _sizes(candidate: Candidate) -> list[int]:
    """Which unknowns are sizes in the vocabulary; all where none is in it, as of a wave's sine and cosine."""
    own, unknowns = _vocabulary(candidate), candidate.unknowns
    return [k for k, u in enumerate(unknowns) if u.name in own and own[u.name].is_size] or list(range(len(unknowns)))


def _largest(candidate: Candidate, values: Sequence[float]) -> Detectable:
    """The size that is farthest from neutral, in units of its range."""
    parameters, own = candidate.parameters(values), _vocabulary(candidate)
    unknowns = {unknown.name: unknown for unknown in candidate.unknowns}

    def distance(name: str) -> float:
        if name not in own:
            unknown = unknowns[name]
            return abs(parameters[name] - unknown.neutral) / (unknown.high - unknown.low)
        neutral, (low, high) = own[name].neutral, own[name].prior
        return abs(parameters[name] - (unknowns[name].neutral if isinstance(neutral, str) else neutral)) / (high - low)

    name = max((key for key in parameters if (own.get(key) or unknowns[key]).is_size), key=distance)
    return Detectable(name, parameters[name], (own.get(name) or unknowns[name]).unit)
