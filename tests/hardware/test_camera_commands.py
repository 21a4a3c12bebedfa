"""``--camera`` of ``wlr deploy``, ``record`` and ``doctor``, in emulated time; and the whole chain beside the simulator."""

import json

import numpy as np
import pytest
import yaml

pytest.importorskip("cv2")
pytest.importorskip("dynamixel_sdk")
pytest.importorskip("onnxruntime")

from camera_rig import small_camera
from policy_log import act_again

from studies.bench.camera_chain import ChainSetting, chain_errors, drive_chain, simulated_errors
from wlr_gym.base.errors import InputError
from wlr_gym.cli import OK, run_command
from wlr_gym.cli.doctor import check_policy
from wlr_gym.data.runs import read_run
from wlr_gym.hardware.log import read_events
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.policy import environment_for, make_policy

POLICY = "velocity_slip_aware"


@pytest.fixture(scope="module")
def camera_file(tmp_path_factory):
    """The small camera as a file of a user's."""
    path = tmp_path_factory.mktemp("camera") / "mine.yaml"
    path.write_text(yaml.safe_dump(small_camera().model_dump(mode="json")), encoding="utf-8")
    return path


def test_an_emulated_camera_is_for_an_emulated_robot():
    with pytest.raises(InputError, match="--camera emulated: it films an emulated robot by rendering"):
        run_command("deploy", ["pid", "--camera", "emulated"])
    with pytest.raises(InputError, match=r"no file 'nowhere\.yaml'"):
        run_command("doctor", ["--emulated", "--camera", "nowhere.yaml"])


def test_a_camera_is_no_part_of_a_simulator(tmp_path):
    words = ["--backend", "mujoco", "--camera", "emulated", "--excitation", "straight", "--out", str(tmp_path)]
    with pytest.raises(InputError, match="--camera: it is about the robot: leave --backend mujoco out"):
        run_command("record", words)


@pytest.mark.parametrize(("policy", "is_told"), [("slip_compensating", True), ("velocity_slip_aware", False)])
def test_who_needs_a_camera_is_told_without_one(tmp_path, policy, is_told, capsys):
    """Not a policy that learnt to drive without, too."""
    words = [policy, "--emulated", "--stepped", "--seconds", "0.2", "--out", str(tmp_path)]
    assert run_command("deploy", words) == OK
    assert ("expect worse tracking" in " ".join(capsys.readouterr().out.split())) == is_told


def test_the_doctor_says_what_a_policy_loses_without_a_camera():
    (found,) = [check for check in check_policy("posture_slip_aware", "nominal") if check.what == "camera"]
    assert (found.ok, found.is_fatal, found.expected) == (False, False, "one, as in 70% of its training")
    assert "expect worse tracking" in found.remedy
    (half,) = [check for check in check_policy("velocity_slip_aware", "nominal") if check.what == "camera"]
    assert half.ok
    assert not [check for check in check_policy("posture_slip_aware", "nominal", has_camera=True) if check.what == "camera"]


@pytest.mark.slow
def test_a_drive_with_the_camera_is_seen_again_from_its_log(tmp_path, camera_file, capsys):
    words = [POLICY, "--emulated", "--stepped", "--seconds", "1", "--camera", str(camera_file), "--out", str(tmp_path)]
    assert run_command("deploy", words) == OK
    told = " ".join(capsys.readouterr().out.split())
    assert "expect worse tracking" not in told
    assert "camera: " in told
    run = tmp_path / "run_01.csv"
    assert np.isfinite(read_run(run)["cam_x"]).sum() > 20
    assert read_events(run)[-1]["statistics"]["camera"]["poses"] > 20
    robot = {"backend": "dynamixel", "hardware": {"emulated": True, "camera": str(camera_file)}, "episode_length": 1.0}
    core = make_core("WLR-Velocity-v0", 1, environment_for(POLICY, robot))
    given, answered = act_again(core, make_policy(POLICY, core.contract()), run)
    core.close()
    np.testing.assert_array_equal(answered, given)


@pytest.mark.slow
def test_the_doctor_looks_at_the_camera(capsys, camera_file):
    words = [POLICY, "--emulated", "--camera", str(camera_file), "--json"]
    assert run_command("doctor", words) == OK
    checks = [check for check in json.loads(capsys.readouterr().out) if check["where"].startswith("camera")]
    assert [check["what"] for check in checks] == ["frames", "rate", "age", "shutter", "floor", "robot", "accuracy"]
    assert all(check["ok"] for check in checks)


@pytest.mark.slow
def test_a_recorded_run_has_the_camera(tmp_path, camera_file):
    words = ["--emulated", "--camera", str(camera_file), "--excitation", "straight", "--seconds", "1", "--out", str(tmp_path)]
    assert run_command("record", words) == OK
    run = read_run(tmp_path / "run_01.csv")
    assert np.isfinite(run["cam_yaw"]).sum() > 20
    assert run["cam_age"].max() < 0.15


@pytest.mark.slow
def test_the_chain_tracks_as_the_simulator_does():
    """Six episodes on ice: of one, most is how it starts, and the two start differently. docs/camera.md has more."""
    file, seeds = small_camera(latency=0.04, dropout=0.1), range(9000, 9006)
    setting = ChainSetting(POLICY, "ice", file, 4.0)
    assert chain_errors(setting, seeds).mean() < 1.2 * simulated_errors(setting, seeds).mean()


@pytest.mark.slow
def test_with_the_lens_covered_the_drive_goes_on():
    drive = drive_chain(ChainSetting(POLICY, "ice", small_camera(), 2.5, ("camera_covered after=1",)), 9000)
    assert drive.reason == "time is over"
    assert drive.reasons[-1] == "the picture is dark or blank: lens covered?"
    assert drive.sensed("camera_age")[-1] == pytest.approx(1.55, abs=0.1)
