"""The robot of imported, converted and exported runs: whichever way it was named, the runs have it wherever they go."""

import numpy as np
import pytest
import yaml
from foreign_logs import lab_frame, lab_map, made_up, rows_of

from wlr_gym.base.errors import InputError
from wlr_gym.cli import main
from wlr_gym.data import convert, read_run, write_run
from wlr_gym.data.format import RunMeta
from wlr_gym.data.logs import export_run, import_log
from wlr_gym.data.logs.map import content, map_text
from wlr_gym.data.runs import robot_of
from wlr_gym.robot import load_robot, robot_content


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """Stand in a folder with a log, and below it maps and a robot of the laboratory."""
    monkeypatch.chdir(tmp_path)
    lab_frame(made_up(4.0)).drop(columns="comment").to_csv("log.csv", index=False)
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "robot.lab.yaml").write_text(yaml.safe_dump(robot_content("nominal") | {"name": "lab", "gravity": 9.0}))
    known = content(lab_map("log.csv"))
    (tmp_path / "lab" / "map.yaml").write_text(map_text(known))
    (tmp_path / "lab" / "named.yaml").write_text(map_text(known) + "meta: {robot: robot.lab.yaml, profile: {}}\n")
    return load_robot("lab/robot.lab.yaml")


@pytest.mark.parametrize("said", [["--map", "lab/map.yaml", "--robot", "lab/robot.lab.yaml"], ["--map", "lab/named.yaml"],
    ["--map", "lab/named.yaml", "--suggest"]])  # fmt: skip
def test_a_robot_file_goes_with_the_runs(lab, tmp_path, said):
    assert main(["import", "log.csv", *said, "--out", "runs"]) == 0
    (tmp_path / "runs").rename(tmp_path / "elsewhere")
    assert robot_of(read_run("elsewhere/run_01.parquet")) == lab
    assert "lab/" not in (tmp_path / "elsewhere" / "map.yaml").read_text()


def test_more_logs_come_to_the_runs_of_a_robot_file(lab, tmp_path):
    import_log("log.csv", "runs", "lab/named.yaml")
    for k, known in enumerate((None, "lab/named.yaml")):
        (tmp_path / f"more{k}.csv").write_bytes((tmp_path / "log.csv").read_bytes())
        (imported,) = import_log(f"more{k}.csv", "runs", known)
        assert robot_of(read_run(imported.path)) == lab


def test_two_robots_of_one_import_are_refused(lab, tmp_path):
    with pytest.raises(
        InputError, match=r"^map: meta.robot = lab/robot.lab.yaml: 'lab' .*--robot nominal: 'wlr-nominal' .*one robot"
    ):
        import_log("log.csv", "runs", "lab/named.yaml", robot="nominal")
    strong = robot_content(lab)
    strong["servo"]["leg"]["stall_current"], strong["servo"]["leg"]["no_load_current"] = (
        9.0,
        0.1,
    )  # not in the fingerprint, and in every torque that was a current
    (tmp_path / "strong.yaml").write_text(yaml.safe_dump(strong))
    with pytest.raises(InputError, match="expected one robot"):
        import_log("log.csv", "runs", "lab/named.yaml", robot="strong.yaml")
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("name", ["wlr-nominal", "nominal"])
def test_a_map_names_a_robot_as_meta_yaml_does(lab, name):
    known = content(lab_map("log.csv", {"meta": {"robot": name}}))
    (imported,) = import_log("log.csv", "runs", known, robot="nominal")
    assert read_run(imported.path).meta.robot == "wlr-nominal"
    with pytest.raises(InputError, match=r"^map: unknown robot 'nobody'"):
        import_log("log.csv", "more", known | {"meta": {"robot": "nobody"}})


def test_a_robot_file_without_a_fingerprint_is_not_lost(lab):
    path = write_run("lab/run_01.csv", rows_of(made_up(3.0)), RunMeta(robot="robot.lab.yaml"))
    convert(path, "other/run_01.parquet")
    convert(path, "lab/run_01.parquet")
    (imported,) = import_log(export_run(read_run(path), path.with_name("a.mcap")), "back")
    for run in ("other/run_01.parquet", "lab/run_01.parquet", imported.path):
        assert robot_of(read_run(run)) == lab
        assert np.isfinite(read_run(run)["pos_leg_lf"]).all()
