"""wlr import and wlr export --to, as a user types them."""

import shutil
from pathlib import Path

import pytest
from foreign_logs import lab_messages, made_up, rows_of, write_mcap

from wlr_gym.base.settings import read_yaml
from wlr_gym.cli import BAD_INPUT, OK, main
from wlr_gym.data import read_dataset, read_run, write_run
from wlr_gym.data.logs.map import map_text


def test_suggest_answer_import(mcap, answered, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["import", str(mcap), "--suggest"]) == OK
    said = capsys.readouterr().out
    assert "decided" in said
    assert "rad, deg, turn, count? topic '/chassis/joints'" in said
    assert "meta.profile" in said
    assert main(["import", str(mcap), "--map", "map.yaml", "--out", "runs"]) == BAD_INPUT
    assert "map.yaml: still open: joints.leg_lf.sign, joints.leg_lf.zero" in capsys.readouterr().err
    Path("map.yaml").write_text(map_text(answered))
    assert main(["import", str(mcap), "--map", "map.yaml", "--out", "runs"]) == OK
    said = capsys.readouterr().out
    assert "as recorded" in said
    assert "held at mid-step" in said
    assert "does not state the servo profile (meta.profile): none is assumed" in " ".join(said.split())
    (run,) = read_dataset("runs").runs
    assert run.meta.robot == "wlr-nominal"
    assert not run.meta.states_profile
    record = read_yaml("runs/import.yaml")["run_01"]
    assert record["channels"]["gyro_x"]["rate"] == pytest.approx(200.0)


@pytest.mark.parametrize("profile", ["{leg_velocity: 1.4}", "{}"], ids=["one", "none"])
def test_what_the_map_states_is_not_asked_and_a_complete_one_is_used_at_once(
    mcap, answered, tmp_path, monkeypatch, capsys, profile
):
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(map_text(answered) + f"meta: {{profile: {profile}}}\n")
    assert main(["import", str(mcap), "--suggest", "--map", "mine.yaml", "--out", "runs"]) == OK
    assert "meta.profile" not in capsys.readouterr().out
    assert read_dataset("runs").meta.states_profile


def test_with_a_folder_the_map_is_written_there_and_runs_wait_for_its_answers(mcap, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["import", str(mcap), "--suggest", "--out", "runs"]) == BAD_INPUT
    said = capsys.readouterr().err
    assert "runs/map.yaml: no run is made, 28 entries of the map are open: joints.leg_lf.sign, " in said
    assert said.rstrip().endswith(f"replace each 'open', then: wlr import {mcap} --out runs")
    assert [path.name for path in Path("runs").iterdir()] == ["map.yaml"]
    assert "# rad, deg, turn, count? topic" in Path("runs/map.yaml").read_text()


def test_a_map_that_is_there_is_not_overwritten(mcap, answered, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("map.yaml").write_text("every: 2  # mine\n")
    for words in ([], ["--map", "map.yaml"]):
        assert main(["import", str(mcap), "--suggest", *words]) == BAD_INPUT
        assert "map.yaml: is there already, and is another map: import with it" in capsys.readouterr().err
    assert Path("map.yaml").read_text() == "every: 2  # mine\n"
    Path("mine.yaml").write_text(map_text(answered | {"every": 2}))
    assert main(["import", str(mcap), "--map", "mine.yaml", "--out", "runs"]) == OK
    assert read_yaml("runs/map.yaml")["every"] == 2
    assert len(read_run("runs/run_01.parquet")["t"]) == pytest.approx(200, abs=10)


def test_a_map_in_the_folder_of_runs_stands(mcap, answered, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("runs").mkdir()
    kept = "# mine\n" + map_text(answered | {"every": 2})
    Path("runs/map.yaml").write_text(kept)
    assert main(["import", str(mcap), "--suggest", "--out", "runs"]) == BAD_INPUT
    assert "runs/map.yaml: is there already" in capsys.readouterr().err
    assert main(["import", str(mcap), "--out", "runs"]) == OK
    shutil.copy(mcap, "other.mcap")
    assert main(["import", "other.mcap", "--out", "runs"]) == OK
    assert Path("runs/map.yaml").read_text() == kept
    assert len(read_run("runs/run_02.parquet")["t"]) == pytest.approx(200, abs=10)


def test_exports_overwrite_nothing(tmp_path, capsys):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    runs = [write_run(tmp_path / name / "run_01.csv", rows_of(made_up(1.0))) for name in ("a", "b")]
    out = tmp_path / "bags"
    assert main(["export", *map(str, runs), "--to", "mcap", "--out", str(out)]) == BAD_INPUT
    assert f"both would be {out / 'run_01.mcap'}" in " ".join(capsys.readouterr().err.split())
    assert not out.exists()
    assert main(["export", str(runs[0]), "--to", "mcap", "--out", str(out)]) == OK
    first = (out / "run_01.mcap").read_bytes()
    assert main(["export", str(runs[1]), "--to", "mcap", "--out", str(out)]) == BAD_INPUT
    assert "run_01.mcap: exists; choose another name" in capsys.readouterr().err
    assert (out / "run_01.mcap").read_bytes() == first


def test_our_own_runs_come_back_whole(mcap, tmp_path, capsys):
    run = write_run(tmp_path / "run_01.csv", rows_of(made_up(1.0)))
    assert main(["export", str(run), "--to", "mcap"]) == OK
    own, out = str(tmp_path / "run_01.mcap"), ["--out", str(tmp_path / "back")]
    for words in (["--split", "3"], ["--robot", "nominal"]):
        assert main(["import", own, *words, *out]) == BAD_INPUT
        assert "takes neither split nor robot" in capsys.readouterr().err
    assert main(["import", own, str(mcap), *out]) == BAD_INPUT
    assert f"{mcap.name}: another program's log" in capsys.readouterr().err
    assert not (tmp_path / "back").exists()


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_what_no_map_helps_is_said_at_once(mcap, tmp_path, capsys, suffix):
    run = write_run(tmp_path / f"run_01{suffix}", rows_of(made_up(1.0)))
    (tmp_path / "cut.parquet").write_bytes(b"PAR1" + bytes(3000))
    (tmp_path / "cut.mcap").write_bytes(mcap.read_bytes()[:3000])
    for name in ("empty.csv", "empty.mcap"):
        (tmp_path / name).touch()
    for name, words in {
        run.name: "is a measured run already",
        "cut.parquet": "cannot be read as parquet",
        "cut.mcap": "cut off or broken near byte",
        "empty.csv": "empty file",
        "empty.mcap": "empty file",
    }.items():
        assert main(["import", str(tmp_path / name), "--out", str(tmp_path / "out")]) == BAD_INPUT
        assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_is_missing_is_said(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "200")
    messages = [one for one in lab_messages(made_up(6.0)) if one[1] not in ("/mocap/base", "/power")]
    monkeypatch.chdir(tmp_path)
    assert main(["import", str(write_mcap(tmp_path / "a.mcap", messages)), "--suggest"]) == OK
    assert "missing: cam, volt" in capsys.readouterr().out


def test_a_run_goes_out_and_comes_back_without_a_map(tmp_path, capsys):
    run = write_run(tmp_path / "runs" / "run_01.csv", rows_of(made_up(3.0)))
    assert main(["export", str(run.parent), "--to", "mcap", "--out", str(tmp_path / "bags")]) == OK
    assert main(["export", str(run), "--to", "rosbag2", "--out", str(tmp_path / "bags")]) == OK
    logs = [str(tmp_path / "bags" / name) for name in ("run_01.mcap", "run_01.bag2")]
    assert main(["import", *logs, "--out", str(tmp_path / "back")]) == OK
    runs = read_dataset(tmp_path / "back").runs
    first = read_run(run)
    assert len(runs) == 2
    for one in runs:
        assert all(abs(one[name] - first[name]).max() <= 1e-9 for name in ("t", "pos_leg_lf", "cmd_wheel_rr"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["import"], "expected logs to import"),
        (["import", "nothing.mcap", "--suggest"], "nothing.mcap: no such file or folder"),
        (["import", "LAB"], "--out: expected a folder"),
        (["import", "LAB", "--out", "runs"], "give --map, or --suggest"),
        (["export", "runs", "--to", "mcap", "--robot", "nominal"], "--robot: it is of policies; --to mcap writes runs"),
    ],
)
def test_bad_words(mcap, tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    assert main([str(mcap) if word == "LAB" else word for word in words]) == BAD_INPUT
    assert message in capsys.readouterr().err


def test_missing_packages_are_named_with_the_extra(mcap, monkeypatch, capsys, tmp_path):
    import importlib.util

    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "rosbags" else find(name, *rest))
    assert main(["import", str(mcap), "--suggest", "--out", str(tmp_path / "runs")]) == BAD_INPUT
    assert "pip install 'wlr-gym[logs]'" in capsys.readouterr().err
