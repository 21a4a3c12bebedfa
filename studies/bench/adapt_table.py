"""Tables of ``python -m studies.bench adapt``: case by case, and what all cases say together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import quantile_test

from studies.bench.adapt_study import CONTENDERS, HELPS
from wlr_gym.base.text import tally
from wlr_gym.learning.adaptation.driving import paired, share_regained
from wlr_gym.learning.evaluation.metrics import Bootstrap, Estimate

Array = NDArray[np.float64]
Line = Mapping[str, Any]
#: case -> contender -> its line.
Table = dict[str, dict[str, Line]]


def by_case(lines: Sequence[Line]) -> Table:
    """Return the lines by case and contender; of repeated ones the last."""
    found: Table = {}
    for line in lines:
        found.setdefault(line["case"], {})[line["contender"]] = line
    return found


def helps(case: Mapping[str, Line]) -> bool | None:
    """Whether the truth helps enough for a case to count; None = not known."""
    if not {"none", "truth"} <= case.keys():
        return None
    return float(_errors(case["truth"]).mean()) <= (1.0 - HELPS) * float(_errors(case["none"]).mean())


def regained(case: Mapping[str, Line], contender: str = "ours") -> Estimate:
    """Return (old - contender) / (old - truth), %, paired over the episodes."""
    return share_regained(*(_errors(case[name]) for name in ("none", contender, "truth")))


def better(case: Mapping[str, Line], ours: str, theirs: str) -> Estimate:
    """Return by how much one contender is better than another, % of the other's, paired over the episodes."""
    return paired(_errors(case[ours]), _errors(case[theirs]))


def markdown(lines: Sequence[Line]) -> str:
    """Return the tables as Markdown."""
    table = by_case(lines)
    header = ["case", "shared law", *(f"{CONTENDERS[name]}" for name in CONTENDERS), "found", "kept", "regained (%)"]
    header += ["driven for it (s)", "took (min)"]
    rows = [_row(name, case) for name, case in table.items()]
    text = [f"Contenders driven by commit: {tally(Counter(line['commit'] for line in lines))}.", ""]
    text += ["| " + " | ".join(header) + " |", "|" + "---|" * len(header), *("| " + " | ".join(row) + " |" for row in rows)]
    return "\n".join([*text, "", *summary(table), ""])


def summary(table: Table) -> list[str]:
    """Return what all cases say together, one sentence a line."""
    known = {name: one for name, case in table.items() if (one := helps(case)) is not None}
    counted = [name for name, one in known.items() if one]
    against = sum(better(table[name], "truth", "none").mean < 0.0 for name in known)
    said = [
        f"- The truth makes the policy at least {HELPS:.0%} better in {len(counted)} of {len(known)} cases, worse in {against}."
    ]
    for contender in ("ours", "calibrated"):
        theirs = [name for name in counted if contender in table[name]]
        if theirs:
            shares = np.array([regained(table[name], contender).mean for name in theirs])
            enough = f"at least 50 in {(shares >= 50.0).sum()} of {len(shares)}"
            said.append(
                f"- Regained by '{CONTENDERS[contender]}' in {len(theirs)} of these, %: median {_median(shares)}; {enough}."
            )
    adapted = [name for name, case in table.items() if {"ours", "none"} <= case.keys()]
    if adapted:
        gains = [better(table[name], "ours", "none") for name in adapted]
        worse = [name for name, gain in zip(adapted, gains, strict=True) if gain.high < 0.0]
        median = _median(np.array([gain.mean for gain in gains]))
        said.append(
            f"- Tracking error after adaptation: {median} % smaller (median); beyond the interval smaller in "
            f"{sum(gain.low > 0.0 for gain in gains)} of {len(adapted)}, larger in {len(worse)} ({', '.join(worse) or '-'})."
        )
        kept = sum(table[name]["ours"].get("kept") == "old" for name in adapted)
        said.append(f"- The acceptance test kept the old policy in {kept} of {len(adapted)} cases.")
    for other in ("wide", "calibrated", "none"):
        both = [name for name, case in table.items() if {"ours", other} <= case.keys()]
        if both:
            found = _all(table, both, "ours", other)
            said.append(f"- Ours against '{CONTENDERS[other]}', {len(both)} cases: {_interval(found)} % better.")
    return said


def _median(shares: Array) -> str:
    """Return the median over cases, each with a training of its own, and its exact interval (of the order statistics)."""
    found = quantile_test(shares, p=0.5).confidence_interval()
    few = np.isnan(found.low) or np.isnan(found.high)  # below six cases there is none
    return f"{np.median(shares):.0f}" if few else f"{np.median(shares):.0f} [{found.low:.0f}, {found.high:.0f}]"


def _all(table: Table, names: Sequence[str], ours: str, theirs: str) -> Estimate:
    """Ours against theirs over several cases, each case a block of episodes, in units of its old policy's error."""
    length = min(len(_errors(table[name]["none"])) for name in names)
    blocks = []
    for who in (ours, theirs):
        scaled = [_errors(table[name][who])[:length] / _errors(table[name]["none"]).mean() for name in names]
        blocks.append(np.stack([np.array(scaled), np.ones((len(names), length))], axis=2))
    return Bootstrap(len(names), length).reduction(*blocks)


def _row(name: str, case: Mapping[str, Line]) -> list[str]:
    any_line = next(iter(case.values()))
    errors = [f"{_errors(case[one]).mean():.3f}" if one in case else "" for one in CONTENDERS]
    ours = case.get("ours", {})
    found = ", ".join(dict.fromkeys(one["name"] for one in ours.get("found", []))) or ("nothing" if ours else "")
    share = _interval(regained(case)) if helps(case) and ours else ""
    times = [f"{ours['recording_seconds']:.0f}", f"{ours['wall_seconds'] / 60.0:.1f}"] if "wall_seconds" in ours else ["", ""]
    return [name, "yes" if any_line["shared_law"] else "no", *errors, found, str(ours.get("kept", "")), share, *times]


def _interval(found: Estimate) -> str:
    return f"{found.mean:.0f} [{found.low:.0f}, {found.high:.0f}]"


def _errors(line: Line) -> Array:
    return np.array(line["errors"], np.float64)
