"""The format of the result file, ``result.json``: every model below is a part of it."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from wlr_gym.base.settings import SettingsModel


def finite(value: Any) -> Any:
    """JSON has no NaN: a number that is none becomes null."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


Number = Annotated[float, Field(allow_inf_nan=False)]
MaybeNumber = Annotated[float | None, BeforeValidator(finite)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
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


class RelationEntry(_Entry):
    """A relation of the model and the predicted improvement of the best law there, as a fall of minus two log posterior."""

    name: str
    law: str
    formula: str
    gain: Number


class RunGapEntry(_Entry):
    """Error of one run: of the model as given, calibrated, and with all effects; ``reduction``: the share that they remove."""

    run: str
    heldout: bool
    before: MaybeNumber = None
    calibrated: MaybeNumber = None
    after: MaybeNumber
    reduction: MaybeNumber = None


class RunsEntry(_Entry):
    """Names of the runs that were fitted to, and of the held-out ones."""

    fit: list[str]
    heldout: list[str]


class DetectableEntry(_Entry):
    """Smallest severity of an effect that the data would have shown; null: none that is plausible."""

    parameter: str
    value: MaybeNumber
    unit: str


class StatisticEntry(_Entry):
    """A statistic of what the final model leaves in the fitted runs, beside the same of runs that it made itself.

    ``expected`` is their median, ``limit`` their 95 % quantile, ``p`` the share of them, the observed ones counted in, that is
    as large, ``ratio`` value over expected.
    """

    value: MaybeNumber
    expected: MaybeNumber
    limit: MaybeNumber
    p: MaybeNumber
    ratio: MaybeNumber


class ByChannelEntry(StatisticEntry):
    """A statistic over all channels, and of each."""

    channels: dict[str, StatisticEntry]


class PulledEntry(StatisticEntry):
    """By how many standard errors one run pulls a number away from the other runs: the largest there is."""

    number: str
    run: str


class ConstancyEntry(StatisticEntry):
    """Scatter of the runs' estimates of the model's numbers, over what their rows predict."""

    pulled_most: PulledEntry


class TurningEntry(_Entry):
    """A signal's residual is periodic in its joint's angle; ``amplitude``: noise units, ``confidence``: selection frequency."""

    joint: str
    signal: str
    order: int
    share: float
    amplitude: float
    confidence: float


class AdequacyEntry(_Entry):
    """Whether the final model is adequate: information, no decision. ``replicates`` sets of runs were made by it."""

    replicates: int
    level: ByChannelEntry
    whiteness: ByChannelEntry
    constancy: ConstancyEntry


class EvidenceEntry(_Entry):
    """One candidate in one round of the search, and its outcome; see :class:`wlr_gym.gap.analysis.Evidence`."""

    round: int
    name: str
    where: list[str]
    values: dict[str, MaybeNumber]
    outcome: str
    probability: Share = 0.0
    formula: str = ""
    units: dict[str, str] = Field(default_factory=dict)


class ThresholdEntry(_Entry):
    """One round of the search; ``none``: probability that none of its candidates is missing."""

    round: int
    none: MaybeNumber = None


class RecommendationEntry(_Entry):
    """A run to record next."""

    excitation: str
    why: str


class Result(_Entry):
    """Contents of ``result.json``."""

    verdict: Literal["bad_data", "not_excited", "nothing_missing", "effect_found", "unknown_effect"]
    summary: str = ""
    effects: list[EffectEntry]
    equivalent: list[list[str]]
    separating_runs: list[str] = Field(default_factory=list)
    calibration: dict[str, CalibrationEntry]
    localisation: dict[str, LocalisationEntry]
    relations: list[RelationEntry] = Field(default_factory=list)
    gap: GapEntry | None
    run_gaps: list[RunGapEntry] = Field(default_factory=list)
    runs: RunsEntry
    patch: str
    detectable: dict[str, DetectableEntry] = Field(default_factory=dict)
    closure: str = ""
    turning: TurningEntry | None = None
    evidence: list[EvidenceEntry] = Field(default_factory=list)
    thresholds: list[ThresholdEntry] = Field(default_factory=list)
    recommendations: list[RecommendationEntry] = Field(default_factory=list)
    adequacy: AdequacyEntry | dict[str, MaybeNumber] | None = None  # earlier versions: the level of each channel
