"""An analysis in plain words: places, channels, effects, numbers, and the verdict as one sentence."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from wlr_gym.base.text import number
from wlr_gym.gap.analysis import (
    BAD_DATA,
    EFFECT_FOUND,
    FAILS_CROSS_VALIDATION,
    NOT_EXCITED,
    NOTHING_MISSING,
    UNKNOWN,
    Adequacy,
    Analysis,
    GapFigures,
    ParameterEstimate,
    Turning,
)
from wlr_gym.gap.validation.held_out import most_in, most_left
from wlr_gym.physics.effects import UNKNOWN_EFFECT
from wlr_gym.physics.plants.base import TRUTH_LAYOUT
from wlr_gym.robot import CORNER_NAMES, CORNERS, LEGS, WHEELS

#: Verdict -> title of the report.
TITLES = {
    BAD_DATA: "Data cannot be used",
    NOT_EXCITED: "Runs show too little",
    NOTHING_MISSING: "Nothing missing",
    EFFECT_FOUND: "Missing effect found",
    UNKNOWN: "Something unknown is missing",
}
#: Title where nothing was named, and yet something is left.
NOTHING_CLEAR = "Nothing clear enough to be named"
_SIDES = {
    frozenset(CORNERS): "all four",
    frozenset(("lf", "rf")): "both front",
    frozenset(("lr", "rr")): "both rear",
    frozenset(("lf", "lr")): "both left",
    frozenset(("rf", "rr")): "both right",
}
#: Times the noise floor, from which on part of the gap is unexplained.
UNEXPLAINED = 1.5
#: Channels that effects make worse, of which so many are named.
MOST_WORSE = 4
#: Groups of channels in words; others as they are.
_GROUPS = {
    "pos_leg": "the angles of the legs", "pos_wheel": "the angles of the wheels", "vel_leg": "the speeds of the legs",
    "vel_wheel": "the speeds of the wheels", "eff_leg": "the motor torques of the legs", "gyro": "the turning rates",
    "eff_wheel": "the motor torques of the wheels", "acc": "the accelerations", "volt": "the supply voltage",
    "cam_xy": "the camera's position", "cam_yaw": "the camera's heading",
    "cam_z": "the camera's height", "cam_pitch": "the camera's pitch",
}  # fmt: skip
_PLACES = {"ground": "floor", "sensor": "sensors"}
_MEASURED = {
    "pos_leg": "angle", "pos_wheel": "angle", "vel_leg": "speed", "vel_wheel": "speed",
    "eff_leg": "motor torque", "eff_wheel": "motor torque", "cmd_leg": "goal angle", "cmd_wheel": "goal speed",
}  # fmt: skip
_CHANNELS = {
    "cam_x": "camera: position x", "cam_y": "camera: position y", "cam_yaw": "camera: heading", "cam_z": "camera: height",
    "cam_pitch": "camera: pitch", "volt": "supply voltage",
    **{f"gyro_{axis}": f"turning rate about {axis}" for axis in "xyz"},
    **{f"acc_{axis}": f"acceleration along {axis}" for axis in "xyz"},
}  # fmt: skip


#: Units of states that the layout of the simulators' truth does not have.
_FEATURES = {"slip_speed": "m/s", "time_since_reversal": "s"}


def plain(name: str) -> str:
    """Return an effect's name as words."""
    return name.replace("_", " ")


def places(where: Sequence[str]) -> str:
    """Return where an effect acts: ``both front wheels``, ``left rear leg``, ``floor``."""
    for kind, members in (("leg", LEGS), ("wheel", WHEELS)):
        if where and all(place in members for place in where):
            corners = [place.removeprefix(f"{kind}_") for place in where]
            group = _SIDES.get(frozenset(corners))
            return f"{group} {kind}s" if group else listed([f"{CORNER_NAMES[corner]} {kind}" for corner in corners])
    if set(where) == {*LEGS, *WHEELS}:
        return "all legs and wheels"
    split = [(name, *name.rpartition("_")) for name in where]
    return listed(
        [
            f"{CORNER_NAMES[corner]} {kind}" if corner in CORNER_NAMES else _PLACES.get(name, name.replace("_", " "))
            for name, kind, _, corner in split
        ]
    )


def channel(name: str) -> str:
    """Return a measured channel in words: ``motor torque, left front leg``."""
    kind, _, corner = name.rpartition("_")
    if kind in _MEASURED and corner in CORNER_NAMES:
        return f"{_MEASURED[kind]}, {CORNER_NAMES[corner]} {kind.partition('_')[2]}"
    return _CHANNELS.get(name, name.replace("_", " "))


def feature(name: str) -> str:
    """Return the name of a state of the robot with its unit: ``motor_torque[leg_lf] (N m)``; others as they are."""
    quantity = name.partition("[")[0]
    unit = TRUTH_LAYOUT.channels[quantity].unit if quantity in TRUTH_LAYOUT.channels else _FEATURES.get(quantity, "")
    return f"{name} ({unit})" if unit else name


def listed(words: Sequence[str], last: str = "and") -> str:
    """Return ``a, b and c``."""
    return f" {last} ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


# ---- numbers ---------------------------------------------------------------------------------------------------------


def error(value: float) -> str:
    """Return an error in units of noise, with as many decimals as one can care for."""
    return f"{value:.{2 if value < 9.995 else 1 if value < 99.95 else 0}f}" if math.isfinite(value) else "-"


def capped(value: float, gap: GapFigures | None) -> str:
    """Return an error of replayed runs; one that is as large as counts may be any larger one."""
    cap = math.inf if gap is None else gap.cap
    return f"{cap:g} or more" if value > 0.999 * cap else error(value)


def percent(share: float) -> str:
    """Return a share as ``87 %``."""
    return f"{round(100.0 * share)} %" if math.isfinite(share) else "-"


def interval(analysis: Analysis) -> str:
    """Return ``95 % interval 91 to 97 %`` of the reduction; where the runs are too few for one, each run's own."""
    low, high = analysis.gap.reduction_ci95 if analysis.gap is not None else (math.nan, math.nan)
    if math.isfinite(low) and math.isfinite(high):
        return f"95 % interval {round(100.0 * low)} to {round(100.0 * high)} %"
    single = [percent(one.reduction) for one in analysis.run_gaps if one.heldout and math.isfinite(one.reduction)]
    return f"run by run {listed(single)}; no interval" if single else "no interval"


def unit_of(unit: str) -> str:
    """Return a unit with the space before it; nothing for a pure number."""
    return "" if unit in ("", "-") else f" {unit}"


def estimate(found: ParameterEstimate) -> str:
    """Return ``0.041 (0.038 to 0.045) N m``; angles in degrees, too."""
    degrees = f" = {number(math.degrees(found.value))}°" if found.unit == "rad" else ""
    known = math.isfinite(found.low) and math.isfinite(found.high)
    value, low, high = _written(found.value, found.low, found.high) if known else (number(found.value), "", "")
    return f"{value}{f' ({low} to {high})' if known else ''}{unit_of(found.unit)}{degrees}"


def _written(value: float, low: float, high: float) -> tuple[str, str, str]:
    """A value and its interval: down to the uncertainty, or, where the value is smaller than that, to its second digit."""
    uncertainty = 0.5 * (high - low)
    if uncertainty <= abs(value):
        # three at least: a scale of 1.022, known to 0.004
        digits = max(3, math.ceil(math.log10(abs(value) / uncertainty)) + 1) if uncertainty > 0.0 else 3
        return number(value, digits), number(low, digits), number(high, digits)
    decimals = max(0, 1 - math.floor(math.log10(uncertainty)))
    first, second, third = (f"{round(one, decimals) + 0.0:.{decimals}f}" for one in (value, low, high))
    return first, second, third


# ---- the verdict -----------------------------------------------------------------------------------------------------


def title(analysis: Analysis) -> str:
    """Return the title of a report."""
    return NOTHING_CLEAR if _leaves_something(analysis) else TITLES[analysis.verdict]


def _leaves_something(analysis: Analysis) -> bool:
    """Whether nothing was named although the held-out runs' error is well above the noise floor, or some runs show one."""
    return analysis.verdict == NOTHING_MISSING and bool(closure(analysis) or _shown_by_some_runs_only(analysis))


def closure(analysis: Analysis) -> str:
    """Return what is left in the held-out runs, and where, in one sentence; empty if that is hardly more than noise."""
    gap = analysis.gap
    if gap is None or not gap.heldout_after >= UNEXPLAINED * gap.noise_floor:
        return ""
    above: dict[str, float] = {}
    for one in analysis.channel_gaps:
        square = max(one.after**2 - gap.noise_floor**2, 0.0) if math.isfinite(one.after) else 0.0
        above[one.group] = above.get(one.group, 0.0) + square
    most = max(above, key=lambda group: above[group], default="")
    share = above[most] / sum(above.values()) if above and sum(above.values()) > 0.0 else math.nan
    where = f"; {percent(share)} of it is in {_GROUPS.get(most, most.replace('_', ' '))}" if math.isfinite(share) else ""
    return (
        f"Not all is explained: an error of {error(gap.heldout_after)} is left in the held-out runs, above the noise floor of "
        f"{error(gap.noise_floor)}{where}."
    )


def below_floor(analysis: Analysis) -> str:
    """Return why the error of the held-out runs is smaller than a perfect model's, in one sentence; empty where it is not."""
    gap = analysis.gap
    if gap is None or not gap.heldout_after < gap.noise_floor or error(gap.heldout_after) == error(gap.noise_floor):
        return ""
    most = ": 100 % is the most that is counted" if analysis.added else ""
    return f"{error(gap.heldout_after)} is below the expected level of noise ({error(gap.noise_floor)}), by chance{most}."


def made_worse(analysis: Analysis) -> str:
    """Return which channels of the held-out runs the effects make worse, in one sentence; empty if none."""
    worse = [one for one in analysis.channel_gaps if one.worse] if analysis.added else []
    if not worse:
        return ""
    worst = sorted(worse, key=lambda one: one.calibrated**2 - one.after**2)[:MOST_WORSE]
    steps = [(channel(one.channel), *(capped(value, analysis.gap) for value in (one.calibrated, one.after))) for one in worst]
    shown = listed([f"{name} ({before} to {after})" for name, before, after in steps])
    more = f", and {len(worse) - len(worst)} more" if len(worse) > len(worst) else ""
    which = "One channel gets" if len(worse) == 1 else f"{len(worse)} of {len(analysis.channel_gaps)} channels get"
    return f"{which} significantly worse in the held-out runs: {shown}{more}."


def adequacy(found: Adequacy) -> str:
    """Return the residual tests of the final model in words: what chance does not explain, and how large it is."""
    tested = {
        f"an error of {error(found.level.value)} times the sensor noise": found.level,
        f"an integrated autocorrelation time of {error(found.whiteness.value)} rows": found.whiteness,
        "scatter of the runs' estimates of the model's numbers": found.constancy,
    }
    beyond = [f"{text} ({error(one.ratio)} times what is expected)" for text, one in tested.items() if one.rejected]
    compared = f"Compared with {found.replicates} sets of runs that the final model made itself"
    untested = "" if math.isfinite(found.constancy.p) else " Whether the runs agree could not be tested."
    if not beyond:
        return f"{compared}, it leaves nothing in the fitted runs that chance does not explain.{untested}"
    levels = {name: level for name, level in found.level.channels.items() if level.rejected}
    excess = {name: one.value**2 - one.expected**2 for name, one in levels.items()}
    most = sorted(levels, key=lambda name: -excess[name])[:3]
    where = f" Most of the error that is not expected is in {listed(most)}." if found.level.rejected and most else ""
    most_pulled = found.constancy.pulled_most
    pulled = f" {most_pulled.run} pulls {most_pulled.number} farthest from the others." if most_pulled.rejected else ""
    return f"{compared}, more than chance explains is left in the fitted runs: {listed(beyond)}.{where}{pulled}{untested}"


def sentence(analysis: Analysis) -> str:
    """Return the verdict in one sentence: the analysis' own, or one made from its numbers."""
    return analysis.summary or _SENTENCES[analysis.verdict](analysis)


def _bad_data(analysis: Analysis) -> str:
    causes = [": ".join(filter(None, [one.place, one.said])).rstrip(".") for one in analysis.intake if one.fatal]
    more = f" (and {len(causes) - 1} more reason{'s' if len(causes) > 2 else ''})" if len(causes) > 1 else ""
    return f"These data cannot be used: {causes[0]}{more}." if causes else "These data cannot be used."


def _not_excited(analysis: Analysis) -> str:
    wanted = listed([recommendation.excitation for recommendation in analysis.recommendations])
    if shown := _shown_by_some_runs_only(analysis):
        return f"{shown}: record more such runs{f', and {wanted}' if wanted else ''}."
    return f"These runs excite too little to show whether the model lacks anything{f'; record {wanted}' if wanted else ''}."


def _shown_by_some_runs_only(analysis: Analysis) -> str:
    """Return which run shows what that others do not, as a clause; "" = none does."""
    alone = [evidence for evidence in analysis.evidence if evidence.outcome == FAILS_CROSS_VALIDATION and evidence.by_run]
    if not alone:
        return ""
    shown = max(alone, key=lambda evidence: evidence.gain)
    run = max(shown.by_run, key=lambda name: shown.by_run[name])
    return f"{run} shows {plain(shown.name)} ({places(shown.where)}) most clearly, but runs left out of the fit do not"


def _nothing_missing(analysis: Analysis) -> str:
    gap = analysis.gap
    calibrated = " once its parameters are calibrated" if analysis.calibration else ""
    if gap is None:
        return f"The model lacks nothing that these runs could show{calibrated}."
    rest = f"it replays the held-out runs to within {error(gap.heldout_calibrated)} times the sensor noise"
    if not _leaves_something(analysis):
        return f"The model lacks nothing that these runs could show: {rest}{calibrated}."
    alone = _shown_by_some_runs_only(analysis)
    return (
        f"No effect of the library is clear enough in these runs to be named: the model {rest.removeprefix('it ')}{calibrated}"
        f"{f'. {alone}; more such runs would tell' if alone else ''}."
    )


def _effect_found(analysis: Analysis) -> str:
    names = [
        f"{'an ' if effect.name == UNKNOWN_EFFECT else ''}{plain(effect.name)} ({places(effect.where)})"
        for effect in analysis.effects
    ]
    lost = names[0] if len(names) == 1 else f"{len(names)} effects: {listed(names)}"
    doubts = []  # other names that these data leave possible, each beside the effect that it may stand for
    for group in analysis.equivalent:
        others = [plain(name) for name in group.names if name not in {effect.name for effect in analysis.effects}]
        if others:
            doubts.append(f"{plain(group.names[0]) if len(names) > 1 else 'it'} from {listed(others, 'or')}")
    doubt = f"; these data do not distinguish {', nor '.join(doubts)}" if doubts else ""
    return f"The model lacks {lost}{_improvement(analysis)}{doubt}."


def _unknown(analysis: Analysis) -> str:
    acts = f" ({places(analysis.effects[0].where)})" if analysis.effects else ""
    lacks = f"The model lacks something{acts} that no effect of the library explains"
    if any(effect.formula for effect in analysis.effects):
        return f"{lacks}; a formula describes it{_improvement(analysis)}."
    shown = turned(analysis.turning) if analysis.turning else _misfit(analysis)
    return f"{lacks}; no formula describes it either{f': {shown}' if shown else ''}."


def _misfit(analysis: Analysis) -> str:
    """What is left where nothing that has a name explains it."""
    gap = analysis.gap
    if gap is None:
        return ""
    left, run = most_left(gap.fit_after, analysis.run_gaps)
    replayed = f"to within {capped(left, gap)} times the sensor noise, where a complete model reaches {error(gap.noise_floor)}"
    if run and analysis.channel_gaps:
        worst = channel(most_in(analysis.channel_gaps))
        return f"{run}, which no fit has used, is replayed {replayed}; in held-out runs {worst} is worst"
    most = [f"; {percent(one.share)} of what is left is in {channel(one.name)}" for one in analysis.localisation[:1]]
    return f"the fitted runs are replayed {replayed}{''.join(most)}"


def turned(turning: Turning) -> str:
    """Return a residual that is periodic in a joint's angle in words."""
    times = {1: "once", 2: "twice"}.get(turning.order, f"{turning.order} times")
    return (
        f"{percent(turning.share)} of the squared residual of {turning.signal} is periodic, {times} per turn of the "
        f"{places((turning.joint,))} ({error(turning.amplitude)} times the sensor noise), as with a wheel out of round or an "
        "encoder off its centre"
    )


#: Share of the avoidable error that a finding must remove, by the whole of its interval, to be said to help.
HELPS = 0.1


def _improvement(analysis: Analysis) -> str:
    if analysis.gap is None or not analysis.added:
        return ""
    share, one = analysis.gap.reduction, len(analysis.added) == 1
    if not math.isfinite(analysis.gap.noise_floor):
        errors = (
            f"{capped(analysis.gap.heldout_calibrated, analysis.gap)} to {capped(analysis.gap.heldout_after, analysis.gap)}"
        )
        return f"; added, {'it changes' if one else 'they change'} the error of the held-out runs from {errors}"
    if not math.isfinite(share):
        return "; the error of the held-out runs is as small without it"
    if share < 0.0 <= analysis.gap.reduction_ci95[1]:
        does = "it does" if one else "they do"
        return f"; added, {does} not measurably change the error of the held-out runs: {removed(analysis)}"
    if share < 0.0:
        does = "makes" if one else "make"
        return f"; added, {'it' if one else 'they'} {does} the error of the held-out runs larger: {removed(analysis)}"
    text = f"; added, {'it removes' if one else 'they remove'} {removed(analysis)} of the avoidable error of the held-out runs"
    if not analysis.gap.reduction_ci95[0] <= HELPS:  # of two runs there is no interval
        return text
    hint = "check the servo profile in meta.yaml and the robot file before you use it"
    return f"{text}, which {'may be' if analysis.gap.reduction_ci95[1] > HELPS else 'is'} too little to help: {hint}"


def removed(analysis: Analysis) -> str:
    """Return ``95 % (95 % interval 91 to 97 %)``: what the effects remove of the avoidable error; negative = they add to it."""
    return f"{percent(analysis.gap.reduction if analysis.gap else math.nan)} ({interval(analysis)})"


_SENTENCES: dict[str, Callable[[Analysis], str]] = {
    BAD_DATA: _bad_data,
    NOT_EXCITED: _not_excited,
    NOTHING_MISSING: _nothing_missing,
    EFFECT_FOUND: _effect_found,
    UNKNOWN: _unknown,
}
