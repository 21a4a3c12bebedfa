"""Score every candidate to first order: by how much would it improve the fit, all calibrated parameters refitted?

**First** by the score test with nuisance parameters projected out (:func:`screen`): one simulation per probe serves all
candidates; a candidate that is confounded with calibrated parameters within their tolerances scores nothing.

**Then** under the alternative (:func:`rescored`): with the level, autocorrelation time and scatter that each candidate would
leave. What an effect leaves unexplained lasts as long as the effect does: judged by the residuals of the model without it, a
constant error of any size counts as few readings. So the fitted numbers and the candidate move together to first order, the
noise of what is then left is estimated, and both are repeated. The model without the candidate is refitted under that same
noise, and the two likelihoods are compared. All of it is sums of products that are formed once; only autocorrelation needs the
residuals themselves.

**What chance gives** (:func:`largest_by_chance`) sets the threshold on each data set: the residuals that the best candidate
leaves are cut into blocks longer than their autocorrelation, and each block's sign is drawn anew (wild block bootstrap; Wu
1986, Liu 1988): what an effect would do alike in all blocks is gone, while size, autocorrelation, and covariance of the
channels stay those of these data. Every candidate is scored on every draw, and the largest improvement of each draw is taken.

The best candidates are refitted (:func:`shortlist`); :func:`detectable` says what the data would have shown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.jobs import in_threads
from wlr_gym.gap.analysis import Detectable
from wlr_gym.gap.estimation import (
    Columns,
    Fit,
    Noise,
    autocorrelation_times,
    bounded_minimum,
    by_channel,
    channel_costs,
    estimate_noise,
    normal_equations,
    run_scatter,
)
from wlr_gym.gap.problem import Array, Candidate, Probe, Setting, Start, blocks

#: Fall of minus two log posterior below which no effect is accepted; see :mod:`wlr_gym.gap.selection.screening`.
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

    def least_amplitude(self, k: int, threshold: float) -> float:
        """Return the smallest amplitude of direction ``k`` that is accepted: clear, and beyond what a tolerance allows."""
        clear = float(np.sqrt(asked_of(self.candidate, threshold) / max(float(self.information[k, k]), 1e-12)))
        tolerance = self.candidate.tolerances[k] if k < len(self.candidate.tolerances) else None
        return clear if tolerance is None else max(clear, tolerance.reach)

    def is_visible(self, threshold: float) -> bool:
        """Whether the smallest severity that would be accepted lies in the plausible range, in some direction."""
        for k in range(len(self.information)):
            for sign in (1.0, -1.0):
                amplitude = np.zeros(len(self.information))
                amplitude[k] = sign * self.least_amplitude(k, threshold)
                pairs = list(zip(self.candidate.unknowns, self.start.values(amplitude), strict=True))
                if all(u.low <= v <= u.high for u, v in pairs) and any(v != u.neutral for u, v in pairs if u.is_size):
                    return True
        return False


@dataclass(frozen=True, eq=False)
class Responses:
    """What candidates beyond a fit are scored with: columns of its numbers and of all probes, and their normal equations.

    Attributes:
        fit: the model without the candidates.
        keys: row of a quantity or probe.
        columns: of all, one (numbers and probes, rows x channels) array per run.
        response, push: ``C W C^T`` and ``C W r`` of all, tolerances not added.
        tight, away: (fitted numbers) weight of their tolerance, and how far they are from nominal.
        information: ``response`` with the fitted numbers projected out.
        low, high: (fitted numbers) how far they may still move.
        products: of columns and residuals, channel by channel.
    """

    fit: Fit
    keys: dict[str, int]
    columns: Columns = field(repr=False)
    response: Array
    push: Array
    tight: Array
    away: Array
    information: Array
    low: Array
    high: Array
    products: Products = field(repr=False)

    def directions(self, start: Start) -> Array:
        """Return which columns (directions, columns) each direction of a start adds up."""
        mix = np.zeros((len(start.directions), len(self.push)))
        for row, names in zip(mix, start.directions, strict=True):
            row[[self.keys[name] for name in names]] = 1.0
        return mix

    def with_directions(self, mix: Array) -> tuple[Array, Array, Array]:
        """Return the columns (numbers, columns) of the fitted numbers and of directions, and their normal equations."""
        rows = np.vstack([np.eye(len(self.low), len(self.push)), mix])
        return rows, *self.with_tolerances(rows @ self.response @ rows.T, rows @ self.push)

    def with_tolerances(self, matrix: Array, gradient: Array) -> tuple[Array, Array]:
        """Add to normal equations, in place, the tolerances of the fitted numbers and a little stiffness of the directions.

        Tolerances hold the quantities, not a direction that is the same response without its tolerance.
        """
        known = np.arange(len(self.tight))
        own = np.arange(len(known), len(gradient))
        matrix[known, known] += self.tight
        gradient[known] += self.tight * self.away
        matrix[own, own] += stiffness(matrix[own, own])
        return matrix, gradient

    def minimum(self, matrix: Array, gradient: Array) -> Array:
        """Return where fitted numbers, within bounds, and free directions go."""
        free = np.full(len(gradient) - len(self.low), np.inf)
        return bounded_minimum(matrix, gradient, np.concatenate([self.low, -free]), np.concatenate([self.high, free]))


def stiffness(information: Array) -> Array:
    """Return a little stiffness of directions with this information: a probe that does nothing gets nothing."""
    return LEAST_OWN * information + 1e-9


def responses(fit: Fit, probes: Sequence[Probe]) -> Responses:
    """Simulate all probes on top of a fitted model and project the fitted numbers out."""
    model, problem, known = fit.model, fit.problem, fit.model.size
    found = problem.residuals([Setting(model.quantities, (*model.patch, *probe.effects)) for probe in probes], fit.runs)

    def with_own(run: tuple[Array, Array, NDArray[np.float32]]) -> NDArray[np.float32]:
        r, base, own = run
        return np.vstack([own, np.nan_to_num(r - base).reshape(len(probes), -1).astype(np.float32)])

    columns = in_threads(problem.threads, with_own, zip(found, fit.residuals, fit.columns, strict=True))
    response, push = normal_equations(columns, fit.residuals, fit.noise, problem.threads)
    imitation = np.linalg.solve(fit.hessian, response[:known])  # how the fitted numbers would follow each column
    information = response - response[:known].T @ imitation
    keys = {quantity.name: k for k, quantity in enumerate(problem.quantities)}
    keys |= {probe.key: known + k for k, probe in enumerate(probes)}
    away = model.scaled - model.nominal
    products = Products(fit, columns)
    return Responses(fit, keys, columns, response, push, model.tightness, away, information, *model.room, products)


def screen(candidates: Sequence[Candidate], found: Responses) -> list[Score]:
    """Return the score of every candidate, best first."""
    nothing = _fall(found, np.zeros((0, len(found.push))))[0]
    best = [max((_score(c, start, found, nothing) for start in c.starts), key=lambda s: s.gain) for c in candidates if c.starts]
    seen = [replace(score, visible=score.is_visible(LEAST_GAIN)) for score in best]
    return sorted(seen, key=lambda score: -score.gain)


def _score(candidate: Candidate, start: Start, found: Responses, nothing: float) -> Score:
    """One start's score; ``nothing``: fall of the cost without it."""
    mix = found.directions(start)
    information = mix @ found.information @ mix.T
    raw = np.diag(mix @ found.response @ mix.T)
    own = float(np.max(np.diag(information) / np.maximum(raw, 1e-12)))
    fall, amplitude = _fall(found, mix)
    values, share = shortened(candidate, start, amplitude, SHARES)
    gain = (fall - nothing) * (2.0 * share - share**2)  # along the way to the minimum of a parabola
    return Score(candidate, values, gain, own, information, start)


def _fall(found: Responses, mix: Array) -> tuple[float, Array]:
    """Fall of the cost if the calibrated parameters, within bounds, and the directions ``mix`` move together; amplitudes."""
    _, matrix, gradient = found.with_directions(mix)
    x = found.minimum(matrix, gradient)
    return -float(2.0 * gradient @ x + x @ matrix @ x), x[len(found.low) :]


def shortened(candidate: Candidate, start: Start, amplitude: Array, shares: Sequence[float]) -> tuple[tuple[float, ...], float]:
    """Shorten an amplitude until its values lie where a fit may go; return the values and the share that is left of it."""
    for share in shares:
        values = start.values(share * amplitude)
        pairs = ((unknown.bounds, value) for unknown, value in zip(candidate.unknowns, values, strict=True))
        if all(low - 1e-12 <= value <= high + 1e-12 for (low, high), value in pairs):
            return values, share
    return candidate.kept(start.values(0.0 * amplitude)), 0.0


# ---- under the alternative -------------------------------------------------------------------------------------------

#: Times that the noise follows the candidate.
ROUNDS = 2
#: Candidates that explain most squares, whatever their autocorrelation, and are scored under the alternative.
SCORED = 32
#: The same for each group of signals.
SCORED_PER_GROUP = 4
#: Shares of an amplitude beyond the plausible range that are tried.
ALTERNATIVE_SHARES = (1.0, 0.85, 0.7, 0.5, 0.3, 0.15, 0.05, 0.0)


def rescored(found: Responses, scores: Sequence[Score]) -> tuple[list[Score], list[Score]]:
    """Score candidates, which :func:`screen` has scored, under the alternative; best first.

    A candidate that explains too little gains nothing. Returned is also, for each group of signals, the candidate that explains
    it best if all other signals are left out: where a response has a kink, as where motors reach the voltage of their supply,
    the first order may speak against the right effect in the other signals, and only a refit can decide.
    """
    if not scores:
        return [], []
    rows = found.products.rows
    best, rest = _System(found, np.arange(len(rows))).best(scores, SCORED)
    everywhere = sorted([*best, *(replace(s, gain=min(s.gain, 0.0)) for s in rest)], key=lambda score: -score.gain)
    groups: dict[str, list[int]] = {}
    for channel, signal in enumerate(found.fit.problem.signals):
        if rows[channel]:
            groups.setdefault(signal.group, []).append(channel)
    here = replace(found, away=np.zeros_like(found.away))  # numbers that a group says nothing about stay
    alone = [_System(here, np.array(channels)).best(scores, SCORED_PER_GROUP)[0][0] for channels in groups.values()]
    return everywhere, sorted(alone, key=lambda score: -score.gain)


class Products:
    """Products of columns and residuals, channel by channel.

    Attributes:
        by_run: (runs, channels, columns, columns) of columns.
        by_run_known: (runs, channels, numbers x numbers) of the fitted numbers' columns alone.
        push_by_run: (runs, channels, columns) of columns and residuals.
        gram, push: the sums over the runs.
        square: (channels) of the residuals.
        rows: (channels) measured.
        columns: one (channels, columns, rows) array per run.
    """

    def __init__(self, fit: Fit, columns: Columns) -> None:
        def of_one(run: tuple[NDArray[np.float32], Array]) -> tuple[NDArray[np.float32], NDArray[np.float32], Array, Array]:
            column, residual = run
            own = by_channel(column, residual.shape[1])
            known = np.nan_to_num(residual).T
            push = (own @ known.astype(np.float32)[:, :, None])[:, :, 0].astype(np.float64)
            return own, own @ own.transpose(0, 2, 1), push, (known * known).sum(axis=1)

        known = fit.model.size
        parts = in_threads(fit.problem.threads, of_one, zip(columns, fit.residuals, strict=True))
        self.columns: list[NDArray[np.float32]] = [own for own, *_ in parts]
        self.by_run: NDArray[np.float32] = np.stack([gram for _, gram, *_ in parts])
        self.by_run_known: NDArray[np.float32] = self.by_run[:, :, :known, :known].reshape(*self.by_run.shape[:2], -1)
        self.push_by_run: Array = np.stack([push for *_, push, _ in parts])
        self.gram: Array = self.by_run.sum(axis=0, dtype=np.float64)
        self.push: Array = self.push_by_run.sum(axis=0)
        self.square: Array = np.asarray(np.sum([square for *_, square in parts], axis=0))
        self.rows: Array = np.sum([np.isfinite(r).sum(axis=0) for r in fit.residuals], axis=0)


class _System:
    """What candidates are scored with, of some signals (``channels``) or all; arrays as in :class:`Products`."""

    def __init__(self, found: Responses, channels: NDArray[np.intp]) -> None:
        products, self.found, self.fit = found.products, found, found.fit
        self.known: int = len(found.tight)
        self.is_whole: bool = len(channels) == len(products.rows)
        self.rows, self.square, self.push = products.rows[channels], products.square[channels], products.push[channels]
        self.gram: Array = products.gram[channels]
        self.gram_known: Array = np.ascontiguousarray(self.gram[:, : self.known, : self.known])
        self.residuals: list[Array] = [np.ascontiguousarray(residual.T[channels]) for residual in self.fit.residuals]
        every = products.columns
        self.columns: list[NDArray[np.float32]] = every if self.is_whole else [columns[channels] for columns in every]
        noise = self.fit.noise
        #: Of the model without a candidate, every row independent.
        self.white = Noise(noise.square[channels], np.full(len(channels), noise.scatter), self.rows, noise.scatter)

    def best(self, scores: Sequence[Score], count: int) -> tuple[list[Score], list[Score]]:
        """Return the candidates that explain most squares, or gain most under the noise of the model without them, best
        first, scored under the alternative; and the rest. A vector and its components take one place of ``count``.
        """
        starts = [start for score in scores for start in score.candidate.starts]
        edges = np.cumsum([0, *(len(score.candidate.starts) for score in scores)])
        rough = np.maximum.reduceat(self._rough(starts), edges[:-1])
        labels = [score.candidate.label for score in scores]
        lasting = dict.fromkeys(labels[k] for k in np.argsort(rough)[::-1])
        leading = dict.fromkeys(labels[k] for k in np.argsort([score.gain for score in scores])[::-1])
        chosen = {*list(lasting)[:count], *list(leading)[: count // 2]}
        best = in_threads(self.fit.problem.threads, self._scored, [s for s in scores if s.candidate.label in chosen])
        return sorted(best, key=lambda score: -score.gain), [s for s in scores if s.candidate.label not in chosen]

    def _rough(self, starts: Sequence[Start]) -> Array:
        """Improvement by each start if every row were independent: what orders candidates before their noise is known."""
        weight, known = self.white.weight, self.known
        whole, push = np.tensordot(weight, self.gram, 1), weight @ self.push
        own, gradient = self.found.with_tolerances(whole[:known, :known].copy(), push[:known].copy())
        following = -np.linalg.solve(own, np.column_stack([gradient, whole[:known]]))  # how the fitted numbers follow
        steps = np.zeros((len(starts) + 1, len(push)))  # the last one is that of the model without any
        steps[:, :known] = following[:, 0]
        for step, start in zip(steps, starts, strict=False):
            mix = self.found.directions(start)
            border, corner = mix @ whole[:, :known], mix @ whole @ mix.T
            corner[np.diag_indices(len(mix))] += stiffness(np.diag(corner))
            amplitude = -np.linalg.solve(corner + border @ (following[:, 1:] @ mix.T), mix @ push + border @ following[:, 0])
            step += amplitude @ mix
            step[:known] += following[:, 1:] @ (amplitude @ mix)
        curved = in_threads(self.fit.problem.threads, lambda gram: np.einsum("sm,sm->s", steps @ gram, steps), self.gram)
        squares = self.square + 2.0 * steps @ self.push.T + np.stack(curved, axis=1)  # (steps, channels) after them
        after = channel_costs(np.maximum(squares, 0.0) / np.maximum(self.rows, 1)) @ self.rows
        return after[-1] - after[:-1]

    def _scored(self, score: Score) -> Score:
        """The candidate's best start, under the alternative."""
        tried = [(*_Alternative(self, score.candidate, start).improvement(), start) for start in score.candidate.starts]
        gain, values, step, start = max(tried, key=lambda one: one[0])
        return replace(score, gain=gain, values=values, start=start, step=step)


class _Alternative:
    """One start of a candidate beside the fitted numbers, in the signals of a system.

    Attributes:
        used: columns that its directions add up. own: (directions, used) which ones each of them does.
        border, corner: (channels, ...) products of the fitted numbers' columns and the directions, and of the directions.
        push: (channels, numbers) products of all and the residuals.
    """

    def __init__(self, system: _System, candidate: Candidate, start: Start) -> None:
        self.system, self.found, self.candidate, self.start, known = system, system.found, candidate, start, system.known
        mix = self.found.directions(start)
        self.used: NDArray[np.intp] = np.flatnonzero(mix.any(axis=0))
        self.own: Array = mix[:, self.used]
        own_gram, pushed = system.gram[:, self.used], system.push
        self.border: Array = (self.own @ own_gram[:, :, :known]).transpose(0, 2, 1)
        self.corner: Array = self.own @ own_gram[:, :, self.used] @ self.own.T
        self.push: Array = np.concatenate([pushed[:, :known], pushed[:, self.used] @ self.own.T], axis=1)

    def improvement(self) -> tuple[float, tuple[float, ...], Array]:
        """Return the improvement of the fit, the values it leads to, and the step of the fitted numbers."""
        found, known, rows = self.found, self.system.known, self.system.rows
        noise = self.system.fit.noise if self.system.is_whole else self.system.white
        for _ in range(ROUNDS):
            noise = self._noise_after(self._step(noise)[0])
        x, values = self._step(noise)
        matrix, gradient = found.with_tolerances(*self._normal(noise.weight))
        bare = np.zeros(len(x))
        bare[:known] = bounded_minimum(matrix[:known, :known], gradient[:known], found.low, found.high)
        before, after = (channel_costs(self._mean_squares(step)) for step in (bare, x))
        priors = [float(found.tight @ (found.away + step[:known]) ** 2) for step in (bare, x)]
        ranges = [2.0 * (v - u.neutral) / (u.high - u.low) for u, v in zip(self.candidate.unknowns, values, strict=True)]
        improved = float((rows / noise.autocorrelation_time) @ (before - after))
        return improved + priors[0] - priors[1] - float(np.square(ranges).sum()), values, x[:known]

    def _normal(self, weight: Array) -> tuple[Array, Array]:
        """Normal equations under weights (channels)."""
        known, border, corner = (np.tensordot(weight, part, 1) for part in (self.system.gram_known, self.border, self.corner))
        return np.block([[known, border], [border.T, corner]]), weight @ self.push

    def _mean_squares(self, x: Array) -> Array:
        """Mean squares (channels) of the residuals after a step (numbers)."""
        known, own = np.split(x, [self.system.known])
        both = (self.system.gram_known @ known) @ known + 2.0 * (self.border @ own) @ known + (self.corner @ own) @ own
        total = self.system.square + 2.0 * self.push @ x + both
        return np.maximum(total, 0.0) / np.maximum(self.system.rows, 1)

    def _step(self, noise: Noise) -> tuple[Array, tuple[float, ...]]:
        """Where fitted numbers and directions go together, within bounds and the plausible range; the candidate's values."""
        found, known = self.found, self.system.known
        matrix, gradient = found.with_tolerances(*self._normal(noise.weight))
        x = found.minimum(matrix, gradient)
        values, share = shortened(self.candidate, self.start, x[known:], ALTERNATIVE_SHARES)
        if share < 1.0:
            x[known:] *= share
            pull = gradient[:known] + matrix[:known, known:] @ x[known:]
            x[:known] = bounded_minimum(matrix[:known, :known], pull, found.low, found.high)
        return x, values

    def _noise_after(self, x: Array) -> Noise:
        """Noise of what is left after a step, the scatter of the runs under it included."""
        system, known, used = self.system, self.system.known, self.used
        steps, change = x[:known].astype(np.float32), (x[known:] @ self.own).astype(np.float32)
        left = [
            residual + steps @ columns[:, :known] + change @ columns[:, used]
            for residual, columns in zip(system.residuals, system.columns, strict=True)
        ]
        times, scatter = autocorrelation_times(left), system.fit.noise.scatter
        noise = Noise(self._mean_squares(x), scatter * times, system.rows, scatter)
        if system.is_whole:
            scatter = min(scatter, self._scatter(noise, x))
        return replace(noise, autocorrelation_time=scatter * times, scatter=scatter)

    def _scatter(self, noise: Noise, x: Array) -> float:
        """Scatter of the runs after a step; see :func:`wlr_gym.gap.estimation.widened`."""
        products, known, used = self.found.products, self.system.known, self.used
        which = np.concatenate([np.arange(known), used])
        rows = np.zeros((len(x), len(which)))
        rows[np.arange(known), np.arange(known)] = 1.0
        rows[known:, known:] = self.own
        border = products.by_run[:, :, used][:, :, :, which]  # symmetric
        inner = noise.weight.astype(np.float32) @ products.by_run_known
        grams = np.zeros((len(border), len(which), len(which)))
        grams[:, :known, :known] = inner.reshape(len(border), known, known)
        grams[:, :, known:] = np.einsum("c,rcmn->rnm", noise.weight, border)
        grams[:, known:, :known] = grams[:, :known, known:].transpose(0, 2, 1)
        matrices = rows @ grams @ rows.T
        vectors = np.einsum("c,rcm->rm", noise.weight, products.push_by_run[:, :, which]) @ rows.T + matrices @ x
        differ = run_scatter(matrices, vectors)
        return np.inf if differ is None else max(self.system.fit.problem.tempering * noise.scatter * differ, 1.0)


# ---- what chance gives -----------------------------------------------------------------------------------------------

#: Draws of the signs.
DRAWS = 200
#: Share of the draws whose largest improvement lies below the threshold.
QUANTILE = 0.98


def acceptance_threshold(cost: float, by_chance: Array) -> float:
    """Return by how much an effect with one unknown must improve the fit.

    Args:
        cost: minus two log posterior of the model without it.
        by_chance: (draws) of :func:`largest_by_chance`; may be empty.
    """
    return max(LEAST_GAIN, LEAST_SHARE * cost, chance(by_chance) if by_chance.size else 0.0)


def chance(by_chance: Array) -> float:
    """Return what :data:`QUANTILE` of the draws do not exceed; NaN where there are none."""
    return float(np.quantile(by_chance, QUANTILE)) if by_chance.size else math.nan


def largest_by_chance(found: Responses, scores: Sequence[Score]) -> Array:
    """Return the largest improvement (:data:`DRAWS`) of any candidate where only the signs of blocks of residuals are random.

    Nothing where there is no candidate. What further unknowns of a candidate cost is taken off, so that all compare with one
    threshold. ``scores``: of the candidates, best first.
    """
    if not scores:
        return np.zeros(0)
    fit, known = found.fit, len(found.tight)
    # to first order, what the best candidate would leave: without it the residuals are no noise
    rows, matrix, gradient = found.with_directions(found.directions(scores[0].start))
    moves = (-np.linalg.solve(matrix, gradient) @ rows).astype(np.float32)
    left = [r + (moves @ column).reshape(r.shape) for r, column in zip(fit.residuals, found.columns, strict=True)]
    noise = estimate_noise(left, scatter=fit.noise.scatter)
    response = np.tensordot(noise.weight, found.products.gram, 1)
    follow = np.linalg.solve(response[:known, :known] + np.diag(found.tight), response[:known])
    information = response - response[:known].T @ follow  # the calibrated parameters follow each column
    pushes = []  # weighted products (columns) of columns and residuals, of every block
    for run, column, residual in zip(fit.runs, found.columns, left, strict=True):
        weighted = (np.nan_to_num(residual) * noise.weight).astype(np.float32)
        shaped = column.reshape(len(column), *residual.shape)
        for rows in blocks(fit.problem.times(run)):
            pushes.append(shaped[:, rows].reshape(len(column), -1) @ weighted[rows].ravel())
    drawn = np.random.default_rng(0).choice((-1.0, 1.0), (DRAWS, len(pushes))) @ np.stack(pushes).astype(np.float64)
    own = drawn - drawn[:, :known] @ follow
    largest = np.zeros(DRAWS)
    for score in scores:
        for start in score.candidate.starts:
            mix = found.directions(start)
            inner = mix @ information @ mix.T + np.diag(stiffness(np.diag(mix @ response @ mix.T)))
            push = own @ mix.T
            improved = (push * np.linalg.solve(inner, push.T).T).sum(axis=1)
            np.maximum(largest, improved - PER_UNKNOWN * (len(score.candidate.unknowns) - 1), out=largest)
    return largest


# ---- what is refitted ------------------------------------------------------------------------------------------------

#: Hypotheses that are refitted in one round for their scores, at most.
SHORTLIST = 8
#: The same per name.
PER_NAME = 3
#: Share of what is asked below which a first score is not worth a refit.
LEAST_WORTH = 0.25
#: The best of so many names that the shortlist lacks are refitted too: the first order says little where a response has a kink.
MORE_NAMES = 3
#: A candidate that explains a group of signals is refitted too if it improves their fit by this many times what is accepted ...
PROPOSED = 1.5
#: ... and so many at most.
MOST_PROPOSED = 3


def one_per_label(scores: Sequence[Score]) -> list[Score]:
    """Of a vector and its components the one that improves the fit by most beyond what is asked; order kept.

    The whole vector where none improves it by much: it is what these runs would show or not.
    """
    much = {score.candidate.label for score in scores if score.gain > LEAST_WORTH * LEAST_GAIN}

    def rank(score: Score) -> float:
        own = score.candidate
        return asked_of(own) - score.gain if own.label in much else -len(own.unknowns)

    best: dict[str, Score] = {}
    for score in sorted(scores, key=rank):
        best.setdefault(score.candidate.label, score)
    return [score for score in scores if best[score.candidate.label] is score]


def shortlist(scores: Sequence[Score], threshold: float = LEAST_GAIN, alone: Sequence[Score] = ()) -> list[Score]:
    """Return the best scores, at most :data:`PER_NAME` of one effect, and only those above a share of the threshold.

    The improvement predicted to first order may be :data:`LEAST_WORTH` of the actual one. The best of :data:`MORE_NAMES`
    further effects follow, and the best of those that explain a group of signals well (``alone``, best first).
    """
    chosen: list[Score] = []
    more: dict[str, Score] = {}
    for score in scores:
        if score.gain <= LEAST_WORTH * threshold:
            break
        name = score.candidate.name
        same = sum(other.candidate.name == name for other in chosen)
        if len(chosen) < SHORTLIST and same < PER_NAME:
            chosen.append(score)
        elif not same:
            more.setdefault(name, score)
    chosen += list(more.values())[:MORE_NAMES]
    had = {score.candidate.label for score in chosen}
    well = {score.candidate.label: score for score in reversed(alone) if score.gain > PROPOSED * least_gain(len(score.values))}
    new = sorted((score for label, score in well.items() if label not in had), key=lambda score: -score.gain)
    return [*chosen, *new[:MOST_PROPOSED]]


# ---- what the data would have shown ----------------------------------------------------------------------------------


def detectable(scores: Sequence[Score], threshold: float = LEAST_GAIN) -> dict[str, Detectable]:
    """Return the smallest severity of every effect that would have been accepted, at the place where it is hardest to see.

    Of an effect with directions of its own (x, y, z of a displaced mass) it is the one that shows best: in another it may hide
    at any size. First order: the gain of an effect grows with the square of its severity. Where no plausible size would show,
    its size is NaN. Formulas are left out: their laws have no size in common. ``threshold``: see :func:`asked_of`.
    """
    found: dict[str, tuple[float, Detectable]] = {}
    for score in scores:
        candidate, start, shown = score.candidate, score.start, np.diag(score.information)
        if len(candidate.where) > 1 or candidate.formula:
            continue
        # which unknowns are sizes in the vocabulary; all where none is in it, as of a wave's sine and cosine
        own, unknowns = candidate.vocabulary, candidate.unknowns
        sizes = [k for k, u in enumerate(unknowns) if u.name in own and own[u.name].is_size] or range(len(unknowns))
        which = max((k for k in sizes if k < len(shown)), key=lambda k: float(shown[k]))
        amplitude = score.least_amplitude(which, threshold)
        steps = np.zeros(len(start.directions))
        steps[min(which, len(steps) - 1)] = amplitude
        entry = _largest(candidate, start.values(steps))
        if not score.visible:
            amplitude, entry = np.inf, replace(entry, value=np.nan)
        if candidate.name not in found or amplitude > found[candidate.name][0]:
            found[candidate.name] = (amplitude, entry)
    return {name: entry for name, (_, entry) in sorted(found.items())}


def _largest(candidate: Candidate, values: Sequence[float]) -> Detectable:
    """The size that is farthest from neutral, in units of its range."""
    parameters, own = candidate.parameters(values), candidate.vocabulary
    unknowns = {unknown.name: unknown for unknown in candidate.unknowns}

    def distance(name: str) -> float:
        if name not in own:
            unknown = unknowns[name]
            return abs(parameters[name] - unknown.neutral) / (unknown.high - unknown.low)
        neutral, (low, high) = own[name].neutral, own[name].prior
        return abs(parameters[name] - (unknowns[name].neutral if isinstance(neutral, str) else neutral)) / (high - low)

    name = max((key for key in parameters if (own.get(key) or unknowns[key]).is_size), key=distance)
    return Detectable(name, parameters[name], (own.get(name) or unknowns[name]).unit)
