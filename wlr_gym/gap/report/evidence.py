"""The section of the report on what is missing: the effects, what is equivalent to them, and every candidate compared."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape

from wlr_gym.base.html import folded, heading, section, table
from wlr_gym.base.text import counted, number
from wlr_gym.gap.analysis import REJECTED, SELECTED, Analysis, Evidence, FoundEffect
from wlr_gym.gap.problem import Range
from wlr_gym.gap.report.text import estimate, listed, percent, places, plain, unit_of
from wlr_gym.physics.effects import EFFECTS, UNKNOWN_EFFECT


def evidence_section(analysis: Analysis, picture: str) -> str:
    """Return what was found, what the data cannot distinguish it from, and every candidate; ``picture`` is HTML."""
    parts = [_effect(effect) for effect in analysis.effects]
    if analysis.equivalent:
        rows = [(listed([plain(name) for name in group.names], "or"), group.separating_run) for group in analysis.equivalent]
        parts += [heading("Effects not distinguishable in these data"), table(("one of", "discriminating experiment"), rows)]
    if analysis.evidence:
        rounds = sorted({one.round for one in analysis.evidence})
        parts += [heading("Candidates compared"), _COMPARED, picture]
        none = {one.round: one.none for one in analysis.thresholds}
        for turn in rounds:
            parts.append(_evidence([one for one in analysis.evidence if one.round == turn], turn, none.get(turn, math.nan)))
    return section("What", *parts)


_COMPARED = """<p>Every candidate was scored by its <i>predicted</i> improvement of the calibrated model (score test, a linear
estimate). The best were added and refitted together with all calibrated parameters: their <i>gain</i> is the fall of minus two
log posterior, of which chance alone gives about 1 for each fitted number. Their
<i>probability</i> is among all that were refitted and none of them. One effect is selected per round, then the search starts
again.</p>"""


def _effect(effect: FoundEffect) -> str:
    known = None if effect.doc else EFFECTS.get(effect.name)
    doc = known.doc if known else effect.doc
    meaning = f"What is missing: {doc}." if doc else "Nothing in the library explains it."
    law = effect.formula or (known.equation if known else "")
    unlawful = "<p>No formula was found that holds.</p>" if effect.name == UNKNOWN_EFFECT else ""
    rows = [(name, estimate(found)) for name, found in effect.parameters.items()]
    return "\n".join(
        [
            heading(f"{plain(effect.name).capitalize()}: {places(effect.where)}"),
            f"<p>{escape(meaning)} In files: <code>{escape(effect.name)}</code>, where <code>{escape(', '.join(effect.where))}"
            f"</code>. Selection frequency {percent(effect.confidence)}.</p>",
            f"<p>Law: <code>{escape(law)}</code></p>" if law else unlawful,
            *([f"<p>Tried where {_tried(effect.validity)}; beyond, it is untested.</p>"] if effect.validity else []),
            table(("parameter", "value (95 % interval)"), rows),
        ]
    )


def _tried(validity: Mapping[str, Range]) -> str:
    texts = [f"{plain(name)} is {number(one.low)} to {number(one.high)}{unit_of(one.unit)}" for name, one in validity.items()]
    return escape(listed(texts, "and"))


def _evidence(evidence: Sequence[Evidence], turn: int, none: float) -> str:
    """The candidates of one round; ``none``: probability that none of them is missing."""
    fitted = sorted((one for one in evidence if one.outcome != REJECTED), key=_rank)
    rows = [
        (
            plain(one.name), places(one.where), _values(one), number(one.gain), number(one.screened), percent(one.probability),
            one.outcome, one.reason,
        )
        for one in fitted
    ]  # fmt: skip
    screened = [one for one in evidence if one.outcome == REJECTED]
    screened.sort(key=lambda one: -one.screened if math.isfinite(one.screened) else math.inf)
    rejected = [(plain(one.name), places(one.where), number(max(one.screened, 0.0)), one.reason) for one in screened]
    classes = ["selected" if one.outcome == SELECTED else "" for one in fitted]
    return "\n".join(
        [
            heading(f"Round {turn}: {counted(len(fitted), 'candidate')} refitted"),
            table(
                ("candidate", "where", "values", "gain", "predicted", "probability", "outcome", "reason"),
                rows,
                {3, 4, 5},
                classes,
            ),
            f"<p>Probability that none of them is missing: {percent(none)}.</p>" if math.isfinite(none) else "",
            folded(
                f"{counted(len(rejected), 'effect')} rejected at screening",
                table(("effect", "where it would gain most", "predicted", "reason"), rejected, {2}),
            ),
        ]
    )


def _rank(one: Evidence) -> tuple[bool, float]:
    """Order of the fitted: the selected one, then by gain."""
    return one.outcome != SELECTED, -one.gain if math.isfinite(one.gain) else math.inf


def _values(one: Evidence) -> str:
    known = EFFECTS[one.name].parameters if one.name in EFFECTS else {}
    units = {name: spec.unit for name, spec in known.items()} | dict(one.units)
    return ", ".join(f"{name} {number(value)}{unit_of(units.get(name, ''))}" for name, value in one.values.items())
