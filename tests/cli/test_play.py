"""``wlr play`` without a window, and with one that is not there."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
import contextlib
import json
from typing import Any

import mujoco
import numpy as np
import pytest
from PIL import Image

from wlr_gym.cli import main
from wlr_gym.cli import play as play_module
from wlr_gym.envs.tasks.signals import PlanarPose, Signals, error_from_path
from wlr_gym.learning.evaluation.film import Journey, commands, drive, film, film_length, result
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.policy import make_policy
from wlr_gym.render.teleop import RESET, UP, Script
from wlr_gym.render.view import View


@pytest.fixture
def headless(monkeypatch):
    monkeypatch.setattr("wlr_gym.render.view.platform.system", lambda: "Linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


def test_video_by_schedule(tmp_path, capsys, graphics, headless):
    path = tmp_path / "film.webp"
    arguments = ["--seconds", "0.4", "--command", "0:0.1,0; 0.2:0,0.3", "--size", "96", "64", "--camera", "top", "--forces"]
    assert main(["play", "--video", str(path), *arguments]) == 0
    assert f"written: {path} (10 pictures, 0.4 s)" in capsys.readouterr().out
    with Image.open(path) as image:
        assert (image.n_frames, image.size) == (10, (96, 64))
        first = np.asarray(image.convert("RGB")).copy()
        image.seek(9)
        assert not np.array_equal(np.asarray(image.convert("RGB")), first)
    assert [child.name for child in tmp_path.iterdir()] == ["film.webp"]


def test_evaluate_writes_policy_and_baseline_side_by_side(tmp_path, capsys, graphics):
    path = tmp_path / "film.webp"
    arguments = ["--episodes", "1", "--baselines", "do_nothing", "--video-seconds", "0.08", "--no-progress"]
    assert main(["evaluate", "pid", "--video", str(path), *arguments]) == 0
    assert f"written: {path}" in capsys.readouterr().out
    with Image.open(path) as image:
        assert image.n_frames == 2
        assert image.size[0] == 2 * 640 + 4


def test_two_policies_side_by_side_with_their_paths(tmp_path, capsys, graphics, headless):
    path = tmp_path / "film.webp"
    arguments = ["--agent", "pid", "--beside", "do_nothing", "--seconds", "0.4", "--fps", "10", "--command", "0.1,0", "--path"]
    assert main(["play", "--video", str(path), *arguments, "--size", "96", "64", "--json"]) == 0
    shown = capsys.readouterr()
    assert json.loads(shown.out) == {"video": str(path), "pictures": 4, "seconds": 0.4}
    assert f"written: {path} (4 pictures, 0.4 s)" in shown.err
    with Image.open(path) as image:
        assert (image.n_frames, image.size[0]) == (4, 2 * 96 + 4)


def test_a_path_is_where_the_robot_went_and_where_it_was_told_to_go():
    core = make_core("WLR-Velocity-v0", 1, {"randomization": "none"})
    policy, path = make_policy("do_nothing", core.contract()), Journey()
    for _, _ in zip(drive(core, policy, 0, Script("0.1,0.2", core.task.commands)), range(101), strict=False):
        path.note(core)
    wanted, driven = (trail.points for trail in path.trails())
    core.close()
    start, turn, speed = driven[0], 2.0 * 0.2, 0.1
    circle = start + speed / 0.2 * np.array([np.sin(turn), 1.0 - np.cos(turn)])  # it starts along x
    np.testing.assert_allclose(wanted[-1], circle, atol=0.002)
    assert np.abs(driven - start).max() < 0.01  # this one stays where it is
    assert len(wanted) == len(driven) == 101


def test_a_film_of_a_climb_knows_the_speed_asked_for_and_the_error_so_far():
    core = make_core("WLR-Slope-v0", 1, {"randomization": "none"})
    core.begin_episodes(core.everyone, {"command": {"climb_speed": 0.05, "climb_time": 6.0}})
    asked, results = [], []
    for _ in range(330):
        asked.append(commands(core)["linear_velocity_x"])
        results.append(result(core))
        core.step(np.zeros((1, 8), np.float32), core.everyone)
    core.close()
    assert (asked[0], asked[10], asked[200], asked[320]) == pytest.approx((0.0, 0.02, 0.05, 0.01))
    assert results[0] == "tracking error 0.00 so far"
    assert results[-1] != results[0]


@pytest.mark.parametrize("shape", [0.5, 1.5, 2.5])
def test_a_commanded_path_is_drawn_on_the_floor_it_was_commanded_on(shape):
    """A robot on a point of the dashed line has no error from the path; the line is as long as the speed makes it."""
    core = make_core("WLR-Path-v0", 1, {"randomization": "none", "effects": ()})
    bend = {"path_shape": shape, "path_curvature": 1.5, "path_wavelength": 1.0, "path_offset": 0.02, "path_heading": 0.1}
    core.begin_episodes(core.everyone, {"command": {**bend, "linear_velocity_x": 0.1}})
    path, given = Journey(), commands(core)
    core.start[0] = (1.0, -2.0, 0.7)
    for _ in range(500):
        path.note(core)
        core.episodes.steps += 1
    wanted = path.trails()[0].points
    core.close()
    read = Signals({f"command.{name}": np.full(500, value) for name, value in given.items()}.__getitem__)
    away = wanted - [1.0, -2.0]
    pose = PlanarPose(away @ [np.cos(0.7), np.sin(0.7)], away @ [-np.sin(0.7), np.cos(0.7)], np.zeros(500))
    assert np.abs(error_from_path(read, pose).lateral).max() < 1e-5
    length = np.hypot(*np.diff(wanted, axis=0).T).sum()
    assert length == pytest.approx(0.1 * 499 * core.task.config.control_period, rel=1e-3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "no display here"),
        (["--agent", "ppo"], "note: 'ppo' is the agent before any training; trained ones: path_blind"),
        (["--agent", "pidd"], "did you mean 'pid'?"),
        (["--agent", "pid", "--command", "1"], "--command '1': expected linear_velocity_x,yaw_rate"),
        (["WLR-Pth-v0"], "did you mean 'WLR-Path-v0'?"),
        (["--json"], "--json: says what was written: add --video"),
        (["--beside", "pid"], "--beside: two robots are shown in a video only"),
        (["--video", "film.webp", "--fps", "0"], "--fps 0: expected a number from 1 to 1000"),
        (["--video", "film.avi"], "--video film.avi: expected a file that ends in"),
        (["--video", "nowhere/film.webp"], "--video nowhere/film.webp: folder nowhere does not exist"),
        (["--video", "film.webp", "--seconds", "-1"], "--seconds -1: expected more than 0"),
        (["--video", "film.webp", "--seed", "-1"], "--seed -1: expected a number from 0 to 4294967295"),
        (["--video", "film.webp", "--camera", "topp"], "--camera: unknown view 'topp' (did you mean 'top'"),
        (["--video", "film.webp", "--size", "1", "1"], "--size 1 1: expected width and height, each 64 to 4096 pixels"),
        (["--video", "film.mp4", "--size", "641", "482"], "--size 641 482: expected even numbers"),
        (["--video", "film.webp", "--command", "1"], "--command '1': expected linear_velocity_x,yaw_rate"),
        (["--video", "film.webp", "--command", "5,0"], "--command: linear_velocity_x = 5: expected -0.217 to 0.217 m/s"),
        (["--video", "film.webp", "--command", "0,0; 3:-1,0"], "linear_velocity_x = -1: expected -0.217"),
        (["--video", "film.webp", "--command", "0,0; 3:0,9"], "--command: yaw_rate = 9: expected -1.36 to 1.36 rad/s"),
        (["--video", "film.webp", "--agent", "pdi"], "did you mean 'pid'"),
        (
            ["--video", "film.webp", "--backend", "mujocoo"],
            "unknown backend 'mujocoo' (did you mean 'mujoco'?); valid: gibbs_appell, mujoco",
        ),
        (["--video", "film.webp", "--backend", "dynamixel"], "--backend dynamixel: a real robot is driven with wlr deploy"),
        (["--video", "film.webp", "--effects", "nothing.yaml"], "nothing.yaml"),
        (["--video", "film.webp", "--gamepad"], "--gamepad drives in the window"),
        (["WLR-Velocty-v0", "--video", "film.webp"], "did you mean 'WLR-Velocity-v0'"),
    ],
)
def test_what_is_refused(monkeypatch, tmp_path, capsys, headless, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert main(["play", *arguments]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert list(tmp_path.iterdir()) == []


def test_commands_beyond_the_tasks_are_taken_with_a_note(capsys):
    core = make_core("WLR-Velocity-v0", 1, {"randomization": "none"})
    for command, note in (
        ("0.15,0", "linear_velocity_x = 0.15 m/s is outside what the task commands, [-0.1, 0.1]"),
        ("0.1,0", ""),
    ):
        play_module._driver(play_module.PlayOptions(command=command), core)
        shown = capsys.readouterr().err
        assert note in shown
        assert bool(note) == bool(shown)
    core.close()


def test_bad_films_of_other_commands_are_refused_first(tmp_path, capsys):
    assert main(["evaluate", "do_nothing", "--video", str(tmp_path / "film.doc")]) == 2
    assert "expected a file that ends in" in capsys.readouterr().err
    assert main(["replay", str(tmp_path), "--out", str(tmp_path / "out"), "--video", str(tmp_path / "film.doc")]) == 2
    assert "expected a file that ends in" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


class Window:
    """A window that presses keys: frame -> key; closes itself at the end."""

    def __init__(self, model, data, on_key, keys, frames):
        self.cam, self.user_scn = mujoco.MjvCamera(), mujoco.MjvScene(model, 100)
        self.on_key, self.keys, self.frames = on_key, keys, frames
        self.texts: list[str] = []

    def is_running(self):
        return len(self.texts) < self.frames

    @contextlib.contextmanager
    def lock(self):
        yield

    def set_texts(self, texts: Any):
        self.texts.append(texts[0][2])

    def sync(self):
        if len(self.texts) in self.keys:
            self.on_key(self.keys[len(self.texts)])

    def close(self):
        self.frames = 0


def test_keys_drive_the_robot_until_the_window_is_closed(monkeypatch):
    monkeypatch.setattr("wlr_gym.render.viewer.time.sleep", lambda seconds: None)
    options = play_module.PlayOptions(randomization="none")
    core = make_core("WLR-Velocity-v0", 1, {"randomization": "none"})
    driver = play_module._driver(options, core)
    windows = []

    def open_window(model, data, on_key):
        windows.append(Window(model, data, on_key, {1: UP, 2: UP, 30: RESET}, 40))
        return windows[-1]

    monkeypatch.setattr("wlr_gym.render.viewer.open_window", open_window)
    play_module.show(options, core, make_policy("pid", core.contract()), driver)
    texts = windows[0].texts
    assert len(texts) == 40
    assert "t 0.00 s" in texts[0]
    assert "of 0.00 m/s" in texts[0]
    assert "of 0.02 m/s" in texts[20]
    speed = float(texts[29].partition("speed ")[2].partition(" of")[0])
    assert speed == pytest.approx(0.02, abs=0.006)
    assert "t 0.00 s" in texts[30]
    assert "of 0.00 m/s" in texts[35]
    core.close()


def test_a_film_goes_on_after_the_end_of_an_episode(graphics):
    core = make_core("WLR-Velocity-v0", 1, {"episode_length": 0.1, "randomization": "none"})
    count, every, fps = film_length(core, 0.4)
    assert (count, every, fps) == (10, 2, 25.0)
    policy = make_policy("do_nothing", core.contract())
    pictures = list(film(core, policy, 0, 0.4, view=View(size=(64, 64), text=False)))
    assert len(pictures) == 10
    assert core.episodes.number[0] >= 2
    core.close()
