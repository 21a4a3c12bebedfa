"""What each part of Velocity's recipe is worth, and what weights of slip buy: docs/data/ablations.json, figure slip_weights.

``python -m studies.ablations SWEEP BLIND PLAIN`` scores every setting of three sweeps (commands: docs/policies.md) as ``wlr
evaluate`` does, beside the whole recipe and the controllers; an interrupted scoring goes on where it stopped. Then, or without
arguments, the picture is drawn. .ci/docs/tables.py has the table.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from studies.learning import interval, percent, read_data
from wlr_gym.base.files import write_json
from wlr_gym.base.plots import BLUE, GREEN, ORANGE, WINE, legend_below, new_figure, save, tidy
from wlr_gym.base.provenance import git_commit
from wlr_gym.base.settings import read_yaml
from wlr_gym.learning.evaluation.scoring import evaluate
from wlr_gym.learning.evaluation.subjects import expand

ROOT = Path(__file__).resolve().parents[1]
SWEEP = ROOT / "examples" / "ablations.yaml"
#: Commit, episodes, settings -> floors -> numbers, controllers.
DATA = ROOT / "docs" / "data" / "ablations.json"
PICTURE = ROOT / "docs" / "figures" / "slip_weights.png"
FLOORS, EPISODES = ("slippery", "split"), 128
#: What all are compared with, and the hand-written controllers in the picture.
RECIPE, CONTROLLERS = "recipe", {"slip_compensating": GREEN, "pid": WINE}
#: Weights of slip -> setting.
AWARE = {0.2: "slip weighs a quarter", 0.8: RECIPE, 3.2: "slip weighs four times as much"}
BLIND = {weight: f"blind, slip weighs {weight:g}" for weight in AWARE}
#: From random weights, with its own recipe.
PLAIN = "plain PPO, 4 million steps"
HEADER = (
    "Velocity, neither camera nor flow",
    *(f"{one}: {what}" for one in FLOORS for what in ("error", "better (%)", "slip (mm/s)")),
)
_KEYS = ("tracking_error", "slip_speed")


def score(sweep: str, blind: str, plain: str) -> None:
    """Score what is not scored yet; every setting is written when it is done."""
    found = {name: f"{sweep}/trials/variant={name.replace(' ', '_')},seed=*" for name in read_yaml(SWEEP)["variants"]}
    found |= {BLIND[weight]: f"{blind}/trials/*slip.weight=-{weight:g},seed=*" for weight in BLIND}
    found |= {PLAIN: f"{plain}/trials/*"}
    data = read_data(DATA) or {"commit": git_commit(), "episodes": EPISODES, "settings": {}, "controllers": {}}
    for name in [one for one in found if expand(found[one]) and one not in data["settings"]]:
        data["settings"][name] = {floors: _numbers(data, found[name], found[RECIPE], floors) for floors in FLOORS}
        write_json(DATA, data)
        print(name, data["settings"][name], flush=True)


def _numbers(data: dict[str, Any], ours: str, recipe: str, floors: str) -> dict[str, Any]:
    """Return the numbers of a setting on floors, without camera and flow; with the recipe those of the controllers."""
    others = {"recipe": expand(recipe)} if ours != recipe else {one: one for one in CONTROLLERS}
    card = evaluate(
        expand(ours),
        "WLR-Velocity-v0",
        baselines=list(others.values()),
        episodes=EPISODES,
        randomization=floors,
        sensors=(),
        precision="float32",
    )
    scores = dict(zip(("ours", *others), (card.scores["main"][name] for name in card.names), strict=True))
    if ours == recipe:
        data["controllers"][floors] = {one: {key: scores[one][key].mean for key in _KEYS} for one in others}
    numbers = {key: interval(scores["ours"][key]) for key in _KEYS}
    if ours != recipe:
        numbers["better"] = interval(card.comparison["main"][card.names[1]]["tracking_error"])
    return numbers


def rows() -> list[list[str]]:
    """Return the rows of the table."""
    return [
        [name, *(cell for floors in FLOORS for cell in _cells(found[floors]))]
        for name, found in read_data(DATA)["settings"].items()
    ]


def _cells(numbers: dict[str, Any]) -> list[str]:
    error, low, high = numbers["tracking_error"]
    better = percent(numbers["better"]) if "better" in numbers else ""
    return [f"{error:.3f} [{low:.3f}, {high:.3f}]", better, f"{1e3 * numbers['slip_speed'][0]:.1f}"]


def draw(path: Path) -> None:
    """Tracking error against all slip, for three weights of slip each."""
    data = read_data(DATA)
    figure = new_figure(8.0, 3.6)
    for k, floors in enumerate(FLOORS):
        axes = figure.add_subplot(1, 2, k + 1)
        for names, colour, label in ((AWARE, BLUE, "slip-aware; number: weight of slip"), (BLIND, ORANGE, "blind; the same")):
            points = [data["settings"][name][floors] for name in names.values()]
            error, slip = ([[1e3**j * v for v in one[key]] for one in points] for j, key in enumerate(_KEYS))
            axes.plot([one[0] for one in error], [one[0] for one in slip], "o-", color=colour, label=label)
            for weight, x, y, place in zip(names, error, slip, ((4, 6), (8, 4), (4, -12)), strict=True):
                axes.plot(x[1:], [y[0]] * 2, color=colour, linewidth=0.8)
                axes.plot([x[0]] * 2, y[1:], color=colour, linewidth=0.8)
                axes.annotate(f"{weight:g}", (x[0], y[0]), place, textcoords="offset points", color=colour, fontsize=9)
        for name, colour in CONTROLLERS.items():
            one = data["controllers"][floors][name]
            axes.plot(one["tracking_error"], 1e3 * one["slip_speed"], "s", color=colour, label=name)
        axes.set(title=floors, xlabel="tracking error (1 = at the scales)", ylabel="slip speed, mean over wheels (mm/s)")
        tidy(axes)
    legend_below(figure)
    save(figure, path)


if __name__ == "__main__":
    if sys.argv[1:]:
        score(*sys.argv[1:])
    draw(PICTURE)
