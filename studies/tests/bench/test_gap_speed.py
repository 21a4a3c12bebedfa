"""``python -m studies.bench gap --speed``: times add up, and what takes long is shown."""

import json
import time
from types import SimpleNamespace

import pytest

from studies.bench import gap_speed
from studies.bench.__main__ import BenchOptions, run
from wlr_gym.base.errors import InputError


@pytest.fixture
def analysed(monkeypatch):
    """Analyses that idle, then work; what each was asked for."""
    asked = []

    def analyse(folder, *, threads, tell):
        asked.append((folder, threads))
        tell("reading", 0.0)
        time.sleep(0.06)
        tell("naming: screening 3 candidates", 0.5)
        begin = time.process_time()
        while time.process_time() < begin + 0.02:
            pass
        return SimpleNamespace(verdict="effect_found", effects=(SimpleNamespace(name="payload"),))

    monkeypatch.setattr(gap_speed, "analyse", analyse)
    return asked


def test_steps_are_timed_by_the_wall_and_by_the_processor(analysed, tmp_path):
    said = []
    (one,) = gap_speed.time_analyses([tmp_path], 3, said.append)
    assert analysed == [(tmp_path, 3)]
    assert [step.step for step in one.steps] == ["reading", "naming: screening 3 candidates"]
    idle, busy = one.steps
    assert idle.wall >= 0.06 > idle.processor + 0.02
    assert busy.wall >= 0.02 <= busy.processor
    assert one.wall == pytest.approx(idle.wall + busy.wall)
    assert said[0] == f"{tmp_path}: effect_found payload"
    assert said[-1].endswith("all")
    assert any("screening 3 candidates" in line for line in said)


def test_the_command_writes_them(analysed, tmp_path, capsys):
    numbers = tmp_path / "speed.json"
    assert run(BenchOptions(what=("gap",), speed=(tmp_path,), threads=1, save=numbers)) == 0
    found = json.loads(numbers.read_text())
    assert found["threads"] == 1
    assert found["analyses"][0]["steps"][0]["step"] == "reading"
    assert "screening 3 candidates" in capsys.readouterr().out


def test_bad_input_is_named(analysed, tmp_path):
    with pytest.raises(InputError, match="--threads 0: expected 1 or more"):
        gap_speed.time_analyses([tmp_path], 0)
    with pytest.raises(InputError, match="one folder of runs"):
        gap_speed.time_analyses([], 1)
