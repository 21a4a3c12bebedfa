"""What the measurement of engine and MuJoCo says: ratios at equal error and at defaults, a table, a picture."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from studies.bench.engine import KINDS, EngineResult
from studies.bench.label_places import Label, place_labels
from studies.bench.measure import Measurement
from wlr_gym.base.plots import BLUE, GREEN, GREY, ORANGE, WINE, legend_below, new_figure, save, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: m: errors at which the fastest setting of each side is compared. The first two
#: are met where the contacts are nearly those of Coulomb, the last by MuJoCo's default contact.
LEVELS = (1e-4, 5e-4, 2e-3, 2.5e-2)
#: m: up to this error MuJoCo's setting counts as comparable.
COMPARABLE = 1e-3
COMPARABLE_BARS = {"float64": 50.0, "float32": 100.0}
UNIT = "x real time"
AT_DEFAULTS = "both at 1 ms, MuJoCo's defaults"
#: What is compared at 1 ms: in words, how MuJoCo is called, threads, bars.
STANDARD = ((AT_DEFAULTS, "step", 1, {"float64": 30.0, "float32": 60.0}), ("both at 1 ms, 2 threads", "rollout", 2, {}))


def level_name(level: float) -> str:
    """Return what a level is called."""
    return f"error at most {1e3 * level:g} mm"


def pairs(results: Sequence[EngineResult]) -> list[Measurement]:
    """Return the ratios of speed: at equal error, at MuJoCo's defaults and equal step, and with two threads."""
    found: list[Measurement] = []
    for precision in ("float64", "float32"):
        ours = [one for one in results if one.setting.side == "engine" and one.setting.precision == precision]
        peers = [one for one in results if one.setting.side == "MuJoCo"]
        for level in LEVELS:
            bar = COMPARABLE_BARS[precision] if level < COMPARABLE else None
            found += _pair(f"{precision}, {level_name(level)}", _fastest(ours, level), _fastest(peers, level), bar)
        for what, call, threads, bar in STANDARD:
            standard = _standard(ours, "step", threads), _standard(peers, call, threads)
            found += _pair(f"{precision}, {what}", *standard, bar.get(precision))
    return found


def _pair(what: str, ours: EngineResult | None, peer: EngineResult | None, bar: float | None) -> list[Measurement]:
    if ours is None or peer is None:
        return []
    text = f"{what}: {ours.setting.label} ({_millimetres(ours.error)})"
    name = f"MuJoCo {peer.setting.label} ({_millimetres(peer.error)})"
    return [Measurement("engine", text, UNIT, ours.speed, peer.speed, name, bar)]


def _fastest(results: Iterable[EngineResult], level: float) -> EngineResult | None:
    """Return the fastest on one thread that stays upright with an error of at most ``level``."""
    fit = [one for one in results if one.upright and one.error <= level and one.setting.threads == 1]
    return max(fit, key=lambda one: sorted(one.speed)[len(one.speed) // 2], default=None)


def _standard(results: Iterable[EngineResult], call: str, threads: int) -> EngineResult | None:
    """Return the setting of 1 ms with everything else at its default."""
    for one in results:
        setting = one.setting
        kind = (setting.cone, setting.contact, setting.integrator)
        usual = setting.side == "engine" or kind == KINDS[0]
        if usual and setting.step == 1e-3 and setting.call == call and setting.threads == threads and setting.is_usual:
            return one
    return None


def _millimetres(value: float | None) -> str:
    return "lost" if value is None else f"{1e3 * value:.3g} mm" if value < 0.1 else f"{1e3 * value:.0f} mm"


def reference_text(report: dict[str, Any]) -> str:
    """Return what the errors are against, and how far that is known; ``report`` is ``EngineReport.as_dict()``."""
    reference = report["reference"]
    apart, rest = reference["disagreement"], reference["convergence"]
    closed = "; ".join(f"{name}: {1e3 * value:+.2f} mm" for name, value in reference["closed_form"].items())
    return (
        f"The limits of both simulators differ by {1e6 * apart['median']:.2g} µm (median) and {1e6 * apart['max']:.2g} µm "
        f"(largest) and lie {1e6 * rest['max']:.2g} µm at most beyond the finest step. Distance driven, reference minus the "
        f"closed form of a rigid robot: {closed}. Not measured, for want of a GPU: MuJoCo Warp, MJX, Isaac Sim, Genesis."
    )


def settings_table(report: dict[str, Any]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return headings and rows: error and speed of every setting; ``report`` as for :func:`reference_text`."""
    rows = []
    for one in report["settings"]:
        errors = [_millimetres(one[key]) if one["upright"] else "falls" for key in ("error", "worst")]
        speed = "{median:.4g} [{min:.4g}..{max:.4g}]".format(**one["speed"])
        rows.append((one["side"], one["label"], one["precision"], *errors, speed))
    return ("side", "setting", "precision", "error, rms", "worst", "x real time"), rows


_ERROR = "rms error: mean distance of the four hips from the reference after a motion of 2 s, rms over ten motions (mm)"
_HOW_TO_READ = "Numbers: step in ms. Crosses: another number of passes (p; usual: 4) or iterations (i; usual: 100)"
#: Colour of an engine's precision and of a contact of MuJoCo.
_COLOURS = {"float64": BLUE, "float32": ORANGE, "default": "black", "stiff friction": GREY, "matched": WINE, "tuned": GREEN}


def save_picture(report: dict[str, Any], path: Path) -> None:
    """Write error against speed of every setting on one thread as a PNG; ``report`` is ``EngineReport.as_dict()``."""
    figure = new_figure(9.5, 6.6)
    axes = figure.subplots()
    axes.set(xscale="log", yscale="log", xlabel=_ERROR)
    axes.set_ylabel("simulated seconds of a robot per second of one core")
    shown = [one for one in report["settings"] if one["upright"] and one["threads"] == 1 and one["call"] == "step"]
    labels: list[Label] = []
    for precision in ("float64", "float32"):
        rows = [one for one in shown if one["side"] == "engine" and one["precision"] == precision]
        labels += _draw(axes, rows, f"engine, {precision}", _COLOURS[precision], "o")
    drawn: set[str] = set()
    for cone, contact, integrator in KINDS:
        kind = {"side": "MuJoCo", "cone": cone, "contact": contact, "integrator": integrator}
        rows = [one for one in shown if all(one[name] == value for name, value in kind.items())]
        label = f"MuJoCo: {contact}, {cone}, {integrator}"
        labels += _draw(axes, rows, label, _COLOURS[contact], "s", is_second=contact in drawn)
        drawn.add(contact)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
    _draw_pair(axes, shown)
    axes.set_title(_HOW_TO_READ, fontsize=9, loc="left")
    tidy(axes)
    legend_below(figure, columns=3)
    place_labels(figure, axes, labels)
    save(figure, path)


def _point(one: dict[str, Any]) -> tuple[float, float]:
    return 1e3 * one["error"], one["speed"]["median"]


def _draw(
    axes: Axes, rows: list[dict[str, Any]], label: str, colour: str, marker: str, *, is_second: bool = False
) -> list[Label]:
    """Draw a curve over the step, and crosses of settings with another number of passes or iterations; return their labels.

    The second of one colour is dashed, its markers are open, and its steps, which are those of the first, are not written.
    """
    usual = [one for one in rows if one["is_usual"]]
    other = [one for one in rows if not one["is_usual"]]
    line: dict[str, Any] = {"marker": marker, "label": label}
    if is_second:
        line |= {"linestyle": "--", "markerfacecolor": "white"}
    crosses: dict[str, Any] = {"marker": "x", "linestyle": "none"}
    for chosen, style in ((usual, line), (other, crosses)):
        if chosen:
            axes.plot(*zip(*map(_point, chosen), strict=True), color=colour, markersize=5, linewidth=1.2, **style)
    steps = [] if is_second else [Label(*_point(one), f"{1e3 * one['step']:g}", colour) for one in usual]
    return steps + [Label(*_point(one), _unusual(one), colour) for one in other]


def _unusual(one: dict[str, Any]) -> str:
    return f"{1e3 * one['step']:g}, {one['iterations']}{'p' if one['side'] == 'engine' else 'i'}"


def _draw_pair(axes: Axes, shown: Sequence[dict[str, Any]]) -> None:
    """Ring the fastest float64 setting of each side within the smallest level, and say how much faster the engine is."""
    fit = [one for one in shown if one["precision"] == "float64" and one["error"] <= LEVELS[0]]
    sides = [[one for one in fit if one["side"] == side] for side in ("engine", "MuJoCo")]
    if not all(sides):
        return
    ours, peer = (max(rows, key=lambda one: one["speed"]["median"]) for rows in sides)
    ratio = np.median(np.divide(ours["speed"]["values"], peer["speed"]["values"]))
    for one in (ours, peer):
        axes.plot(*_point(one), "o", markersize=11, markerfacecolor="none", markeredgecolor="black")
    ends = {"arrowstyle": "<->", "shrinkA": 9, "shrinkB": 9}
    axes.annotate("", _point(ours), _point(peer), arrowprops=ends)
    text = f"rings: {level_name(LEVELS[0])}\n{ratio:.0f} times as fast\n\nengine: {ours['label']}\nMuJoCo: {peer['label']}"
    middle = 1e3 * peer["error"], float(np.sqrt(ours["speed"]["median"] * peer["speed"]["median"]))
    axes.annotate(text, middle, (8, 0), textcoords="offset points", va="center", fontsize=9)
