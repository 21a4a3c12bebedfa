"""docs/performance.md has the numbers of docs/data/bench.json, and those come from reports of ``wlr bench``."""

from __future__ import annotations

import importlib.util
import json
from types import ModuleType

import pytest
from blocks import ROOT

from wlr_gym.cli.bench import MEASUREMENTS
from wlr_gym.studies.bench.measure import Measurement, machine


def _load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("performance", ROOT / ".ci" / "docs" / "performance.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


performance = _load()
ROWS = json.loads((ROOT / "docs" / "data" / "bench.json").read_text(encoding="utf-8"))["rows"]


def report(*rows: Measurement, quick: bool = False) -> dict:
    found = {"machine": machine(), "rounds": 3, "quick": quick, "measurements": [row.as_dict() for row in rows]}
    return json.loads(json.dumps(found))


def test_the_page_is_what_the_numbers_make():
    text = performance.PAGE.read_text(encoding="utf-8")
    assert performance.write_page(text, ROWS) == text
    assert {row["name"] for row in ROWS} <= set(MEASUREMENTS)


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
    assert line.startswith("| substeps | 3 M/s | 100 k/s (mujoco.batch) | 30 [20..40] | >= 25 | `wlr bench --only engine` |")


def test_quick_numbers_are_refused():
    with pytest.raises(SystemExit, match="mean nothing"):
        performance.merged([], report(quick=True))
