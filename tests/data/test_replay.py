"""Replay: a run that this simulator made itself must come back; a run of another simulator must come close."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas
import pytest
import yaml

from wlr_gym import cli
from wlr_gym.base.errors import InputError
from wlr_gym.data import Profile, Run, RunMeta, read_run
from wlr_gym.data.format import CHANNELS
from wlr_gym.data.replay import ReplayResult, held_setpoints, profile_parameters, replay, save_plots
from wlr_gym.data.run_states import camera_pose, euler_angles, local_fit, quaternion, rest_pose
from wlr_gym.data.runs import note_robot, robot_of
from wlr_gym.data.sensors import channel_noise
from wlr_gym.physics.effects import apply_patch, load_patch
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, standing_state
from wlr_gym.physics.plants.sensors import rotation
from wlr_gym.robot import JOINTS, load_robot, robot_hash
from wlr_gym.robot.parameters import Parameters

DATA = Path(__file__).parent / "data"
TWIN = Path(__file__).parents[3] / "shared" / "data" / "twin_dev"
ROBOT = load_robot()
META = RunMeta(profile=Profile(wheel_acceleration=11.0, leg_velocity=1.5, leg_acceleration=15.0))
CLOCK = 0.002

DELAY = {"name": "command_delay", "where": list(JOINTS), "parameters": {"delay": 0.03}}
ZERO = {"name": "joint_zero_offset", "where": ["leg_lf"], "parameters": {"angle": 0.05}}
RESISTANCE = {"name": "rolling_resistance", "where": ["wheel_lf", "wheel_lr"], "parameters": {"coefficient": 0.1}}
CAMERA = {"name": "camera_delay", "parameters": {"delay": 0.06}}
MOUNT = {"name": "camera_misalignment", "parameters": {"yaw": 0.1, "scale": 1.08}}
TILTED_IMU = {"name": "imu_misalignment", "parameters": {"roll": 0.1, "pitch": -0.15, "yaw": 0.2}}
SPRING = {
    "name": "unknown_effect",
    "where": ["leg_lr"],
    "formula": "-k * (leg_angle - a0)",
    "parameters": {"k": 0.8, "a0": 0.5},
    "units": {"k": "N m/rad", "a0": "rad"},
}
PAYLOAD = {"name": "payload", "parameters": {"mass": 0.5, "x": 0.08, "z": 0.05}}


def commands(t: float) -> np.ndarray:
    """Drive, turn and change posture; rear wheels free for a while."""
    setpoints = np.zeros(8)
    moving = max(t - 0.6, 0.0)
    setpoints[:4] = 1.4 + 0.3 * np.sin(1.3 * moving) * np.array([1.0, 1.0, -1.0, -1.0])
    setpoints[4:] = 3.0 * np.sin(1.1 * moving) + np.array([-0.6, 0.6, -0.6, 0.6]) * np.sin(0.7 * moving)
    if 3.3 < t < 4.6:
        setpoints[6:] = np.nan
    return setpoints


def simulated_run(effects: Sequence[dict], steps: Sequence[int], meta: RunMeta = META, seconds: float = 5.0) -> Run:
    """Record a run on the exact sensors of the simulator, rows ``steps`` (repeated) plant ticks of 2 ms apart."""
    patch = load_patch(list(effects))
    parameters = apply_patch(patch, profile_parameters(Parameters.nominal(ROBOT), meta.profile))
    delay, parameters["camera.delay"] = float(parameters["camera.delay"][0]), 0.0
    plant = make_plant("gibbs_appell", ROBOT, 1, PlantOptions(control_period=CLOCK, sensor_noise=False), patch.forces)
    state = standing_state(ROBOT, parameters, 1.4)
    state.joint_position[:, :4] -= parameters["joint.zero_offset"]
    state.reference_position[:, :4] -= parameters["joint.zero_offset"]
    sensors = plant.reset(parameters=parameters, state=state)
    for _ in range(200):
        sensors = plant.step(commands(0.0)[None])
    wheels, start = sensors.joint_position[0, 4:].copy(), plant.truth().position[0].copy()
    rows, poses, tick = [], [(-1.0, 0.0, 0.0, 0.0)], 0
    while tick * CLOCK < seconds:
        goal = commands(tick * CLOCK)
        positions = sensors.joint_position[0] - np.append(np.zeros(4), wheels)
        joints = [positions, sensors.joint_velocity[0], sensors.joint_effort[0]]
        rows.append(
            np.concatenate([[tick * CLOCK], goal, *joints, sensors.gyro[0], sensors.accelerometer[0], sensors.supply_voltage])
        )
        for _ in range(steps[len(rows) % len(steps)]):
            truth = plant.truth()
            yaw = euler_angles(truth.quaternion)[0]
            marker = (
                truth.position[0] - start + rotation(yaw, *euler_angles(truth.quaternion)[1:])[0] @ np.array(meta.marker_offset)
            )
            poses.append((tick * CLOCK, marker[0], marker[1], yaw[0]))
            sensors = plant.step(np.nan_to_num(goal)[None], ~np.isnan(goal)[None])
            tick += 1
    plant.close()
    names = ["t", *(f"cmd_{joint}" for joint in JOINTS), *(name for name in CHANNELS if not name.startswith("cam"))]
    table = pandas.DataFrame(np.array(rows), columns=names)
    pose = np.array(poses)
    x, y, yaw = (np.asarray(np.interp(table["t"] - delay, pose[:, 0], pose[:, k])) for k in (1, 2, 3))
    mount, scale = float(parameters["camera.mount_yaw"][0]), float(parameters["camera.scale"][0])
    table["cam_x"], table["cam_y"] = scale * _turned(x, y, -mount)
    table["cam_yaw"] = yaw
    table.loc[::2, ["cam_x", "cam_y", "cam_yaw"]] = np.nan
    return Run(table, meta, Path("run_01.parquet"))


def _turned(x: np.ndarray, y: np.ndarray, angle: float) -> np.ndarray:
    return np.array([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y])


def worst(result: ReplayResult, kind: str, *, segments: bool = True) -> float:
    """Largest error of a kind of channel in units of sensor noise."""
    errors = [error for name, error in result.errors.items() if name.startswith(kind)]
    return max((error.segment_rms if segments else error.full_run_rms) / error.noise for error in errors)


# --- a run of this very simulator -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("effects", "steps"),
    [
        ([], [10]),
        ([], [9, 10, 11, 10, 20]),  # jitter and lost control steps
        ([DELAY], [10]),
        ([ZERO, RESISTANCE, PAYLOAD], [10]),
        ([CAMERA, MOUNT], [10]),
        ([TILTED_IMU], [10]),
    ],
    ids=["plain", "jitter", "delay", "effects", "camera", "imu"],
)
def test_own_run_comes_back(effects, steps):
    result = replay(simulated_run(effects, steps), effects=effects)
    assert set(result.errors) == {name for name in CHANNELS if name not in ("cam_z", "cam_pitch")}
    for kind in ("pos", "vel", "eff", "gyro", "acc", "cam", "volt"):
        assert worst(result, kind, segments=False) < 1.0, kind
        assert worst(result, kind) < 0.5, kind


def test_own_run_with_the_marker_off_the_centre_comes_back():
    run = simulated_run([], [10], META.model_copy(update={"marker_offset": (0.1, 0.05, 0.08)}))
    result = replay(run)
    assert worst(result, "cam", segments=False) < 1.0
    assert worst(result, "cam") < 1.0
    without = Run(run.table, META, run.path)
    assert worst(replay(without), "cam") > 2.0


@pytest.mark.parametrize(
    ("effect", "channel"),
    [
        (DELAY, "pos_wheel"),
        (RESISTANCE, "eff_wheel_lf"),
        (PAYLOAD, "eff_leg"),
        (CAMERA, "cam_x"),
        (MOUNT, "cam_y"),
        (TILTED_IMU, "acc_x"),
        (SPRING, "eff_leg_lr"),
        (ZERO, "eff_leg"),
    ],
)
def test_the_missing_effect_shows_and_its_patch_removes_it(effect, channel):
    run = simulated_run([effect], [10])
    assert worst(replay(run), channel) > 3 * worst(replay(run, effects=[effect]), channel)


def test_drift_does_not_swamp_the_segments():
    effect = {"name": "wheel_radius_error", "where": ["wheel_lf", "wheel_lr"], "parameters": {"scale": 1.05}}
    result = replay(simulated_run([effect], [10], seconds=8.0))
    error = result.errors["cam_y"]
    assert error.full_run_rms > 4 * error.segment_rms


def test_replay_is_reproducible_and_does_not_touch_the_run():
    run = simulated_run([], [10], seconds=2.0)
    before = run.table.copy()
    first, second = replay(run), replay(run)
    assert first.errors == second.errors
    pandas.testing.assert_frame_equal(run.table, before)


def test_only_required_columns_are_enough(tmp_path):
    run = simulated_run([], [10])
    names = [name for name in run.table if name == "t" or name.startswith(("cmd", "pos"))]
    result = replay(Run(run.table.loc[:, names], META, run.path))
    assert {name[:3] for name in result.errors} == {"pos"}
    assert worst(result, "pos") < 0.5
    assert [path.name for path in save_plots(result, tmp_path)] == [f"{run.path.stem}_joints.png"]


# --- a run of another simulator of the same robot ---------------------------------------------------------------------


def test_measured_run_is_within_the_robots_tolerances():
    result = replay(read_run(DATA / "run_01.parquet"))
    bounds = {"pos_leg": 12, "vel_leg": 4, "eff_leg": 20, "pos_wheel": 150, "vel_wheel": 20, "eff_wheel": 10}
    for kind, bound in {**bounds, "gyro": 10, "acc": 8, "cam": 2.5}.items():
        assert worst(result, kind) < bound, kind


@pytest.mark.slow
@pytest.mark.skipif(not TWIN.is_dir(), reason="the measured data are not beside the repository")
@pytest.mark.parametrize(
    ("name", "run", "channel", "shrinks_to"),
    [
        ("command_delay", "run_01", "vel_wheel", 0.5),
        ("rolling_resistance", "run_07", "eff_wheel", 0.5),
        ("payload", "run_08", "cam_x", 0.5),
        ("friction_asymmetry", "run_03", "cam_x", 0.5),
        ("combo_hip_friction_and_wheel_radius", "run_02", "pos_leg_rf", 0.5),
    ],
)
def test_labelled_effect_as_a_patch_shrinks_the_error(name, run, channel, shrinks_to):
    label = yaml.safe_load((TWIN / "labels.yaml").read_text())[name]
    measured = read_run(TWIN / name / f"{run}.parquet")
    before, after = worst(replay(measured), channel), worst(replay(measured, effects=label["effects"]), channel)
    assert after < shrinks_to * before


# --- refusals ---------------------------------------------------------------------------------------------------------


def test_bad_arguments_are_refused(tmp_path):
    run = read_run(DATA / "run_01.parquet")
    with pytest.raises(InputError, match=r"'gibbs_apell'.*did you mean 'gibbs_appell'"):
        replay(run, backend="gibbs_apell")
    with pytest.raises(InputError, match=r"segment = 0\.05: expected more than 0\.1 s"):
        replay(run, segment=0.05)
    with pytest.raises(InputError, match="too short"):
        replay(run, segment=20.0)
    with pytest.raises(InputError, match="unknown effect 'payloud'"):
        replay(run, effects=[{"name": "payloud"}])


def test_the_robot_is_the_one_the_meta_data_name(tmp_path):
    def with_robot(name: str | None) -> Run:
        return Run(pandas.DataFrame(), RunMeta(robot=name), tmp_path / "run_01.csv")

    heavy = ROBOT.model_dump(mode="json") | {"name": "heavy"}
    (tmp_path / "heavy.yaml").write_text(yaml.safe_dump(heavy))
    assert [robot_of(with_robot(name)).name for name in (None, "nominal", "wlr-nominal")] == ["wlr-nominal"] * 3
    assert robot_of(with_robot("heavy.yaml")).name == "heavy"
    assert robot_of(with_robot("heavy.yaml"), "nominal").name == "wlr-nominal"
    with pytest.raises(InputError, match=r"meta\.yaml: unknown robot 'wlr-nominall' \(did you mean 'wlr-nominal'"):
        robot_of(with_robot("wlr-nominall"))


def test_a_robot_of_ones_own_travels_beside_its_runs(tmp_path):
    heavy = load_robot(ROBOT.model_dump(mode="json") | {"name": "heavy", "gravity": 5.0})
    meta = note_robot(tmp_path / "here", heavy, RunMeta(ground="mat"))
    assert (meta.robot, meta.robot_hash, meta.ground) == ("robot.yaml", robot_hash(heavy), "mat")
    shutil.move(tmp_path / "here", tmp_path / "there")
    run = Run(pandas.DataFrame(), meta, tmp_path / "there" / "run_01.csv")
    assert robot_of(run) == heavy
    file = tmp_path / "there" / "robot.yaml"
    file.write_text(file.read_text().replace("gravity: 5.0", "gravity: 6.0"))
    with pytest.raises(InputError, match=r"robot\.yaml: its fingerprint is .*, meta\.yaml says .*--robot"):
        robot_of(run)
    with pytest.raises(InputError, match="holds another robot than 'heavy'"):
        note_robot(tmp_path / "there", heavy, RunMeta())
    assert note_robot(tmp_path / "runs", ROBOT, RunMeta()) == RunMeta(robot="wlr-nominal")  # one that ships is named
    assert not (tmp_path / "runs").exists()


def test_legs_that_were_off_do_not_jump_when_torque_is_back():
    run = simulated_run([DELAY], [10], seconds=3.0)
    off = (run["t"] > 1.0) & (run["t"] < 1.3)
    run.table.loc[off, [f"cmd_{joint}" for joint in JOINTS[:4]]] = np.nan
    held = held_setpoints(run)
    assert np.isfinite(held).all()
    assert (held[off, :4] > 1.0).all()  # not 0
    result = replay(run, effects=[DELAY])
    assert min(result.full[f"pos_{joint}"][run["t"] < 1.32].min() for joint in JOINTS[:4]) > 0.2
    back = (run["t"] > 1.3) & (run["t"] < 1.4)
    assert min(np.diff(result.full[f"pos_{joint}"][back]).min() for joint in JOINTS[:4]) > -0.03


def test_a_joint_without_goals_stays():
    run = simulated_run([], [10], seconds=1.0)
    run.table.loc[:, ["cmd_leg_lf", "cmd_wheel_lf"]] = np.nan
    run.table.loc[:5, "cmd_leg_rf"] = np.nan
    held = held_setpoints(run)
    assert (held[:, JOINTS.index("leg_lf")] == run["pos_leg_lf"][0]).all()
    assert (held[:, JOINTS.index("wheel_lf")] == 0.0).all()
    assert (held[:6, JOINTS.index("leg_rf")] == run["cmd_leg_rf"][6]).all()


# --- building blocks --------------------------------------------------------------------------------------------------


def test_local_fit_is_exact_for_parabolas_skips_missing_samples_and_bridges_gaps():
    t = np.sort(np.random.default_rng(1).uniform(0, 1, 200))
    values = 1 + 2 * t - 3 * t**2
    values[::3] = np.nan
    at = np.array([0.0, 0.5, 1.0])
    value, slope = local_fit(t, values, at, 0.1)
    np.testing.assert_allclose(value, 1 + 2 * at - 3 * at**2, atol=1e-9)
    np.testing.assert_allclose(slope, 2 - 6 * at, atol=1e-6)
    t = np.array([0.0, 0.02, 1.0, 1.02, 1.04])  # a gap
    value, slope = local_fit(t, 2 * t, np.array([0.5]), 0.05)
    np.testing.assert_allclose([value[0], slope[0]], [1.0, 2.0], atol=1e-6)


def test_rest_pose_puts_four_wheels_on_the_floor():
    parameters = Parameters.nominal(ROBOT, 2)
    legs = np.array([[1.2, 1.2, 1.2, 1.2], [0.6, 0.6, 2.2, 2.2]])
    height, pitch, roll = rest_pose(parameters, legs).T
    assert height[0] == pytest.approx(0.135 * np.sin(1.2) + 0.034)
    np.testing.assert_allclose([pitch[0], *roll], 0, atol=1e-12)
    hips = np.array([[0.175, 0.16, 0], [0.175, -0.16, 0], [-0.175, 0.16, 0], [-0.175, -0.16, 0]])
    axles = hips + 0.135 * np.stack([np.cos(legs[1]), 0 * legs[1], -np.sin(legs[1])], axis=1)
    up = (rotation(np.zeros(1), pitch[1:], roll[1:])[0] @ axles.T)[2] + height[1]
    np.testing.assert_allclose(up, 0.034, atol=1e-12)
    assert pitch[1] > 0.01  # shorter in front: nose down


def test_angles_quaternions_and_matrices_agree():
    angles = np.random.default_rng(2).uniform(-1.4, 1.4, (3, 50))
    q = quaternion(*angles)
    np.testing.assert_allclose(euler_angles(q), angles, atol=1e-12)
    w, x, y, z = q.T
    third_row = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    np.testing.assert_allclose(rotation(*angles)[:, 2], third_row, atol=1e-12)


# --- command line -----------------------------------------------------------------------------------------------------


def test_command_writes_errors_plots_and_provenance(tmp_path, capsys):
    patch = tmp_path / "patch.yaml"
    patch.write_text("effects: [{name: payload, parameters: {mass: 0.1}}]")
    out = tmp_path / "out"
    assert cli.main(["replay", str(DATA), "--effects", str(patch), "--out", str(out)]) == 0
    errors = json.loads((out / "errors.json").read_text())
    assert list(errors) == ["run_01"]
    assert set(errors["run_01"]) == set(CHANNELS)
    entry = errors["run_01"]["vel_leg_lf"]
    assert set(entry) == {
        "segment_rms", "full_run_rms", "unit", "noise", "segment_in_noise_units", "full_run_in_noise_units",
    }  # fmt: skip
    assert entry["unit"] == "rad/s"
    assert entry["segment_in_noise_units"] == pytest.approx(entry["segment_rms"] / entry["noise"])
    assert {path.name for path in out.iterdir()} == {
        "errors.json", "run_01_joints.png", "run_01_body.png", "config.yaml", "provenance.yaml",
    }  # fmt: skip
    config = yaml.safe_load((out / "config.yaml").read_text())
    assert config["effects"][0]["name"] == "payload"
    assert config["robot"] == "wlr-nominal"
    printed = capsys.readouterr().out
    for word in ("pos_leg", "rad/s", "effects added: payload", "gap"):
        assert word in printed


def test_command_takes_one_run(tmp_path):
    assert cli.main(["replay", str(DATA / "run_01.parquet"), "--out", str(tmp_path), "--no-plots"]) == 0
    assert not list(tmp_path.glob("*.png"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere"], ["nowhere", "no such file"]),
        ([str(DATA), "--effects", "nowhere.yaml"], ["nowhere.yaml"]),
        ([str(DATA), "--backend", "mojoco"], ["mojoco"]),
        ([str(DATA), "--robot", "nominall"], ["nominall", "nominal"]),
        ([str(DATA), "--segment", "0.05"], ["--segment 0.05"]),
        ([str(DATA), "--segment", "20"], ["too short"]),
    ],
)
def test_a_refused_replay_says_why_and_leaves_no_folder(tmp_path, capsys, arguments, words):
    assert cli.main(["replay", *arguments, "--out", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err.replace("\n", " ")
    for word in words:
        assert word in message
    assert not (tmp_path / "out").exists()


def test_noise_is_that_of_the_robot_file_with_quantisation():
    noise = channel_noise(ROBOT)
    assert set(noise) == set(CHANNELS)
    assert noise["pos_leg_lf"] == pytest.approx(2 * np.pi / 4096 / np.sqrt(12))
    assert noise["vel_wheel_rr"] == pytest.approx(0.229 * 2 * np.pi / 60 / np.sqrt(12))
    assert noise["eff_leg_lf"] == pytest.approx(np.hypot(0.010, 2.69e-3 * 12 / 5.55 / np.sqrt(12)))  # XM540: 2.69 mA per count
    assert noise["eff_wheel_lf"] == pytest.approx(np.hypot(0.005, 1e-3 * 1.5 / np.sqrt(12)))  # XL430: 0.1 % of stall torque
    assert noise["volt"] == pytest.approx(np.hypot(0.03, 0.1 / np.sqrt(12)))
    assert (noise["gyro_x"], noise["acc_z"], noise["cam_x"], noise["cam_yaw"]) == (0.0009, 0.03, 0.001, 0.005)


def test_a_robot_that_the_camera_found_again_is_where_it_saw_it():
    """Positions are no angles: 4.2 m without a frame, more than 3.14, are no jump to undo; headings are."""
    t = np.arange(0.0, 16.0, 0.02)
    seen = {"cam_x": 0.35 * t, "cam_y": -0.35 * t, "cam_yaw": np.where(t < 8.0, 3.1, 3.1 - 2.0 * np.pi)}
    table = pandas.DataFrame({"t": t, **seen})
    table.loc[(t > 3.0) & (t < 15.0), list(seen)] = np.nan
    x, y, yaw = camera_pose(Run(table, RunMeta(), Path("run_01.parquet")))
    np.testing.assert_array_equal(x, table["cam_x"])
    np.testing.assert_array_equal(y, table["cam_y"])
    np.testing.assert_allclose(yaw[np.isfinite(yaw)], 3.1)
