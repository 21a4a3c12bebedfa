"""Pictures of an analysis: where the gap is, the candidates, how much the gap shrank, and traces of runs.

Matplotlib only, drawn without a display.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.plots import BLUE, GREEN, GREY, ORANGE, PALE, new_figure, png, text_colour, tidy
from wlr_gym.gap.analysis import (
    EQUIVALENT,
    REJECTED,
    SELECTED,
    Analysis,
    ChannelGap,
    Evidence,
    GapFigures,
    HeatMap,
    Relation,
    RunGap,
    Threshold,
    Trace,
)
from wlr_gym.gap.report.text import channel, error, feature, places, plain

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

#: Colour of the measurement.
MEASURED = GREY
#: Of the model as given.
BEFORE = "#b0b0b0"
#: Of the calibrated model.
CALIBRATED = ORANGE
#: Of the model with the effects added.
AFTER = BLUE
#: Outcome of a candidate -> colour; :data:`_OTHER_OUTCOME` for all others.
_COLOURS = {SELECTED: BLUE, EQUIVALENT: "#6d9bd1"}
_OTHER_OUTCOME = PALE
#: Overlays in one figure.
_PANELS = 6
#: Effects shown in a round beside those that were fitted.
_OTHERS = 3
#: Gain beyond which a round's axis is logarithmic above the second number: small bars and the threshold stay visible.
_LARGE_GAIN, _LINEAR_GAIN = 200.0, 10.0
#: Ends of the heat map's scale, noise units.
_COLDEST = 0.7
_HOTTEST = 10.0
#: Rows by which the markers of the three models stand apart: equal errors do not hide each other.
_APART = 0.2
#: Relations in one figure.
_MOST_RELATIONS = 12


def draw(analysis: Analysis) -> dict[str, bytes]:
    """Return name -> PNG of every picture that the analysis has the numbers for."""
    return {name: png(figure) for name, figure in figures(analysis).items()}


def figures(analysis: Analysis) -> dict[str, Figure]:
    """Return name -> figure, of what there is: relations, where_N, overlays_N, gap, channels, evidence."""
    found: dict[str, Figure] = {}
    if analysis.relations:
        found["relations"] = _relations(analysis.relations[:_MOST_RELATIONS])
    for index, heat_map in enumerate(analysis.heat_maps):
        if heat_map.values.size:
            found[f"where_{index + 1}"] = _heat_map(heat_map)
    if analysis.evidence:
        found["evidence"] = _evidence(analysis.evidence, analysis.thresholds)
    if analysis.gap is not None:
        found["gap"] = _gap(analysis.gap, analysis.run_gaps, with_effects=bool(analysis.added))
    if analysis.channel_gaps:
        found["channels"] = _channels(analysis.channel_gaps, with_effects=bool(analysis.added))
    noise = {gap.channel: gap.noise for gap in analysis.channel_gaps}
    for index in range(0, len(analysis.traces), _PANELS):
        shown = analysis.traces[index : index + _PANELS]
        found[f"overlays_{index // _PANELS + 1}"] = _overlays(shown, noise, with_effects=bool(analysis.added))
    return found


# ---- where -----------------------------------------------------------------------------------------------------------


def _relations(shown: Sequence[Relation]) -> Figure:
    figure = new_figure(9.0, 0.9 + 0.3 * len(shown))
    axes = figure.subplots()
    ordered = shown[::-1]
    bars = axes.barh([one.name for one in ordered], [one.gain for one in ordered], color=CALIBRATED, height=0.6)
    texts = [f"{one.gain:.0f}  {plain(one.law)}{f': {one.formula}' if one.formula else ''}" for one in ordered]
    axes.bar_label(bars, texts, padding=4, fontsize=8)
    axes.set_xlim(0.0, 1.7 * max(one.gain for one in shown))
    axes.set_xlabel("predicted improvement by the best law there (fall of minus two log posterior)", fontsize=9)
    tidy(axes, "x")
    return figure


def _heat_map(heat_map: HeatMap) -> Figure:
    from matplotlib.colors import LogNorm

    rows, columns = heat_map.values.shape
    figure = new_figure(min(12.0, 3.4 + 0.75 * columns), 1.9 + 0.24 * rows)
    axes = figure.subplots()
    hottest = max(_HOTTEST, float(np.nanmax(heat_map.values, initial=0.0)))
    norm = LogNorm(_COLDEST, hottest)
    values = np.ma.masked_invalid(np.maximum(heat_map.values, _COLDEST))
    axes.set_facecolor("#e4e4e4")
    image = axes.imshow(values, norm=norm, cmap="YlOrRd", aspect="auto")
    axes.set_yticks(range(rows), heat_map.channels, fontsize=8)
    axes.set_xticks(range(columns), heat_map.bins, fontsize=8, rotation=35, ha="right", rotation_mode="anchor")
    axes.set_xticks(np.arange(columns) - 0.5, minor=True)
    axes.set_yticks(np.arange(rows) - 0.5, minor=True)
    axes.grid(which="minor", color="white", linewidth=0.8)
    axes.tick_params(which="both", length=0)
    if rows * columns <= 800:
        colours = np.asarray(image.to_rgba(heat_map.values))
        for row, column in np.argwhere(np.isfinite(heat_map.values)):
            value, ink = float(heat_map.values[row, column]), text_colour(colours[row, column].tolist())
            text = f"{value:.1f}" if value < 9.95 else f"{value:.0f}"
            axes.text(column, row, text, ha="center", va="center", fontsize=7.5, color=ink)
    axes.set_xlabel(feature(heat_map.feature), fontsize=9)
    axes.set_title("rms error of the calibrated model", fontsize=9, loc="left")
    ticks = [tick for tick in (1.0, 2.0, 5.0, 10.0, 20.0, 50.0) if tick <= hottest]
    bar = figure.colorbar(image, ax=axes, shrink=0.8, pad=0.02, ticks=ticks, format="%g")
    bar.ax.tick_params(labelsize=8)
    bar.minorticks_off()
    bar.set_label("rms error (1 = sensor noise)", fontsize=9)
    return figure


# ---- what ------------------------------------------------------------------------------------------------------------


def _evidence(evidence: Sequence[Evidence], thresholds: Sequence[Threshold]) -> Figure:
    least = {one.round: one.least for one in thresholds}
    rounds = sorted({one.round for one in evidence})
    shown = [_strongest([one for one in evidence if one.round == turn]) for turn in rounds]
    heights = [0.85 + 0.18 * len(members) for members in shown]
    figure = new_figure(8.5, sum(heights) + 0.6)
    panels = figure.subplots(len(rounds), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axes, turn, members in zip(panels, rounds, shown, strict=True):
        _draw_round(axes, members)
        if turn in least:
            style = {"color": GREEN, "linestyle": "--", "linewidth": 1.2}
            axes.axvline(least[turn], label="least that an effect of one number must gain", **style)
        part = ": the strongest candidates" if sum(one.round == turn for one in evidence) > len(members) else ""
        axes.set_title(f"Round {turn}{part}", fontsize=10, loc="left")
        axes.set_xlabel("gain: improvement of the fit (fall of -2 log posterior)", fontsize=9)
    labels = (
        (_COLOURS[SELECTED], "selected"),
        (_COLOURS[EQUIVALENT], "equivalent: not distinguishable from it"),
        (_OTHER_OUTCOME, "not selected"),
    )
    handles = [panels[0].barh([0], [0], color=colour, label=label) for colour, label in labels]
    handles.append(panels[0].barh([0], [0], fill=False, edgecolor=GREY, label="not fitted: predicted improvement"))
    handles += [axes.lines[-1] for axes in panels[:1] if axes.lines]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def _strongest(evidence: Sequence[Evidence]) -> list[Evidence]:
    """Return all that were fitted, and of the best other effects the place with the largest prediction; weakest first."""
    fitted = [one for one in evidence if one.outcome != REJECTED]
    named = {one.name for one in fitted}
    best: dict[str, Evidence] = {}
    for one in evidence:
        if one.name not in named:
            best[one.name] = max(best.get(one.name, one), one, key=_size)
    return sorted(best.values(), key=_size)[-_OTHERS:] + sorted(fitted, key=_size)


def _size(one: Evidence) -> float:
    value = one.screened if one.outcome == REJECTED else one.gain
    return value if np.isfinite(value) else 0.0


def _draw_round(axes: Axes, members: Sequence[Evidence]) -> None:
    rows, sizes = np.arange(len(members)), np.array([_size(one) for one in members])
    bars = axes.barh(rows, sizes, color=[_COLOURS.get(one.outcome, _OTHER_OUTCOME) for one in members], height=0.7)
    for row, bar, size, one in zip(rows, bars, sizes, members, strict=True):
        if one.outcome == REJECTED:
            bar.set(fill=False, edgecolor=GREY)
        weight, box = "bold" if one.outcome == SELECTED else "normal", {"facecolor": "white", "linewidth": 0.0, "pad": 0.5}
        text, style = f"{size:.0f}  {one.outcome}", {"va": "center", "fontsize": 7.5, "weight": weight, "bbox": box}
        axes.annotate(text, (max(size, 0.0), row), (5, 0), textcoords="offset points", **style)
    labels = [f"{plain(one.name)}, {places(one.where)}" for one in members]
    axes.set_yticks(rows, [textwrap.shorten(label, 48, placeholder=" …") for label in labels])
    low, high = min(sizes.min(), 0.0), max(sizes.max(), 1.0)
    if high > _LARGE_GAIN:
        axes.set_xscale("symlog", linthresh=_LINEAR_GAIN)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.set_xlim(3.0 * low, 40.0 * high)
    else:
        axes.set_xlim(low - (0.05 * (high - low) if low < 0.0 else 0.0), high + 0.25 * (high - low))
    axes.set_ylim(-0.6, len(members) - 0.4)
    tidy(axes, "x")


# ---- how much --------------------------------------------------------------------------------------------------------


def _gap(gap: GapFigures, runs: Sequence[RunGap], *, with_effects: bool) -> Figure:
    figure = new_figure(10.0, max(3.4, 1.7 + 0.3 * len(runs)) if runs else 3.2)
    left, *right = np.atleast_1d(figure.subplots(1, 2 if runs else 1, width_ratios=(1.0, 1.25) if runs else (1.0,)))
    shown = _draw_gap_bars(left, gap, with_effects=with_effects)
    if runs:
        labels = [f"{one.run}{'  (held out)' if one.heldout else ''}" for one in runs]
        handles = _draw_moves(right[0], labels, runs, with_effects=with_effects)
        right[0].set_title("each run", fontsize=10, loc="left")
        shown += handles
    if shown:
        figure.legend(handles=shown, loc="outside lower right", ncols=5, fontsize=8.5, frameon=False)
    return figure


def _draw_gap_bars(axes: Axes, gap: GapFigures, *, with_effects: bool) -> list[Artist]:
    """Draw a bar per model, over the held-out runs; return the interval of the reduction, if there is one, for a legend."""
    bars = [("model as given", gap.heldout_before, BEFORE), ("calibrated", gap.heldout_calibrated, CALIBRATED)]
    if with_effects:
        bars.append(("effects added", gap.heldout_after, AFTER))
    names, values, colours = zip(*bars, strict=True)
    rows = np.arange(len(bars))[::-1]
    axes.barh(rows, np.nan_to_num(values), color=colours, height=0.6)
    end = max(np.nan_to_num(values))
    for row, value in zip(rows, values, strict=True):
        raised = 10.0 if with_effects and row == 0 else 0.0  # clear of the interval
        place = (float(np.nan_to_num(value)), row)
        axes.annotate(error(value), place, (6, raised), textcoords="offset points", va="center", fontsize=9)
    avoidable = gap.heldout_calibrated - gap.noise_floor
    interval = [gap.heldout_calibrated - share * avoidable for share in gap.reduction_ci95]
    whiskers: list[Artist] = []
    if with_effects and np.all(np.isfinite(interval)):
        low, high = sorted(interval)
        style: dict[str, Any] = {"color": "black", "linewidth": 1.4, "marker": "|", "markersize": 9}
        whiskers += axes.plot([low, high], [rows[-1]] * 2, label="95 % interval of the reduction", **style)
        end = max(end, high)
    axes.axvline(gap.noise_floor, color=GREEN, linestyle="--", linewidth=1.2)
    axes.set_ylim(-0.55, len(bars) - 0.1)
    axes.annotate("noise floor", (gap.noise_floor, len(bars) - 0.45), (4, 0), textcoords="offset points", color=GREEN,
                  fontsize=8)  # fmt: skip
    axes.set_yticks(rows, names)
    axes.set_xlim(0.0, 1.18 * max(end, gap.noise_floor))
    axes.set_xlabel("error of replayed runs (1 = sensor noise)", fontsize=9)
    axes.set_title("held-out runs", fontsize=10, loc="left")
    tidy(axes, "x")
    axes.tick_params(axis="y", labelsize=9)
    return whiskers


def _draw_moves(
    axes: Axes, labels: Sequence[str], gaps: Sequence[RunGap] | Sequence[ChannelGap], *, with_effects: bool
) -> list[Artist]:
    """One line per run or channel, from the error as given over that after calibration to that with the effects."""
    rows = np.arange(len(gaps))[::-1]
    before, calibrated, after = (np.array([getattr(one, name) for one in gaps]) for name in ("before", "calibrated", "after"))
    ends = [before, calibrated, *([after] if with_effects else [])]
    axes.hlines(rows, np.nanmin(ends, axis=0), np.nanmax(ends, axis=0), color="#d0d0d0", linewidth=2.0, zorder=1)
    given = axes.scatter(before, rows + _APART, s=26, facecolor="white", edgecolor="#7a7a7a", label="model as given", zorder=2)
    handles: list[Artist] = [given, axes.scatter(calibrated, rows, s=26, color=CALIBRATED, label="calibrated", zorder=3)]
    if with_effects:
        handles.append(axes.scatter(after, rows - _APART, s=26, color=AFTER, label="effects added", zorder=4))
    handles.append(axes.axvline(1.0, color=GREY, linestyle=":", linewidth=1.4, label="sensor noise"))
    axes.set_yticks(rows, labels)
    axes.set_ylim(-0.6, len(gaps) - 0.4)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in "25" else "")
    axes.set_xlabel("error of replayed runs (1 = sensor noise)", fontsize=9)
    tidy(axes)
    axes.tick_params(which="minor", labelsize=7)
    return handles


def _channels(gaps: Sequence[ChannelGap], *, with_effects: bool) -> Figure:
    figure = new_figure(9.0, 1.4 + 0.2 * len(gaps))
    axes = figure.subplots()
    handles = _draw_moves(axes, [one.channel for one in gaps], gaps, with_effects=with_effects)
    figure.legend(handles=handles, loc="outside upper right", ncols=4, fontsize=8.5, frameon=False)
    return figure


# ---- overlays --------------------------------------------------------------------------------------------------------


def _overlays(traces: Sequence[Trace], noise: dict[str, float], *, with_effects: bool) -> Figure:
    columns = min(2, len(traces))
    lines = -(-len(traces) // columns)
    figure = new_figure(6.2 * columns, 3.3 * lines + 0.5)
    outer = figure.add_gridspec(lines, columns)
    for index, trace in enumerate(traces):
        inner = outer[index // columns, index % columns].subgridspec(2, 1, height_ratios=(2, 1), hspace=0.04)
        above = figure.add_subplot(inner[0])
        below = figure.add_subplot(inner[1], sharex=above)
        _draw_trace(above, below, trace, noise.get(trace.channel), with_effects=with_effects)
        if index >= len(traces) - columns:
            below.set_xlabel("time (s)", fontsize=9)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=4, fontsize=9, frameon=False)
    return figure


def _draw_trace(above: Axes, below: Axes, trace: Trace, noise: float | None, *, with_effects: bool) -> None:
    read = slice(int(not np.isfinite(trace.calibrated_error[0])), None)  # a first row that no sensor has read is not compared
    t: Array = trace.t[read] - trace.t[0]
    measured = trace.measured[read]
    known = np.isfinite(measured)
    dots: dict[str, Any] = {"marker": ".", "markersize": 3.0, "linestyle": ""} if not known.all() else {"linewidth": 2.4}
    above.plot(t[known], measured[known], color=MEASURED, label="measured", **dots)
    above.plot(t, trace.before[read], color="black", linewidth=0.8, linestyle=":", label="model as given")
    models = [(trace.calibrated, trace.calibrated_error, CALIBRATED, "calibrated")]
    models += [(trace.after, trace.after_error, AFTER, "effects added")] if with_effects else []
    for values, left, colour, label in models:
        counted = np.isfinite(left[read])
        above.plot(t, values[read], color=colour, linewidth=1.0, label=label)
        below.plot(t[counted], left[read][counted], color=colour, linewidth=0.8)
    if noise is not None:
        below.axhspan(-2.0 * noise, 2.0 * noise, color=GREEN, alpha=0.15, linewidth=0.0)
    below.axhline(0.0, color="black", linewidth=0.5)
    above.set_title(f"{trace.channel} ({channel(trace.channel)})\n{trace.run}, held out", fontsize=9, loc="left")
    above.set_ylabel(trace.unit, fontsize=9)
    below.set_ylabel(f"error\n{trace.unit}", fontsize=9)
    above.tick_params(labelbottom=False)
    for axes in (above, below):
        tidy(axes)
        axes.margins(x=0.01)
