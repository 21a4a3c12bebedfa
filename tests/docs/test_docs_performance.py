"""docs/performance.md has the numbers of docs/data/bench.json, and those come from reports of ``python -m studies.bench``."""

from __future__ import annotations

import json
import re
from contextlib import closing

import gymnasium
import pytest
from blocks import ROOT

from studies.bench import performance
from studies.bench.__main__ import MEASUREMENTS
from studies.bench.measure import Measurement, machine

DATA = json.loads((ROOT / "docs" / "data" / "bench.json").read_text(encoding="utf-8"))
ROWS = DATA["rows"]
#: What the page says in words.
IN_SHORT = {f"{precision}, {what}" for precision in ("float64", "float32") for what in performance.README_RATIOS}
IN_SHORT |= {"env.step of one robot, float64", "PPO, frames, 512 robots, float32", "times learnt (reward 1.7/s), 256 robots"}


def report(*rows: Measurement, quick: bool = False) -> dict:
    found = {"machine": machine(), "rounds": 3, "quick": quick, "measurements": [row.as_dict() for row in rows]}
    return json.loads(json.dumps(found))


def test_page_and_readme_have_the_numbers():
    text = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8").partition("**In short**")[2].partition("\n\n")[0]
    for row in ROWS:
        if row["what"].partition(":")[0] in IN_SHORT:
            assert f"{(row['ratio'] or row['ours'])['median']:.3g}" in re.findall(r"\d[\d.]*\d|\d", text), row["what"]
    readme = performance.README.read_text(encoding="utf-8")
    assert performance.write_readme(readme, ROWS) == readme
    assert {row["name"] for row in ROWS} <= set(MEASUREMENTS)


def test_the_fairness_of_the_speed_claim_has_the_numbers():
    page = " ".join((ROOT / "docs" / "performance.md").read_text(encoding="utf-8").split())
    settings = [one for one in DATA["engine"]["settings"] if one["precision"] == "float64"]
    speed = {(one["side"], one["label"]): one["speed"]["median"] for one in settings}
    (best,) = [row for row in ROWS if row["what"].startswith("float64, error at most 0.1 mm")]
    usual, fast = (speed["engine", label] / best["peer"]["median"] for label in ("2 ms", "1 ms"))
    assert f"With the usual 4 passes it is {usual:.0f} (2 ms), at `gym.make`'s 1 ms {fast:.0f}." in page
    (both,) = [row["ratio"]["median"] for row in ROWS if row["what"].startswith("float64, both at 1 ms, 2 threads")]
    assert f"with two the 35.9 are {both:.1f}" in page
    (alone,) = [row["ours"]["median"] for row in ROWS if row["what"] == "1 robots, float64, 1 thread"]
    peer = speed["MuJoCo", "1 ms, pyramidal, default contact, Euler"] * 1000
    assert f"{alone / 1000:.0f} k substeps of 1 ms per second, {alone / peer:.0f} times MuJoCo at 1 ms" in page
    worst = max(one["worst"] for one in settings if one["label"].startswith("0.25 ms, elliptic, tuned"))
    assert f"at most {worst * 1000:.2f} mm away at 0.25 ms" in page
    (loose,) = [row for row in ROWS if row["what"].startswith("float64, error at most 25 mm")]
    readme = performance.README.read_text(encoding="utf-8")
    times = "\N{MULTIPLICATION SIGN}"
    assert f"{loose['ratio']['median']:.0f}{times} as fast where an error of 25 mm suffices, and {both:.0f}{times}" in readme


def test_a_snapshot_is_as_large_as_the_page_says():
    text = (ROOT / "docs" / "planning.md").read_text(encoding="utf-8")
    with closing(gymnasium.make("WLR-Velocity-v0", randomization="ice")) as env:
        env.reset(seed=0)
        size = env.get_wrapper_attr("get_state")().nbytes
    assert f"`snapshot.nbytes` ({size / 1000:.0f} kB per robot in float64)" in text


def test_a_report_replaces_its_own_measurement_only():
    new = Measurement("import", "import wlr_gym, beyond bare Python", "s", (0.2, 0.1, 0.4), bar=0.15)
    rows = performance.merged(ROWS, report(new))
    (line,) = [line for line in performance.speed_table(rows) if "import wlr_gym" in line]
    assert "0.2 s [0.1..0.4]" in line
    assert "< 0.15 s: missed" in line
    assert machine()["date"] in line
    assert len(rows) == len(ROWS)
    assert [row for row in rows if row["name"] != "import"] == [row for row in ROWS if row["name"] != "import"]


def test_a_pair_is_shown_with_its_peer_and_ratio():
    row = Measurement("engine", "substeps", "1/s", (2e6, 4e6, 3e6), (1e5, 1e5, 1e5), "mujoco.batch", 25.0)
    (line,) = performance.speed_table(performance.merged([], report(row)))[2:]
    assert line.startswith(
        "| substeps | 3 M/s | 100 k/s (mujoco.batch) | 30 [20..40] | >= 25 | `python -m studies.bench --only engine` |"
    )


def test_quick_numbers_are_refused():
    with pytest.raises(SystemExit, match="mean nothing"):
        performance.merged([], report(quick=True))


def test_the_engine_is_taken_over_into_data_readme_and_picture(tmp_path, monkeypatch):
    for name in ("DATA", "README"):
        copy = tmp_path / getattr(performance, name).name
        copy.write_text(getattr(performance, name).read_text(encoding="utf-8"), encoding="utf-8")
        monkeypatch.setattr(performance, name, copy)
    monkeypatch.setattr(performance, "PICTURE", tmp_path / "accuracy_speed.png")
    names = [f"{precision}, {what}: 1 ms" for precision in ("float64", "float32") for what in performance.README_RATIOS]
    rows = [Measurement("engine", name, "x real time", (90.0 + n,), (1.0,), "MuJoCo") for n, name in enumerate(names)]
    speed = {"median": 90.0, "min": 90.0, "max": 90.0}
    setting = {"side": "engine", "label": "1 ms", "precision": "float64", "step": 1e-3, "threads": 1, "call": "step"}
    setting |= {"is_usual": True, "error": 2e-5, "worst": 4e-5, "upright": True, "speed": speed}
    limits = {"disagreement": {"median": 1e-8, "max": 3e-7}, "convergence": {"median": 1e-7, "max": 3e-6}}
    engine = {"reference": {**limits, "closed_form": {"slide": 1e-5}}, "settings": [setting]}
    file = tmp_path / "report.json"
    file.write_text(json.dumps({**report(*rows), "engine": engine}), encoding="utf-8")
    performance.main([str(file)])
    taken = json.loads(performance.DATA.read_text(encoding="utf-8"))["engine"]
    assert "| engine | 1 ms | float64 | 0.02 mm | 0.04 mm | 90 [90..90] |" in performance.engine_lines(taken)
    assert "90\N{MULTIPLICATION SIGN} as fast (float64), 92\N{MULTIPLICATION SIGN} (float32)" in performance.README.read_text(
        encoding="utf-8"
    )
    assert performance.PICTURE.is_file()
