"""``--floor``: runs are driven on it and say so, replays take the run's, results have its content, bad ones are refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from wlr_gym import cli
from wlr_gym.base.errors import InputError
from wlr_gym.cli import main
from wlr_gym.cli.deploy import DeployOptions, robot_options
from wlr_gym.cli.emulate import EmulateOptions, machine_of
from wlr_gym.cli.options import FloorOption
from wlr_gym.data import read_run
from wlr_gym.data.comparison import compare, parse_plant
from wlr_gym.data.excitations import Motion
from wlr_gym.data.format import META_FILE, RunMeta
from wlr_gym.data.record import record_simulation
from wlr_gym.data.replay import replay
from wlr_gym.data.runs import floor_of, write_meta
from wlr_gym.data.watch import RunRecording
from wlr_gym.hardware.plant import RobotPlant
from wlr_gym.learning.adaptation.driving import EmulatedRobot
from wlr_gym.learning.training import settings_of
from wlr_gym.physics.floor import load_floor
from wlr_gym.physics.plants.base import RobotOptions
from wlr_gym.robot import load_robot

ROBOT = load_robot()
#: Commands that simulate robots, or drive emulated ones.
SIMULATING = ["adapt", "compare", "deploy", "emulate", "evaluate", "play", "record", "replay", "sweep", "train", "view"]
#: A robot that drives straight on goes up within the first second.
STEP: dict[str, Any] = {
    "name": "step",
    "pieces": [{"kind": "kerb", "at": [0.28, 0.0], "height": 0.01}],
    "randomise": {"pieces.0.height": [0.005, 0.015]},
}
#: Legs at home, wheels straight on.
STRAIGHT = Motion("straight", np.tile(np.repeat([np.pi / 2, 4.0], 4), (100, 1)), 0.02)


@pytest.fixture(scope="module")
def step(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("floors") / "step.yaml"
    path.write_text(yaml.safe_dump(STEP))
    return path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """A run on the kerb as seed 3 draws it."""
    path = tmp_path_factory.mktemp("runs") / "run_01.parquet"
    return record_simulation(path, STRAIGHT, ROBOT, "gibbs_appell", meta=RunMeta(floor=load_floor(STEP).drawn(3).content()))


def kerb(content: Any) -> float:
    return float(content["pieces"][0]["height"])


def test_every_command_that_simulates_takes_it():
    kinds = {name: cli.options_of(name) for name in cli.COMMANDS}
    kinds = {name: kind.get("", None) if isinstance(kind, dict) else kind for name, kind in kinds.items()}
    taking = {name for name, kind in kinds.items() if kind is not None and issubclass(kind, FloorOption)}
    assert taking == set(SIMULATING)


@pytest.mark.parametrize(
    "command",
    ["compare --out {out}", "deploy pid --emulated", "emulate", "evaluate pid --out {out}", "play",
     "record --backend mujoco --excitation straight --out {out}", "sweep WLR-Velocity-v0 --out {out}", "train --out {out}",
     "robot export nominal --out {out}.xml"],
)  # fmt: skip
def test_an_unknown_floor_is_refused_before_any_work(command, tmp_path, capsys):
    words = command.format(out=tmp_path / "out").split()
    assert main([*words, "--floor", "kerb"]) == 2
    assert "unknown floor config 'kerb' (did you mean 'kerbs'?)" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


# ---- runs ------------------------------------------------------------------------------------------------------------


def test_a_recorded_run_says_its_floor(step, tmp_path, capsys):
    words = ["record", "--backend", "gibbs_appell", "--excitation", "straight", "--seconds", "0.4", "--seed", "3"]
    assert main([*words, "--floor", str(step), "--out", str(tmp_path / "runs")]) == 0
    meta = yaml.safe_load((tmp_path / "runs" / META_FILE).read_text())
    assert meta["floor"] == load_floor(STEP).drawn(3).content()
    capsys.readouterr()


def test_a_replay_takes_the_runs_floor(recorded):
    run = read_run(recorded)
    assert kerb(floor_of(run).content()) == kerb(load_floor(STEP).drawn(3).content())
    own, flat = replay(run), replay(run, floor="flat")
    for channel in ("gyro_y", "pos_wheel_lf", "eff_leg_lf"):
        assert own.errors[channel].full_run_rms < 0.5 * flat.errors[channel].full_run_rms, channel
        assert own.errors[channel].segment_rms < 0.5 * flat.errors[channel].segment_rms, channel


def test_the_ghost_of_a_run_is_on_its_floor(recorded):
    run = read_run(recorded)
    on_floor, flat = (RunRecording(run, backend=None, floor=floor) for floor in (None, "flat"))
    for one in (on_floor, flat):
        one.wait()
    assert kerb(floor_of(run).content()) == float(on_floor.at(0.0).parameters["piece.height"][0, 0])
    assert not flat._model["piece.height"].any()


def test_replay_writes_the_floor_into_its_provenance(recorded, tmp_path, capsys):
    assert main(["replay", str(recorded), "--out", str(tmp_path / "out"), "--no-plots"]) == 0
    config = yaml.safe_load((tmp_path / "out" / "config.yaml").read_text())
    assert config["floor"] == load_floor(STEP).drawn(3).content()
    capsys.readouterr()


def test_old_and_hand_written_meta_data(tmp_path, recorded):
    assert RunMeta().floor is None
    assert "floor" not in RunMeta(ground="tiles").content()
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(STEP))
    for noted, name in ((None, "flat"), ("kerbs", "kerbs"), ("mine.yaml", "step"), (STEP, "step")):
        folder = tmp_path / str(name) / str(noted is STEP)
        if noted == "mine.yaml":
            folder = tmp_path
        folder.mkdir(exist_ok=True, parents=True)
        (folder / recorded.name).write_bytes(recorded.read_bytes())
        write_meta(folder, RunMeta(floor=noted))
        run = read_run(folder / recorded.name)
        assert floor_of(run, robot=ROBOT).name == name
        (folder / META_FILE).unlink()
    (tmp_path / META_FILE).write_text("floor: {pieces: [{kind: kerb, at: [0.5, 0], height: 0.1, hight: 0.1}]}")
    with pytest.raises(InputError, match=r"meta.yaml: floor: unknown key 'pieces.0.hight'"):
        floor_of(read_run(tmp_path / recorded.name))


# ---- robots that are emulated ----------------------------------------------------------------------------------------


def test_an_emulated_robot_stands_on_it(step):
    machine = machine_of(EmulateOptions(floor=str(step), seed=3))
    height = float(machine.plant.parameters["piece.height"][0, 0])
    machine.close()
    assert height == kerb(load_floor(STEP).drawn(3).content())


def test_on_a_stand_there_is_no_floor(step):
    with pytest.raises(InputError, match="--floor: on a stand"):
        machine_of(EmulateOptions(floor=str(step), stand=True))


def test_logs_of_an_emulated_robot_say_its_floor(tmp_path):
    options = RobotOptions(emulated=True, floor=STEP, seed=3, log=tmp_path)
    plant = RobotPlant(ROBOT, 1, hardware=options)
    assert plant.loop.recorder.meta.floor == load_floor(STEP).drawn(3).content()
    plant.close()
    assert robot_options(DeployOptions("pid", floor="kerbs", emulated=True, seed=3), None).floor == load_floor("kerbs").drawn(3)


def test_a_robot_that_is_adapted_to_stands_on_it():
    floor = load_floor(STEP).drawn(3)
    driven, plant = EmulatedRobot(ROBOT, floor=floor).start(None, seed=5)
    assert driven.loop.recorder.meta.floor == floor.content()
    assert float(plant.parameters["piece.height"][0, 0]) == kerb(floor.content())
    driven.close()


def test_the_floor_under_a_real_robot_is_not_drawn():
    with pytest.raises(InputError, match="randomise: the floor under a real robot is one"):
        RobotPlant(ROBOT, 1, hardware=RobotOptions(floor=STEP))


# ---- comparison, training, export ------------------------------------------------------------------------------------


def test_both_plants_are_compared_on_it():
    plants = parse_plant("gibbs_appell"), parse_plant("mujoco")
    found = compare([STRAIGHT], plants, floor={**STEP, "randomise": {}})
    height = found.first.signals["true_z"][:, 0, 0]
    assert height.max() - height[0] == pytest.approx(0.005, abs=5e-4)  # half of it: the front wheels are up
    assert np.abs(found.second.signals["true_z"] - found.first.signals["true_z"]).max() < 1e-4


def test_a_training_has_it_by_content(step):
    settings = {"environment": {"floor": str(step)}}
    assert settings_of("WLR-Velocity-v0", None, "ppo", None, settings=settings)["environment"]["floor"] == STEP


def test_export_writes_the_pieces(step, tmp_path, capsys):
    mujoco: Any = pytest.importorskip("mujoco")
    assert main(["robot", "export", "nominal", "--floor", "ramps", "--out", str(tmp_path / "ramps.xml"), "--json"]) == 0
    assert "edge radii of pieces" in json.loads(capsys.readouterr().out)["not_held"]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "ramps.xml"))
    assert model.npair == 3 * 9  # the floor and two ramps, each with four wheels, four legs and the body
    assert model.mesh_vertnum.tolist() == [8, 8]
    assert main(["robot", "export", "nominal", "--floor", str(step), "--out", str(tmp_path / "step.xml")]) == 0
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "step.xml"))
    piece = model.geom("piece_1")
    assert piece.type == mujoco.mjtGeom.mjGEOM_BOX
    height = kerb(load_floor(STEP).drawn().content())
    np.testing.assert_allclose([piece.pos[2], piece.size[2]], height / 2, rtol=1e-5)
    assert piece.pos[0] - piece.size[0] == pytest.approx(0.28)
    capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--floor", "rough", "--out", "x.xml"], "MJCF has no waves, bumps or grids"),
        (["--floor", "kerbs", "--out", "x.urdf"], "URDF holds a robot, no floor"),
    ],
)
def test_what_cannot_be_exported(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["robot", "export", "nominal", *words]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_floors_are_listed(capsys):
    assert main(["robot", "floors", "--json"]) == 0
    assert [floor["name"] for floor in json.loads(capsys.readouterr().out)] == [
        "flat", "gravel", "kerbs", "ramps", "rough", "stairs",
    ]  # fmt: skip
