"""The result file of an analysis, ``result.json``, and the patch that adds what was found to the model, ``patch.yaml``.

:class:`Result` is the format: its parts are models of this module, and those classes of :mod:`wlr_gym.gap.analysis` that the
file has as they are. What is written has passed it, and :func:`read_result` checks a file against it. Keys that other versions
add to the models are kept. :func:`explanations` says what a result leaves open: the names that its data do not distinguish, and
"nothing more".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from wlr_gym import __version__
from wlr_gym.base.files import write_json
from wlr_gym.base.settings import SettingsModel, parse_config, read_json
from wlr_gym.base.text import json_text
from wlr_gym.gap.analysis import (
    EQUIVALENT,
    FAILS_CROSS_VALIDATION,
    REMOVED,
    SELECTED,
    TOO_LITTLE,
    WORSE_FIT,
    Adequacy,
    Analysis,
    Calibrated,
    Detectable,
    Evidence,
    FoundEffect,
    Recommendation,
    Relation,
    RunGap,
    Share,
    Threshold,
    Turning,
    finite,
)
from wlr_gym.gap.report.text import closure, sentence, unit_of
from wlr_gym.physics.effects import Patch, PatchEffect, save_patch
from wlr_gym.physics.plants.forces import COORDINATES

Number = Annotated[float, Field(allow_inf_nan=False)]
MaybeNumber = Annotated[float | None, BeforeValidator(finite)]
Interval = tuple[Number, Number]


class _Entry(SettingsModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(extra="allow", allow_inf_nan=True)


class ParameterEntry(_Entry):
    """A fitted parameter of an effect; ``ci95`` is null where the data give none."""

    value: Number
    ci95: Interval | None
    unit: str

    @model_validator(mode="after")
    def _inside(self) -> ParameterEntry:
        if self.ci95 is not None and not self.ci95[0] <= self.value <= self.ci95[1]:
            raise ValueError(f"value {self.value:g} is not within its ci95 {list(self.ci95)}")
        return self


class RangeEntry(_Entry):
    """Lowest and highest value of what a formula reads, in the fitted runs."""

    range: Interval
    unit: str


class EffectEntry(_Entry):
    """One missing effect.

    ``confidence`` is its selection frequency; ``formula`` is text with units, of unknown effects only, ``validity`` where
    it was tried.
    """

    name: str
    where: list[str]
    parameters: dict[str, ParameterEntry]
    confidence: Share
    gain: MaybeNumber = None
    formula: str | None = None
    validity: dict[str, RangeEntry] = Field(default_factory=dict)


class CalibrationEntry(_Entry):
    """A calibrated parameter; ``sigma`` is its tolerance."""

    nominal: Number
    fitted: Number
    unit: str
    sigma: MaybeNumber = None
    ci95: Interval | None = None


class LocalisationEntry(_Entry):
    """Where the gap is."""

    share_of_gap: Share
    state_dependence: str


class GapEntry(_Entry):
    """The gap: rms error of replayed runs, 1.0 = sensor noise.

    ``reduction`` lies in 0..1; ``reduction_signed`` is negative where the effects make held-out runs worse, and null where
    calibration leaves nothing to remove and in results of versions without it. The interval is that of
    ``reduction_signed``, null where held-out runs are too few. ``cap``: what a reading counts at most.
    """

    metric: str
    fit_before: MaybeNumber
    fit_after: MaybeNumber
    heldout_before: MaybeNumber
    heldout_calibrated: MaybeNumber
    heldout_after: MaybeNumber
    noise_floor: MaybeNumber
    reduction: Share
    reduction_signed: Annotated[float | None, Field(le=1.0), BeforeValidator(finite)] = None
    reduction_ci95: tuple[MaybeNumber, MaybeNumber] | None
    cap: MaybeNumber = None


class RunsEntry(_Entry):
    """Names of the runs that were fitted to, and of the held-out ones."""

    fit: list[str]
    heldout: list[str]


class Result(_Entry):
    """Contents of ``result.json``."""

    verdict: Literal["bad_data", "not_excited", "nothing_missing", "effect_found", "unknown_effect"]
    summary: str = ""
    effects: list[EffectEntry]
    equivalent: list[list[str]]
    separating_runs: list[str] = Field(default_factory=list)
    calibration: dict[str, CalibrationEntry]
    localisation: dict[str, LocalisationEntry]
    relations: list[Relation] = Field(default_factory=list)
    gap: GapEntry | None
    run_gaps: list[RunGap] = Field(default_factory=list)
    runs: RunsEntry
    patch: str
    detectable: dict[str, Detectable] = Field(default_factory=dict)
    closure: str = ""
    turning: Turning | None = None
    evidence: list[Evidence] = Field(default_factory=list)
    thresholds: list[Threshold] = Field(default_factory=list)
    recommendations: list[Recommendation] = Field(default_factory=list)
    adequacy: Adequacy | dict[str, MaybeNumber] | None = None  # earlier versions: the level of each channel


RESULT_FILE = "result.json"
PATCH_FILE = "patch.yaml"
MADE_BY = "wlr gap"


# ---- writing ---------------------------------------------------------------------------------------------------------


def patch_of(analysis: Analysis) -> Patch:
    """Return the effects that were found, as a patch; an unknown effect without a formula cannot be added.

    Neither the effects that were given as known nor calibrated numbers are in it.
    """
    effects = tuple(
        PatchEffect(
            effect.name,
            tuple(effect.where),
            {name: float(found.value) for name, found in effect.parameters.items()},
            effect.formula,
            dict(effect.units),
        )
        for effect in analysis.added
    )
    origin = {"made_by": MADE_BY, "data": [analysis.data], "date": _today(), "version": __version__}
    return Patch(effects, {**origin, "verdict": analysis.verdict}, source=PATCH_FILE)


def result_of(analysis: Analysis, patch: Path | str = PATCH_FILE) -> Result:
    """Return what the result file says of an analysis.

    Args:
        analysis: what was found.
        patch: where its patch is.

    Raises:
        ValueError: a number that makes no sense, such as a share above 1.
    """
    places = sorted(analysis.localisation, key=lambda place: -place.share)
    gap, as_it_is = analysis.gap, (
        "verdict", "relations", "detectable", "turning", "evidence", "thresholds", "run_gaps", "channel_gaps", "intake",
        "recommendations", "adequacy", "known_effects", "seconds",
    )  # fmt: skip
    content = {
        **{name: getattr(analysis, name) for name in as_it_is},
        "summary": sentence(analysis),
        "closure": closure(analysis),
        "effects": [_effect(effect) for effect in analysis.effects],
        "equivalent": [group.names for group in analysis.equivalent],
        "separating_runs": [group.separating_run for group in analysis.equivalent],
        "calibration": {name: _calibrated(moved) for name, moved in analysis.calibration.items()},
        "localisation": {p.name: {"share_of_gap": p.share, "state_dependence": p.dependence} for p in places},
        "gap": gap and {
            **vars(gap),
            "reduction": min(max(gap.reduction, 0.0), 1.0) if math.isfinite(gap.reduction) else 0.0,
            "reduction_signed": gap.reduction,
            "reduction_ci95": _interval(*gap.reduction_ci95),
        },
        "runs": {"fit": analysis.fit_runs, "heldout": analysis.heldout_runs},
        "patch": str(patch),
        "provenance": {
            "made_by": MADE_BY, "data": analysis.data, "date": _today(), "version": __version__, **analysis.provenance
        },
    }  # fmt: skip
    return Result.model_validate_json(json_text(content))


def write_result(analysis: Analysis, folder: Path) -> Path:
    """Write ``patch.yaml`` and then ``result.json`` into a folder that is there, each in one step; return the latter's path.

    The result names the patch by its absolute path.
    """
    patch = folder.resolve() / PATCH_FILE
    result = result_of(analysis, patch)
    save_patch(patch_of(analysis), patch)
    path = folder / RESULT_FILE
    write_json(path, result.model_dump(mode="json", exclude_none=False))
    return path


def _effect(effect: FoundEffect) -> dict[str, Any]:
    """An effect; its formula with the units of its force and its constants: ``-k * leg_angle N m; k in N m/rad``."""
    force = unit_of(COORDINATES.get(effect.where[0], "")) if effect.where else ""
    constants = [f"{name} in {'1' if unit == '-' else unit}" for name, unit in effect.units.items()]
    return {
        "name": effect.name,
        "where": effect.where,
        "parameters": {
            name: {"value": one.value, "ci95": _interval(one.low, one.high, holding=one.value), "unit": one.unit}
            for name, one in effect.parameters.items()
        },
        "confidence": effect.confidence,
        "gain": effect.gain,
        "formula": "; ".join([effect.formula + force, *constants]) if effect.formula else None,
        "validity": {name: {"range": [one.low, one.high], "unit": one.unit} for name, one in effect.validity.items()},
    }


def _calibrated(moved: Calibrated) -> dict[str, Any]:
    interval = _interval(moved.fitted - moved.uncertainty, moved.fitted + moved.uncertainty)
    return {
        "nominal": moved.nominal, "fitted": moved.fitted, "unit": moved.unit, "sigma": moved.sigma, "ci95": interval
    }  # fmt: skip


def _interval(low: float, high: float, holding: float | None = None) -> list[float] | None:
    """Return an interval, which holds a value where one is given; None where the data give none."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return None
    return [low, high] if holding is None else [min(low, holding), max(high, holding)]


def _today() -> str:
    return datetime.now(UTC).date().isoformat()


# ---- reading ---------------------------------------------------------------------------------------------------------


def read_result(path: str | Path) -> Result:
    """Read and check a result file.

    Raises:
        InputError: no such file, broken JSON, or contents that are not those of a result; the message names the place.
    """
    return parse_config(Result, read_json(path), str(path))


# ---- what a result leaves open ---------------------------------------------------------------------------------------

#: Probability from which on a name is decided.
DECIDED = 0.95
#: Name of the explanation that adds nothing to the effects found before.
NOTHING = "nothing"
#: Outcomes that further runs can change: what needs an implausible size, or less than tolerances allow, they do not.
_OPEN = frozenset({SELECTED, EQUIVALENT, WORSE_FIT, TOO_LITTLE, FAILS_CROSS_VALIDATION})


@dataclass(frozen=True)
class Explanation:
    """One way to explain the runs.

    Attributes:
        name: of the effect in question, or :data:`NOTHING`.
        probability: among all explanations of its round.
        effects: of the whole model, those found in earlier rounds included.
    """

    name: str
    probability: float
    effects: tuple[PatchEffect, ...]


def explanations(result: Result) -> tuple[Explanation, ...]:
    """Return the explanations in play, most probable first; one where the runs distinguish it, none without an analysis.

    They are those of the first round of the search in which no name alone has 95 %, or names are equivalent: the smallest set
    of names that has 95 %, nothing among them, what was selected, and what is equivalent to it (probabilities know nothing of
    what simulators cannot reproduce). Once an effect was found, a round that adds nothing is decided.
    """
    added: tuple[PatchEffect, ...] = ()
    found: list[Explanation] = []
    for threshold in result.thresholds:
        entries = [one for one in result.evidence if one.round == threshold.round and one.outcome in _OPEN]
        selected = next((one for one in entries if one.outcome == SELECTED), None)
        if any(one.outcome == REMOVED for one in result.evidence if one.round == threshold.round):
            continue
        if selected is None and added:
            break
        found = _of_round(entries, 0.0 if math.isnan(threshold.none) else threshold.none, added)
        if selected is None or len(found) > 1:
            break
        added = found[0].effects
    return tuple(found)


def _of_round(entries: Sequence[Evidence], nothing: float, added: tuple[PatchEffect, ...]) -> list[Explanation]:
    best: dict[str, Evidence] = {}
    total: dict[str, float] = {NOTHING: nothing}
    for entry in sorted(entries, key=lambda one: -one.probability):
        best.setdefault(entry.name, entry)
        total[entry.name] = total.get(entry.name, 0.0) + entry.probability
    whole = sum(total.values()) or 1.0
    ranked = []
    for name, share in sorted(total.items(), key=lambda one: -one[1]):
        effects = added
        if name in best:
            entry = best[name]
            values = {key: value for key, value in entry.values.items() if math.isfinite(value)}
            effects = (*added, PatchEffect(name, tuple(entry.where), values, entry.formula, entry.units))
        ranked.append(Explanation(name, share / whole, effects))
    chosen = next((entry.name for entry in entries if entry.outcome == SELECTED), NOTHING)
    rivals = {entry.name for entry in entries if entry.outcome == EQUIVALENT}
    if ranked[0].name == chosen and ranked[0].probability >= DECIDED and not rivals:
        return ranked[:1]
    reached, credible = 0.0, set()
    for one in ranked:
        if reached < DECIDED:
            credible.add(one.name)
        reached += one.probability
    return [one for one in ranked if one.name in credible | rivals | {chosen}]
