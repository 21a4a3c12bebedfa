"""The smallest size of each effect that the data would have shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from wlr_gym.gap.analysis import Detectable
from wlr_gym.gap.problem import Candidate
from wlr_gym.gap.selection.screening import LEAST_GAIN, Score, least_amplitude


def detectable(scores: Sequence[Score], threshold: float = LEAST_GAIN) -> dict[str, Detectable]:
    """Return the smallest severity of every effect that would have been accepted, at the place where it is hardest to see.

    Of an effect with directions of its own (x, y, z of a displaced mass) it is the one that shows best: in another it may hide
    at any size. First order: the gain of an effect grows with the square of its severity. Where no plausible size would show,
    its size is NaN. Formulas are left out: their laws have no size in common. ``threshold``: see
    :func:`wlr_gym.gap.selection.screening.asked_of`.
    """
    found: dict[str, tuple[float, Detectable]] = {}
    for score in scores:
        if len(score.candidate.where) > 1 or score.candidate.formula:
            continue
        start = score.start
        shown = np.diag(score.information)
        which = max((k for k in _sizes(score.candidate) if k < len(shown)), key=lambda k: float(shown[k]))
        amplitude = least_amplitude(score.candidate, score.information, which, threshold)
        steps = np.zeros(len(start.directions))
        steps[min(which, len(steps) - 1)] = amplitude
        entry = _largest(score.candidate, start.values(steps))
        if not score.visible:
            amplitude, entry = np.inf, replace(entry, value=np.nan)
        if score.candidate.name not in found or amplitude > found[score.candidate.name][0]:
            found[score.candidate.name] = (amplitude, entry)
    return {name: entry for name, (_, entry) in sorted(found.items())}


def _sizes(candidate: Candidate) -> list[int]:
    """Which unknowns are sizes in the vocabulary; all where none is in it, as of a wave's sine and cosine."""
    own, unknowns = candidate.vocabulary, candidate.unknowns
    return [k for k, u in enumerate(unknowns) if u.name in own and own[u.name].is_size] or list(range(len(unknowns)))


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
