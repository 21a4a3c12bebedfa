"""Last stages: the gap workflow names the hidden fault, its patch is tried on held-out runs, and the truth is shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.base.html import heading, table
from wlr_gym.base.plots import new_figure, tidy
from wlr_gym.base.text import number
from wlr_gym.gap.report.text import listed, places, plain, unit_of
from wlr_gym.studies.demo.settings import Demo
from wlr_gym.studies.demo.stage import NOT_SHOWN, SHOWN, Section, Tell, drawn, link, paragraph, picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from wlr_gym.data.replay import ReplayResult
    from wlr_gym.gap.report.entries import EffectEntry, Result
    from wlr_gym.physics.effects.effect import PatchEffect

NAME_TITLE = "4. What does the simulator lack?"
CHECK_TITLE = "5. Does it hold?"
#: Channels in the picture of a replay.
_SHOWN = 3
#: A channel has got worse where its error rises by more than this; 1 = sensor noise.
_WORSE = 0.1


def name(demo: Demo, tell: Tell) -> Section:
    """Run the gap workflow on the measured runs, and nothing else."""
    from wlr_gym.gap import analyse
    from wlr_gym.gap.analysis import EFFECT_FOUND
    from wlr_gym.gap.report.folder import REPORT_FILE
    from wlr_gym.gap.report.text import sentence

    if not demo.measured.is_dir():
        raise InputError("no measured runs: the robot was not driven")
    found = analyse(demo.measured, demo.gap, tell=lambda text, share: tell(f"gap workflow: {text}", share))
    html = paragraph(
        "The gap workflow gets the folder of measured runs. It calibrates the simulator within its tolerances, tests every "
        "effect of its library at every place, and holds out one run or two that no fit has seen."
    )
    html += f"<p><b>{escape(sentence(found))}</b></p>"
    plots = demo.gap / "plots"
    for kind, caption in (
        ("evidence", "By how much each candidate improves the fit; the selected one is dark."),
        ("overlays_1", "Measured channels, and the same runs replayed by the simulator as given, calibrated, and with what was "
         "found; below each the error that is left. Green: two standard deviations of sensor noise."),
    ):  # fmt: skip
        if (plots / f"{kind}.png").is_file():
            html += picture(plots / f"{kind}.png", caption)
    files = ((REPORT_FILE, "the whole report"), ("patch.yaml", "the patch"))
    links = [link(demo, demo.gap / name, text) for name, text in files if (demo.gap / name).is_file()]
    html += f"<p>Files: {', '.join(links)}.</p>"
    verdict = SHOWN if found.verdict == EFFECT_FOUND else NOT_SHOWN
    return Section(NAME_TITLE, sentence(found), html, verdict)


# ---- does it hold? ---------------------------------------------------------------------------------------------------


def check(demo: Demo, tell: Tell) -> Section:
    """Replay the held-out runs with and without the patch, then show the hidden fault."""
    from wlr_gym.gap.report.result import PATCH_FILE, RESULT_FILE, read_result
    from wlr_gym.physics.effects import load_patch

    if not (demo.gap / RESULT_FILE).is_file():
        raise InputError("no result of the gap workflow to check")
    result = read_result(demo.gap / RESULT_FILE)
    html, agrees, better = _replayed(demo, result, load_patch(demo.gap / PATCH_FILE), tell)
    hidden = load_patch(demo.hidden).effects[0]
    answer = judge(hidden, result.effects, result.equivalent)
    html += heading("The hidden fault") + _revealed(hidden, result.effects, answer)
    return Section(CHECK_TITLE, f"{answer.sentence} {agrees}", html, SHOWN if answer.right and better else NOT_SHOWN)


def _replayed(demo: Demo, result: Result, patch: Any, tell: Tell) -> tuple[str, str, bool]:
    """Return the part about the replays, its sentence for the top of the page, and whether all of the simulator got better."""
    from wlr_gym.data import read_dataset
    from wlr_gym.data.replay import pooled, replay

    runs = [run for run in read_dataset(demo.measured).runs if run.name in result.runs.heldout]
    if not runs:
        return paragraph("No run was held out."), "", False
    pairs = []
    for index, run in enumerate(runs):
        tell(f"replaying {run.name}, held out", index / len(runs))
        pairs.append((replay(run), replay(run, effects=patch)))

    def error(replayed: ReplayResult) -> float:
        return pooled(list(replayed.errors.values()), lambda one: one.segment_rms / one.noise)

    rows = [(one.run.name, number(error(one)), number(error(other))) for one, other in pairs]
    before, after = (float(np.sqrt(np.mean([error(pair[k]) ** 2 for pair in pairs]))) for k in range(2))
    text = paragraph(
        "The simulator as its file has it, not calibrated, drives the held-out runs once more: with nothing added, and with "
        "patch.yaml, as any command takes it (--effects). Pieces of one second, each begun where the robot was."
    )
    text += table(("held-out run", "error as given (1 = sensor noise)", "with the patch (1 = sensor noise)"), rows, (1, 2))
    text += drawn(
        _replay_picture(*pairs[0]),
        demo.out / "replay.png",
        f"{runs[0].name}, which no fit has seen: the channels that were furthest off without the patch.",
    )
    worse = worse_channels(*([one.errors for one in several] for several in zip(*pairs, strict=True)))
    verb = "fell" if after < before else "rose" if after > before else "stayed"
    said = f"With the patch the simulator's error on held-out runs {verb} from {number(before)} to {number(after)} "
    said += f"(1 = sensor noise){f', and rose in {listed(worse)}' if worse and after < before else ''}."
    return text, said, after < before and not worse


def worse_channels(before: Sequence[Mapping[str, Any]], after: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the channels whose error the patch makes larger, by more than a tenth of the sensor noise, over all runs.

    Args:
        before, after: channel -> error of each run, without the patch and with it.
    """

    from wlr_gym.data.replay import pooled

    def error(runs: Sequence[Mapping[str, Any]], channel: str) -> float:
        return pooled([run[channel] for run in runs], lambda one: one.segment_rms / one.noise)

    return [one for one in before[0] if error(after, one) > error(before, one) + _WORSE]


def _replay_picture(before: ReplayResult, after: ReplayResult) -> Figure:
    from wlr_gym.gap.report.plots import AFTER, CALIBRATED, MEASURED

    run = before.run
    seen = [name for name in before.errors if not name.startswith("pos_wheel")]  # in turns of a wheel no error is seen
    worst = sorted(seen, key=lambda name: -before.errors[name].segment_rms / before.errors[name].noise)[:_SHOWN]
    figure = new_figure(10.0, 2.3 * len(worst) + 0.5)
    rows = np.atleast_1d(figure.subplots(len(worst), 1, sharex=True))
    t = run["t"] - run["t"][0]
    for axes, channel in zip(rows, worst, strict=True):
        axes.plot(t, run[channel], color=MEASURED, linewidth=2.4, label="measured")
        for replayed, colour, label in ((before, CALIBRATED, "simulator as given"), (after, AFTER, "with the patch")):
            values = replayed.segments[channel].copy()
            values[list(replayed.starts)] = np.nan  # lift the pen between pieces
            axes.plot(t, values, color=colour, linewidth=1.0, label=label)
        was, now = (one.errors[channel] for one in (before, after))
        before_text, after_text = (f"{one.segment_rms:.2g}{unit_of(one.unit)}" for one in (was, now))
        axes.set_title(f"{channel}: rms error {before_text}, with the patch {after_text}", fontsize=9, loc="left")
        axes.set_ylabel(was.unit)
        tidy(axes)
        axes.margins(x=0.01)
    rows[-1].set_xlabel("time (s)")
    figure.legend(*rows[0].get_legend_handles_labels(), loc="outside upper right", ncols=3, fontsize=9, frameon=False)
    return figure


# ---- the hidden fault ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Diagnosis:
    """How good a diagnosis is.

    Attributes:
        named, placed: the hidden effect is among those found; at its place.
        near: another name was selected, and the report says that these data do not distinguish it from the hidden one.
        sizes: parameter -> (hidden, found, low, high); the interval is NaN where there is none.
        extra: names found that were not hidden.
    """

    named: bool
    placed: bool
    near: bool
    sizes: Mapping[str, tuple[float, float, float, float]]
    extra: tuple[str, ...]

    @property
    def right(self) -> bool:
        """Named, at its place, and nothing besides."""
        return self.named and self.placed and not self.extra

    @property
    def sentence(self) -> str:
        """Return the verdict in words."""
        if not self.named:
            return (
                "The name was not found, but the report gave it as an alternative." if self.near else "The name was not found."
            )
        place = "the place were right" if self.placed else "but not the place was right"
        text = f"The name {'and ' if self.placed else ''}{place}"
        if self.sizes:
            off = max(abs(found / hidden - 1.0) for hidden, found, _, _ in self.sizes.values())
            text += f", the size off by {100.0 * off:.0f} %"
        return text + (
            f"; {listed([plain(name) for name in self.extra])} was named, too, but is not there." if self.extra else "."
        )


def judge(hidden: PatchEffect, found: Sequence[EffectEntry], equivalent: Sequence[Sequence[str]] = ()) -> Diagnosis:
    """Compare what was found with what was hidden.

    Args:
        hidden: the effect.
        found: entries of the result file.
        equivalent: groups of names that the data do not distinguish.
    """
    same = [one for one in found if one.name == hidden.name]
    best = next((one for one in same if set(one.where) == set(hidden.where)), same[0] if same else None)
    sizes = {}
    if best is not None:
        for parameter, value in hidden.parameters.items():
            if value != 0.0:  # the other axes of a bias have no size to be off by
                entry = best.parameters.get(parameter)  # a component of a vector may be missing
                found_value, interval = (0.0, None) if entry is None else (entry.value, entry.ci95)
                sizes[parameter] = (value, found_value, *(interval or (np.nan, np.nan)))
    return Diagnosis(
        named=best is not None,
        placed=best is not None and set(best.where) == set(hidden.where),
        near=best is None and any(hidden.name in group for group in equivalent),
        sizes=sizes,
        extra=tuple(one.name for one in found if one is not best),
    )


def _revealed(hidden: PatchEffect, found: Sequence[EffectEntry], answer: Diagnosis) -> str:
    from wlr_gym.physics.effects import EFFECTS

    named = [plain(one.name) for one in found] or ["nothing"]
    at = [places(one.where) for one in found if one.name == hidden.name] or [places(one.where) for one in found] or ["-"]
    rows = [
        ("effect", plain(hidden.name), ", ".join(named), _yes(answer.named)),
        ("place", places(hidden.where), ", ".join(at), _yes(answer.placed)),
    ]
    for parameter, (truth, value, low, high) in answer.sizes.items():
        unit = unit_of(EFFECTS[hidden.name].parameters[parameter].unit)
        interval = f" (95 % interval {number(low)} to {number(high)})" if np.isfinite(low) else ""
        inside = "the interval holds it" if low <= truth <= high else "outside the interval"
        rows.append(
            (
                parameter,
                f"{number(truth)}{unit}",
                f"{number(value)}{unit}{interval}",
                f"{round(100.0 * (value / truth - 1.0)):+d} %; {inside}",
            )
        )
    extra = (
        paragraph(f"Named beside it, but not there: {', '.join(plain(name) for name in answer.extra)}.") if answer.extra else ""
    )
    return table(("", "hidden in the robot", "found by the gap workflow", "right?"), rows) + extra


def _yes(right: bool) -> str:
    return "yes" if right else "no"
