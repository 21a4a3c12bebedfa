"""Tables of ``python -m studies.bench decide``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from studies.bench.blind.score import FAILED, at_least, at_most
from studies.bench.decide_study import CONTENDERS
from wlr_gym.base.text import tally

Line = Mapping[str, Any]


def markdown(lines: Sequence[Line]) -> str:
    """Return how often each contender decided rightly after how much driving, pairs of contenders, and every case."""
    taking_part = [name for name in CONTENDERS if any(one["contender"] == name for one in lines)]
    text = [f"Robots analysed by commit: {tally(Counter(one['commit'] for one in lines))}.", ""]
    text += [
        "| drives | decided rightly, of robots with an effect | wrongly | failed | driving per right decision |"
        " nothing hidden: rightly | false alarms |",
        "|---|---|---|---|---|---|---|",
    ]
    text += [_row(name, [one for one in lines if one["contender"] == name]) for name in taking_part]
    text += ["", *(_pair(lines, other) for other in taking_part[1:] if taking_part[0] == "chosen")]
    text += ["", "| hidden | camera | " + " | ".join(taking_part) + " |", "|---|---|" + "---|" * len(taking_part)]
    for case in dict.fromkeys(one["case"] for one in lines):
        own = {one["contender"]: one for one in lines if one["case"] == case}
        first = next(iter(own.values()))
        cells = [_cell(own[name]) for name in taking_part]
        text.append(
            f"| {', '.join(first['hidden']) or 'nothing'} | {'yes' if first['camera'] else 'no'} | {' | '.join(cells)} |"
        )
    return "\n".join(text) + "\n"


def _row(name: str, lines: Sequence[Line]) -> str:
    hiding, nulls = [one for one in lines if one["hidden"]], [one for one in lines if not one["hidden"]]
    right = at_least(sum(one["right"] for one in hiding), len(hiding))
    wrong = at_most(sum(one["ended"] == "decided" and not one["right"] for one in hiding), len(hiding))
    driving = sum(one.get("seconds", 0.0) for one in hiding)
    cells = (
        CONTENDERS[name],
        f"{right.hits}/{right.count} (at least {right.bound:.0%})" if hiding else "-",
        f"{wrong.hits} (at most {wrong.bound:.0%})" if hiding else "-",
        str(sum(one["ended"] == FAILED for one in lines)),
        f"{driving / right.hits:.0f} s" if right.hits else "-",
        f"{sum(one['right'] for one in nulls)}/{len(nulls)}",
        str(sum(bool(one["found"]) for one in nulls)),
    )
    return f"| {' | '.join(cells)} |"


def _pair(lines: Sequence[Line], other: str) -> str:
    """What choosing gains over another contender in the same robots."""
    both = {
        name: {one["case"]: one for one in lines if one["contender"] == name and one["hidden"]} for name in ("chosen", other)
    }
    pairs = [(one, both[other][case]) for case, one in both["chosen"].items() if case in both[other]]
    only = [sum(one["right"] and not two["right"] for one, two in order) for order in (pairs, [p[::-1] for p in pairs])]
    saved = [two["seconds"] - one["seconds"] for one, two in pairs if one["right"] and two["right"]]
    less = f"{np.mean(saved):.0f} s less driving on average in the {len(saved)} where both are" if saved else "both in none"
    return f"- Chosen runs against '{CONTENDERS[other]}': right alone in {only[0]} robots, the other in {only[1]}; {less}."


def _cell(line: Line) -> str:
    if line["ended"] == FAILED:
        return FAILED
    return (
        f"{'right' if line['right'] else ', '.join(line['found']) or line['verdict']}, {line['ended']}, {line['seconds']:.0f} s"
    )
