"""Sentences with numbers that were measured once have those of docs/data."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from blocks import ROOT

from studies import learning
from studies.bench.adapt_study import CONTENDERS, read_lines
from studies.bench.adapt_table import by_case, summary
from studies.bench.gap import score_answers

UNITS = {"1/A": " /A", "-": ""}


def page(name: str) -> str:
    return in_one_line(ROOT / "docs" / f"{name}.md")


def in_one_line(path: Path) -> str:
    """A page's text in one line."""
    return " ".join(path.read_text(encoding="utf-8").split())


def data(name: str) -> Any:
    return learning.read_data(ROOT / "docs" / "data" / f"{name}.json")


def test_the_real_servo_lacks_what_the_page_says():
    found = data("xl330_pendulum")["workflow"]
    text, gap = page("gap_rig"), found["gap"]
    for effect in found["effects"]:
        (number,) = effect["parameters"].values()
        value, unit, (low, high) = number["value"], UNITS[number["unit"]], number["ci95"]
        assert f"{value:.2f}{unit} ({low:.2f} to {high:.2f})" in text, effect["name"]
    low, high = (100 * share for share in gap["reduction_ci95"])
    assert f"from {gap['heldout_calibrated']:.1f} to {gap['heldout_after']:.1f} encoder counts" in text
    assert f"{100 * gap['reduction']:.0f} % ({low:.0f} to {high:.0f}) of what can be avoided" in text
    assert len(found["runs"]["heldout"]) == 4


def test_the_observer_on_mujoco_is_as_the_page_says():
    rows = data("observer")["rows"]
    ours = {(row["floor"], row["drive"]): row for row in rows if row["backend"] == "gibbs_appell"}
    ratios = [
        row[sensors]["slip_mm_s"] / ours[row["floor"], row["drive"]][sensors]["slip_mm_s"]
        for row in rows
        if row["backend"] == "mujoco"
        for sensors in ("neither", "camera")
    ]
    assert f"slip errors are {min(ratios):.1f} to {max(ratios):.1f} times these" in page("slip_observer")


def test_the_observers_sigmas_are_as_the_page_says():
    rows, text = data("observer")["rows"], page("slip_observer")
    found = {
        (row["floor"], row["drive"], row["backend"], sensors): row[sensors]["error_over_sigma"]
        for row in rows
        for sensors in ("neither", "camera", "flow", "camera and flow")
        if sensors in row
    }
    wide, on_mujoco = (found.pop(("wide", "commands", backend, "neither")) for backend in ("gibbs_appell", "mujoco"))
    excited = {key: found.pop(key) for key in list(found) if key[1] == "excitation" and key[-1] == "neither"}
    ours = [value for (_, _, backend, _), value in excited.items() if backend == "gibbs_appell"]
    split = [found.pop(key) for key in list(found) if key[0] == "split" and "velocity" in key[1] and key[-1] == "neither"]
    assert f"`wide` commands (error/sigma {wide:.1f}; {on_mujoco:.1f} on MuJoCo)" in text
    assert f"for excitation ({min(ours):.1f} to {max(ours):.1f}) and for policies on split floors" in text
    assert f"({min(split):.1f} to {max(split):.1f}). Elsewhere, and with a camera" in text
    assert f"error/sigma is {min(found.values()):.1f} to {max(found.values()):.1f}" in text


def test_a_covered_lens_costs_what_the_page_says():
    rows = [row for row in data("bench")["rows"] if row["name"] == "camera" and "over that without a camera" in row["what"]]
    ratios = [row["ours"]["median"] for row in rows]
    said = (
        f"{min(ratios):.2f} to {max(ratios):.2f} times that of a robot without a camera (target: at most 1.00, just missed on "
    )
    assert sum(not row["met"] for row in rows) == 2
    assert f"{said}two of the three floors)" in page("camera")


def test_films_of_a_lab_have_the_numbers():
    film, text = data("lab_films"), page("vision")
    score, count = film["score"], len(film["films"])
    share, printed, held = (100 * score[name] for name in ("within_1_mm_all", "within_1_mm", "within_2.5_sigma"))
    assert f"{share:.0f} % ({share * count / 100:.0f} of {count}; target 95 %, missed;" in text
    assert f"body target on one sheet: {printed:.0f} %) and within 2.5 sigma in {held:.0f} % (95 %)" in text
    assert "No film is refused, and none beyond 4 sigma lacks a finding" in text
    assert score["refused"] == score["silently_wrong"] == 0


def test_the_pages_have_the_numbers_of_adaptation():
    readme, said = (
        in_one_line(ROOT / "README.md"),
        " ".join(summary(by_case(read_lines(ROOT / "docs" / "data" / "adapt.jsonl")))),
    )
    (error,) = re.findall(r"after adaptation: (\d+ \[\d+, \d+\]) % smaller", said)
    shares = dict(re.findall(r"Regained by '([^']+)' in \d+ of these, %: median (\d+ \[-?\d+, \d+\])", said))
    ours, calibrated = (shares[CONTENDERS[name]] for name in ("ours", "calibrated"))
    assert f"tracking error {error.replace(' ', ' % ', 1)} smaller (median)" in readme
    assert f"{ours.replace(' ', ' % ', 1)} of what training with the true model wins" in readme
    assert f"calibration alone {calibrated.split()[0]} %" in readme


def test_the_adaptation_page_counts_what_was_named_and_what_was_not_committed():
    lines, text = read_lines(ROOT / "docs" / "data" / "adapt.jsonl"), page("adapt")
    library = [line for line in lines if line["contender"] == "ours" and line["shared_law"]]
    named = [sorted(one["name"] for one in line["found"]) == sorted(one["name"] for one in line["effects"]) for line in library]
    assert f"In {sum(named)} of {len(named)} cases from the library all effects were named" in text
    assert sum(len(line["effects"]) == 2 for line in library) == 4
    loose = sum(line["commit"].endswith("-dirty") for line in lines)
    assert f"{loose} of the {len(lines)} results come from uncommitted code" in text
    assert f"{loose} of {len(lines)} results of adaptation" in page("versions")


def test_the_pages_have_the_numbers_of_the_blind_test():
    found, readme = score_answers(ROOT / "docs" / "data" / "gap_answers.json"), in_one_line(ROOT / "README.md")
    named, alarms, sets = found["single"]["top1"], found["false_alarms"]["all"], found["sets"]
    said = f"right name first in {named['hits']} of {named['count']} (at least {100 * named['bound95']:.0f} %), "
    said += f"no false alarm in {alarms['count']} (at most {100 * alarms['bound95']:.0f} %)"
    assert alarms["hits"] == 0
    assert said + (f"; {sets} of 400 sets so far" if sets < 400 else "") in readme
    one, refused = found["single"]["top1_at_one"], found["false_alarms"]["refused_good_data"]
    assert f"names {one['hits']} of {one['count']} effects of severity 1 (target 80 %)" in readme
    assert f"says that {refused['hits']} of {refused['count']} good data sets show too little" in readme


def test_the_policies_page_has_the_numbers_of_velocity():
    rows = {(row["sensors"], row["floors"]): row for row in data("learning")["velocity"]["rows"]}
    text, readme = page("policies"), in_one_line(ROOT / "README.md")
    late, plain = (rows["camera", floors]["tracking_error"][0] for floors in ("slippery, 40 ms late", "slippery"))
    assert f"increase the error by {100 * (late / plain - 1):.0f} %: {late:.3f} instead of {plain:.3f}" in text
    assert f"40 ms late raise the tracking error by {100 * (late / plain - 1):.0f} %" in readme
    blind, controller, pid = (
        rows["none", "slippery"]["others"][name]["tracking_error"] for name in (learning.BLIND, *learning.CONTROLLERS)
    )
    said = f"blind policy (three seeds) {blind:.3f}, `slip_compensating` (hand-written) {controller:.3f}, tuned PID {pid:.3f}"
    assert said in readme
    split = rows["none", "split"]
    ours, theirs = split["tracking_error"][0], split["others"]["pid"]["tracking_error"]
    assert f"(mean error on such floors: {ours:.2f} and {theirs:.2f})" in readme
    of_one_friction = ("ice", "nominal", "wide", "ribbed")
    gains = {floors: [] for floors in (True, False)}
    for (_, floors), row in rows.items():
        if floors != "slippery, 40 ms late":
            gains[floors in of_one_friction].append(row["others"]["slip_compensating"]["better"])
    alike, mixed = ([one[0] for one in gains[key]] for key in (True, False))
    assert f"the policy is {-min(alike):.0f} % worse to {max(alike):.0f} % better, and every interval contains 0" in text
    assert all(low < 0.0 < high for _, low, high in gains[True])
    assert f"On mixed floors it is {min(mixed):.0f} to {max(mixed):.0f} % better" in text
    slips = [row["others"]["blind"]["slips_less"] for row in rows.values()]
    more, less = -min(one[0] for one in slips), max(one[0] for one in slips)
    widest = max(abs(edge) for _, *edges in slips for edge in edges)
    assert f"({more:.0f} % more to {less:.0f} % less, intervals within {widest:.0f} %" in text
    errors = [row["others"]["blind"]["better"][0] for row in rows.values()]
    assert f"its error is {min(errors):.0f} to {max(errors):.0f} % smaller" in text


def test_the_policies_page_has_the_numbers_of_slope():
    (row,) = [row for row in data("learning")["slope"]["rows"] if row["sensors"] == "none"]
    better, less = ({name: f"{one[key][0]:.0f} %" for name, one in row["others"].items()} for key in ("better", "slips_less"))
    said = f"error is {better['blind']} smaller than that of `blind`, {better['slip_compensating']} than `slip_compensating`, "
    said += f"{better['pid']} than `pid`. It slips {less['blind']} less than `blind`"
    assert f"{said} and {less['pid']} less than `pid`" in page("policies")


def card_numbers(task: str, metric: str) -> dict[str, list[float]]:
    """A row of a score card's tables, by policy; a row that both tables have is that of the comparison."""
    text = (ROOT / "docs" / "cards" / task / "card.md").read_text(encoding="utf-8")
    header: list[str] = []
    found: dict[str, list[float]] = {}
    for cells in ([cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")):
        if cells[0] in ("metric", "better in"):
            header = cells
        elif cells[0] == metric:
            numbers = [[float(number) for number in re.findall(r"-?[\d.]+", cell)] for cell in cells[2:]]
            found = dict(zip(header[2:], numbers, strict=True))
    return found


def test_the_policies_page_has_the_numbers_of_the_cards():
    text = page("policies")
    mean, median = (card_numbers("velocity", name)["slip_compensating"] for name in ("tracking_error", "tracking_error_median"))
    assert (
        f"mean error is {mean[0]:.1f} % smaller, the median only {median[0]:.1f} % [{median[1]:.1f}, {median[2]:.1f}]" in text
    )
    path, slope = (card_numbers(task, "action_jitter") for task in ("path", "slope"))
    times, more = 1 - path["pid"][0] / 100, -path["slip_compensating"][0]
    assert f"its jitter is {times:.1f} times that of `pid` and {more:.0f} % above `slip_compensating`" in text
    times, more = 1 - slope["pid"][0] / 100, -slope["slip_compensating"][0]
    assert f"Jitter is {times:.1f} times that of `pid`, {more:.0f} % above `slip_compensating`" in text


def test_the_policies_page_has_the_numbers_of_the_ablations():
    settings, text = data("ablations")["settings"], page("policies")
    for name, said in (
        ("plain PPO, 4 million steps", "has an error {} % larger [{}, {}]"),
        ("controller of pid", "the error is {} % larger [{}, {}]"),
        ("estimates to the controller only", "it is {} % larger [{}, {}]"),
        ("large minibatches", "may cost {} % [{}, {}]"),
    ):
        mean, low, high = (f"{-value:.0f}".replace("-", "\N{MINUS SIGN}") for value in settings[name]["slippery"]["better"])
        assert said.format(mean, high, low) in text, name


def test_filmed_drives_have_the_numbers():
    rows, text = data("vision")["vision"], page("vision")
    along, across, clock = (
        max(row["value"] for row in rows if word in row["what"])
        for word in ("longitudinal slip", "lateral slip", "clock offset")
    )
    assert f"at most {along:.2f} mm longitudinally and {across:.2f} mm laterally, the clock offset by {clock:.1f} ms" in text
    assert all(row["met"] is not False for row in rows)


def test_the_frames_of_learning_have_the_numbers():
    frames = {row["what"]: row["ours"]["median"] for row in data("bench")["rows"] if row["what"].startswith("frames, ")}
    ours, peers = frames.pop("frames, ours"), sorted(frames.values())
    said = f"Ours needed {ours:,.0f} frames; the peers were stopped by the clock after {peers[0]:,.0f} and {peers[1]:,.0f}"
    assert said in page("performance")


def test_the_classifier_has_the_numbers():
    found = data("gap_classifier")
    named, alarms = found["single"]["top1"], found["false_alarms"]["all"]
    said = (
        f"it names {named['hits']} of {named['count']} effects of severity 2 or more, and raises {alarms['hits']} false alarms"
    )
    assert f"{said} in {alarms['count']}" in page("gap_benchmark")


def test_what_chosen_runs_decide_is_as_the_page_says():
    hiding, took = [line for line in data("decide") if line["hidden"]], {}
    for contender in ("chosen", "random", "eight"):
        own = [line for line in hiding if line["contender"] == contender]
        took[contender] = sum(line["seconds"] for line in own) / sum(line["right"] for line in own)
    right = {name: [line["right"] for line in hiding if line["contender"] == name] for name in took}
    chosen = right["chosen"]
    text = page("gap")
    assert f"decide {sum(chosen)} of {len(chosen)} rightly ({100 * sum(chosen) / len(chosen):.0f} %; target 95 %" in text
    assert f"with {took['chosen']:.0f} s of driving per right decision" in text
    random, eight = (f"{took[name]:.0f} s ({sum(right[name])} right)" for name in ("random", "eight"))
    assert f"random ones take {random}, eight fixed ones {eight}" in text


def test_the_large_robot_has_the_numbers():
    found, text = data("own_robot"), page("own_robot").replace("\N{MINUS SIGN}", "-")
    for name, said in (("three", "have a tracking error of"), ("tuned_pid", "tuned `pid`")):
        mean, low, high = found["policies"][name]["tracking_error"]
        assert f"{said} {mean:.3f} [{low:.3f}, {high:.3f}]" in text
    better = found["better_than_tuned_pid_percent"]
    assert "{:.0f} % [{:.0f}, {:.0f}] less on the same episodes".format(*better["tracking_error"]) in text
    for key, said in (
        ("excess_slip", "slip **{:.0f} % more** [{:.0f}, {:.0f}]"),
        ("yaw_rate_error", "({:.0f} % worse [{:.0f}, {:.0f}])"),
    ):
        mean, low, high = better[key]
        assert said.format(-mean, -high, -low) in text
    gap = found["gap"]
    (number,) = gap["parameters"].values()
    low, high = number["ci95"]
    assert gap["effect"] == "rolling_resistance"
    assert f"found {number['value']:.4f} ({low:.4f} to {high:.4f})" in text
    assert f"removed {100 * gap['reduction']:.0f} % of the avoidable error" in text
