"""Score candidates under the alternative: level, autocorrelation time and scatter are those that each candidate would leave.

What an effect leaves unexplained lasts as long as the effect does: judged by the residuals of the model without it, a constant
error of any size counts as few readings. So the fitted numbers and the candidate move together to first order, the
noise of what is then left is estimated, and both are repeated. The model without the candidate is refitted under that same
noise, and the two likelihoods are compared. All of it is sums of products that are formed once; only autocorrelation
needs the residuals themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.threads import in_threads
from wlr_gym.gap.estimation.fit import Fit
from wlr_gym.gap.estimation.least_squares import bounded_minimum, by_channel
from wlr_gym.gap.estimation.likelihood import Noise, channel_costs, run_scatter, series_times
from wlr_gym.gap.problem import Candidate, Problem, Start
from wlr_gym.gap.selection.screening import Responses, Score, directions, shortened, stiffness, with_tolerances

Array = NDArray[np.float64]

#: Times that the noise follows the candidate.
ROUNDS = 2
#: Candidates that explain most squares, whatever their autocorrelation, and are scored under the alternative.
SCORED = 32
#: The same for each group of signals.
SCORED_PER_GROUP = 4
#: Shares of an amplitude beyond the plausible range that are tried.
SHARES = (1.0, 0.85, 0.7, 0.5, 0.3, 0.15, 0.05, 0.0)


def rescored(
    problem: Problem, fit: Fit, found: Responses, products: Products, scores: Sequence[Score]
) -> tuple[list[Score], list[Score]]:
    """Score candidates under the alternative.

    Args:
        problem: the system.
        fit: the model without the candidates.
        found: responses of its numbers and of the candidates' probes.
        products: of both.
        scores: to first order, under the noise of ``fit``.

    Returns:
        All scores, best first, with gain and values under the alternative; a candidate that explains too little to be
        scored gains nothing. And for each group of signals the candidate that explains it best if all other signals are
        left out: where a response has a kink, as where motors reach the voltage of their supply, the first order may speak
        against the right effect in the other signals, and only a refit can decide.
    """
    if not scores:
        return [], []
    system = _System(problem, fit, found, products, np.arange(len(products.rows)))
    best, rest = system.best(scores, SCORED)
    everywhere = sorted([*best, *(replace(s, gain=min(s.gain, 0.0)) for s in rest)], key=lambda score: -score.gain)
    groups: dict[str, list[int]] = {}
    for channel, signal in enumerate(problem.signals):
        if products.rows[channel]:
            groups.setdefault(signal.group, []).append(channel)
    here = replace(found, away=np.zeros_like(found.away))  # numbers that a group says nothing about stay
    alone = [
        replace(system, found=here, channels=np.array(channels)).best(scores, SCORED_PER_GROUP)[0][0]
        for channels in groups.values()
    ]
    return everywhere, sorted(alone, key=lambda score: -score.gain)


@dataclass(frozen=True, eq=False)
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

    by_run: NDArray[np.float32]
    by_run_known: NDArray[np.float32]
    push_by_run: Array
    gram: Array
    push: Array
    square: Array
    rows: Array
    columns: list[NDArray[np.float32]] = field(repr=False)

    @staticmethod
    def of(fit: Fit, found: Responses, threads: int = 1) -> Products:
        """Form the products of a fit's residuals with all columns of the responses."""

        def of_one(run: tuple[NDArray[np.float32], Array]) -> tuple[NDArray[np.float32], NDArray[np.float32], Array, Array]:
            column, residual = run
            own = by_channel(column, residual.shape[1])
            known = np.nan_to_num(residual).T
            push = (own @ known.astype(np.float32)[:, :, None])[:, :, 0].astype(np.float64)
            return own, own @ own.transpose(0, 2, 1), push, (known * known).sum(axis=1)

        parts = in_threads(threads, of_one, zip(found.columns, fit.residuals, strict=True))
        columns = [own for own, *_ in parts]
        by_run, push_by_run = np.stack([gram for _, gram, *_ in parts]), np.stack([push for *_, push, _ in parts])
        square = np.sum([square for *_, square in parts], axis=0)
        rows = np.sum([np.isfinite(r).sum(axis=0) for r in fit.residuals], axis=0)
        gram, push = by_run.sum(axis=0, dtype=np.float64), push_by_run.sum(axis=0)
        known = len(found.tight)
        by_run_known = by_run[:, :, :known, :known].reshape(*by_run.shape[:2], -1)
        return Products(by_run, by_run_known, push_by_run, gram, push, np.asarray(square), rows, columns)


@dataclass(frozen=True, eq=False)
class _System:
    """What candidates are scored with; ``channels``: the signals that count."""

    problem: Problem
    fit: Fit
    found: Responses
    products: Products
    channels: NDArray[np.intp]

    @property
    def known(self) -> int:
        """Number of fitted numbers."""
        return len(self.found.tight)

    @cached_property
    def rows(self) -> Array:
        """Measured rows (channels)."""
        return self.products.rows[self.channels]

    @cached_property
    def square(self) -> Array:
        """Squares of the residuals (channels)."""
        return self.products.square[self.channels]

    @cached_property
    def push(self) -> Array:
        """Products of columns and residuals (channels, columns)."""
        return self.products.push[self.channels]

    @cached_property
    def gram(self) -> Array:
        """Products of columns (channels, columns, columns)."""
        return self.products.gram[self.channels]

    @cached_property
    def residuals(self) -> list[Array]:
        """Residuals (channels, rows) of each run."""
        return [np.ascontiguousarray(residual.T[self.channels]) for residual in self.fit.residuals]

    @cached_property
    def columns(self) -> list[NDArray[np.float32]]:
        """Columns (channels, columns, rows) of each run."""
        every = len(self.channels) == len(self.products.rows)
        return self.products.columns if every else [columns[self.channels] for columns in self.products.columns]

    @cached_property
    def gram_known(self) -> Array:
        """The same of the fitted numbers (channels, numbers, numbers)."""
        return np.ascontiguousarray(self.gram[:, : self.known, : self.known])

    def best(self, scores: Sequence[Score], count: int) -> tuple[list[Score], list[Score]]:
        """Return the candidates that explain most squares, or gain most under the noise of the model without them, best
        first, scored under the alternative; and the rest. A vector and its components take one place of ``count``.
        """
        threads = self.problem.threads
        starts = [start for score in scores for start in score.candidate.starts]
        edges = np.cumsum([0, *(len(score.candidate.starts) for score in scores)])
        rough = np.maximum.reduceat(self._rough(starts), edges[:-1])
        labels = [score.candidate.label for score in scores]
        lasting = dict.fromkeys(labels[k] for k in np.argsort(rough)[::-1])
        leading = dict.fromkeys(labels[k] for k in np.argsort([score.gain for score in scores])[::-1])
        chosen = {*list(lasting)[:count], *list(leading)[: count // 2]}
        best = in_threads(threads, self._scored, [s for s in scores if s.candidate.label in chosen])
        return sorted(best, key=lambda score: -score.gain), [s for s in scores if s.candidate.label not in chosen]

    def _rough(self, starts: Sequence[Start]) -> Array:
        """Improvement by each start if every row were independent: what orders candidates before their noise is known."""
        weight, known = self._white().weight, self.known
        whole, push = np.tensordot(weight, self.gram, 1), weight @ self.push
        own, gradient = with_tolerances(whole[:known, :known].copy(), push[:known].copy(), self.found)
        following = -np.linalg.solve(own, np.column_stack([gradient, whole[:known]]))  # how the fitted numbers follow
        steps = np.zeros((len(starts) + 1, len(push)))  # the last one is that of the model without any
        steps[:, :known] = following[:, 0]
        for step, start in zip(steps, starts, strict=False):
            mix = directions(start, self.found)
            border, corner = mix @ whole[:, :known], mix @ whole @ mix.T
            corner[np.diag_indices(len(mix))] += stiffness(np.diag(corner))
            amplitude = -np.linalg.solve(corner + border @ (following[:, 1:] @ mix.T), mix @ push + border @ following[:, 0])
            step += amplitude @ mix
            step[:known] += following[:, 1:] @ (amplitude @ mix)
        after = channel_costs(np.maximum(self._squares(steps), 0.0) / np.maximum(self.rows, 1)) @ self.rows
        return after[-1] - after[:-1]

    def _squares(self, steps: Array) -> Array:
        """Squares of the residuals (steps, channels) after steps of all columns (steps, columns)."""
        curved = in_threads(self.problem.threads, lambda gram: np.einsum("sm,sm->s", steps @ gram, steps), self.gram)
        return self.square + 2.0 * steps @ self.push.T + np.stack(curved, axis=1)

    def _white(self) -> Noise:
        """The noise of the model without a candidate, every row independent."""
        noise = self.fit.noise
        return Noise(noise.square[self.channels], np.full(len(self.channels), noise.scatter), self.rows, noise.scatter)

    def _parts(self, start: Start) -> _Directions:
        """Products of the fitted numbers and of the directions of a start."""
        mix, known = directions(start, self.found), self.known
        used = np.flatnonzero(mix.any(axis=0))
        own, own_gram, pushed = mix[:, used], self.gram[:, used], self.push
        border = (own @ own_gram[:, :, :known]).transpose(0, 2, 1)
        corner = own @ own_gram[:, :, used] @ own.T
        push = np.concatenate([pushed[:, :known], pushed[:, used] @ own.T], axis=1)
        return _Directions(self.gram_known, border, corner, push, self.square, self.rows)

    def _scored(self, score: Score) -> Score:
        """The candidate's best start, under the alternative."""
        tried = [(*self._under_alternative(score.candidate, start), start) for start in score.candidate.starts]
        gain, values, step, start = max(tried, key=lambda one: one[0])
        return replace(score, gain=gain, values=values, start=start, step=step)

    def _under_alternative(self, candidate: Candidate, start: Start) -> tuple[float, tuple[float, ...], Array]:
        """Improvement of the fit by one start of a candidate, the values it leads to, and the step of the fitted numbers."""
        parts, found, known = self._parts(start), self.found, self.known
        noise = self._white() if len(self.channels) < len(self.products.rows) else self.fit.noise
        for _ in range(ROUNDS):
            x, _ = _step(parts, noise, found, candidate, start)
            noise = self._noise_after(parts, start, x)
        x, values = _step(parts, noise, found, candidate, start)
        matrix, gradient = with_tolerances(*parts.normal(noise.weight), found)
        bare = np.zeros(len(x))
        bare[:known] = bounded_minimum(matrix[:known, :known], gradient[:known], found.low, found.high)
        before, after = (channel_costs(parts.mean_squares(step)) for step in (bare, x))
        priors = [float(found.tight @ (found.away + step[:known]) ** 2) for step in (bare, x)]
        ranges = [2.0 * (v - u.neutral) / (u.high - u.low) for u, v in zip(candidate.unknowns, values, strict=True)]
        improved = float((self.rows / noise.autocorrelation_time) @ (before - after))
        return improved + priors[0] - priors[1] - float(np.square(ranges).sum()), values, x[:known]

    def _noise_after(self, parts: _Directions, start: Start, x: Array) -> Noise:
        """Noise of what is left after a step, the scatter of the runs under it included."""
        known, mix = self.known, directions(start, self.found)
        used = np.flatnonzero(mix.any(axis=0))
        steps, change = x[:known].astype(np.float32), (x[known:] @ mix[:, used]).astype(np.float32)
        left = [
            residual + steps @ columns[:, :known] + change @ columns[:, used]
            for residual, columns in zip(self.residuals, self.columns, strict=True)
        ]
        own = series_times(left)
        scatter = self.fit.noise.scatter
        noise = Noise(parts.mean_squares(x), scatter * own, parts.rows, scatter)
        if len(self.channels) == len(self.products.rows):
            scatter = min(scatter, self._scatter(noise, start, x))
        return Noise(noise.square, scatter * own, parts.rows, scatter)

    def _scatter(self, noise: Noise, start: Start, x: Array) -> float:
        """Scatter of the runs after a step; see :func:`wlr_gym.gap.estimation.fit.widened`."""
        products, known, mix = self.products, self.known, directions(start, self.found)
        used = np.flatnonzero(mix.any(axis=0))
        which, own = np.concatenate([np.arange(known), used]), mix[:, used]
        rows = np.zeros((len(x), len(which)))
        rows[np.arange(known), np.arange(known)] = 1.0
        rows[known:, known:] = own
        border = products.by_run[:, :, used][:, :, :, which]  # symmetric
        inner = noise.weight.astype(np.float32) @ products.by_run_known
        grams = np.zeros((len(border), len(which), len(which)))
        grams[:, :known, :known] = inner.reshape(len(border), known, known)
        grams[:, :, known:] = np.einsum("c,rcmn->rnm", noise.weight, border)
        grams[:, known:, :known] = grams[:, :known, known:].transpose(0, 2, 1)
        matrices = rows @ grams @ rows.T
        vectors = np.einsum("c,rcm->rm", noise.weight, products.push_by_run[:, :, which]) @ rows.T + matrices @ x
        differ = run_scatter(matrices, vectors)
        return np.inf if differ is None else max(self.problem.tempering * noise.scatter * differ, 1.0)


@dataclass(frozen=True, eq=False)
class _Directions:
    """The products of the fitted numbers and a candidate's directions (channels, ...); see :class:`Products`.

    Attributes:
        known: of the fitted numbers' columns.
        border: of those and the directions.
        corner: of the directions.
        push, square, rows: of all columns and the residuals; of the residuals; measured rows.
    """

    known: Array
    border: Array
    corner: Array
    push: Array
    square: Array
    rows: Array

    def normal(self, weight: Array) -> tuple[Array, Array]:
        """Normal equations under weights (channels)."""
        known, border, corner = (np.tensordot(weight, part, 1) for part in (self.known, self.border, self.corner))
        return np.block([[known, border], [border.T, corner]]), weight @ self.push

    def mean_squares(self, x: Array) -> Array:
        """Mean squares (channels) of the residuals after a step (numbers)."""
        known, own = np.split(x, [self.known.shape[1]])
        both = (self.known @ known) @ known + 2.0 * (self.border @ own) @ known + (self.corner @ own) @ own
        total = self.square + 2.0 * self.push @ x + both
        return np.maximum(total, 0.0) / np.maximum(self.rows, 1)


def _step(
    parts: _Directions, noise: Noise, found: Responses, candidate: Candidate, start: Start
) -> tuple[Array, tuple[float, ...]]:
    """Where fitted numbers and directions go together, within bounds and the candidate's plausible range; its values there."""
    known = len(found.tight)
    matrix, gradient = with_tolerances(*parts.normal(noise.weight), found)
    free = np.full(len(gradient) - known, np.inf)
    x = bounded_minimum(matrix, gradient, np.concatenate([found.low, -free]), np.concatenate([found.high, free]))
    values, share = shortened(candidate, start, x[known:], SHARES)
    if share < 1.0:
        x[known:] *= share
        pull = gradient[:known] + matrix[:known, known:] @ x[known:]
        x[:known] = bounded_minimum(matrix[:known, :known], pull, found.low, found.high)
    return x, values
