"""Refit hypotheses together with all calibrated parameters: many at once, with responses known or corrected by the steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.jobs import in_threads
from wlr_gym.gap.estimation.fit import CONVERGED, Fit, channel_products, constrained_step, cross_products, fit
from wlr_gym.gap.estimation.model import FittedModel, Noise, estimate_noise, moved, scaled_numbers, total_cost, untouched
from wlr_gym.gap.problem import Candidate, Problem, Setting
from wlr_gym.gap.selection.hypothesis import Hypothesis, fall_by_run, occam, within_tolerance
from wlr_gym.gap.selection.screening import LEAST_GAIN, Score

Array = NDArray[np.float64]

#: Rounds of refitting.
ROUNDS = 6
#: Shares of a step that a refit tries.
TRIED = (2.0, 1.0, 0.5, 0.2)
#: Share of the best hypothesis' improvement by which one start may be behind another of the same before it is given up.
BEHIND = 0.5
#: A hypothesis with less than this share of the best's improvement ...
HOPELESS = 0.4
#: ... after so many steps is not improved any further.
PATIENCE = 2
#: Hypotheses whose calibrated parameters the model without an effect more tries too.
NUDGES = 2


@dataclass(frozen=True, eq=False)
class _Trial:
    """One start of a hypothesis' refit, and how far it got.

    Attributes:
        of: which hypothesis; -1 = none, the model without an effect more.
        known: columns of the numbers that all hypotheses share, where the trial started; what its effect replaces does nothing.
        whole: the same, with those that its effect replaces.
        model, residuals: the best so far.
        corrections: of ``known``, one per step taken (Broyden): a direction (numbers) of these numbers, and by what residuals
            change more along it, one (rows, channels) per run.
        converged: whether another step gains nothing.
    """

    of: int
    known: Sequence[NDArray[np.float32]] = field(repr=False)
    whole: Sequence[NDArray[np.float32]] = field(repr=False)
    model: FittedModel
    residuals: list[Array] = field(default_factory=list, repr=False)
    corrections: tuple[tuple[Array, list[Array]], ...] = field(default=(), repr=False)
    converged: bool = False


def refit(
    problem: Problem,
    runs: Sequence[int],
    current: Fit,
    scores: Sequence[Score],
    given: Sequence[NDArray[np.float32]],
    rounds: int = ROUNDS,
) -> list[Hypothesis]:
    """Refit every hypothesis together with all calibrated parameters; best first.

    Each starts twice: from the calibrated model with its first guess, and from the model as given with its probe, as
    calibration may have compensated the effect and stay there. The responses of the calibrated parameters are those of the
    two starts; those of each hypothesis' own unknowns are simulated anew. The model without an effect more is refitted too,
    in the end also from where the best hypotheses are.

    ``given``: columns of ``current`` without its calibration, one (numbers, rows x channels) array per run.
    """
    if not scores:
        return []
    trials = _simulated(problem, _starts(problem, current, scores, given), runs)
    trials = _descended(problem, runs, current, trials, rounds)
    plain = _simulated(problem, _without_effect(problem, current, trials), runs)
    nudged = in_threads(problem.threads, lambda one: _descended(problem, runs, current, [one], rounds), plain)
    trials += [trial for own in nudged for trial in own]
    autocorrelation_time = _best_autocorrelation_time(problem, current, trials)
    costs = [total_cost(problem, t.model, t.residuals, autocorrelation_time) for t in trials]
    best = [
        trials[min((k for k, t in enumerate(trials) if t.of == of), key=lambda k: costs[k])] for of in (*range(len(scores)), -1)
    ]
    return _ranked(problem, scores, [t.model for t in best], [t.residuals for t in best], autocorrelation_time)


def _descended(problem: Problem, runs: Sequence[int], current: Fit, trials: list[_Trial], rounds: int) -> list[_Trial]:
    """The trials after so many steps; those that are far behind are removed or no longer improved."""
    kinds = {id(trial.known): trial.known for trial in trials}
    products = {key: channel_products(known, len(problem.signals), problem.threads) for key, known in kinds.items()}
    for done in range(rounds):
        autocorrelation_time = _best_autocorrelation_time(problem, current, trials)
        if done >= PATIENCE:  # what is far behind the best counts as converged
            _, least = _least_costs(problem, trials, autocorrelation_time)
            enough = HOPELESS * (least[-1] - min(least.values()))
            trials = [replace(t, converged=t.converged or (t.of >= 0 and least[-1] - least[t.of] < enough)) for t in trials]
        going = [trial for trial in trials if not trial.converged]
        if not going:
            break
        moved_on = _improved(problem, runs, current, going, products)
        both = [*(trial for trial in trials if trial.converged), *moved_on]
        costs, least = _least_costs(problem, both, autocorrelation_time)
        room = max(max(least.values()) - min(least.values()), LEAST_GAIN)
        trials = [t for cost, t in zip(costs, both, strict=True) if cost - least[t.of] < BEHIND * room]  # the better start
    return trials


def _without_effect(problem: Problem, current: Fit, trials: Sequence[_Trial]) -> list[_Trial]:
    """The model without an effect more, where the best hypotheses have moved the calibrated parameters.

    The cost is rough: any small change may leave a local minimum, and then it is no evidence for the effect that made it.
    """
    autocorrelation_time = _best_autocorrelation_time(problem, current, trials)
    best: dict[int, _Trial] = {}
    for trial in sorted(trials, key=lambda t: total_cost(problem, t.model, t.residuals, autocorrelation_time)):
        if trial.of >= 0:
            best.setdefault(trial.of, trial)
    free = [replace(t, of=-1, model=t.model.without_effect(-1), converged=False) for t in list(best.values())[:NUDGES]]
    return [t if t.known is t.whole else replace(t, known=t.whole, corrections=()) for t in free]


def _improved(
    problem: Problem, runs: Sequence[int], current: Fit, trials: Sequence[_Trial], products: Mapping[int, Array]
) -> list[_Trial]:
    """The trials one Gauss-Newton step on, each under the noise of its own residuals.

    Under that of a model without its effect, an effect that lasts would count as few readings and stay where it began.

    ``products``: of the known columns of trials, channel by channel, by the columns' id.
    """
    owns = _own_columns(problem, trials, runs)

    def proposed(one: tuple[_Trial, list[Array]]) -> tuple[Noise, list[_Trial]]:
        trial, own = one
        noise = estimate_noise(trial.residuals, scatter=current.noise.scatter)
        equations = _equations(np.tensordot(noise.weight, products[id(trial.known)], 1), trial, own, noise)
        change = constrained_step(problem, trial.model, *equations)
        return noise, [replace(trial, model=moved(problem, trial.model, share * change)) for share in TRIED]

    steps = in_threads(problem.threads, proposed, zip(trials, owns, strict=True))
    tries = iter(_simulated(problem, [each for _, own in steps for each in own], runs))
    shared = [[next(tries) for _ in TRIED] for _ in trials]

    def best(one: tuple[_Trial, list[Array], tuple[Noise, list[_Trial]], list[_Trial]]) -> _Trial:
        trial, own, (noise, _), tried = one
        before, *costs = (total_cost(problem, t.model, t.residuals, noise.autocorrelation_time) for t in (trial, *tried))
        gained = before - min(costs)
        better = _corrected(problem, trial, own, tried[int(np.argmin(costs))]) if gained > 0.0 else trial
        return replace(better, converged=gained < CONVERGED)

    return in_threads(problem.threads, best, zip(trials, owns, steps, shared, strict=True))


def _equations(matrix: Array, trial: _Trial, own: Sequence[Array], noise: Noise) -> tuple[Array, Array]:
    """Normal equations of a trial's numbers: the calibrated ones' matrix is given, its corrections are so many columns more."""
    size, more = len(matrix), len(trial.corrections)
    runs = range(len(trial.residuals))
    columns = [np.concatenate([own[r], *(missed[r][None] for _, missed in trial.corrections)]) for r in runs]
    wide, push = _bordered(matrix, trial.known, columns, trial.residuals, noise)
    mix = np.eye(len(wide) - more, len(wide))
    for k, (direction, _) in enumerate(trial.corrections):
        mix[:size, len(wide) - more + k] = direction
    return mix @ wide @ mix.T, mix @ push


def _corrected(problem: Problem, before: _Trial, own: Sequence[Array], after: _Trial) -> _Trial:
    """The trial after a step, its known columns corrected by what the step did beyond what they and its own had predicted."""
    taken = scaled_numbers(problem, after.model) - scaled_numbers(problem, before.model)
    size = len(before.known[0])
    known, rest = taken[:size], taken[size:]
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


def _least_costs(
    problem: Problem, trials: Sequence[_Trial], autocorrelation_time: Array
) -> tuple[list[float], dict[int, float]]:
    """Costs of the trials, and of the best trial of each hypothesis."""
    costs = [total_cost(problem, t.model, t.residuals, autocorrelation_time) for t in trials]
    return costs, {of: min(c for c, t in zip(costs, trials, strict=True) if t.of == of) for of in {t.of for t in trials}}


def _starts(problem: Problem, current: Fit, scores: Sequence[Score], given: Sequence[NDArray[np.float32]]) -> list[_Trial]:
    """Where refits begin. The model as given keeps the effects found before."""
    as_given = untouched(problem, current.model)
    trials = [_Trial(-1, current.columns, current.columns, current.model)]
    for k, score in enumerate(scores):
        candidate = score.candidate
        near, anew = (_without_replaced(problem, candidate, known) for known in (current.columns, given))
        beside = current.model if score.step is None else moved(problem, current.model, score.step)
        trials.append(_Trial(k, near, current.columns, beside.with_effect(candidate, score.values)))
        probed = as_given.with_effect(candidate, candidate.probed(candidate.starts[0]))
        trials.append(_Trial(k, anew, given, probed))
    return trials


def _without_replaced(
    problem: Problem, candidate: Candidate, known: Sequence[NDArray[np.float32]]
) -> Sequence[NDArray[np.float32]]:
    """Columns of the calibrated parameters; those that a candidate replaces are zero beside it."""
    replaced = candidate.replaced
    if not replaced:
        return known
    rows = [k for k, quantity in enumerate(problem.quantities) if quantity.name in replaced]
    silent = [column.copy() for column in known]
    for column in silent:
        column[rows] = 0.0
    return silent


def _simulated(problem: Problem, trials: Sequence[_Trial], runs: Sequence[int]) -> list[_Trial]:
    """The trials with the residuals of their models."""
    found = problem.residuals([trial.model.setting for trial in trials], runs)
    return [replace(trial, residuals=[r[k] for r in found]) for k, trial in enumerate(trials)]


def refit_thoroughly(problem: Problem, runs: Sequence[int], current: Fit, scores: Sequence[Score]) -> list[Hypothesis]:
    """Fit every hypothesis in full, from its first guess and from its first two probes; best first."""
    noise = current.noise
    options: Any = {"autocorrelation_time": noise.autocorrelation_time, "scatter": noise.scatter, "steps": problem.steps}
    fits = []
    for score in scores:
        candidate = score.candidate
        starts = dict.fromkeys((score.values, *(candidate.probed(start) for start in candidate.starts[:2])))
        tried = [fit(problem, runs, current.model.with_effect(candidate, values), **options) for values in starts]
        fits.append(min(tried, key=lambda found: found.cost))
    fits.append(fit(problem, runs, current.model, **options))
    trials = [_Trial(k, found.columns, found.columns, found.model, found.residuals) for k, found in enumerate(fits)]
    autocorrelation_time = _best_autocorrelation_time(problem, current, trials)
    return _ranked(problem, scores, [t.model for t in trials], [t.residuals for t in trials], autocorrelation_time)


def _bordered(
    matrix: Array, known: Sequence[NDArray[np.float32]], own: Sequence[Array], residuals: Sequence[Array], noise: Noise
) -> tuple[Array, Array]:
    """Normal equations of the calibrated parameters, whose matrix is given, and a candidate's own unknowns."""
    both = [np.concatenate([columns, residual[None]]) for columns, residual in zip(own, residuals, strict=True)]
    across = cross_products(known, both, noise)
    root = np.sqrt(noise.weight)
    flat = [np.nan_to_num(part * root).reshape(len(part), -1) for part in both]
    inner = np.sum([part @ part.T for part in flat], axis=0)
    whole = np.block([[matrix, across[:, :-1]], [across[:, :-1].T, inner[:-1, :-1]]])
    return whole, np.concatenate([across[:, -1], inner[:-1, -1]])


def _ranked(
    problem: Problem,
    scores: Sequence[Score],
    models: Sequence[FittedModel],
    residuals: Sequence[list[Array]],
    autocorrelation_time: Array,
) -> list[Hypothesis]:
    """Hypotheses from refitted models, the last of which has no effect more; best first."""
    base = total_cost(problem, models[-1], residuals[-1], autocorrelation_time)
    found = []
    for score, model, residual in zip(scores, models[:-1], residuals[:-1], strict=True):
        by_run = fall_by_run(residuals[-1], residual, estimate_noise(residual, autocorrelation_time))
        gain = base - total_cost(problem, model, residual, autocorrelation_time)
        hypothesis = Hypothesis(score.candidate, model, gain, by_run, score.gain, residual, models[-1], residuals[-1])
        found.append(replace(hypothesis, tolerable=within_tolerance(problem, model), occam=occam(score, problem.tempering)))
    return sorted(found, key=lambda hypothesis: -hypothesis.gain)


def _best_autocorrelation_time(problem: Problem, current: Fit, trials: Sequence[_Trial]) -> Array:
    """Autocorrelation time of what the best trial leaves: the same for all that are compared.

    The best is the one that improves the fit most under its own autocorrelation time: under that of a model without it, an
    effect that lasts counts as few readings.
    """
    scatter = current.noise.scatter
    bare = [(t.model, t.residuals) for t in trials if t.of < 0] or [(current.model, current.residuals)]

    def own_gain(trial: _Trial) -> tuple[float, Array]:
        own = estimate_noise(trial.residuals, scatter=scatter).autocorrelation_time
        before = min(total_cost(problem, model, residuals, own) for model, residuals in bare)
        return before - total_cost(problem, trial.model, trial.residuals, own), own

    gain, best = max(in_threads(problem.threads, own_gain, trials), key=lambda found: found[0])
    return best if gain > 0.0 else current.noise.autocorrelation_time


def _own_columns(problem: Problem, trials: Sequence[_Trial], runs: Sequence[int]) -> list[list[Array]]:
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
            settings.append(replace(trial.model, effects=(*trial.model.effects[:-1], (candidate, changed))).setting)
            taken[-1].append(step / unknown.step)
    if not settings:
        return [[np.zeros((0, *residual.shape)) for residual in trial.residuals] for trial in trials]
    found = problem.residuals(settings, runs)
    columns, at = [], 0
    for trial, steps in zip(trials, taken, strict=True):
        mine = [r[at : at + len(steps)] for r in found]
        scale = np.array(steps)[:, None, None]
        columns.append([np.nan_to_num((r - base) / scale) for r, base in zip(mine, trial.residuals, strict=True)])
        at += len(steps)
    return columns
