"""How often a selected effect is selected again (bootstrap over the runs), and which other names explain the data as well."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.selection.hypothesis import MOST_HARM, Hypothesis
from wlr_gym.gap.selection.screening import LEAST_GAIN, asked_of

Array = NDArray[np.float64]

#: Bootstrap samples of the runs.
SAMPLES = 500
#: Two effects are equivalent if the second improves the fit by at least this share of what the first does.
EQUIVALENT = 0.93
#: A rival that improves the fit by this share is equivalent unless the runs agree that it is worse ...
RIVAL = 0.75
#: ... by so many standard errors.
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
        possible = not other.at_bound and not other.tolerable
        if (
            name != selected.candidate.name
            and possible
            and name not in found
            and (name in credible or _as_good(selected, other))
        ):
            found[name] = other
    return list(found.values())


def _as_good(selected: Hypothesis, other: Hypothesis) -> bool:
    """Whether another hypothesis improves the fit by nearly as much, or the runs do not agree that it does by less."""
    if other.gain > EQUIVALENT * selected.gain or selected.gain - other.gain < 0.25 * LEAST_GAIN:
        return True
    ahead = selected.by_run - other.by_run
    spread = float(ahead.std(ddof=1)) / np.sqrt(len(ahead)) if len(ahead) > 1 else 0.0
    return bool(other.gain > RIVAL * selected.gain and ahead.mean() < AGREED * spread)
