"""Which candidates of a screening are refitted: the best few of several names, and what explains a group of signals well."""

from __future__ import annotations

from collections.abc import Sequence

from wlr_gym.gap.selection.screening import LEAST_GAIN, Score, asked_of, least_gain

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


def shortlist(scores: Sequence[Score], threshold: float = LEAST_GAIN) -> list[Score]:
    """Return the best scores, at most :data:`PER_NAME` of one effect, and only those above a share of the threshold.

    The improvement predicted to first order may be :data:`LEAST_WORTH` of the actual one. The best of :data:`MORE_NAMES`
    further effects follow.
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
    return [*chosen, *list(more.values())[:MORE_NAMES]]


def with_proposals(chosen: Sequence[Score], alone: Sequence[Score]) -> list[Score]:
    """Return the shortlist with the best of the candidates that explain a group of signals well; ``alone``: best first."""
    had = {score.candidate.label for score in chosen}
    more = {score.candidate.label: score for score in reversed(alone) if score.gain > PROPOSED * least_gain(len(score.values))}
    new = sorted((score for label, score in more.items() if label not in had), key=lambda score: -score.gain)
    return [*chosen, *new[:MOST_PROPOSED]]
