"""Validation on held-out runs, which no fit has used: how far are replays from measurements?

One decision has used them: effects that they refute are not selected (:func:`confirmed`).

All numbers are root mean square residuals in units of sensor noise, over the channels of a run. A perfect model does not reach
1.0: every window of a replay starts from measured, hence noisy, values. What it does reach is found by replaying data that the
fitted model itself made, with the same sensors (:func:`noise_floor`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.analysis import ChannelGap, GapFigures, RunGap
from wlr_gym.gap.estimation import (
    FittedModel,
    Replayed,
    level,
    mean_of_runs,
    mean_squares,
    minus_two_log_likelihood,
    replay,
    two_sided_95,
)
from wlr_gym.gap.problem import Array, blocks
from wlr_gym.gap.selection.hypotheses import Hypothesis
from wlr_gym.gap.selection.screening import LEAST_GAIN
from wlr_gym.gap.selection.search import SearchResult, without_each

#: Held-out runs that an interval of their mean needs.
LEAST_FOR_INTERVAL = 3
#: Searches, at most, after the first.
MOST_SEARCHES = 2
#: Share by which the error of held-out runs must grow to count against an effect.
LEAST_GROWTH = 0.02
#: Distance from the noise floor below which nothing is left to be removed.
LEAST_ROOM = 1e-9


def confirmed(search: SearchResult, held_out: Sequence[int], again: Callable[[Container[str]], SearchResult]) -> SearchResult:
    """Return the search, none of whose effects runs refute that no fit has used.

    Each effect is judged beside the others. Where one of several is refuted, ``again`` searches without effects of these
    labels: a wrong effect changes what others seem to gain. A single one, or what :data:`MOST_SEARCHES` more find, is left out:
    to try names until one passes would wear the test out.
    """
    refuted: list[Hypothesis] = []
    while (worst := _refuted(search, held_out)) is not None:
        if len(search.fit.model.effects) == 1 or len(refuted) >= MOST_SEARCHES:
            return _left_out(search, refuted)
        refuted += [replace(one, cross_validated=False) for _, one in search.kept if one.candidate.label == worst]
        search = again({one.candidate.label for one in refuted})
    return replace(search, refuted=refuted)


def _left_out(search: SearchResult, refuted: Sequence[Hypothesis]) -> SearchResult:
    """The search without its effects, which count as failing cross-validation."""
    seen = {one: replace(one, cross_validated=False) for _, one in search.kept}
    rounds = []
    for look in search.rounds:
        selected = None if look.selected is None else seen.get(look.selected, look.selected)
        rounds.append(replace(look, hypotheses=[seen.get(one, one) for one in look.hypotheses], selected=selected))
    last = max(k for k, look in enumerate(search.rounds, 1) if look.selected in seen)
    return SearchResult(search.calibrated, search.calibrated, rounds[:last], {}, refuted)


def _refuted(search: SearchResult, held_out: Sequence[int]) -> str | None:
    """Label of the effect that the held-out runs refute most; None: none of them."""
    effects, tau = search.fit.model.effects, search.fit.noise.autocorrelation_time
    if not effects:
        return None
    without = [search.calibrated] if len(effects) == 1 else without_each(search.fit)
    *before, after = replay([one.model for one in (*without, search.fit)], held_out)
    beyond = [_beyond_need(one, after, tau) for one in before]
    return effects[int(np.argmin(beyond))][0].label if min(beyond) < 0.0 else None


def _beyond_need(before: Replayed, after: Replayed, autocorrelation_time: Array) -> float:
    """How much more the held-out runs gain by an effect, in minus two log likelihood, than they must.

    By chance they may lose, but not as much as an effect must gain to be selected (:data:`LEAST_GAIN`). Where their error
    clearly grows, they must gain as much.
    """
    was, now = (level(mean_squares(one.residuals, one.problem.cap)) for one in (before, after))
    least = LEAST_GAIN if now > (1.0 + LEAST_GROWTH) * was else -LEAST_GAIN
    gained = minus_two_log_likelihood(before.residuals, autocorrelation_time)
    return gained - minus_two_log_likelihood(after.residuals, autocorrelation_time) - least


def noise_floor(model: FittedModel, runs: Sequence[int]) -> float:
    """Return the level that a model reaches on runs that it made itself, with the same sensors; NaN where it breaks down."""
    made = next(model.problem.remade(model.setting, runs, 1), None)
    return math.nan if made is None else level(mean_squares(made, model.problem.cap))


def compare_models(
    models: Sequence[FittedModel], fitted: Sequence[int], heldout: Sequence[int], floor: float
) -> tuple[GapFigures, tuple[RunGap, ...], tuple[ChannelGap, ...]]:
    """Compare three models on fitted and held-out runs.

    ``models``: as its file says; calibrated; with the effects. ``floor``: level that a perfect model reaches.
    """
    problem = models[0].problem
    found = replay(models, [*fitted, *heldout])
    squares = [mean_squares(one.residuals, problem.cap) for one in found]
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
        min(reduction(squares[1][outside], squares[2][outside], floor), 1.0),
        _interval(squares[1][outside], squares[2][outside], floor),
        problem.cap,
    )
    gaps = []
    for k, run in enumerate((*fitted, *heldout)):
        closed = min(reduction(squares[1][k], squares[2][k], floor), 1.0)
        gaps.append(RunGap(problem.runs[run], k >= len(fitted), *(level(s[k]) for s in squares), reduction=closed))
    worse = worse_channels(*(replace(one, runs=heldout, residuals=one.residuals[outside]) for one in found[1:]))
    levels = np.sqrt([mean_of_runs(s[outside]) for s in squares])
    channels = tuple(
        ChannelGap(signal.name, signal.unit, signal.noise, *levels[:, c].tolist(), group=signal.group, worse=bool(worse[c]))
        for c, signal in enumerate(problem.signals)
        if np.isfinite(squares[0][outside][:, c]).any()
    )
    return figures, tuple(gaps), channels


def reduction(calibrated: Array, after: Array, floor: float) -> float:
    """Return the share of the gap above the floor that the effects close: negative where they make it larger.

    ``(L_c - L_a) / (L_c - floor)`` of the levels of all runs given; NaN where calibration leaves nothing to be closed.
    """
    room = level(calibrated) - floor
    return (level(calibrated) - level(after)) / room if room > LEAST_ROOM else math.nan


def _interval(calibrated: Array, after: Array, floor: float) -> tuple[float, float]:
    """95 % interval of the reduction; NaN where the runs are too few.

    Student's t interval with the jackknife's standard error: ``R +- t(n-1) sqrt((n-1)/n sum (R_k - mean R_k)^2)``, with R_k the
    reduction without run k. R counts 1 at most, as it is reported; only the upper end is cut off at 1: an interval that lies
    above it would have no width otherwise.
    """
    count = len(calibrated)
    if count < LEAST_FOR_INTERVAL:
        return math.nan, math.nan
    left_out = np.array([reduction(np.delete(calibrated, k, axis=0), np.delete(after, k, axis=0), floor) for k in range(count)])
    error = math.sqrt((count - 1) / count * float(((left_out - left_out.mean()) ** 2).sum()))
    whole, half = reduction(calibrated, after, floor), two_sided_95(count - 1) * error
    if not math.isfinite(whole + half):
        return math.nan, math.nan
    return min(whole, 1.0) - half, min(whole + half, 1.0)


# ---- channels that effects make worse --------------------------------------------------------------------------------

#: Bootstrap samples of the blocks.
SAMPLES = 2000
#: Share by which a channel's mean square must rise.
LEAST_RISE = 0.02
#: Share of the samples in which it must rise.
CONFIDENCE = 0.99


def worse_channels(calibrated: Replayed, after: Replayed) -> NDArray[np.bool_]:
    """Return which channels (signals) the effects make significantly worse in the held-out runs.

    The mean square rises by more than :data:`LEAST_RISE`, and rises in :data:`CONFIDENCE` of the samples of blocks of 2 s,
    drawn with replacement: residuals within a block depend on each other.
    """
    before = _block_squares(calibrated)
    rise = _block_squares(after) - before
    picks = np.random.default_rng(0).integers(0, len(rise), (SAMPLES, len(rise)))
    counts = np.stack([np.bincount(pick, minlength=len(rise)) for pick in picks])
    certain = np.quantile(counts @ rise, 1.0 - CONFIDENCE, axis=0) > 0.0
    return certain & (rise.sum(axis=0) > LEAST_RISE * before.sum(axis=0))


def _block_squares(found: Replayed) -> Array:
    """Sums of squares (blocks of all runs, signals); what is beyond the problem's cap counts as that."""
    sums = []
    for run, residual in zip(found.runs, found.residuals, strict=True):
        squares = np.nan_to_num(np.minimum(residual**2, found.problem.cap**2))
        sums += [squares[rows].sum(axis=0) for rows in blocks(found.problem.times(run))]
    return np.stack(sums)


# ---- runs that are replayed worst ------------------------------------------------------------------------------------


def most_left(fitted: float | None, runs: Iterable[RunGap]) -> tuple[float, str]:
    """Return the largest error, and of which held-out run it is; "" = of the fitted runs together.

    Fitted runs count together, as the fit sees them. Held-out ones count one by one: a single motion may show what is missing.
    """
    held_out = [(one.after, one.run) for one in runs if one.heldout and math.isfinite(one.after)]
    return max([(fitted or 0.0, ""), *held_out], key=lambda one: one[0])


def most_in(channels: Iterable[ChannelGap]) -> str:
    """Return the channel of which most noise units are left in the held-out runs."""
    return max((one for one in channels if math.isfinite(one.after)), key=lambda one: one.after).channel
