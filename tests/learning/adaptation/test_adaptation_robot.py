"""Episodes on an emulated robot, scored by the true motion; and the whole loop of docs/adapt.md at a tiny size."""

import json
from typing import ClassVar

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("dynamixel_sdk")
pytest.importorskip("onnxruntime")

from wlr_gym.cli import OK, run_command
from wlr_gym.hardware.deployment import Deployment
from wlr_gym.hardware.emulator.machine import Machine
from wlr_gym.learning.adaptation import driving
from wlr_gym.learning.adaptation.driving import EmulatedRobot, RealRobot, drive_episode, paired
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.physics.effects import load_patch
from wlr_gym.robot import load_robot

POLICY, ENVIRONMENT = "velocity_slip_aware", "WLR-Velocity-v0"


class Watched(EmulatedRobot):
    """An emulated robot that notes its true motion after every control step."""

    seen: ClassVar[list[tuple[float, float]]] = []

    def start(self, log, seed, meta=None):
        plant, truth = super().start(log, seed, meta)
        self.seen.clear()
        step = plant.step

        def stepped(*arguments):
            sensors = step(*arguments)
            now = truth.truth()
            self.seen.append((now["linear_velocity_in_body"][0, 0], now["angular_velocity_in_body"][0, 2]))
            return sensors

        plant.step = stepped  # pyright: ignore[reportAttributeAccessIssue]
        return plant, truth


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["gibbs_appell", "mujoco"])
def test_an_episode_is_scored_by_the_true_motion(backend, monkeypatch):
    commands = []
    take = driving._Score.take
    monkeypatch.setattr(driving._Score, "take", lambda self, command: commands.append(command[0]) or take(self, command))
    episode = drive_episode(ENVIRONMENT, POLICY, Watched(load_robot(), backend=backend, physics_step=0.002), 5, 1.0)
    speed, turn = (np.array(Watched.seen) - np.array(commands)).T
    assert episode.whole
    assert episode.measures["velocity_error"] == pytest.approx(np.sqrt(np.mean(speed**2)), rel=1e-9)
    assert episode.measures["yaw_rate_error"] == pytest.approx(np.sqrt(np.mean(turn**2)), rel=1e-9)
    scaled = np.sqrt((np.mean(speed**2) / 0.02**2 + np.mean(turn**2) / 0.06**2) / 2.0)  # scales of configs/task/velocity.yaml
    assert episode.tracking_error == pytest.approx(scaled, rel=1e-9)


def test_a_real_robot_is_scored_by_the_pose_of_its_observer_too():
    """On a floor without slip the observer knows where the robot is."""
    core = make_core("WLR-Posture-v0", 1, {"randomization": "none", "episode_length": 4.0})
    core.seed(0, 0)
    core.begin_episodes(core.everyone, {})
    estimated, true = (driving._Score(core.task, core, truth) for truth in (None, core.plant))
    for score in (estimated, true):
        score.begin()
    action = np.zeros((1, 8), np.float32)
    action[:, 4:] = 0.1, 0.5, 0.1, 0.5
    for _ in range(150):
        command = core.command.copy()
        core.step(action, core.everyone)
        for score in (estimated, true):
            score.take(command)
    driven = Deployment(None, "time is over", True, 150, {}, np.zeros(150))
    found, expected = (score.episode(0, driven).measures for score in (estimated, true))
    for name in ("lateral_error", "heading_error"):
        assert expected[name] > 0.005
        assert found[name] == pytest.approx(expected[name], rel=0.05)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits_and_what_is_hidden_shows():
    hidden = load_patch([{"name": "friction_asymmetry", "where": ["wheel_lf", "wheel_lr"], "parameters": {"mu": 0.1}}])
    robots = (EmulatedRobot(load_robot()), EmulatedRobot(load_robot()), EmulatedRobot(load_robot(), hidden))
    one, same, other = (drive_episode(ENVIRONMENT, POLICY, robot, 3, 0.6) for robot in robots)
    assert one == same
    assert one.measures != other.measures


class Failing(EmulatedRobot):
    """An emulated robot whose IMU falls silent."""

    def start(self, log, seed, meta=None):
        plant, truth = super().start(log, seed, meta)
        assert isinstance(plant.loop.clock, Machine)
        plant.loop.clock.inject("dead imu after=1.5")
        return plant, truth


def test_a_drive_that_the_supervision_stops_counts_as_a_fall():
    episode = drive_episode(ENVIRONMENT, POLICY, Failing(load_robot()), 3, 2.0)
    assert not episode.whole
    assert "imu" in episode.reason
    assert episode.tracking_error > 10.0
    assert 0.0 < episode.seconds < 2.0


def test_a_real_robot_asks_before_it_drives():
    def nobody(text):
        raise RuntimeError(text)

    with pytest.raises(RuntimeError, match="will stand up and drive"):
        RealRobot(load_robot(), ask=nobody).start(None, 0)


def test_gains_are_paired():
    theirs = np.array([0.2, 0.4, 0.9, 0.3])
    gain = paired(0.5 * theirs, theirs)
    assert (gain.mean, gain.low, gain.high) == pytest.approx((50.0, 50.0, 50.0))


@pytest.mark.slow
def test_the_whole_loop_at_a_tiny_size(tmp_path, capsys):
    path = tmp_path / "hidden.yaml"
    path.write_text("effects: [{name: joint_zero_offset, where: [leg_rr], parameters: {angle: -0.08}}]")
    words = [POLICY, "--emulated", "--effects", str(path), "--out", str(tmp_path / "out"), "--drives", "2", "--drive-seconds"]
    words += ["1", "--excitation", "straight", "turns", "posture", "--budget-runs", "0", "--steps", "16384", "--episodes", "8"]
    assert run_command("adapt", [*words, "--json"]) == OK
    first = json.loads(capsys.readouterr().out)
    assert [one["outcome"] for one in first["steps"].values()].count("done") >= 6
    assert first["steps"]["gap"]["numbers"]["verdict"]
    assert run_command("adapt", [*words, "--json"]) == OK  # nothing is repeated
    second = json.loads(capsys.readouterr().out)
    assert second["steps"]["gap"] == first["steps"]["gap"]
    assert second["steps"]["training"] == first["steps"]["training"]
    assert "emulated" in (tmp_path / "out" / "adapt.html").read_text()
