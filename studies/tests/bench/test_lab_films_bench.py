"""The bench of lab films: its plan, its score, and that it resumes film by film; nothing is filmed here."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

pytest.importorskip("cv2")

from studies.bench import lab_films
from studies.bench.lab_films import LabResult, bars, plan, run_lab_films, score
from wlr_gym.perception.vision.self_calibration import UNSURE


def result(film, error=0.0004, refused="", findings=()):
    errors = np.full((4, 2), error).tolist()
    if refused:
        return LabResult(asdict(film), refused, 1.0, [], [], 0.0, [], 0.0, [])
    return LabResult(asdict(film), "", 1.0, errors, np.full((4, 2), 0.0004).tolist(), 0.1, [1.0] * 6, 1.0, list(findings))


def test_the_plan_fills_the_space_and_repeats():
    films = plan(20)
    assert [asdict(film) for film in films] == [asdict(film) for film in plan(20)]
    assert {film.camera for film in films} == set(lab_films.CAMERAS)
    assert {film.codec for film in films} == {"none", "h264", "hevc"}
    floors = np.sort([film.lab.floor_error for film in films])
    assert np.all(np.abs(floors - 0.003 * (np.arange(20) + 0.5) / 20) <= 0.003 / 20)  # one in every twentieth
    assert max(film.lab.readout for film in films) > 0.02
    assert sum(film.lab.kick is not None for film in films) == 4
    assert sum(film.lab.doubled > 0 for film in films) == 6


def test_another_seed_gives_other_films():
    films, others = plan(5), plan(5, seed=29)
    assert not {film.lab.seed for film in films} & {film.lab.seed for film in others}
    assert [film.lab.floor_error for film in films] != [film.lab.floor_error for film in others]


def test_the_score_counts_what_the_bars_are_about():
    films = [replace(film, hand_laid=False) for film in plan(5)]
    good = [result(film) for film in films[:3]]
    found = score([*good, result(films[3], refused="no floor"), result(films[4], 0.002)])
    assert (found["films"], found["refused"], found["silently_wrong"]) == (5, 1, 1)
    assert found["within_1_mm"] == found["within_2.5_sigma"] == 0.75
    met = {what: row for what, _, _, row in bars(found)}
    assert not met["refused"]
    assert not met["beyond 4 sigma without a finding that doubts it"]
    doubted = score([*good, result(films[4], 0.002, findings=[f"a sheet was moved; {UNSURE}"])])
    assert doubted["silently_wrong"] == 0


def test_finished_films_are_not_made_again(tmp_path, monkeypatch):
    pytest.importorskip("imageio_ffmpeg")
    made = []
    monkeypatch.setattr(lab_films, "measure_film", lambda film: made.append(film.index) or result(film))
    first = run_lab_films(tmp_path, 3, say=lambda text: None)
    (tmp_path / "film_01.json").unlink()
    broken = json.loads((tmp_path / "film_02.json").read_text())
    broken["film"]["speed"] = 1.0  # of another plan
    (tmp_path / "film_02.json").write_text(json.dumps(broken))
    again = run_lab_films(tmp_path, 3, say=lambda text: None)
    assert made == [0, 1, 2, 1, 2]
    assert [r.worst for r in again] == [r.worst for r in first]
