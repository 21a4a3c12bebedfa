"""The report of an analysis: one HTML page with its pictures inside, for an engineer who never saw the tool; and its folder."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from wlr_gym import __version__
from wlr_gym.base.errors import InputError
from wlr_gym.base.files import contents, make_output_folder, replace_file, require_output_place, write_text
from wlr_gym.base.html import commands, document, folded, heading, pictures_of, section, table
from wlr_gym.base.provenance import CONFIG_FILE, PROVENANCE_FILE
from wlr_gym.base.text import counted, duration, number
from wlr_gym.data.excitations import EXCITATIONS
from wlr_gym.gap.analysis import (
    BAD_DATA,
    EFFECT_FOUND,
    NO_PROFILE,
    NOT_EXCITED,
    NOTHING_MISSING,
    REJECTED,
    SELECTED,
    UNKNOWN,
    Adequacy,
    Analysis,
    Calibrated,
    Evidence,
    FoundEffect,
    GapFigures,
    Statistic,
)
from wlr_gym.gap.report.plots import draw
from wlr_gym.gap.report.recommendation import record_commands
from wlr_gym.gap.report.result import PATCH_FILE, RESULT_FILE, patch_of, read_result, result_of, write_result
from wlr_gym.gap.report.text import (
    adequacy,
    below_floor,
    capped,
    channel,
    closure,
    error,
    estimate,
    interval,
    listed,
    made_worse,
    percent,
    places,
    plain,
    removed,
    sentence,
    title,
    turned,
    unit_of,
)
from wlr_gym.gap.validation.held_out import LEAST_FOR_INTERVAL
from wlr_gym.physics.effects import EFFECTS, UNKNOWN_EFFECT, load_patch
from wlr_gym.robot.parameter_table import TABLE

_COLOURS = {
    BAD_DATA: "#b03030", NOT_EXCITED: "#8a6d00", NOTHING_MISSING: "#2e7d32", EFFECT_FOUND: "#1f4e9c", UNKNOWN: "#7b3fa0",
}  # fmt: skip

#: Name of the robot of commands without ``--robot``.
NOMINAL = "nominal"
#: Tolerances by which a calibrated number must have moved to be shown at once.
_FAR = 0.5
CAPTIONS = {
    "where": "In which states the calibrated model is wrong: each row a measured channel, each column a range of what is named "
    "below. The numbers are rms errors; about 1 is what sensor noise alone would leave, grey is a range without data.",
    "relations": "Which relations of the model could hold the gap: the predicted improvement by the best law that acts there "
    "alone. The true place is among the longest bars; others are long because they move the robot in a similar way.",
    "overlays": "Measured runs, and the same runs replayed by the model. Below each: the error as it is counted "
    "(pose and wheel angles: since a window of some 2 s began, x and y along and across its heading; what shakes on the tyres: "
    "averaged, noise keeps its size); the green band is two standard deviations of sensor noise.",
    "gap": "Error of replayed runs. Left: over the held-out runs, with the 95 % interval of the reduction by the effects. "
    "Right: run by run; dotted: 1, the noise of the sensors, which the noise floor of these runs need not be.",
    "channels": "The same for each measured channel, over the held-out runs.",
    "evidence": "By how much each candidate improves the fit: all that were fitted, and the best that were not. The "
    "selected one is dark.",
}


# ---- the page --------------------------------------------------------------------------------------------------------


def report(analysis: Analysis, pictures: Mapping[str, bytes], folder: Path) -> str:
    """Return the page.

    Args:
        analysis: what was found.
        pictures: name -> PNG, of :func:`wlr_gym.gap.report.plots.draw`.
        folder: where the results are, for the commands it shows.
    """
    body = [
        _header(analysis),
        _where(analysis, pictures),
        _what(analysis, pictures),
        _how_much(analysis, pictures),
        _how_sure(analysis),
        _next(analysis),
        _calibration(analysis),
        _intake(analysis),
        _use(analysis, folder),
        _footer(analysis),
    ]
    return document(f"{title(analysis)}: {analysis.data}", _COLOURS[analysis.verdict], body)


def _pictures(kind: str, pictures: Mapping[str, bytes]) -> str:
    return pictures_of(kind, pictures, CAPTIONS[kind])


def _header(analysis: Analysis) -> str:
    facts = [f"Data: <code>{escape(analysis.data)}</code>"]
    fitted, held = (
        f"{counted(len(names), 'run')} ({escape(', '.join(names))})" for names in (analysis.fit_runs, analysis.heldout_runs)
    )
    facts += [f"fitted to {fitted}"] if analysis.fit_runs else []
    facts += [f"validated on {held}, which no fit has used"] if analysis.heldout_runs else []
    if analysis.known_effects:
        known = listed([plain(str(effect.get("name", ""))) for effect in analysis.known_effects])
        facts.append(f"known from the start: {escape(known)}")
    assumed = [f"{one.text}." for one in analysis.intake if one.kind == NO_PROFILE]
    left = "".join(f"<p>{escape(text)}</p>\n" for text in (*assumed, made_worse(analysis), closure(analysis)) if text)
    return (
        f'<header>\n<p class="label">{escape(title(analysis))}</p>\n<h1>{escape(sentence(analysis))}</h1>\n{left}'
        f'<p class="small">{"; ".join(facts)}.</p>\n</header>\n{_tiles(analysis)}'
    )


def _tiles(analysis: Analysis) -> str:
    gap = analysis.gap
    if gap is None:
        return ""
    before, calibrated, after = _errors(gap.heldout_before, gap.heldout_calibrated, gap.heldout_after, gap)
    floor = (error(gap.noise_floor), "noise floor: what a perfect model reaches")
    tiles = [(before, "error of the model as given"), (calibrated, "after calibration"), floor]
    if analysis.added:
        tiles.insert(2, (after, "with the effects added"))
        tiles.append((percent(gap.reduction), f"of the avoidable error removed; {interval(analysis)}"))
    items = "".join(f"<li><b>{escape(value)}</b>{escape(text)}</li>" for value, text in tiles)
    return (
        f'<ul class="figures">{items}</ul>\n<p class="small">Errors are of the held-out runs, replayed by the model with the '
        f"commands of the measured run: {escape(gap.metric)}; 1 = the noise of the sensors. {escape(below_floor(analysis))}</p>"
    )


# ---- where ----------------------------------------------------------------------------------------------------------


def _where(analysis: Analysis, pictures: Mapping[str, bytes]) -> str:
    ordered = sorted(analysis.localisation, key=lambda place: -place.share)
    rows = [(place.name, channel(place.name), percent(place.share), place.dependence) for place in ordered]
    shown = [_pictures(kind, pictures) for kind in ("relations", "overlays", "where")]
    if not any((rows, *shown)):
        return ""
    text = (
        "<p>First the model was calibrated: its parameters were moved within their tolerances until it fits the runs as well "
        "as it can. The error that is left is shown here.</p>"
    )
    if analysis.turning:
        text += f"<p>With the final model, {escape(turned(analysis.turning))}.</p>"
    headings = ("channel", "", "share of the gap", "how it depends on the state")
    return section("Where", text, table(headings, rows, {2}), *shown)


# ---- what is missing -------------------------------------------------------------------------------------------------


def _what(analysis: Analysis, pictures: Mapping[str, bytes]) -> str:
    """What was found, what the data cannot distinguish it from, and every candidate."""
    parts = [_effect(effect) for effect in analysis.effects]
    if analysis.equivalent:
        rows = [(listed([plain(name) for name in group.names], "or"), group.separating_run) for group in analysis.equivalent]
        parts += [heading("Effects not distinguishable in these data"), table(("one of", "discriminating experiment"), rows)]
    if analysis.evidence:
        rounds = sorted({one.round for one in analysis.evidence})
        parts += [heading("Candidates compared"), _COMPARED, _pictures("evidence", pictures)]
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
    rows = [
        (name, estimate(found) if math.isfinite(found.low) else f"{estimate(found)}, assumed: runs hardly show it")
        for name, found in effect.parameters.items()
    ]
    tried = [
        f"{plain(name)} is {number(one.low)} to {number(one.high)}{unit_of(one.unit)}" for name, one in effect.validity.items()
    ]
    return "\n".join(
        [
            heading(f"{plain(effect.name).capitalize()}: {places(effect.where)}"),
            f"<p>{escape(meaning)} In files: <code>{escape(effect.name)}</code>, where <code>{escape(', '.join(effect.where))}"
            f"</code>. Selection frequency {percent(effect.confidence)}.</p>",
            f"<p>Law: <code>{escape(law)}</code></p>" if law else unlawful,
            *([f"<p>Tried where {escape(listed(tried))}; beyond, it is untested.</p>"] if tried else []),
            table(("parameter", "value (95 % interval)"), rows),
        ]
    )


def _evidence(evidence: Sequence[Evidence], turn: int, none: float) -> str:
    """The candidates of one round; ``none``: probability that none of them is missing."""
    fitted = [one for one in evidence if one.outcome != REJECTED]
    fitted.sort(key=lambda one: (one.outcome != SELECTED, -one.gain if math.isfinite(one.gain) else math.inf))
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


def _values(one: Evidence) -> str:
    known = EFFECTS[one.name].parameters if one.name in EFFECTS else {}
    units = {name: spec.unit for name, spec in known.items()} | dict(one.units)
    return ", ".join(f"{name} {number(value)}{unit_of(units.get(name, ''))}" for name, value in one.values.items())


# ---- how much, how sure, what next -----------------------------------------------------------------------------------


def _how_much(analysis: Analysis, pictures: Mapping[str, bytes]) -> str:
    gap = analysis.gap
    if gap is None:
        return ""
    headings = ("as given", "calibrated", "with effects")[: 3 if analysis.added else 2]
    of_runs = (*headings, "removed") if analysis.added else headings
    runs, channels = [], []
    for one in analysis.run_gaps:
        cells = (*_errors(one.before, one.calibrated, one.after, gap), percent(one.reduction))
        runs.append((one.run, "held out" if one.heldout else "fitted", *cells[: len(of_runs)]))
    for one in analysis.channel_gaps:
        cells = _errors(one.before, one.calibrated, one.after, gap)
        noise = f"{number(one.noise)}{unit_of(one.unit)}"
        channels.append((one.channel, channel(one.channel), noise, *cells[: len(headings)]))
    return section(
        "How much",
        _gap_in_words(gap, analysis),
        _pictures("gap", pictures),
        table(("run", "", *of_runs), runs, {2, 3, 4, 5}),
        _pictures("channels", pictures),
        folded("Numbers of each channel", table(("channel", "", "noise (1 sigma)", *headings), channels, {2, 3, 4, 5})),
    )


def _errors(before: float, calibrated: float, after: float, gap: GapFigures) -> tuple[str, str, str]:
    return capped(before, gap), capped(calibrated, gap), capped(after, gap)


def _gap_in_words(gap: GapFigures, analysis: Analysis) -> str:
    """What the figures at the top do not say."""
    fitted = f"{capped(gap.fit_before, gap)} as given, {capped(gap.fit_after, gap)} after"
    text = f"<p>Error of replayed runs, as at the top. Over the runs that were fitted: {fitted}.</p>"
    if not analysis.added:
        return text
    return (
        f"{text}\n<p>What was found removes {removed(analysis)} of the avoidable error of the held-out runs: of the distance "
        "from the calibrated model to the noise floor. A negative value means that it makes them worse. The interval is "
        "Student's, with as many degrees of freedom as there are held-out runs, less one; fewer than "
        f"{LEAST_FOR_INTERVAL} give none.</p>"
    )


def _how_sure(analysis: Analysis) -> str:
    parts = []
    if analysis.effects:
        parts.append(_SELECTION_FREQUENCY)
    if analysis.adequacy:
        parts += [heading("Is anything left?"), _adequacy(analysis.adequacy)]
    if analysis.detectable:
        sizes = [
            (plain(name), one.parameter, f"{number(one.value)}{unit_of(one.unit)}" if math.isfinite(one.value) else _NONE)
            for name, one in sorted(analysis.detectable.items())
        ]
        parts += [heading("What these runs would have shown"), _DETECTABLE]
        parts.append(table(("effect", "parameter", "smallest size"), sizes, {2}))
    return section("How sure", *parts)


def _adequacy(found: Adequacy) -> str:
    ordered = sorted(found.level.channels, key=lambda name: -found.level.channels[name].value)
    pulled = found.constancy.pulled_most
    rows = [
        ("level", "error of all channels, units of sensor noise", *_statistic(found.level)),
        ("whiteness", "integrated autocorrelation time in rows, geometric mean of the channels", *_statistic(found.whiteness)),
        ("constancy", "scatter of the runs' estimates over what their rows predict", *_statistic(found.constancy)),
        ("", f"standard errors by which {pulled.run} pulls {pulled.number}: the largest", *_statistic(pulled)),
    ]
    for kind, tested in (("level", found.level), ("whiteness", found.whiteness)):
        rows += [(f"{kind}: {name}", channel(name), *_statistic(tested.channels[name])) for name in ordered]
    headings = ("what", "", "measured", "expected", "95 % limit", "times", "p")
    return (
        f"<p>{escape(adequacy(found))}</p>\n{_ADEQUACY}\n"
        f"{folded('All three, and every channel', table(headings, rows, {2, 3, 4, 5, 6}))}"
    )


def _statistic(found: Statistic) -> tuple[str, ...]:
    return error(found.value), error(found.expected), error(found.limit), error(found.ratio), error(found.p)


_ADEQUACY = """<p>No decision depends on this. No simulator is exact, and such tests notice that: with real runs they always
reject. What matters is how many times larger than expected. Of runs that another simulator of the same robot made, with
nothing missing, it was 1.1 to 1.7 (level, whiteness) and 1.4 to 1.5 (constancy); where one wheel stood on a slippery floor 10,
3.7 and 5.2 before that was in the model, and 2.1, 2.0 and 1.8 with it. One channel in 20 exceeds its limit by chance.</p>"""
_SELECTION_FREQUENCY = """<p>Selection frequency (bootstrap): the fitted runs are drawn again and again, with replacement, each
with its part in the gain of every candidate (nothing is refitted). It is the share of these draws in which the effect improves
the fit enough, the runs agree, and no other effect improves it more; of an effect without a formula, in which it is as clear.
A 95 % interval misses the true number in one of 20 cases, provided that nothing else is wrong with the model.</p>"""
_NONE = "none that is plausible"
_DETECTABLE = """<p>The smallest size of each effect that would have been noticed, at the place where it is hardest to see.
Smaller ones may be there. Of an effect with several directions (a displaced mass: x, y, z) it is the direction that shows best:
in another it may stay hidden at any size.</p>"""


def _next(analysis: Analysis) -> str:
    parts = []
    if analysis.recommendations:
        parts.append(table(("motion", "why"), [(one.excitation, one.why) for one in analysis.recommendations]))
        known = [name for name in dict.fromkeys(one.excitation for one in analysis.recommendations) if name in EXCITATIONS]
        if known:
            parts.append("<p>Drive them on the robot, or write their command files with <code>--commands-only</code>:</p>")
            parts.append(commands([line + _robot(analysis) for line in record_commands(known)]))
    named = [(one.separating_run, listed([plain(name) for name in one.names], "from")) for one in analysis.equivalent]
    items = [f"<li>{escape(run)}: distinguishes {escape(names)}.</li>" for run, names in named if run]
    return section("What to run next", *parts, f"<ul>{''.join(items)}</ul>" if items else "")


# ---- calibration, intake, use ----------------------------------------------------------------------------------------


def _calibration(analysis: Analysis) -> str:
    if not analysis.calibration:
        return ""
    text = (
        "<p>Parameters that are known only to a tolerance were fitted before anything was called missing. "
        "<i>Moved</i> counts in tolerances: where a number has moved as far as it may (2.5; biases of sensors 4), doubt the "
        "tolerance or the model; its interval is set to 1.96 tolerances, as the fit gives none.</p>"
    )
    headings, right = ("number", "unit", "nominal", "fitted", "± (95 %)", "tolerance (1 sigma)", "moved"), {2, 3, 4, 5, 6}
    ordered = sorted(analysis.calibration.items(), key=lambda pair: -abs(_shift(pair[1])))
    rows = [
        (
            name, moved.unit, number(moved.nominal, 4), number(moved.fitted, 4), number(moved.uncertainty, 2),
            number(moved.sigma, 2), f"{_shift(moved):+.1f}",
        )
        for name, moved in ordered
    ]  # fmt: skip
    far = sum(abs(_shift(moved)) >= _FAR for _, moved in ordered)
    rest = folded(f"{len(rows) - far} that moved by less than {_FAR:g} tolerances", table(headings, rows[far:], right))
    return section("Calibration", text, table(headings, rows[:far], right), rest if far < len(rows) else "")


def _shift(moved: Calibrated) -> float:
    """By how many tolerances a number moved; 0 where there is none."""
    return (moved.fitted - moved.nominal) / moved.sigma if moved.sigma > 0 else 0.0


def _intake(analysis: Analysis) -> str:
    if not analysis.intake:
        return section("The data", "<p>Nothing odd was noticed about the data.</p>")
    ordered = sorted(analysis.intake, key=lambda one: not one.fatal)
    rows = [
        (
            "fatal" if one.fatal else "noted",
            one.run or "all",
            one.channel or "all",
            "" if one.time is None else f"{one.time:.2f} s",
            one.kind.replace("_", " "),
            one.said,
        )
        for one in ordered
    ]
    classes = ["fatal" if one.fatal else "" for one in ordered]
    text = "<p>What was noticed about the data before any model was asked.</p>"
    return section("The data", text, table(("", "run", "channel", "from", "kind", "what was seen"), rows, classes=classes))


def _use(analysis: Analysis, folder: Path) -> str:
    if analysis.verdict in (BAD_DATA, NOT_EXCITED):
        return ""
    patch, result, data = (shlex.quote(str(path)) for path in (folder / PATCH_FILE, folder / RESULT_FILE, analysis.data))
    known, robot = "FILES-GIVEN-AS-KNOWN " if analysis.known_effects else "", _robot(analysis)
    effects = f"--effects {known}{patch}"
    lines = [f"wlr effects check {patch}", f"wlr replay {data} --out replayed {effects}", f"wlr train {_TASK} {effects}"]
    found = patch_of(analysis)
    try:
        load_patch(found.content())
    except InputError as error:
        refused = f"The patch says what was found. The robot's simulators cannot load it: {escape(str(error))}."
        parts = [f"<p>{refused}</p>"]
    else:
        parts = [_PATCH, commands([line + robot for line in lines])]
    if not found.effects:
        parts = ["<p>There is no effect to add: the patch is empty.</p>"]
    if _drawable(analysis):
        line = f"wlr train {_TASK} --set environment.randomization={result}{robot}"
        parts += [_RESULT, commands([f"{line} --effects {known}".rstrip() if known else line])]
    return section("How to use the result", *parts)


def _robot(analysis: Analysis) -> str:
    """The option that names the robot, where it is not the nominal one."""
    robot = analysis.provenance.get("robot", NOMINAL)
    return "" if robot == NOMINAL else f" --robot {shlex.quote(str(robot))}"


_TASK = "WLR-Velocity-v0"
_PATCH = """<p><code>patch.yaml</code> holds the effects, to be laid over the nominal model. Every command that simulates takes
it: check it, replay the runs with it, train with it.</p>"""
_RESULT = """<p>The patch does not hold the calibrated numbers. <code>result.json</code> holds these and the effects with their
uncertainty: used as randomization (without the patch; known effects are not in it), every episode draws a robot that these data
allow.</p>"""


def _drawable(analysis: Analysis) -> bool:
    """Whether the result can be used as randomization: it has numbers, of the parameter table and of named effects."""
    known = {name for spec in TABLE for name in (spec.name, spec.tolerance)}
    calibrated = all(name.partition("[")[0] in known for name in analysis.calibration)
    named = all(effect.name in EFFECTS for effect in analysis.effects)
    return named and calibrated and bool(analysis.calibration or analysis.effects)


def _footer(analysis: Analysis) -> str:
    spent = [f"{stage} {duration(seconds)}" for stage, seconds in analysis.seconds.items()]
    total = f"Time: {duration(sum(analysis.seconds.values()))} ({', '.join(spent)}). " if spent else ""
    origin = [f"{key}: {value}" for key, value in analysis.provenance.items() if isinstance(value, str | int | float)]
    made = "; ".join([f"Made by wlr gap {__version__}", *origin])
    return f"<footer><p>{escape(f'{total}{made}.')}</p></footer>"


# ---- the folder ------------------------------------------------------------------------------------------------------

REPORT_FILE = "report.html"
#: Folder of the pictures.
PLOTS = "plots"
_OWN = {RESULT_FILE, PATCH_FILE, REPORT_FILE, PLOTS, CONFIG_FILE, PROVENANCE_FILE}


def check_folder(folder: Path) -> None:
    """Refuse, before the work, a folder that the results cannot go into; nothing is made.

    Raises:
        InputError: a file, a folder without rights, or one with contents that no earlier analysis wrote.
    """
    there = [path.name for path in contents(folder)]
    strange = [name for name in there if name not in _OWN] or ([] if _is_analysis(folder) else there)
    if strange:
        raise InputError(f"--out {folder}: '{strange[0]}' in it is not of an analysis; expected a new folder or an earlier one")
    require_output_place(folder)


def _is_analysis(folder: Path) -> bool:
    """Whether an analysis wrote a folder: files of these names alone may be anybody's."""
    if not (folder / RESULT_FILE).exists():  # one that was interrupted, before anything but pictures was there
        return (folder / PROVENANCE_FILE).exists() or not any((folder / name).exists() for name in (PATCH_FILE, CONFIG_FILE))
    try:
        read_result(folder / RESULT_FILE)
    except InputError:
        return False
    return True


def save_analysis(analysis: Analysis, folder: Path) -> Path:
    """Write report, pictures, patch and result into ``folder``, and return the path of the result.

    Everything is made before anything is written, and ``result.json`` comes last: a folder that holds one is whole.

    Raises:
        InputError: see :func:`check_folder`, or a folder that cannot be written to.
    """
    check_folder(folder)
    result_of(analysis)
    pictures = draw(analysis)
    page = report(analysis, pictures, folder)
    make_output_folder(folder / PLOTS)
    # the provenance stays until there is a result: it tells whose the folder is
    for stale in (RESULT_FILE, PATCH_FILE, CONFIG_FILE):
        (folder / stale).unlink(missing_ok=True)
    for stale in (folder / PLOTS).glob("*.png"):
        if stale.stem.rstrip("_0123456789") in CAPTIONS:
            stale.unlink()
    for name, picture in pictures.items():
        replace_file(folder / PLOTS / f"{name}.png", lambda temporary, picture=picture: temporary.write_bytes(picture))
    write_text(folder / REPORT_FILE, page)
    return write_result(analysis, folder)
