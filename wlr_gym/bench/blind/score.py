"""Score results of a workflow against sealed truths: names, places, parameters, intervals, gaps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import beta

from wlr_gym.bench.blind.truth import NAMED

#: What a result is called that names nothing of the vocabulary.
NOTHING, UNKNOWN, BAD, QUIET, FAILED = "nothing_missing", "unknown_effect", "bad_data", "not_excited", "failed"
#: Value at which a parameter means nothing; 0 where not listed. Errors count from there.
NEUTRAL = {"scale": 1.0, "ratio": {"friction_anisotropy": 1.0}}
#: Parameters that belong to one vector, whose error is the length of the difference.
VECTORS = {
    "payload": ("x", "y", "z"),
    "com_offset": ("x", "y", "z"),
    "floor_slope": ("pitch", "roll"),
    "external_force": ("fx", "fy"),
    "tether": ("x", "y"),
    "gyro_bias": ("x", "y", "z"),
    "imu_misalignment": ("roll", "pitch", "yaw"),
    "friction_patch": ("x_min", "x_max"),
}
#: Angles of periodic laws, whose error is not relative.
PHASES = ("phase",)
#: A name counts as right at this severity and above, where nothing is said about severity.
CLEAR = 2.0

Result = Mapping[str, Any]
Truth = Mapping[str, Any]


@dataclass(frozen=True)
class Share:
    """How many of how many, with an exact 95 % bound (Clopper-Pearson, one-sided) on the worse side."""

    hits: int
    count: int
    bound: float

    @property
    def value(self) -> float | None:
        """The share; None of nothing."""
        return self.hits / self.count if self.count else None

    def as_dict(self) -> dict[str, Any]:
        """Return the numbers."""
        return {"hits": self.hits, "count": self.count, "share": self.value, "bound95": self.bound}


def at_most(hits: int, count: int) -> Share:
    """Share of something bad: the bound is the highest rate that still gives so few in one of twenty repetitions."""
    return Share(hits, count, float(beta.ppf(0.95, hits + 1, count - hits)) if hits < count else 1.0)


def at_least(hits: int, count: int) -> Share:
    """Share of something good: the bound is the lowest rate that still gives so many in one of twenty repetitions."""
    return Share(hits, count, float(beta.ppf(0.05, hits, count - hits + 1)) if hits else 0.0)


# --- reading a result -------------------------------------------------------------------------------------------------


def headline(result: Result) -> str:
    """Return the strongest effect's name, or the verdict where none is named."""
    verdict = str(result["verdict"])
    if verdict not in ("effect_found", UNKNOWN):
        return verdict
    effects = result.get("effects") or []
    return str(effects[0]["name"]) if effects else verdict


def found_names(result: Result) -> list[str]:
    """Return the names of the effects found, strongest first."""
    if result["verdict"] not in ("effect_found", UNKNOWN):
        return []
    return [str(effect["name"]) for effect in result.get("effects") or []]


def equivalence_set(result: Result) -> set[str]:
    """Return the strongest effect's name and the names that the result says cannot be told from it.

    ``equivalent`` is a list of groups: lists of names (and a text), or mappings that hold such lists. Only vocabulary counts.
    """
    names = found_names(result)
    together = set(names[:1])
    for group in map(_names_within, result.get("equivalent") or []):
        if len(names) == 1 or group & set(names[:1]):
            together |= group
    return together


def _names_within(group: Any) -> set[str]:
    """Names of the vocabulary in a nest of lists, mappings and texts: a text counts by its first word."""
    if isinstance(group, str):
        return {group.split(" ")[0]} & {*NAMED, UNKNOWN}
    if isinstance(group, Mapping):
        return set().union(*map(_names_within, group.values()))
    return set().union(*map(_names_within, group)) if isinstance(group, Sequence) else set()


def parameter_errors(truth: Mapping[str, Any], found: Mapping[str, Any]) -> dict[str, float]:
    """Return relative errors of the parameters of one effect, from their neutral values; vectors count as one."""
    name, true, fitted = truth["name"], truth["parameters"], found["parameters"]
    vector = [key for key in VECTORS.get(name, ()) if key in true or key in fitted]
    errors = {}
    for key in true:
        if key in vector or key in PHASES or key not in fitted:
            continue
        neutral = NEUTRAL.get(key, 0.0)
        neutral = neutral.get(name, 0.0) if isinstance(neutral, dict) else neutral
        size = abs(true[key] - neutral)
        if size > 0:
            errors[key] = abs(_value(fitted[key]) - true[key]) / size
    if vector and (size := float(np.linalg.norm([true.get(key, 0.0) for key in vector]))) > 0:
        difference = [_value(fitted.get(key, 0.0)) - true.get(key, 0.0) for key in vector]
        errors["+".join(vector)] = float(np.linalg.norm(difference)) / size
    return errors


def _value(parameter: Any) -> float:
    return float(parameter["value"] if isinstance(parameter, Mapping) else parameter)


def intervals_hold(truth: Mapping[str, Any], found: Mapping[str, Any]) -> list[bool]:
    """Say for each true parameter with an interval whether it lies inside."""
    holds = []
    for key, value in truth["parameters"].items():
        if key in PHASES:
            continue
        interval = (found["parameters"].get(key) or {}) if isinstance(found["parameters"].get(key), Mapping) else {}
        low, high = interval.get("ci95") or (None, None)
        if low is not None and high is not None:
            holds.append(bool(low <= value <= high))
    return holds


# --- scoring ----------------------------------------------------------------------------------------------------------


def score(results: Mapping[str, Result], truths: Mapping[str, Truth]) -> dict[str, Any]:
    """Score results, by the names of their sets, against truths.

    Args:
        results: contents of ``result.json``, or ``{"verdict": "refused" | "failed", "message": ...}``.
        truths: as of ``cases.Case.as_dict``; those without a result are left out.

    Returns:
        Plain data: shares with bounds, lists of errors' quantiles, the confusion matrix.
    """
    scored = [(dict(truths[name]), dict(results[name])) for name in sorted(results) if name in truths]
    of = {kind: [pair for pair in scored if pair[0]["kind"] == kind] for kind in _KINDS}
    clear = [pair for pair in of["effect"] if pair[0]["severity"] >= CLEAR]
    return {
        "sets": len(scored),
        "false_alarms": {
            "none": _share(at_most, [_alarm(result) for _, result in of["none"]]),
            "parameters": _share(at_most, [_alarm(result) for _, result in of["parameters"]]),
            "refused_good_data": _share(at_most, [_refused(r) for t, r in scored if t["kind"] != "bad"]),
        },
        "single": _single(of["effect"], clear),
        "pairs": _pairs(of["pair"]),
        "outside": _outside(of["stranger"]),
        "bad_data": _share(at_least, [_caught(result) for _, result in of["bad"]]),
        "failed": sorted(truth["name"] for truth, result in scored if result["verdict"] == FAILED),
        "seconds": _quantiles([result["wall_seconds"] for _, result in scored if "wall_seconds" in result]),
        "confusion": confusion(scored),
    }


_KINDS = ("none", "parameters", "effect", "pair", "stranger", "bad")


def _share(kind: Any, hits: Sequence[bool]) -> dict[str, Any]:
    return kind(sum(map(bool, hits)), len(hits)).as_dict()


def _alarm(result: Result) -> bool:
    return result["verdict"] in ("effect_found", UNKNOWN)


def _refused(result: Result) -> bool:
    return result["verdict"] in ("refused", BAD, FAILED)


def _caught(result: Result) -> bool:
    return result["verdict"] in ("refused", BAD, QUIET)


def _top(truth: Truth, result: Result) -> bool:
    return headline(result) == truth["effects"][0]["name"]


def _matched(truth: Truth, result: Result) -> list[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """Pair each true effect with the found one of its name, if there is one."""
    found = {effect["name"]: effect for effect in reversed(result.get("effects") or [])} if _alarm(result) else {}
    return [(effect, found[effect["name"]]) for effect in truth["effects"] if effect["name"] in found]


def _same_place(true: Mapping[str, Any], found: Mapping[str, Any]) -> bool:
    return set(true["where"]) == set(found.get("where") or [])


def _single(pairs: Sequence[tuple[Truth, Result]], clear: Sequence[tuple[Truth, Result]]) -> dict[str, Any]:
    severities = sorted({truth["severity"] for truth, _ in pairs})
    by_severity = {}
    for severity in severities:
        chosen = [pair for pair in pairs if pair[0]["severity"] == severity]
        by_severity[str(severity)] = {
            "found": _share(at_least, [_alarm(result) for _, result in chosen]),
            "top1": _share(at_least, [_top(truth, result) for truth, result in chosen]),
            "in_set": _share(at_least, [_in_set(truth, result) for truth, result in chosen]),
        }
    matched = [match for truth, result in clear for match in _matched(truth, result)]
    errors = [error for true, found in matched for error in parameter_errors(true, found).values()]
    holds = [hold for true, found in matched for hold in intervals_hold(true, found)]
    gaps = [result.get("gap") or {} for _, result in clear if _alarm(result)]
    return {
        "by_severity": by_severity,
        "top1": _share(at_least, [_top(truth, result) for truth, result in clear]),
        "in_set": _share(at_least, [_in_set(truth, result) for truth, result in clear]),
        "mean_set_size": _mean([len(equivalence_set(r)) for _, r in clear if _alarm(r)]),
        "place": _share(at_least, [_same_place(true, found) for true, found in matched]),
        "extra_names": _mean([len(set(found_names(r)) - {t["effects"][0]["name"]}) for t, r in clear if _alarm(r)]),
        "parameter_error": _quantiles(errors),
        "interval_coverage": _share(at_least, holds),
        "gap_reduction": _quantiles([gap["reduction"] for gap in gaps if gap.get("reduction") is not None]),
        "gap_grew": _share(at_most, [_grew(gap) for gap in gaps]),
        "confidence": _calibration(clear),
    }


def _in_set(truth: Truth, result: Result) -> bool:
    return _alarm(result) and truth["effects"][0]["name"] in equivalence_set(result)


def _grew(gap: Mapping[str, Any]) -> bool:
    after, before = gap.get("heldout_after"), gap.get("heldout_calibrated")
    return after is not None and before is not None and after > 1.02 * before


def _pairs(pairs: Sequence[tuple[Truth, Result]]) -> dict[str, Any]:
    def names(truth: Truth) -> set[str]:
        return {effect["name"] for effect in truth["effects"]}

    return {
        "both": _share(at_least, [names(truth) <= set(found_names(result)) for truth, result in pairs]),
        "exact": _share(at_least, [names(truth) == set(found_names(result)) for truth, result in pairs]),
        "at_least_one": _share(at_least, [bool(names(truth) & set(found_names(result))) for truth, result in pairs]),
    }


def _outside(pairs: Sequence[tuple[Truth, Result]]) -> dict[str, Any]:
    """A stranger is answered rightly by a formula or ``unknown_effect``, wrongly by a name; silence is neither."""
    right = [set(found_names(result)) == {UNKNOWN} or headline(result) == UNKNOWN for _, result in pairs]
    silent = [not _alarm(result) for _, result in pairs]
    wrong = [not r and not s for r, s in zip(right, silent, strict=True)]
    return {"not_misnamed": _share(at_least, [not w for w in wrong]), "unknown": _share(at_least, right), "silent": sum(silent)}


def _calibration(pairs: Sequence[tuple[Truth, Result]]) -> dict[str, Any]:
    """Mean stated confidence of the first name beside how often it is right."""
    rows = [(float(r["effects"][0]["confidence"]), _top(t, r)) for t, r in pairs if _alarm(r) and r.get("effects")]
    if not rows:
        return {"mean_confidence": None, "right": None, "count": 0}
    confidence, right = np.array(rows, dtype=float).T
    return {"mean_confidence": float(confidence.mean()), "right": float(right.mean()), "count": len(rows)}


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _quantiles(values: Sequence[float]) -> dict[str, float | int | None]:
    if not len(values):
        return {"median": None, "p90": None, "worst": None, "count": 0}
    array = np.asarray(values, dtype=float)
    return {
        "median": float(np.median(array)),
        "p90": float(np.quantile(array, 0.9)),
        "worst": float(array.max()),
        "lowest": float(array.min()),
        "count": len(array),
    }


def confusion(scored: Sequence[tuple[Truth, Result]]) -> dict[str, dict[str, int]]:
    """Return counts: what was hidden -> what the headline says. Effects count from severity 1 on, pairs are left out."""
    table: dict[str, dict[str, int]] = {}
    for truth, result in scored:
        if truth["kind"] == "pair" or (truth["kind"] == "effect" and truth["severity"] < 1.0):
            continue
        row = _row(truth)
        said = headline(result)
        counts = table.setdefault(row, {})
        counts[said] = counts.get(said, 0) + 1
    return table


def _row(truth: Truth) -> str:
    """What was hidden, for the confusion matrix; strangers in brackets."""
    if truth["kind"] in ("effect", "stranger"):
        name = truth["effects"][0]["name"]
        return name if truth["kind"] == "effect" else f"({name})"
    return {"none": "nothing", "parameters": "parameters only", "bad": "bad data"}[truth["kind"]]
