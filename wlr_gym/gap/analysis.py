"""What one analysis found: everything the result file, the pictures and the report are made of.

Several of these classes stand in the result file as they are; see :mod:`wlr_gym.gap.report.result`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, PlainSerializer

from wlr_gym.gap.problem import Range

Array = NDArray[np.float64]


def finite(value: Any) -> Any:
    """JSON has no NaN: it is written as null."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


#: A number that may be NaN; the result file has null for that.
MaybeNan = Annotated[
    float,
    BeforeValidator(lambda value: math.nan if value is None else value),
    PlainSerializer(finite, return_type=float | None, when_used="json"),
]
Share = Annotated[float, Field(ge=0.0, le=1.0)]

#: Verdicts, as in the result file.
BAD_DATA = "bad_data"
NOT_EXCITED = "not_excited"
NOTHING_MISSING = "nothing_missing"
EFFECT_FOUND = "effect_found"
UNKNOWN = "unknown_effect"
#: Outcomes of a candidate that the report and the workflow ask for; docs/gap.md explains all.
SELECTED = "selected"
EQUIVALENT = "equivalent"
WORSE_FIT = "worse fit"
TOO_LITTLE = "too little"
FAILS_CROSS_VALIDATION = "fails cross-validation"
REMOVED = "removed"
REJECTED = "rejected at screening"
#: Kind of the finding that the data do not say which servo profile they were recorded with.
NO_PROFILE = "servo_profile"


@dataclass(frozen=True)
class IntakeFinding:
    """Something noticed about the data before any model was asked.

    Attributes:
        run, channel: where; "" for all.
        kind: short word (``gap``, ``wrap``, ``dead``, ``clipped``, ``units``, ``few_runs`` ...).
        text: what was seen.
        fatal: the run, or without one the whole set, cannot be used.
        time: s from the run's first row, where it was seen first; None = it is of the whole run.
        expected, remedy: what would be right, and what to do; "" where the text says it.
    """

    run: str
    channel: str
    kind: str
    text: str
    fatal: bool = False
    time: float | None = None
    expected: str = ""
    remedy: str = ""

    @property
    def place(self) -> str:
        """Run, channel and time in words: ``run_03 gyro_z at 4.20 s``."""
        at = None if self.time is None else f"at {self.time:.2f} s"
        return " ".join(filter(None, [self.run, self.channel, at]))

    @property
    def said(self) -> str:
        """What was seen, what would be right, and what to do, in words."""
        return "; ".join(filter(None, [self.text, self.expected and f"expected {self.expected}", self.remedy]))


#: Runs that an analysis needs: two to fit, one to hold out.
LEAST_RUNS = 3


def few_runs(usable: int, there: int, remedy: str = "") -> list[IntakeFinding]:
    """Return that too few runs are usable; nothing where there are enough."""
    text = f"{usable} usable runs of {there}: at least {LEAST_RUNS} are needed, two to fit and one to hold out"
    return [] if usable >= LEAST_RUNS else [IntakeFinding("", "", "few_runs", text, fatal=True, remedy=remedy)]


@dataclass(frozen=True)
class ParameterEstimate:
    """A fitted number with its 95 % interval."""

    value: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class FoundEffect:
    """One effect that was added, strongest first in an analysis.

    Attributes:
        confidence: 0..1: selection frequency: share of bootstrap samples of the fitted runs in which it improves the fit
            enough, the runs agree and no other name improves it more; nothing is refitted.
        gain: fall of minus two log posterior on the fitted runs when it was added, beside the effects selected before it.
        formula, units: of an unknown effect; empty otherwise.
        validity: where the formula was tried, by what it reads. doc: of a rig's own law; empty = as the library says.
    """

    name: str
    where: tuple[str, ...]
    parameters: Mapping[str, ParameterEstimate]
    confidence: float
    gain: float
    formula: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    validity: Mapping[str, Range] = field(default_factory=dict)
    doc: str = ""


@dataclass(frozen=True)
class Evidence:
    """One candidate in one round, and its outcome.

    Attributes:
        round: 1 for the first effect.
        gain: improvement of the fit after a refit, as a fall of minus two log posterior; ``screened``: the improvement that
            the score test predicted.
        outcome: ``selected``, ``equivalent``, ``worse fit``, ``too little``, ``inconsistent``, ``fails cross-validation``,
            ``implausible``, ``within tolerance``, ``removed`` or ``rejected at screening``.
        reason: of the outcome, one sentence.
        by_run: fall of the weighted squares per fit run; empty where it was only screened.
        probability: of this candidate among all that were refitted and none of them; 0 where it was only screened.
        formula: of an unknown effect; empty otherwise. units: of values, where the library's effect of this name has none.
    """

    round: int
    name: str
    where: tuple[str, ...]
    values: Mapping[str, MaybeNan]
    gain: MaybeNan
    screened: MaybeNan
    outcome: str
    reason: str
    by_run: Mapping[str, MaybeNan] = field(default_factory=dict)
    probability: Share = 0.0
    formula: str = ""
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Equivalent:
    """Effects that these data cannot distinguish, and the discriminating experiment; ``where``: places of the first."""

    names: tuple[str, ...]
    separating_run: str
    where: tuple[str, ...] = ()


@dataclass(frozen=True)
class Place:
    """Where the gap is: share of the avoidable misfit, and how it depends on the state."""

    name: str
    share: float
    dependence: str


@dataclass(frozen=True)
class Relation:
    """A relation of the model, the law that explains most by acting there alone, and its predicted improvement.

    See :mod:`wlr_gym.gap.report.recommendation`.
    """

    name: str
    law: str
    formula: str
    gain: float


@dataclass(frozen=True, eq=False)
class HeatMap:
    """Root mean square residual (noise units) of the calibrated model per channel and state bin: (channels, bins).

    ``feature`` says what the bins are of, with its unit; NaN where a bin holds no rows.
    """

    channels: tuple[str, ...]
    bins: tuple[str, ...]
    values: Array
    feature: str = ""


@dataclass(frozen=True, eq=False)
class Trace:
    """One channel of one held-out run: measured, and as three models replay it; SI.

    Attributes:
        before, calibrated, after: replayed by the model as given, calibrated, with the effects.
        calibrated_error, after_error: measured minus replayed as it is counted, residual times noise (of the robot:
            :mod:`wlr_gym.gap.robot.windows`); NaN where nothing is.
    """

    run: str
    channel: str
    unit: str
    t: Array
    measured: Array
    before: Array
    calibrated: Array
    after: Array
    calibrated_error: Array
    after_error: Array


@dataclass(frozen=True)
class GapFigures:
    """Noise-normalised RMS error of replayed runs, 1.0 = sensor noise; see the result file.

    ``reduction`` is the share of what calibration leaves above the noise floor that the effects remove on held-out runs: 1 at
    most, negative if they make it worse, NaN where calibration leaves nothing; so is its interval, which is NaN of few runs.
    ``cap``: units that a reading counts at most, so that an error of as many may be any larger one.
    """

    metric: str
    fit_before: float
    fit_after: float
    heldout_before: float
    heldout_calibrated: float
    heldout_after: float
    noise_floor: float
    reduction: float
    reduction_ci95: tuple[float, float]
    cap: float = math.inf


@dataclass(frozen=True)
class RunGap:
    """The same for one run: of the model as given, calibrated, and with all effects.

    ``reduction`` is by the noise floor of all held-out runs.
    """

    run: str
    heldout: bool
    before: MaybeNan = math.nan
    calibrated: MaybeNan = math.nan
    after: MaybeNan = math.nan
    reduction: MaybeNan = math.nan


@dataclass(frozen=True)
class ChannelGap:
    """RMS residual of one channel over the held-out runs, in noise units; channels of a kind share a ``group``.

    ``worse``: the effects make it significantly worse (:mod:`wlr_gym.gap.validation.held_out`).
    """

    channel: str
    unit: str
    noise: float
    before: float
    calibrated: float
    after: float
    group: str = ""
    worse: bool = False


@dataclass(frozen=True)
class Calibrated:
    """A number that calibration moved; ``uncertainty`` is half of its 95 % interval."""

    nominal: float
    fitted: float
    unit: str
    sigma: float
    uncertainty: float


@dataclass(frozen=True)
class Detectable:
    """Smallest severity of an effect that these data would have shown; NaN: none that is plausible."""

    parameter: str
    value: MaybeNan
    unit: str


@dataclass(frozen=True)
class Statistic:
    """One number about what the final model leaves in the fitted runs, beside the same of runs that it made itself.

    Attributes:
        value: observed.
        expected: median of the runs made.
        limit: their 95 % quantile.
        p: share of them, the observed ones counted in, that are as large; NaN where they cannot be compared.
        ratio: how many times larger than expected; NaN where nothing is expected.
    """

    value: MaybeNan
    expected: MaybeNan
    limit: MaybeNan
    p: MaybeNan
    ratio: MaybeNan

    @property
    def rejected(self) -> bool:
        """Whether chance alone leaves so much in one case of 20 at most."""
        return self.p <= 0.05


@dataclass(frozen=True)
class ByChannel(Statistic):
    """A statistic over all channels, and of each."""

    channels: Mapping[str, Statistic]


@dataclass(frozen=True)
class Pulled(Statistic):
    """By how many standard errors one run pulls a number away from the other runs: the largest there is."""

    number: str
    run: str


@dataclass(frozen=True)
class Constancy(Statistic):
    """Scatter of the runs' estimates of the numbers over what their rows predict.

    Its value is NaN where the data are informative about no number.
    """

    pulled_most: Pulled


@dataclass(frozen=True)
class Adequacy:
    """What the final model leaves in the fitted runs; see :mod:`wlr_gym.gap.validation.residual_tests`.

    Attributes:
        replicates: how many sets of runs the model made.
        level: root mean square, noise units.
        whiteness: integrated autocorrelation time of the residuals in rows; of all channels the geometric mean.
        constancy: whether the runs agree about the numbers.
    """

    replicates: int
    level: ByChannel
    whiteness: ByChannel
    constancy: Constancy


@dataclass(frozen=True)
class Turning:
    """Part of a signal's residual is periodic in the angle of its joint; see :mod:`wlr_gym.gap.validation.residual_tests`.

    Attributes:
        joint, signal: whose.
        order: periods per turn.
        share: of the squared residuals that the angle predicts, beyond what other orders do.
        amplitude: noise units, root mean square over the runs.
        confidence: 0..1: selection frequency: share of bootstrap samples of the runs in which it is as clear as required.
    """

    joint: str
    signal: str
    order: int
    share: float
    amplitude: float
    confidence: float


@dataclass(frozen=True)
class Threshold:
    """By how much an effect with one unknown had to improve the fit in a round of the search, and what chance alone gives.

    ``by_chance``: 98 % of draws of chance have no larger improvement (:mod:`wlr_gym.gap.selection.screening`); NaN = not drawn.
    ``none``: probability that none of the refitted candidates is missing (:mod:`wlr_gym.gap.selection.hypotheses`).
    """

    round: int
    least: MaybeNan = math.nan
    by_chance: MaybeNan = math.nan
    none: MaybeNan = math.nan


@dataclass(frozen=True)
class Recommendation:
    """A run to record next: name of an excitation, and why."""

    excitation: str
    why: str


@dataclass(frozen=True, eq=False)
class Analysis:
    """Everything one analysis found."""

    data: str
    verdict: str
    summary: str
    intake: tuple[IntakeFinding, ...] = ()
    fit_runs: tuple[str, ...] = ()
    heldout_runs: tuple[str, ...] = ()
    effects: tuple[FoundEffect, ...] = ()
    equivalent: tuple[Equivalent, ...] = ()
    calibration: Mapping[str, Calibrated] = field(default_factory=dict)
    evidence: tuple[Evidence, ...] = ()
    thresholds: tuple[Threshold, ...] = ()
    localisation: tuple[Place, ...] = ()
    relations: tuple[Relation, ...] = ()
    heat_maps: tuple[HeatMap, ...] = ()
    traces: tuple[Trace, ...] = ()
    gap: GapFigures | None = None
    run_gaps: tuple[RunGap, ...] = ()
    channel_gaps: tuple[ChannelGap, ...] = ()
    detectable: Mapping[str, Detectable] = field(default_factory=dict)
    recommendations: tuple[Recommendation, ...] = ()
    adequacy: Adequacy | None = None
    turning: Turning | None = None
    known_effects: tuple[Mapping[str, object], ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    provenance: Mapping[str, object] = field(default_factory=dict)

    @property
    def added(self) -> tuple[FoundEffect, ...]:
        """The effects that were added to the model: all but an unknown one without a formula."""
        return tuple(effect for effect in self.effects if effect.name != UNKNOWN or effect.formula)
