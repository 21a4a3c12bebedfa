"""Hypotheses: candidates refitted together with all calibrated parameters; how probable each is, and what explains as much.

Many are refitted at once (:func:`refit`), with responses that are known, or corrected by the steps.

Probabilities are Bayesian model evidence (Laplace's approximation), with "none of these" among the models. Minus two log
evidence of a model is its cost, which holds the prior's exponent, plus the log determinant of its curvature, less that of its
prior. What all models share cancels: beside the model without a further effect an effect has its gain, less what its unknowns
could have been and are not (Occam's factor): ``ln det(1 + I / P)`` with the information I that the data hold of them,
calibrated parameters projected out, and the precision P of their prior. Likelihood and prior are tempered as in the fit. Kass
and Raftery (1995) is the review.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.jobs import in_threads
from wlr_gym.gap.estimation import (
    CONVERGED,
    Columns,
    Fit,
    FittedModel,
    Noise,
    Replayed,
    by_channel,
    estimate_noise,
    fit,
    replay,
)
from wlr_gym.gap.problem import Array, Candidate, Setting
from wlr_gym.gap.selection.screening import LEAST_GAIN, Score, asked_of

#: An effect that helps some runs and harms others is none: harm, as a share of the help, that is put down to chance.
MOST_HARM = 0.2
#: Fall of minus two log posterior that outweighs what is known beforehand of the size of an effect, or what other runs lack.
INSISTENT = 160.0
#: Of an unknown that meets no calibrated parameter, what counts as an effect, in its steps.
NOTICED = 0.25


@dataclass(frozen=True, eq=False)
class Hypothesis(Replayed):
    """One candidate after its refit: the model with the effect as its last, and what it leaves.

    Attributes:
        base: the model without the effect, refitted as long.
        gain: fall of minus two log posterior.
        by_run: (runs) fall of the weighted squares in each run.
        predicted_gain: the improvement that the score test predicted.
        cross_validated: whether runs are replayed better by a fit to the other runs (checked for finalists only).
        tolerable: whether the tolerances of calibrated parameters allow as much.
        occam: what its unknowns cost beside its gain (:func:`occam`).
    """

    base: Replayed = field(repr=False)
    gain: float
    by_run: Array
    predicted_gain: float
    cross_validated: bool = True
    tolerable: bool = False
    occam: float = 0.0

    @property
    def candidate(self) -> Candidate:
        """The effect."""
        return self.model.effects[-1][0]

    @property
    def values(self) -> tuple[float, ...]:
        """Values of the candidate's unknowns."""
        return self.model.effects[-1][1]

    @property
    def at_bound(self) -> bool:
        """Whether an unknown ended at the edge of its plausible range (other than its neutral value)."""
        for unknown, value in zip(self.candidate.unknowns, self.values, strict=True):
            low, high = unknown.bounds
            too_much = value >= high - 1e-9 * abs(high) and high != unknown.neutral
            if too_much or (value <= low + 1e-9 * abs(low) and low != unknown.neutral):
                return True
        return False

    @property
    def plausible(self) -> bool:
        """Whether its size is one that a robot may have, and more than tolerances allow, and the runs agree.

        At the edge of what a robot may have it is, too, where the data insist.
        """
        inside = not self.at_bound or self.gain > INSISTENT
        return inside and not self.tolerable and self.consistent and self.cross_validated

    @property
    def consistent(self) -> bool:
        """Whether the runs agree that it is there."""
        help_, harm = self.by_run.clip(min=0.0).sum(), -self.by_run.clip(max=0.0).sum()
        return bool(harm <= MOST_HARM * help_)


def within_tolerance(model: FittedModel) -> bool:
    """Whether the tolerances of the numbers that the last effect meets allow what number and effect do together."""
    candidate, values = model.effects[-1]
    if not any(candidate.tolerances):
        return False
    known = {q.name: (q, value) for q, value in zip(model.problem.quantities, model.quantities, strict=True)}
    for unknown, value, tolerance in zip(candidate.unknowns, values, candidate.tolerances, strict=True):
        if tolerance is None:
            if abs(value - unknown.neutral) > NOTICED * unknown.step:
                return False
            continue
        for quantity, now in (known[name] for name in tolerance.quantities):
            shift = (value - quantity.nominal) / tolerance.size
            if not tolerance.replaces:
                shift = (now - quantity.nominal) / quantity.sigma + (value - unknown.neutral) / tolerance.size
            if abs(shift) > tolerance.reach:
                return False
    return True


def fall_by_run(before: Sequence[Array], after: Sequence[Array], noise: Noise) -> Array:
    """Fall of the weighted squares in each run."""
    return np.array([np.nansum((b * b - a * a) * noise.weight) for b, a in zip(before, after, strict=True)])


# ---- probability -----------------------------------------------------------------------------------------------------

#: Prior probability that nothing is missing; the names share the rest, and the places of a name share its part.
NOTHING = 0.5
#: Probability of the set of names that the data do not distinguish.
CREDIBLE = 0.95
#: Least precision of a prior, of amplitudes in probes: a direction that hardly moves an unknown is not unbounded.
LEAST_PRECISION = 1e-3


def occam(score: Score, tempering: float) -> float:
    """Return by how much a candidate's unknowns are known better by the data than beforehand: ``ln det(1 + I / P)``."""
    start, unknowns, size = score.start, score.candidate.unknowns, len(score.information)
    if len(start.directions) != size:  # it was scored with another start
        size = min(size, len(start.directions))
    nothing = np.array(start.values(np.zeros(len(start.directions))))
    slopes = np.stack([np.array(start.values(own)) - nothing for own in np.eye(len(start.directions))[:size]], axis=1)
    precision = tempering * np.array([4.0 / (u.high - u.low) ** 2 for u in unknowns])
    prior = slopes.T @ (precision[:, None] * slopes) + LEAST_PRECISION * np.eye(size)
    data = 0.5 * (score.information + score.information.T)[:size, :size]
    return float(np.linalg.slogdet(prior + data)[1] - np.linalg.slogdet(prior)[1])


def probabilities(hypotheses: Sequence[Hypothesis], scores: Sequence[Score]) -> tuple[list[float], float]:
    """Return the probability of each hypothesis, and that of none of them.

    Args:
        hypotheses: refitted; what tolerances allow is no effect and has none.
        scores: of all candidates of the round: how many names and places there are.
    """
    places = Counter(score.candidate.name for score in scores)
    logs = [np.log(NOTHING)]
    for one in hypotheses:
        shared = (1.0 - NOTHING) / max(len(places), 1) / max(places[one.candidate.name], 1)
        logs.append(-np.inf if one.tolerable else np.log(shared) + 0.5 * (one.gain - one.occam))
    weights = np.exp(np.array(logs) - max(logs))
    shares = (weights / weights.sum()).tolist()
    return shares[1:], shares[0]


def credible_names(hypotheses: Sequence[Hypothesis], shares: Sequence[float]) -> list[str]:
    """Return the smallest set of names that together have :data:`CREDIBLE` of what all names have, most probable first."""
    total: dict[str, float] = {}
    for one, share in zip(hypotheses, shares, strict=True):
        total[one.candidate.name] = total.get(one.candidate.name, 0.0) + share
    found, reached, whole = [], 0.0, sum(total.values())
    for name in sorted(total, key=lambda name: -total[name]):
        if reached >= CREDIBLE * whole:
            break
        found.append(name)
        reached += total[name]
    return found


# ---- bootstrap and equivalence ---------------------------------------------------------------------------------------

#: Bootstrap samples of the runs.
SAMPLES = 500
#: Two effects are equivalent if the second improves the fit by at least this share of what the first does.
EQUIVALENT = 0.93
#: A rival that improves the fit by this share is equivalent unless the runs agree that it is worse ...
RIVAL = 0.75
#: ... by this many standard errors.
AGREED = 2.0


def selection_frequency(selected: Hypothesis, others: Sequence[Hypothesis], threshold: float = LEAST_GAIN) -> float:
    """Return the share of bootstrap samples of the runs in which the selected effect is accepted and no other fits better.

    A run counts by its part in the gain, as fitted to all runs: no sample is refitted. ``threshold``: see
    :func:`wlr_gym.gap.selection.screening.asked_of`.
    """
    rng = np.random.default_rng(0)
    rivals = [other for other in others if other.candidate.name != selected.candidate.name and not other.tolerable]
    picks = rng.integers(0, len(selected.by_run), (SAMPLES, len(selected.by_run)))
    parts = _parts(selected)[picks]
    gains = parts.sum(axis=1)
    agreed = -parts.clip(max=0.0).sum(axis=1) <= MOST_HARM * parts.clip(min=0.0).sum(axis=1)
    wins = agreed & (gains >= asked_of(selected.candidate, threshold))
    for rival in rivals:
        wins &= gains >= _parts(rival)[picks].sum(axis=1)
    return float(wins.mean())


def _parts(hypothesis: Hypothesis) -> Array:
    """The runs' parts (runs) in the gain of a hypothesis: their falls of squares, scaled to it."""
    total = float(hypothesis.by_run.sum())
    return hypothesis.by_run * (hypothesis.gain / total) if total > 0.0 < hypothesis.gain else hypothesis.by_run


def equivalents(selected: Hypothesis, others: Sequence[Hypothesis], credible: Sequence[str] = ()) -> list[Hypothesis]:
    """Return the best hypothesis of every other name that the data cannot distinguish from the selected one.

    ``credible``: names that cannot be left out of a set with 95 % of the probability.
    """
    found: dict[str, Hypothesis] = {}
    for other in others:
        name = other.candidate.name
        possible = name != selected.candidate.name and not other.at_bound and not other.tolerable
        if possible and (name in credible or _as_good(selected, other)):
            found.setdefault(name, other)
    return list(found.values())


def _as_good(selected: Hypothesis, other: Hypothesis) -> bool:
    """Whether another hypothesis improves the fit by nearly as much, or the runs do not agree that it does by less."""
    if other.gain > EQUIVALENT * selected.gain or selected.gain - other.gain < 0.25 * LEAST_GAIN:
        return True
    ahead = selected.by_run - other.by_run
    spread = float(ahead.std(ddof=1)) / np.sqrt(len(ahead)) if len(ahead) > 1 else 0.0
    return bool(other.gain > RIVAL * selected.gain and ahead.mean() < AGREED * spread)


# ---- refits ----------------------------------------------------------------------------------------------------------

#: Rounds of refitting.
ROUNDS = 6
#: Shares of a step that a refit tries.
TRIED = (2.0, 1.0, 0.5, 0.2)
#: Share of the best hypothesis' improvement by which one start may be behind another of the same before it is given up.
BEHIND = 0.5
#: A hypothesis with less than this share of the best's improvement ...
HOPELESS = 0.4
#: ... after this many steps is not improved any further.
PATIENCE = 2
#: Hypotheses whose calibrated parameters the model without an effect more tries too.
NUDGES = 2


@dataclass(frozen=True, eq=False)
class _Trial(Replayed):
    """One start of a hypothesis' refit, and the best so far.

    Attributes:
        of: which hypothesis; -1 = none, the model without an effect more.
        known: columns of the numbers that all hypotheses share, where the trial started; what its effect replaces does nothing.
        whole: the same, with those that its effect replaces.
        corrections: of ``known``, one per step taken (Broyden): a direction (numbers) of these numbers, and by what residuals
            change more along it, one (rows, channels) per run.
        converged: whether another step gains nothing.
    """

    of: int
    known: Columns = field(repr=False)
    whole: Columns = field(repr=False)
    corrections: tuple[tuple[Array, list[Array]], ...] = field(default=(), repr=False)
    converged: bool = False


def refit(current: Fit, scores: Sequence[Score], given: Columns) -> list[Hypothesis]:
    """Refit every hypothesis together with all calibrated parameters; best first.

    Each starts twice: from the calibrated model with its first guess, and from the model as given with its probe, as
    calibration may have compensated the effect and stay there. The responses of the calibrated parameters are those of the
    two starts; those of each hypothesis' own unknowns are simulated anew. The model without an effect more is refitted too,
    in the end also from where the best hypotheses are: the cost is rough, any small change may leave a local minimum, and then
    it is no evidence for the effect that made it.

    ``given``: columns of ``current`` without its calibration.
    """
    if not scores:
        return []
    trials = _descended(current, _simulated(_starts(current, scores, given)))
    autocorrelation_time = _best_autocorrelation_time(current, trials)
    best: dict[int, _Trial] = {}
    for trial in sorted(trials, key=lambda one: one.cost_under(autocorrelation_time)):
        if trial.of >= 0:
            best.setdefault(trial.of, trial)
    free = [replace(t, of=-1, model=t.model.without_effect(-1), converged=False) for t in list(best.values())[:NUDGES]]
    plain = _simulated([t if t.known is t.whole else replace(t, known=t.whole, corrections=()) for t in free])
    trials += [
        trial for own in in_threads(current.problem.threads, lambda one: _descended(current, [one]), plain) for trial in own
    ]
    autocorrelation_time = _best_autocorrelation_time(current, trials)
    costs = {id(trial): trial.cost_under(autocorrelation_time) for trial in trials}
    found = [min((t for t in trials if t.of == of), key=lambda t: costs[id(t)]) for of in (*range(len(scores)), -1)]
    return _ranked(scores, found[:-1], found[-1], autocorrelation_time)


def refit_thoroughly(current: Fit, scores: Sequence[Score]) -> list[Hypothesis]:
    """Fit every hypothesis in full, from its first guess and from its first two probes; best first."""
    noise = current.noise

    def whole(model: FittedModel) -> Fit:
        return fit(model, current.runs, autocorrelation_time=noise.autocorrelation_time, scatter=noise.scatter)

    fits = []
    for score in scores:
        candidate = score.candidate
        starts = dict.fromkeys((score.values, *(candidate.probed(start) for start in candidate.starts[:2])))
        tried = [whole(current.model.with_effect(candidate, values)) for values in starts]
        fits.append(min(tried, key=lambda found: found.cost))
    base = whole(current.model)
    return _ranked(scores, fits, base, _best_autocorrelation_time(current, [*fits, base]))


def _ranked(
    scores: Sequence[Score], found: Sequence[Replayed], base: Replayed, autocorrelation_time: Array
) -> list[Hypothesis]:
    """Hypotheses from what was refitted with each and, ``base``, without any; best first."""
    base = Replayed(base.model, base.runs, base.residuals)
    before, hypotheses = base.cost_under(autocorrelation_time), []
    for score, one in zip(scores, found, strict=True):
        by_run = fall_by_run(base.residuals, one.residuals, estimate_noise(one.residuals, autocorrelation_time))
        gain, tolerable = before - one.cost_under(autocorrelation_time), within_tolerance(one.model)
        cost = occam(score, one.problem.tempering)
        own = Hypothesis(one.model, one.runs, one.residuals, base, gain, by_run, score.gain, tolerable=tolerable, occam=cost)
        hypotheses.append(own)
    return sorted(hypotheses, key=lambda hypothesis: -hypothesis.gain)


def _best_autocorrelation_time(current: Fit, trials: Sequence[Replayed]) -> Array:
    """Autocorrelation time of what the best trial leaves: the same for all that are compared.

    The best is the one that improves the fit most under its own autocorrelation time: under that of a model without it, an
    effect that lasts counts as few readings.
    """
    bare = [one for one in trials if isinstance(one, _Trial) and one.of < 0] or [current]

    def own_gain(trial: Replayed) -> tuple[float, Array]:
        own = estimate_noise(trial.residuals, scatter=current.noise.scatter).autocorrelation_time
        return min(one.cost_under(own) for one in bare) - trial.cost_under(own), own

    gain, best = max(in_threads(current.problem.threads, own_gain, trials), key=lambda found: found[0])
    return best if gain > 0.0 else current.noise.autocorrelation_time


# ---- trials ----------------------------------------------------------------------------------------------------------


def _starts(current: Fit, scores: Sequence[Score], given: Columns) -> list[_Trial]:
    """Where refits begin. The model as given keeps the effects found before."""
    as_given = current.model.untouched()
    trials = [_Trial(current.model, current.runs, [], -1, current.columns, current.columns)]
    for k, score in enumerate(scores):
        candidate = score.candidate
        replaced = [row for row, one in enumerate(current.problem.quantities) if one.name in candidate.replaced]
        beside = current.model if score.step is None else current.model.moved(score.step)
        probed = as_given.with_effect(candidate, candidate.probed(candidate.starts[0]))
        for model, known in ((beside.with_effect(candidate, score.values), current.columns), (probed, given)):
            trials.append(_Trial(model, current.runs, [], k, _silenced(known, replaced), known))
    return trials


def _silenced(known: Columns, rows: Sequence[int]) -> Columns:
    """Columns of the calibrated parameters; those that a candidate replaces are zero beside it."""
    if not rows:
        return known
    silent = [column.copy() for column in known]
    for column in silent:
        column[rows] = 0.0
    return silent


def _simulated(trials: Sequence[_Trial]) -> list[_Trial]:
    """The trials with the residuals of their models."""
    found = replay([trial.model for trial in trials], trials[0].runs)
    return [replace(trial, residuals=one.residuals) for trial, one in zip(trials, found, strict=True)]


def _descended(current: Fit, trials: list[_Trial]) -> list[_Trial]:
    """The trials after :data:`ROUNDS` steps; those that are far behind are removed or no longer improved."""
    kinds = {id(trial.known): trial.known for trial in trials}
    products = {key: _channel_products(known, current) for key, known in kinds.items()}
    for done in range(ROUNDS):
        autocorrelation_time = _best_autocorrelation_time(current, trials)
        if done >= PATIENCE:  # what is far behind the best counts as converged
            _, least = _least_costs(trials, autocorrelation_time)
            enough = HOPELESS * (least[-1] - min(least.values()))
            trials = [replace(t, converged=t.converged or (t.of >= 0 and least[-1] - least[t.of] < enough)) for t in trials]
        going = [trial for trial in trials if not trial.converged]
        if not going:
            break
        both = [*(trial for trial in trials if trial.converged), *_improved(current, going, products)]
        costs, least = _least_costs(both, autocorrelation_time)
        room = max(max(least.values()) - min(least.values()), LEAST_GAIN)
        trials = [t for cost, t in zip(costs, both, strict=True) if cost - least[t.of] < BEHIND * room]  # the better start
    return trials


def _least_costs(trials: Sequence[_Trial], autocorrelation_time: Array) -> tuple[list[float], dict[int, float]]:
    """Costs of the trials, and of the best trial of each hypothesis."""
    costs = [trial.cost_under(autocorrelation_time) for trial in trials]
    return costs, {of: min(c for c, t in zip(costs, trials, strict=True) if t.of == of) for of in {t.of for t in trials}}


def _channel_products(columns: Columns, current: Fit) -> Array:
    """``C C^T`` of each channel alone (channels, numbers, numbers), over all runs: weights come later."""

    def of_one(column: NDArray[np.float32]) -> NDArray[np.float32]:
        own = by_channel(column, len(current.problem.signals))
        return own @ own.transpose(0, 2, 1)

    return np.stack(in_threads(current.problem.threads, of_one, columns)).sum(axis=0, dtype=np.float64)


def _improved(current: Fit, trials: Sequence[_Trial], products: Mapping[int, Array]) -> list[_Trial]:
    """The trials one Gauss-Newton step on, each under the noise of its own residuals.

    Under that of a model without its effect, an effect that lasts would count as few readings and stay where it began.

    ``products``: of the known columns of trials, channel by channel, by the columns' id.
    """
    owns = _own_columns(trials)

    def proposed(one: tuple[_Trial, list[Array]]) -> tuple[Noise, list[_Trial]]:
        trial, own = one
        noise = estimate_noise(trial.residuals, scatter=current.noise.scatter)
        change = trial.model.step(*_equations(np.tensordot(noise.weight, products[id(trial.known)], 1), trial, own, noise))
        return noise, [replace(trial, model=trial.model.moved(share * change)) for share in TRIED]

    steps = in_threads(current.problem.threads, proposed, zip(trials, owns, strict=True))
    tries = iter(_simulated([each for _, own in steps for each in own]))
    shared = [[next(tries) for _ in TRIED] for _ in trials]

    def best(one: tuple[_Trial, list[Array], tuple[Noise, list[_Trial]], list[_Trial]]) -> _Trial:
        trial, own, (noise, _), tried = one
        before, *costs = (each.cost_under(noise.autocorrelation_time) for each in (trial, *tried))
        gained = before - min(costs)
        better = _corrected(trial, own, tried[int(np.argmin(costs))]) if gained > 0.0 else trial
        return replace(better, converged=gained < CONVERGED)

    return in_threads(current.problem.threads, best, zip(trials, owns, steps, shared, strict=True))


def _own_columns(trials: Sequence[_Trial]) -> list[list[Array]]:
    """Responses of each trial's last effect's unknowns, scaled by their steps: per trial, per run, (unknowns, rows, channels).

    Only those of the last effect are simulated anew: the others' are among the known columns.
    """
    settings: list[Setting] = []
    taken: list[list[float]] = []
    for trial in trials:
        taken.append([])
        if trial.of < 0:
            continue
        candidate, values = trial.model.effects[-1]
        for k, unknown in enumerate(candidate.unknowns):
            step = unknown.step if values[k] + unknown.step <= unknown.bounds[1] else -unknown.step
            changed = tuple(v + step * (i == k) for i, v in enumerate(values))
            settings.append(trial.model.without_effect(-1).with_effect(candidate, changed).setting)
            taken[-1].append(step / unknown.step)
    if not settings:
        return [[np.zeros((0, *residual.shape)) for residual in trial.residuals] for trial in trials]
    found = trials[0].problem.residuals(settings, trials[0].runs)
    columns, at = [], 0
    for trial, steps in zip(trials, taken, strict=True):
        mine = [r[at : at + len(steps)] for r in found]
        scale = np.array(steps)[:, None, None]
        columns.append([np.nan_to_num((r - base) / scale) for r, base in zip(mine, trial.residuals, strict=True)])
        at += len(steps)
    return columns


def _equations(matrix: Array, trial: _Trial, own: Sequence[Array], noise: Noise) -> tuple[Array, Array]:
    """Normal equations of a trial's numbers: the calibrated ones' matrix is given, its corrections are so many columns more."""
    size, more = len(matrix), len(trial.corrections)
    root, across, inner = np.sqrt(noise.weight), 0.0, []
    for r, (known, residual) in enumerate(zip(trial.known, trial.residuals, strict=True)):
        both = np.concatenate([own[r], *(missed[r][None] for _, missed in trial.corrections), residual[None]])
        weighted = (np.nan_to_num(both) * noise.weight).reshape(len(both), -1).astype(np.float32)
        across = across + known @ weighted.T
        flat = np.nan_to_num(both * root).reshape(len(both), -1)
        inner.append(flat @ flat.T)
    across, inside = np.asarray(across, np.float64), np.sum(inner, axis=0)
    wide = np.block([[matrix, across[:, :-1]], [across[:, :-1].T, inside[:-1, :-1]]])
    push = np.concatenate([across[:, -1], inside[:-1, -1]])
    mix = np.eye(len(wide) - more, len(wide))
    for k, (direction, _) in enumerate(trial.corrections):
        mix[:size, len(wide) - more + k] = direction
    return mix @ wide @ mix.T, mix @ push


def _corrected(before: _Trial, own: Sequence[Array], after: _Trial) -> _Trial:
    """The trial after a step, its known columns corrected by what the step did beyond what they and its own had predicted."""
    taken = after.model.scaled - before.model.scaled
    known, rest = np.split(taken, [len(before.known[0])])
    length = float(known @ known)
    if length < 1e-9:
        return after
    shares = [known @ direction for direction, _ in before.corrections]
    missed = []
    for r, (old, new) in enumerate(zip(before.residuals, after.residuals, strict=True)):
        predicted = (known.astype(np.float32) @ before.known[r]).reshape(old.shape) + np.tensordot(rest, own[r], 1)
        for share, (_, beyond) in zip(shares, before.corrections, strict=True):
            predicted += share * beyond[r]
        missed.append((np.nan_to_num(new - old) - predicted) / length)
    return replace(after, corrections=(*before.corrections, (known, missed)))
