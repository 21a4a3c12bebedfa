"""Render modes of the three faces. The plant is the fake one: pictures know no plant."""

import pickle
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import AddRenderObservation, RenderCollection

import wlr_gym  # noqa: F401
from wlr_gym.base.errors import InputError
from wlr_gym.envs import interfaces as pictures_module
from wlr_gym.envs.settings import read_settings

ID = "WLR-Velocity-v0"
SMALL = {"view": {"size": [96, 64]}, "randomization": "none"}


def make(**keywords) -> Any:
    return gym.make(ID, **{**SMALL, **keywords})


# ---- rgb_array ----


def test_single_environment(fake, graphics):
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.shape == (64, 96, 3)
    assert first.dtype == np.uint8
    assert np.array_equal(env.render(), first)
    for _ in range(20):
        env.step(np.full(8, 0.5, np.float32))
    assert not np.array_equal(env.render(), first)
    env.close()


def test_the_same_episode_gives_the_same_pictures(fake, graphics):
    def film():
        env = make(render_mode="rgb_array")
        env.reset(seed=5)
        frames = []
        for _ in range(3):
            env.step(np.full(8, 0.4, np.float32))
            frames.append(env.render())
        env.close()
        return frames

    assert np.array_equal(film(), film())


def test_batch_gives_one_picture_per_robot_the_same_as_alone(fake, graphics):
    batch: Any = gym.make_vec(ID, num_envs=2, render_mode="rgb_array", **SMALL)
    batch.reset(seed=3)
    batch.step(np.full((2, 8), 0.3, np.float32))
    frames = batch.render()
    assert isinstance(frames, tuple)
    for row in range(2):
        env = make(render_mode="rgb_array")
        env.reset(seed=3 + row)
        env.step(np.full(8, 0.3, np.float32))
        assert np.array_equal(env.render(), frames[row])
        env.close()
    batch.close()


def test_gymnasiums_wrappers(fake, graphics):
    env = RenderCollection(make(render_mode="rgb_array"))
    env.reset(seed=0)
    env.step(np.zeros(8, np.float32))
    assert len(env.render()) == 2
    listed: Any = make(render_mode="rgb_array_list")
    listed.reset(seed=0)
    assert len(listed.render()) == 1
    pixels = AddRenderObservation(make(render_mode="rgb_array"))
    observation, _ = pixels.reset(seed=0)
    assert observation in pixels.observation_space
    for opened in (env, listed, pixels):
        opened.close()


def test_check_env_with_pictures_without_a_warning(fake, graphics):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(render_mode="rgb_array").unwrapped)


def test_metadata(fake):
    env = make(task={"control_period": 0.04})
    assert env.metadata["render_fps"] == 25
    assert "rgb_array" in env.metadata["render_modes"]
    assert type(env.unwrapped).metadata == {"render_modes": ["human", "rgb_array"], "render_fps": 50}


def test_a_copy_of_an_environment_that_has_drawn(fake, graphics):
    env = make(render_mode="rgb_array").unwrapped
    env.reset(seed=4)
    expected = env.render()
    copy = pickle.loads(pickle.dumps(env))
    copy.reset(seed=4)
    assert np.array_equal(copy.render(), expected)
    env.close()
    copy.close()


@pytest.mark.parametrize("face", ["single", "vector", "sb3"])
def test_before_the_first_reset_there_is_nothing_to_see(fake, face):
    env = faces(face, "rgb_array")
    with pytest.raises(gym.error.ResetNeeded, match=r"reset\(\) before render"):
        env.render()


def faces(face, render_mode) -> Any:
    if face == "single":
        return make(render_mode=render_mode).unwrapped
    if face == "vector":
        return gym.make_vec(ID, num_envs=2, render_mode=render_mode, **SMALL)
    pytest.importorskip("stable_baselines3")
    from wlr_gym.envs import Sb3VecEnv

    return Sb3VecEnv(ID, 2, seed=0, render_mode=render_mode, **SMALL)


@pytest.mark.parametrize("face", ["single", "vector"])
def test_without_a_render_mode_nothing_is_shown_and_that_is_said(fake, face):
    env = faces(face, None)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="make the environment with render_mode='rgb_array'"):
        assert env.render() is None


def test_bad_view(fake):
    with pytest.raises(InputError, match="did you mean 'chase'"):
        gym.make(ID, view={"camera": "chse"})
    with pytest.raises(InputError, match="view = 3: expected a mapping"):
        gym.make(ID, view=3)
    with pytest.raises(InputError, match="view: path = True: only films show a path"):
        gym.make(ID, view={"path": True})


def test_sizes_may_be_numpy_integers():
    assert read_settings({"view": {"size": (np.int64(320), 240)}}).picture_view.size == (320, 240)


def test_stable_baselines(fake, graphics):
    env = faces("sb3", "rgb_array")
    assert env.get_attr("render_mode") == ["rgb_array"] * 2
    assert env.metadata["render_fps"] == 50
    env.reset()
    env.step(np.zeros((2, 8), np.float32))
    tiles = env.render()
    assert tiles.shape in {(64, 192, 3), (128, 96, 3)}
    assert len(env.get_images()) == 2
    env.close()


def test_stable_baselines_own_vector_environment(fake, graphics):
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.env_util import make_vec_env

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make_vec_env(ID, n_envs=2, env_kwargs=SMALL)
    env.reset()
    picture = env.render()
    assert picture is not None
    assert picture.shape[2] == 3
    env.close()


# ---- human ----


@pytest.mark.parametrize("make_env", [gym.make, gym.make_vec])
def test_no_display_no_window(fake, monkeypatch, make_env):
    monkeypatch.setattr("wlr_gym.render.view.platform.system", lambda: "Linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError, match=r"no display here .*render_mode='rgb_array'"):
        make_env(ID, render_mode="human")
    env: Any = make_env(ID)
    assert env.metadata["render_modes"] == ["rgb_array"]


class FakeViewer:
    made: list = []  # noqa: RUF012

    def __init__(self, robot, view):
        self.shown, self.closed = [], False
        FakeViewer.made.append(self)

    def show(self, truth, parameters, *, period, contacts, time, command):
        assert period == 0.02
        assert contacts is None
        self.shown.append((round(time, 6), set(command)))
        return True

    def close(self):
        self.closed = True


@pytest.mark.parametrize("face", ["single", "vector", "sb3"])
def test_a_window_shows_every_reset_and_step(fake, monkeypatch, face):
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr("wlr_gym.render.viewer.Viewer", FakeViewer)
    FakeViewer.made.clear()
    env = faces(face, "human")
    assert FakeViewer.made == []
    env.reset(seed=0) if face != "sb3" else env.reset()
    for _ in range(3):
        env.step(np.zeros(8 if face == "single" else (2, 8), np.float32))
    assert env.render() is None
    (viewer,) = FakeViewer.made
    names = {"linear_velocity_x", "yaw_rate"}
    assert viewer.shown == [(time, names) for time in (0.0, 0.02, 0.04, 0.06, 0.06)]
    env.close()
    assert viewer.closed


def test_modes_that_do_not_exist():
    for mode in ("ansi", "rgb", 3):
        with pytest.raises(InputError, match="expected None, 'human' or 'rgb_array'"):
            pictures_module.check_render_mode(mode)  # type: ignore[arg-type]


def test_gymnasiums_recording_wrapper_writes_a_film(fake, graphics, tmp_path):
    pytest.importorskip("moviepy")
    env = gym.wrappers.RecordVideo(make(render_mode="rgb_array", episode_length=0.2), str(tmp_path), disable_logger=True)
    env.reset(seed=0)
    for _ in range(10):
        env.step(np.zeros(8, np.float32))
    env.close()
    assert [path.name for path in tmp_path.iterdir()] == ["rl-video-episode-0.mp4"]
