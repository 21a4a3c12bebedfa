"""Numbers that were measured once: README and docs/ have those of docs/data, in order, whatever the sentences around them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import closing
from functools import cache
from typing import Any

import gymnasium
import pytest
from blocks import ROOT

from studies import learning
from studies.bench import adapt, performance
from studies.bench.__main__ import MEASUREMENTS
from studies.bench.gap import score_answers

DATA = ROOT / "docs" / "data"
NUMBER = re.compile(r"(?<![\w.])-?\d[\d,]*(?:\.\d+)?")


@cache
def page(name: str) -> str:
    """A page, or README."""
    path = ROOT / ("README.md" if name == "README" else f"docs/{name}.md")
    return path.read_text(encoding="utf-8").replace("\N{MINUS SIGN}", "-")


@cache
def data(name: str) -> Any:
    return learning.read_data(DATA / f"{name}.json")


def numbers(text: str) -> list[str]:
    return [found.rstrip(",").replace(",", "") for found in NUMBER.findall(text)]


def missing(name: str, heading: str, *groups: Sequence[float | str]) -> list[list[str]]:
    """Groups of numbers that do not follow each other under a heading of a page; '': all of it."""
    text = page(name).partition(f"{heading}\n")[2].partition("\n#")[0] if heading else page(name)
    there = numbers(text)
    wanted = [[f"{one:.0f}" if isinstance(one, float) else str(one) for one in group] for group in groups]
    return [one for one in wanted if not any(there[k : k + len(one)] == one for k in range(len(there)))]


def test_the_real_servo():
    found = data("xl330_pendulum")["workflow"]
    gap, groups = found["gap"], []
    for effect in found["effects"]:
        (number,) = effect["parameters"].values()
        groups.append([f"{value:.2f}" for value in (number["value"], *number["ci95"])])
    groups.append([f"{gap['heldout_calibrated']:.1f}", f"{gap['heldout_after']:.1f}"])
    groups.append([100 * share for share in (gap["reduction"], *gap["reduction_ci95"])])
    assert not missing("own_rig", "## A servo that swings a pendulum", *groups)


def test_the_slip_observer():
    rows = data("observer")["rows"]
    ours = {(row["floor"], row["drive"]): row for row in rows if row["backend"] == "gibbs_appell"}
    ratios = [
        row[sensors]["slip_mm_s"] / ours[row["floor"], row["drive"]][sensors]["slip_mm_s"]
        for row in rows
        if row["backend"] == "mujoco"
        for sensors in ("neither", "camera")
    ]
    found = {
        (row["floor"], row["drive"], row["backend"], sensors): row[sensors]["error_over_sigma"]
        for row in rows
        for sensors in ("neither", "camera", "flow", "camera and flow")
        if sensors in row
    }
    wide = [found.pop(("wide", "commands", backend, "neither")) for backend in ("gibbs_appell", "mujoco")]
    excited = {key: found.pop(key) for key in list(found) if key[1] == "excitation" and key[-1] == "neither"}
    own = [value for (_, _, backend, _), value in excited.items() if backend == "gibbs_appell"]
    split = [found.pop(key) for key in list(found) if key[0] == "split" and "velocity" in key[1] and key[-1] == "neither"]
    ends = [[f"{one:.1f}" for one in (min(group), max(group))] for group in (ratios, wide, own, split, found.values())]
    assert not missing("slip_observer", "## Accuracy", *ends)


def test_the_camera_in_the_loop():
    rows = [row for row in data("bench")["rows"] if row["name"] == "camera" and "over that without a camera" in row["what"]]
    ratios = [row["ours"]["median"] for row in rows]
    assert not missing("camera", "## Measured", [f"{min(ratios):.2f}", f"{max(ratios):.2f}", "1.00"])


def test_films():
    film, drives = data("lab_films"), data("vision")["vision"]
    score, count = film["score"], len(film["films"])
    share, printed, held = (100 * score[name] for name in ("within_1_mm_all", "within_1_mm", "within_2.5_sigma"))
    worst = [max(row["value"] for row in drives if word in row["what"]) for word in ("longitudinal slip", "lateral slip")]
    clock = max(row["value"] for row in drives if "clock offset" in row["what"])
    lab = [share, share * count / 100, count, 95, printed, "2.5", held, 95]
    groups = [[f"{one:.2f}" for one in worst], [f"{clock:.1f}"], lab]
    assert not missing("vision", "## Measured", *groups)
    assert score["refused"] == score["silently_wrong"] == 0
    assert all(row["met"] is not False for row in drives)


def test_adaptation():
    lines = adapt.read_lines(DATA / "adapt.jsonl")
    said = " ".join(adapt.summary(adapt.by_case(lines)))
    (error,) = re.findall(r"after adaptation: (\d+ \[\d+, \d+\]) % smaller", said)
    shares = dict(re.findall(r"Regained by '([^']+)' in \d+ of these, %: median (\d+ \[-?\d+, \d+\])", said))
    ours, calibrated = (numbers(shares[adapt.CONTENDERS[name]]) for name in ("ours", "calibrated"))
    library = [line for line in lines if line["contender"] == "ours" and line["shared_law"]]
    named = [sorted(one["name"] for one in line["found"]) == sorted(one["name"] for one in line["effects"]) for line in library]
    groups = [numbers(error), ours, calibrated[:1]]
    assert not missing("README", "", *groups)
    assert not missing("adapt", "## What it regains", *groups, [sum(named), len(named)])


def test_the_blind_test():
    found = score_answers(DATA / "gap_answers.json")
    named, alarms = found["single"]["top1"], found["false_alarms"]["all"]
    share = [named["hits"], named["count"], 100 * named["bound95"], alarms["count"], 100 * alarms["bound95"]]
    one, refused = found["single"]["top1_at_one"], found["false_alarms"]["refused_good_data"]
    small = [[one["hits"], one["count"]], [refused["hits"], refused["count"]]]
    assert alarms["hits"] == 0
    assert not missing("README", "", share, *small)


def test_chosen_runs():
    hiding = [line for line in data("decide") if line["hidden"]]
    right, took = {}, {}
    for contender in ("chosen", "random", "eight"):
        own = [line for line in hiding if line["contender"] == contender]
        right[contender] = sum(line["right"] for line in own)
        took[contender] = sum(line["seconds"] for line in own) / right[contender]
    count = len(hiding) // 3
    groups = [[right["chosen"], count, 100 * right["chosen"] / count, 95, took["chosen"]]]
    groups += [[took[name], right[name]] for name in ("random", "eight")]
    assert not missing("gap", "## Until it is decided", *groups)


def test_velocity():
    rows = {(row["sensors"], row["floors"]): row for row in data("learning")["velocity"]["rows"]}
    late, plain = (rows["camera", floors]["tracking_error"][0] for floors in ("slippery, 40 ms late", "slippery"))
    others = [rows["none", "slippery"]["others"][name]["tracking_error"] for name in (learning.BLIND, *learning.CONTROLLERS)]
    split = rows["none", "split"]
    readme = [[f"{one:.3f}" for one in (*rows["none", "slippery"]["tracking_error"], *others[:1])]]
    readme += [[f"{others[1]:.3f}"], [f"{others[2]:.3f}"], [40, 100 * (late / plain - 1)]]
    readme += [[f"{split['tracking_error'][0]:.2f}", f"{split['others']['pid']['tracking_error']:.2f}"]]
    assert not missing("README", "", *readme)
    gains = {floors: [] for floors in (True, False)}
    for (_, floors), row in rows.items():
        if floors != "slippery, 40 ms late":
            gains[floors in ("ice", "nominal", "wide", "ribbed")].append(row["others"]["slip_compensating"]["better"])
    alike, mixed = ([one[0] for one in gains[key]] for key in (True, False))
    assert all(low < 0.0 < high for _, low, high in gains[True])
    slips = [row["others"]["blind"]["slips_less"] for row in rows.values()]
    errors = [row["others"]["blind"]["better"][0] for row in rows.values()]
    widest = max(abs(edge) for _, *edges in slips for edge in edges)
    less = [-min(one[0] for one in slips), max(one[0] for one in slips), widest, min(errors), max(errors)]
    worst = [100 * (late / plain - 1), f"{late:.3f}", f"{plain:.3f}"]
    mean, median = (card_numbers("velocity", name)["slip_compensating"] for name in ("tracking_error", "tracking_error_median"))
    cards = [f"{mean[0]:.1f}", *(f"{one:.1f}" for one in median)]
    groups = [worst, cards, [-min(alike), max(alike)], [min(mixed), max(mixed)], less]
    assert not missing("policies", "### Velocity", *groups)


def test_slope_and_jitter():
    (row,) = [row for row in data("learning")["slope"]["rows"] if row["sensors"] == "none"]
    others = row["others"]
    groups = [[others[name]["better"][0] for name in ("blind", "slip_compensating", "pid")]]
    groups[0] += [others[name]["slips_less"][0] for name in ("blind", "pid")]
    for task, more in (("path", []), ("slope", groups)):
        jitter = card_numbers(task, "action_jitter")
        pair = [f"{1 - jitter['pid'][0] / 100:.1f}", -jitter["slip_compensating"][0]]
        assert not missing("policies", f"### {task.title()}", pair, *more)


def test_ablations():
    settings = data("ablations")["settings"]
    names = ("plain PPO, 4 million steps", "controller of pid", "estimates to the controller only", "large minibatches")
    better = [settings[name]["slippery"]["better"] for name in names]
    assert not missing("policies", "## Ablations", *([-mean, -high, -low] for mean, low, high in better))


def card_numbers(task: str, metric: str) -> dict[str, list[float]]:
    """A row of a score card's tables, by policy; a row that both tables have is that of the comparison."""
    text = (ROOT / "docs" / "cards" / task / "card.md").read_text(encoding="utf-8")
    header: list[str] = []
    found: dict[str, list[float]] = {}
    for cells in ([cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")):
        if cells[0] in ("metric", "better in"):
            header = cells
        elif cells[0] == metric:
            found = dict(zip(header[2:], ([float(one) for one in numbers(cell)] for cell in cells[2:]), strict=True))
    return found


def test_the_large_robot():
    found = data("own_robot")
    better, gap = found["better_than_tuned_pid_percent"], found["gap"]
    policies = [f"{one:.3f}" for name in ("three", "tuned_pid") for one in found["policies"][name]["tracking_error"]]
    worse = [[-mean, -high, -low] for mean, low, high in (better["excess_slip"], better["yaw_rate_error"])]
    (number,) = gap["parameters"].values()
    resistance = [f"{one:.4f}" for one in (number["value"], *number["ci95"])]
    groups = [policies[:3], policies[3:], better["tracking_error"], *worse]
    assert not missing("own_robot", "## Train, tune, evaluate, export", *groups)
    removed = [100 * gap["reduction"]]
    assert not missing("own_robot", "## Deploy on the emulator, record, find what is missing", resistance, removed)


#: What the table on top of the page is about.
IN_SHORT = {f"{precision}, {what}" for precision in ("float64", "float32") for what in performance.README_RATIOS}
IN_SHORT |= {"env.step of one robot, float64", "PPO, frames, 512 robots, float32", "times learnt (reward 1.7/s), 256 robots"}


def test_speed():
    bench = data("bench")
    rows = bench["rows"]
    top = page("performance").partition("**In short**")[2].partition("\n\n")[0]
    for row in rows:
        if row["what"].partition(":")[0] in IN_SHORT:
            assert f"{(row['ratio'] or row['ours'])['median']:.3g}" in numbers(top), row["what"]
    assert performance.write_readme(performance.README.read_text(encoding="utf-8"), rows) == performance.README.read_text(
        encoding="utf-8"
    )
    assert {row["name"] for row in rows} <= set(MEASUREMENTS)
    settings = [one for one in bench["engine"]["settings"] if one["precision"] == "float64"]
    speed = {(one["side"], one["label"]): one["speed"]["median"] for one in settings}
    (best,) = [row for row in rows if row["what"].startswith("float64, error at most 0.1 mm")]
    (both,) = [row["ratio"]["median"] for row in rows if row["what"].startswith("float64, both at 1 ms, 2 threads")]
    (loose,) = [row["ratio"]["median"] for row in rows if row["what"].startswith("float64, error at most 25 mm")]
    (alone,) = [row["ours"]["median"] for row in rows if row["what"] == "1 robots, float64, 1 thread"]
    usual, fast = (speed["engine", label] / best["peer"]["median"] for label in ("2 ms", "1 ms"))
    peer = speed["MuJoCo", "1 ms, pyramidal, default contact, Euler"] * 1000
    worst = max(one["worst"] for one in settings if one["label"].startswith("0.25 ms, elliptic, tuned"))
    groups = [["35.9", f"{both:.1f}"], [usual, 2, 1, fast], [alone / 1000, 1, alone / peer], [f"{1000 * worst:.2f}", "0.25"]]
    assert not missing("performance", "## How fair is the speed claim?", *groups)
    assert not missing("README", "", [loose, 25, both])
    frames = {row["what"]: row["ours"]["median"] for row in rows if row["what"].startswith("frames, ")}
    learnt = [frames.pop("frames, ours"), *sorted(frames.values())]
    assert not missing("performance", "## What else is compared", learnt)


def test_a_snapshot():
    with closing(gymnasium.make("WLR-Velocity-v0", randomization="ice")) as env:
        env.reset(seed=0)
        size = env.get_wrapper_attr("get_state")().nbytes
    assert not missing("environments", "## Snapshots", [size / 1000])


@pytest.mark.parametrize("task", learning.ROWS)
def test_every_row_of_the_results_is_there(task):
    wanted = [(sensors, floors if isinstance(floors, str) else floors["name"]) for sensors, floors in learning.ROWS[task]]
    assert [(row["sensors"], row["floors"]) for row in data("learning")[task]["rows"]] == wanted
