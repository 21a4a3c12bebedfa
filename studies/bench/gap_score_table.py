"""The score of the blind test as a table: numbers beside their targets, severities, confusion matrix."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from wlr_gym.base.text import tally

#: Whether a target is reached: ``not shown`` is a value that reaches it with a 95 % bound that does not; empty: no target.
Met = Literal["yes", "no", "not shown", ""]


@dataclass(frozen=True)
class ScoreLine:
    """One line of the report: a number beside its target."""

    what: str
    value: str
    target: str = ""
    met: Met = ""


def lines(report: Mapping[str, Any]) -> list[ScoreLine]:
    """Return the numbers that the workflow is judged by, in the order of the targets."""
    alarms, single, pairs, outside = report["false_alarms"], report["single"], report["pairs"], report["outside"]
    return [
        _at_most("false alarms, nominal robot", alarms["none"]),
        _at_most("false alarms, parameters only", alarms["parameters"]),
        _at_most("false alarms, all", alarms["all"], 0.02),
        _at_least("right name first, severity >= 2", single["top1"], 0.95),
        _at_least("right name first, severity 1", single["top1_at_one"], 0.80),
        _at_least("truth in the equivalence set", single["in_set"], 0.95),
        _set_size(single["mean_set_size"]),
        _at_most("a further name beside the right one", single["extra_name"]),
        _confidence(single["confidence"]),
        _at_least("right place, where named", single["place"], 0.98),
        _at_least("both of a pair named", pairs["both"], 0.85),
        _at_least("both of a pair and nothing else", pairs["exact"]),
        _median("median error of size", single["size_error"], most=0.03),
        _median("median error of place or form", single["shape_error"]),
        _at_least("order of a ripple", single["order"]),
        _coverage(single["interval_coverage"]),
        _median("median gap reduction, where found", single["gap_reduction"], least=0.9),
        _median("median gap reduction, misses as 0", single["gap_reduction_of_all"], least=0.9),
        _median("median error left, noise floors: named rightly, severity >= 2", report["left"]["named"]),
        _median("median error left, noise floors: nothing hidden", report["left"]["nothing hidden"]),
        _none("gap grew, interval below 0", single["gap_grew_surely"]),
        _none("gap grew by more than 2 %", single["gap_grew"]),
        _at_least("outside the library: formula or unknown, no name", outside["unknown"], 0.95),
        _at_least("outside the library: not misnamed", outside["not_misnamed"]),
        _at_least("bad data caught", report["bad_data"], 1.0),
        _none("good data refused", alarms["refused_good_data"]),
        _none("analyses that crashed", report["crashed"]),
    ]


def _met(reached: bool, shown: bool) -> Met:
    return ("yes" if shown else "not shown") if reached else "no"


def _share(share: Mapping[str, Any], bound: str) -> str:
    if not share["count"]:
        return "-"
    return f"{share['hits']}/{share['count']} = {share['share']:.0%} ({bound} {share['bound95']:.0%})"


def _at_least(what: str, share: Mapping[str, Any], target: float | None = None) -> ScoreLine:
    value = _share(share, "at least")
    if target is None:
        return ScoreLine(what, value)
    met = _met(share["share"] >= target, share["bound95"] >= target) if share["count"] else ""
    return ScoreLine(what, value, f">= {target:.0%}", met)


def _at_most(what: str, share: Mapping[str, Any], target: float | None = None) -> ScoreLine:
    value = _share(share, "at most")
    if target is None:
        return ScoreLine(what, value)
    met = _met(share["share"] <= target, share["bound95"] <= target) if share["count"] else ""
    return ScoreLine(what, value, f"<= {target:.0%}", met)


def _none(what: str, share: Mapping[str, Any]) -> ScoreLine:
    """Something that must not happen in any of these sets: no bound could show that it never does."""
    return ScoreLine(what, _share(share, "at most"), "0", _met(not share["hits"], True) if share["count"] else "")


def _coverage(coverage: Mapping[str, Any]) -> ScoreLine:
    """Intervals may be too narrow or too wide."""
    line = _at_least("95 % intervals that hold", coverage)
    if not coverage["count"]:
        return ScoreLine(line.what, line.value, "92-98 %")
    shown = coverage["bound95"] >= 0.92 and coverage["bound95_above"] <= 0.98
    return ScoreLine(line.what, line.value, "92-98 %", _met(0.92 <= coverage["share"] <= 0.98, shown))


def _median(what: str, numbers: Mapping[str, Any], most: float | None = None, least: float | None = None) -> ScoreLine:
    target = f"<= {most:g}" if most is not None else f">= {least:g}" if least is not None else ""
    if not numbers["count"]:
        return ScoreLine(what, "-", target)
    word, bound = ("at least", numbers["at_least95"]) if least is not None else ("at most", numbers["at_most95"])
    value = f"{numbers['median']:.3g} of {numbers['count']} ({'no bound' if bound is None else f'{word} {bound:.3g}'})"
    if most is not None:
        return ScoreLine(what, value, target, _met(numbers["median"] <= most, bound is not None and bound <= most))
    if least is not None:
        return ScoreLine(what, value, target, _met(numbers["median"] >= least, bound is not None and bound >= least))
    return ScoreLine(what, value)


def _set_size(size: float | None) -> ScoreLine:
    what, target = "mean size of that set, where found", "<= 1.5"
    return ScoreLine(what, "-", target) if size is None else ScoreLine(what, f"{size:.3g}", target, _met(size <= 1.5, True))


def _confidence(numbers: Mapping[str, Any]) -> ScoreLine:
    value = f"{numbers['mean_confidence']:.2f}, right {numbers['right']:.2f} of {numbers['count']}" if numbers["count"] else "-"
    return ScoreLine("mean confidence of the first name", value)


def markdown(report: Mapping[str, Any]) -> str:
    """Return the report as Markdown tables: numbers beside targets, severities, confusion matrix."""
    rows = [f"Sets analysed by commit: {tally(report['commits'])}.", ""]
    rows += ["| | measured (95 % bound) | target | met |", "|---|---|---|---|"]
    rows += [f"| {line.what} | {line.value} | {line.target} | {line.met} |" for line in lines(report)]
    rows += ["", "| severity | sets | found | right name first | in the set |", "|---|---|---|---|---|"]
    for severity, shares in report["single"]["by_severity"].items():
        cells = [f"{shares[key]['share']:.0%}" for key in ("found", "top1", "in_set")]
        rows.append(f"| {severity} | {shares['found']['count']} | {' | '.join(cells)} |")
    rows += ["", "| recorded | false alarms | right name first, severity >= 2 |", "|---|---|---|"]
    for recorded, shares in report["by_recording"].items():
        rows.append(f"| {recorded} | {_share(shares['alarms'], 'at most')} | {_share(shares['top1'], 'at least')} |")
    rows += ["", "Single effects from severity 1 on; in brackets laws outside the library:", ""]
    rows += ["| hidden | what the results say |", "|---|---|"]
    for hidden, said in sorted(report["confusion"].items()):
        ordered = sorted(said.items(), key=lambda item: (item[0] != hidden, -item[1], item[0]))
        rows.append(f"| {hidden} | {tally(dict(ordered))} |")
    return "\n".join(rows) + "\n"
