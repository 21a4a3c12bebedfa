"""Score results of a workflow against sealed truths: names, places, parameters, intervals, gaps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.stats import beta, binom

from studies.bench.blind.cases import LATER, NAMED
from studies.bench.blind.copies import nominal, read_robot
from wlr_gym.base.paths import data_directory

#: Verdict, and name, of a law outside the vocabulary.
UNKNOWN = "unknown_effect"
#: Answers that reject the data.
REFUSALS = ("refused", "bad_data", "not_excited")
#: No answer: the analysis raised an error.
FAILED = "failed"
#: Parameters that do not say how large an effect is, but where it acts or what form it has. All others are its size.
SHAPE = {
    "torque_ripple": ("order", "phase"),
    "stribeck_friction": ("stribeck_speed",),
    "slip_weakening": ("slip_speed",),
    "friction_patch": ("x_min", "x_max", "y_min", "y_max"),
    "tyre_brush": ("relaxation_length",),
    "payload": ("x", "y", "z"),
    "tether": ("x", "y"),
}
#: A whole number of periodic laws: it has no relative error.
ORDER = "order"
#: An angle of periodic laws: it has no relative error either.
PHASE = "phase"
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


# ---- reading a result ------------------------------------------------------------------------------------------------


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
        return {group.split(" ")[0]} & {*NAMED, *LATER, UNKNOWN}
    if isinstance(group, Mapping):
        return set().union(*map(_names_within, group.values()))
    return set().union(*map(_names_within, group)) if isinstance(group, Sequence) else set()


@cache
def neutral(name: str, parameter: str) -> float:
    """Return the value at which an effect vanishes: a floor like the nominal one, a factor of 1, else 0."""
    if parameter in ("mu", "mu_k"):
        return nominal(read_robot(data_directory("configs") / "robot" / "nominal.yaml")).mu
    return 1.0 if parameter == "scale" or name == "friction_anisotropy" else 0.0


def size_error(truth: Mapping[str, Any], found: Mapping[str, Any]) -> float:
    """Return how far off the size of one effect is, relative to the true size: 1.0 = as wrong as not seen at all.

    The size is what parameters differ by from where the effect vanishes; several of them count as a vector, and one that is
    not given is at that value.
    """
    shape = SHAPE.get(truth["name"], ())
    return _vector_error(truth, found, [key for key in {**truth["parameters"], **found["parameters"]} if key not in shape])


def shape_error(truth: Mapping[str, Any], found: Mapping[str, Any]) -> float | None:
    """Return the relative error of place or form, as one vector; None for an effect that has neither."""
    shape = [key for key in SHAPE.get(truth["name"], ()) if key in truth["parameters"] and key not in (ORDER, PHASE)]
    return _vector_error(truth, found, shape) if shape else None


def _vector_error(truth: Mapping[str, Any], found: Mapping[str, Any], keys: Sequence[str]) -> float:
    zero = np.array([neutral(truth["name"], key) for key in keys])
    true = np.array([truth["parameters"].get(key, value) for key, value in zip(keys, zero, strict=True)])
    fitted = np.array([_value(found["parameters"].get(key, value)) for key, value in zip(keys, zero, strict=True)])
    return float(np.linalg.norm(fitted - true) / np.linalg.norm(true - zero))


def order_found(truth: Mapping[str, Any], found: Mapping[str, Any]) -> bool | None:
    """Say whether the order of a ripple is right, as whole numbers; None for an effect without."""
    if ORDER not in truth["parameters"]:
        return None
    return ORDER in found["parameters"] and round(_value(found["parameters"][ORDER])) == truth["parameters"][ORDER]


def _value(parameter: Any) -> float:
    return float(parameter["value"] if isinstance(parameter, Mapping) else parameter)


def intervals_hold(truth: Mapping[str, Any], found: Mapping[str, Any]) -> list[bool]:
    """Say for each true parameter with an interval whether it lies inside; one that was left out is at its neutral value."""
    holds = []
    for key in [key for key in truth["parameters"] if key != PHASE]:
        value, entry = truth["parameters"][key], found["parameters"].get(key)
        low, high = (isinstance(entry, Mapping) and entry.get("ci95")) or (None, None)
        if low is not None and high is not None:
            holds.append(bool(low <= value <= high))
        elif entry is None and value != neutral(truth["name"], key):
            holds.append(False)
    return holds


# ---- scoring ---------------------------------------------------------------------------------------------------------


def score(results: Mapping[str, Result], truths: Mapping[str, Truth]) -> dict[str, Any]:
    """Score results, by the names of their sets, against truths.

    Args:
        results: contents of ``result.json``, or ``{"verdict": "refused" | "failed", "message": ...}``; under ``blind_test`` the
            commit that analysed it, where that is known.
        truths: as of ``cases.BlindCase.as_dict``; those without a result are left out.

    Returns:
        Plain data: shares with bounds, lists of errors' quantiles, the confusion matrix.
    """
    scored = [(dict(truths[name]), dict(results[name])) for name in sorted(results) if name in truths]
    of = {kind: [pair for pair in scored if pair[0]["kind"] == kind] for kind in _KINDS}
    clear = [pair for pair in of["effect"] if pair[0]["severity"] >= CLEAR]
    nulls = [*of["none"], *of["parameters"]]
    return {
        "sets": len(scored),
        "commits": dict(Counter((r.get("blind_test") or {}).get("commit") or "unknown" for _, r in scored).most_common()),
        "false_alarms": {
            "none": _share(at_most, [_alarm(result) for _, result in of["none"] if _answered(result)]),
            "parameters": _share(at_most, [_alarm(result) for _, result in of["parameters"] if _answered(result)]),
            "all": _share(at_most, [_alarm(result) for _, result in nulls if _answered(result)]),
            "refused_good_data": _share(at_most, [_refused(r) for t, r in scored if t["kind"] != "bad"]),
        },
        "by_recording": _by_recording(nulls, clear),
        "single": _single(of["effect"], clear),
        "left": {"named": _left([pair for pair in clear if _top(*pair)]), "nothing hidden": _left(nulls)},
        "pairs": _pairs(of["pair"]),
        "outside": _outside(of["stranger"]),
        "bad_data": _share(at_least, [_refused(result) for _, result in of["bad"]]),
        "crashed": _share(at_most, [result["verdict"] == FAILED for _, result in scored]),
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
    return result["verdict"] in REFUSALS


def _answered(result: Result) -> bool:
    """Whether there is an answer about what is missing: silence of a crash or a refusal is none."""
    return not _refused(result) and result["verdict"] != FAILED


def _top(truth: Truth, result: Result) -> bool:
    return headline(result) == truth["effects"][0]["name"]


def _matched(truth: Truth, result: Result) -> list[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """Pair each true effect with the found one of its name, if there is one."""
    found = {effect["name"]: effect for effect in reversed(result.get("effects") or [])} if _alarm(result) else {}
    return [(effect, found[effect["name"]]) for effect in truth["effects"] if effect["name"] in found]


def _same_place(true: Mapping[str, Any], found: Mapping[str, Any]) -> bool:
    return set(true["where"]) == set(found.get("where") or [])


def _single(pairs: Sequence[tuple[Truth, Result]], clear: Sequence[tuple[Truth, Result]]) -> dict[str, Any]:
    by_severity = {}
    for severity in sorted({truth["severity"] for truth, _ in pairs}):
        chosen = [pair for pair in pairs if pair[0]["severity"] == severity]
        by_severity[str(severity)] = {
            "found": _share(at_least, [_alarm(result) for _, result in chosen]),
            "top1": _share(at_least, [_top(*pair) for pair in chosen]),
            "in_set": _share(at_least, [_in_set(*pair) for pair in chosen]),
        }
    matched = [match for truth, result in clear for match in _matched(truth, result)]
    shapes = [error for true, found in matched if (error := shape_error(true, found)) is not None]
    orders = [right for true, found in matched if (right := order_found(true, found)) is not None]
    holds = [hold for true, found in matched for hold in intervals_hold(true, found)]
    gaps = [result.get("gap") or {} for _, result in clear if _alarm(result)]
    upper_ends = [(gap.get("reduction_ci95") or (None, None))[1] for gap in gaps]
    reductions = [share for gap in gaps if (share := gap.get("reduction_signed", gap.get("reduction"))) is not None]
    sizes = [len(equivalence_set(r)) for _, r in clear if _alarm(r)]
    extra = [set(found_names(r)) != {t["effects"][0]["name"]} for t, r in clear if t["effects"][0]["name"] in found_names(r)]
    return {
        "by_severity": by_severity,
        "top1": _share(at_least, [_top(truth, result) for truth, result in clear]),
        "top1_at_one": _share(at_least, [_top(truth, result) for truth, result in pairs if truth["severity"] == 1.0]),
        "in_set": _share(at_least, [_in_set(truth, result) for truth, result in clear]),
        "mean_set_size": float(np.mean(sizes)) if sizes else None,
        "place": _share(at_least, [_same_place(true, found) for true, found in matched]),
        "extra_name": _share(at_most, extra),
        "size_error": _quantiles([size_error(true, found) for true, found in matched]),
        "shape_error": _quantiles(shapes),
        "order": _share(at_least, orders),
        "interval_coverage": {**_share(at_least, holds), "bound95_above": at_most(sum(holds), len(holds)).bound},
        "gap_reduction": _quantiles(reductions),
        "gap_reduction_of_all": _quantiles(reductions + [0.0] * (len(clear) - len(reductions))),
        "gap_grew_surely": _share(at_most, [high < 0 for high in upper_ends if high is not None]),  # few runs have no interval
        "gap_grew": _share(at_most, [_grew(gap) for gap in gaps]),
        "confidence": _calibration(clear),
    }


def _left(pairs: Sequence[tuple[Truth, Result]]) -> dict[str, Any]:
    """Errors of held-out runs that the final model leaves, over the noise floor."""
    levels = [(gap.get("heldout_after"), gap.get("noise_floor")) for _, result in pairs if (gap := result.get("gap"))]
    return _quantiles([left / floor for left, floor in levels if left and floor])


def _by_recording(
    nulls: Sequence[tuple[Truth, Result]], clear: Sequence[tuple[Truth, Result]]
) -> dict[str, dict[str, dict[str, Any]]]:
    """False alarms and right names by what a set was recorded with, as its result says."""

    def recorded(result: Result) -> list[str]:
        made = result.get("blind_test") or {}
        return ["with a camera" if made.get("camera", True) else "without a camera", f"{len(made.get('runs', ()))} runs"]

    words = sorted({word for _, result in [*nulls, *clear] for word in recorded(result)})
    return {
        word: {
            "alarms": _share(at_most, [_alarm(r) for _, r in nulls if word in recorded(r) and _answered(r)]),
            "top1": _share(at_least, [_top(t, r) for t, r in clear if word in recorded(r)]),
        }
        for word in words
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
    """A stranger is answered rightly by a formula or ``unknown_effect`` and no name of the vocabulary beside it.

    Silence names nothing wrong, and is still no answer; a crash or a refusal is neither.
    """
    right = [{headline(result), *found_names(result)} == {UNKNOWN} for _, result in pairs]
    unnamed = [_answered(result) and set(found_names(result)) <= {UNKNOWN} for _, result in pairs]
    return {"unknown": _share(at_least, right), "not_misnamed": _share(at_least, unnamed)}


def _calibration(pairs: Sequence[tuple[Truth, Result]]) -> dict[str, Any]:
    """Mean stated confidence of the first name beside how often it is right."""
    rows = [(float(r["effects"][0]["confidence"]), _top(t, r)) for t, r in pairs if _alarm(r) and r.get("effects")]
    if not rows:
        return {"mean_confidence": None, "right": None, "count": 0}
    confidence, right = np.array(rows, dtype=float).T
    return {"mean_confidence": float(confidence.mean()), "right": float(right.mean()), "count": len(rows)}


def _quantiles(values: Sequence[float]) -> dict[str, float | int | None]:
    """Return quantiles and one-sided 95 % bounds of the median from order statistics; "worst" is the largest value."""
    if not len(values):
        return dict.fromkeys(("median", "at_least95", "at_most95", "p90", "worst", "lowest"), None) | {"count": 0}
    array = np.sort(np.asarray(values, dtype=float))
    count, rank = len(array), int(binom.ppf(0.95, len(array), 0.5))  # whatever the distribution; none below five values
    low, high = (float(array[count - 1 - rank]), float(array[rank])) if rank < count else (None, None)
    return {
        "median": float(np.median(array)),
        "at_least95": low,
        "at_most95": high,
        "p90": float(np.quantile(array, 0.9)),
        "worst": float(array.max()),
        "lowest": float(array.min()),
        "count": count,
    }


def confusion(scored: Sequence[tuple[Truth, Result]]) -> dict[str, dict[str, int]]:
    """Return counts: what was hidden -> what the headline says. Effects count from severity 1 on, pairs are left out."""
    table: dict[str, dict[str, int]] = {}
    words = {"none": "nothing", "parameters": "parameters only", "bad": "bad data"}
    for truth, result in scored:
        kind, said = truth["kind"], headline(result)
        if kind == "pair" or (kind == "effect" and truth["severity"] < 1.0):
            continue
        hidden = words[kind] if kind in words else truth["effects"][0]["name"]
        counts = table.setdefault(f"({hidden})" if kind == "stranger" else hidden, {})
        counts[said] = counts.get(said, 0) + 1
    return table
