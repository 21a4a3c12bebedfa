"""Reports of ``python -m studies.bench`` are taken over into data, README and picture."""

from __future__ import annotations

import json

import pytest

from studies.bench import performance
from studies.bench.measure import Measurement, machine

ROWS = json.loads(performance.DATA.read_text(encoding="utf-8"))["rows"]


def report(*rows: Measurement, quick: bool = False) -> dict:
    found = {"machine": machine(), "rounds": 3, "quick": quick, "measurements": [row.as_dict() for row in rows]}
    return json.loads(json.dumps(found))


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
        "| substeps | 3 M/s | 100 k/s (mujoco.batch) | 30 [20..40] | >= 25 | `python -m studies.bench engine` |"
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
