"""Score every candidate at once, to first order: by how much would it improve the fit, all calibrated parameters refitted?

This is the score test with nuisance parameters projected out. One simulation per probe serves all candidates; a candidate that
is confounded with calibrated parameters within their tolerances scores nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.threads import in_threads
from wlr_gym.gap.estimation.fit import Fit
from wlr_gym.gap.estimation.least_squares import bounded_minimum, normal_equations
from wlr_gym.gap.estimation.model import prior_tightness, room, scaled_nominal, scaled_numbers
from wlr_gym.gap.problem import Candidate, Probe, Problem, Setting, Start

Array = NDArray[np.float64]

#: Fall of minus two log posterior below which no effect is accepted; see :mod:`wlr_gym.gap.selection.threshold`.
LEAST_GAIN = 16.0
#: By how much more an effect must improve the fit for every unknown beyond the first.
PER_UNKNOWN = 3.0
#: An effect must also improve the fit by this share of minus two log posterior.
LEAST_SHARE = 0.02
#: A response of which calibrated parameters reproduce all but this share is not distinguishable from them.
LEAST_OWN = 1e-4
#: Shares of an amplitude that are tried where the whole lies beyond where a fit may go.
SHARES = (1.0, 0.7, 0.5, 0.3, 0.1, 0.0)


def least_gain(unknowns: int, threshold: float = LEAST_GAIN) -> float:
    """Return by how much an effect with so many unknowns must improve the fit; ``threshold``: one with a single unknown."""
    return threshold + PER_UNKNOWN * (unknowns - 1)


def asked_of(candidate: Candidate, threshold: float = LEAST_GAIN) -> float:
    """Return by how much a candidate must improve the fit; ``threshold``: as for :func:`least_gain`."""
    return least_gain(len(candidate.unknowns), threshold) + candidate.surcharge


def least_amplitude(candidate: Candidate, information: Array, k: int, threshold: float = LEAST_GAIN) -> float:
    """Return the smallest amplitude of direction ``k`` that would be accepted: clear, and beyond what a tolerance allows."""
    clear = float(np.sqrt(asked_of(candidate, threshold) / max(float(information[k, k]), 1e-12)))
    tolerance = candidate.tolerances[k] if k < len(candidate.tolerances) else None
    return clear if tolerance is None else max(clear, tolerance.reach)


@dataclass(frozen=True, eq=False)
class Score:
    """A candidate's score.

    Attributes:
        candidate: the effect.
        values: first guess of its unknowns.
        gain: expected fall of minus two log likelihood.
        own: share of its response that is not confounded with calibrated parameters.
        information: of the amplitudes of its best start (k, k), calibrated parameters projected out; 1 = the probe.
        start: that best start.
        visible: whether the data would show it somewhere in its plausible range.
        step: (fitted numbers) scaled, how they move with it; None = they stay.
    """

    candidate: Candidate
    values: tuple[float, ...]
    gain: float
    own: float
    information: Array
    start: Start
    visible: bool = False
    step: Array | None = field(default=None, repr=False)


@dataclass(frozen=True, eq=False)
class Responses:
    """Normal equations of the fitted numbers and all probes: what :func:`screen` scores candidates with.

    Attributes:
        keys: row of a quantity or probe.
        response, push: ``C W C^T`` and ``C W r`` of all, tolerances not added.
        tight, away: (fitted numbers) weight of their tolerance, and how far they are from nominal.
        information: ``response`` with the fitted numbers projected out.
        low, high: (fitted numbers) how far they may still move.
        columns: of all, one (numbers and probes, rows x channels) array per run.
    """

    keys: dict[str, int]
    response: Array
    push: Array
    tight: Array
    away: Array
    information: Array
    low: Array
    high: Array
    columns: Sequence[NDArray[np.float32]] = field(repr=False)


def responses(problem: Problem, fit: Fit, runs: Sequence[int], probes: Sequence[Probe]) -> Responses:
    """Simulate all probes on top of a fitted model and project the fitted numbers out."""
    settings = [Setting(fit.model.quantities, (*fit.model.patch, *probe.effects)) for probe in probes]
    found = problem.residuals(settings, runs)

    def with_own(run: tuple[Array, Array, NDArray[np.float32]]) -> NDArray[np.float32]:
        r, base, known = run
        return np.vstack([known, np.nan_to_num(r - base).reshape(len(probes), -1).astype(np.float32)])

    columns = in_threads(problem.threads, with_own, zip(found, fit.residuals, fit.columns, strict=True))
    return project(problem, fit, columns, [probe.key for probe in probes])


def project(problem: Problem, fit: Fit, columns: Sequence[NDArray[np.float32]], keys: Sequence[str]) -> Responses:
    """Project the fitted numbers out of the probes' columns, which follow theirs."""
    known = fit.model.size
    response, push = normal_equations(columns, fit.residuals, fit.noise, problem.threads)
    tight = prior_tightness(problem, fit.model)
    away = scaled_numbers(problem, fit.model) - scaled_nominal(problem, fit.model)
    imitation = np.linalg.solve(fit.hessian, response[:known])  # how the fitted numbers would follow each column
    information = response - response[:known].T @ imitation
    names = [*(quantity.name for quantity in problem.quantities)]
    places = {name: k for k, name in enumerate(names)} | {key: known + k for k, key in enumerate(keys)}
    return Responses(places, response, push, tight, away, information, *room(problem, fit.model), columns)


def screen(candidates: Sequence[Candidate], found: Responses, threshold: float = LEAST_GAIN) -> list[Score]:
    """Return the score of every candidate, best first; ``threshold``: see :func:`least_gain`."""
    nothing = _fall(found, np.zeros((0, len(found.push))))[0]
    scores = [score for candidate in candidates if (score := _score(candidate, found, nothing)) is not None]
    seen = [replace(score, visible=is_visible(score, threshold)) for score in scores]
    return sorted(seen, key=lambda score: -score.gain)


def _score(candidate: Candidate, found: Responses, nothing: float) -> Score | None:
    best: Score | None = None
    for start in candidate.starts:
        mix = directions(start, found)
        information = mix @ found.information @ mix.T
        raw = np.diag(mix @ found.response @ mix.T)
        own = float(np.max(np.diag(information) / np.maximum(raw, 1e-12)))
        fall, amplitude = _fall(found, mix)
        values, share = shortened(candidate, start, amplitude, SHARES)
        gain = (fall - nothing) * (2.0 * share - share**2)  # along the way to the minimum of a parabola
        if best is None or gain > best.gain:
            best = Score(candidate, values, gain, own, information, start)
    return best


def _fall(found: Responses, mix: Array) -> tuple[float, Array]:
    """Fall of the cost if the calibrated parameters, within bounds, and the directions ``mix`` move together; amplitudes."""
    known = len(found.low)
    rows = np.vstack([np.eye(known, len(found.push)), mix])
    matrix, gradient = with_tolerances(rows @ found.response @ rows.T, rows @ found.push, found)
    free = np.full(len(mix), np.inf)
    x = bounded_minimum(matrix, gradient, np.concatenate([found.low, -free]), np.concatenate([found.high, free]))
    return -float(2.0 * gradient @ x + x @ matrix @ x), x[known:]


def is_visible(score: Score, threshold: float) -> bool:
    """Whether the smallest severity that would be accepted lies in the plausible range, in some direction."""
    candidate, start, information = score.candidate, score.start, score.information
    for k in range(len(information)):
        for sign in (1.0, -1.0):
            amplitude = np.zeros(len(information))
            amplitude[k] = sign * least_amplitude(candidate, information, k, threshold)
            values = start.values(amplitude)
            pairs = list(zip(candidate.unknowns, values, strict=True))
            if all(u.low <= v <= u.high for u, v in pairs) and any(v != u.neutral for u, v in pairs if u.is_size):
                return True
    return False


def directions(start: Start, found: Responses) -> Array:
    """Return which columns (directions, columns) each direction of a start adds up."""
    mix = np.zeros((len(start.directions), len(found.push)))
    for row, names in zip(mix, start.directions, strict=True):
        row[[found.keys[name] for name in names]] = 1.0
    return mix


def with_tolerances(matrix: Array, gradient: Array, found: Responses) -> tuple[Array, Array]:
    """Add to normal equations, in place, the tolerances of the fitted numbers and a little stiffness of the directions.

    Tolerances hold the quantities, not a direction that is the same response without its tolerance.
    """
    known = np.arange(len(found.tight))
    own = np.arange(len(known), len(gradient))
    matrix[known, known] += found.tight
    gradient[known] += found.tight * found.away
    matrix[own, own] += stiffness(matrix[own, own])
    return matrix, gradient


def stiffness(information: Array) -> Array:
    """Return a little stiffness of directions with this information: a probe that does nothing gets nothing."""
    return LEAST_OWN * information + 1e-9


def shortened(candidate: Candidate, start: Start, amplitude: Array, shares: Sequence[float]) -> tuple[tuple[float, ...], float]:
    """Shorten an amplitude until its values lie where a fit may go; return the values and the share that is left of it."""
    for share in shares:
        values = start.values(share * amplitude)
        pairs = ((unknown.bounds, value) for unknown, value in zip(candidate.unknowns, values, strict=True))
        if all(low - 1e-12 <= value <= high + 1e-12 for (low, high), value in pairs):
            return values, share
    return candidate.kept(start.values(0.0 * amplitude)), 0.0
