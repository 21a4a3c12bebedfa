"""What environments say: infos, samples of what was drawn, sensors that are there or not."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from velocity import DRIFT, ID, TIMED, make, make_vec

from wlr_gym.base.errors import InputError
from wlr_gym.envs import Sb3VecEnv
from wlr_gym.envs.tasks import describe, load_randomization, load_task
from wlr_gym.learning.evaluation.metrics import summarise
from wlr_gym.learning.evaluation.rollout import make_core, roll_out
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, PlantOptions
from wlr_gym.policy import Policy, needs_camera
from wlr_gym.robot import CORNER_SIGNS, load_robot

SHORT: dict[str, Any] = {"episode_length": 0.5, "randomization": "ice"}
COUNT = 5


class Wild(Policy):
    """The same random actions for every robot; some robots fall."""

    def __init__(self, count: int) -> None:
        self._rng, self._count = np.random.default_rng(8), count

    def reset(self, mask: Any) -> None:
        pass

    def act(self, observations: Any) -> np.ndarray:
        return np.repeat(self._rng.uniform(-1, 1, (1, 8)).astype(np.float32), self._count, axis=0)


def ends(env: Any) -> list[dict[str, float]]:
    """Measures of every robot's first episode, by a plain loop."""
    policy, found = Wild(COUNT), [{}] * COUNT
    env.reset(seed=20)
    while not all(found):
        *_, infos = env.step(policy.act(None))
        for row in range(COUNT):
            if infos.get("_episode_measures", np.zeros(COUNT, bool))[row] and not found[row]:
                found[row] = {name: float(v[row]) for name, v in infos["episode_measures"].items() if not name.startswith("_")}
    return found


def test_measures_of_an_episode_are_those_of_the_score_card():
    found = ends(gym.make_vec(ID, num_envs=COUNT, **SHORT))
    played = summarise([roll_out(make_core(ID, COUNT, SHORT), Wild(COUNT), first_seed=20)])
    assert {"tracking_error", "success", "velocity_error", "slip_speed"} <= set(found[0])
    for row, measures in enumerate(found):
        for name in ("tracking_error", "velocity_error", "yaw_rate_error"):
            assert measures[name] == played.pairs[name][0, 0, row, 0], name
        assert 100.0 * measures["success"] == played.pairs["success"][0, 0, row, 0]


def test_measures_are_said_by_all_interfaces() -> None:
    expected = ends(gym.make_vec(ID, num_envs=COUNT, **SHORT))
    at_once = gym.make_vec(ID, num_envs=COUNT, autoreset_mode="SameStep", **SHORT)
    policy = Wild(COUNT)
    at_once.reset(seed=20)
    batch = Sb3VecEnv(ID, COUNT, seed=20, **SHORT)
    batch.reset()
    found: list[Any] = [None] * COUNT
    while any(each is None for each in found):
        actions = policy.act(None)
        *_, final = at_once.step(actions)
        *_, dones, infos = batch.step(actions)
        for row in np.flatnonzero(dones & [each is None for each in found]).tolist():
            found[row] = infos[row]["episode_measures"]
            same = final["final_info"]["episode_measures"]
            assert found[row] == {name: same[name][row] for name in found[row]}
    assert found == expected
    env, policy = gym.make(ID, **SHORT), Wild(1)
    env.reset(seed=20)
    over, info = False, {}
    while not over:
        *_, terminated, truncated, info = env.step(policy.act(None)[0])
        over = terminated or truncated
        assert ("episode_measures" in info) == over
    assert info["episode_measures"] == expected[0]


def test_wrappers_that_record_episodes_still_work() -> None:
    env = RecordEpisodeStatistics(gym.make_vec(ID, num_envs=2, **SHORT))
    env.reset(seed=0)
    infos: dict[str, Any] = {}
    for _ in range(25):
        *_, infos = env.step(np.zeros((2, 8), np.float32))
    assert infos["episode"]["l"].tolist() == [25, 25]
    assert infos["episode_measures"]["velocity_error"].shape == (2,)


def test_the_truth_is_there_only_when_it_is_asked_for() -> None:
    env, plain = (gym.make(ID, truth_info=asked, **SHORT) for asked in (True, False))
    batch = gym.make_vec(ID, num_envs=2, truth_info=True, **SHORT)
    infos = batch.reset(seed=4)[1]
    info = env.reset(seed=4)[1]
    assert "truth" not in plain.reset(seed=4)[1]
    for _ in range(3):
        truth = env.unwrapped.core.plant.truth()  # type: ignore[attr-defined]
        shapes = {"position": (3,), "quaternion": (4,), "linear_velocity_in_body": (3,), "angular_velocity_in_body": (3,)}
        for name, shape in shapes.items():
            assert info["truth"][name].shape == shape
            np.testing.assert_array_equal(info["truth"][name], truth[name][0])
            np.testing.assert_array_equal(infos["truth"][name][0], truth[name][0])
        command = dict(zip(("linear_velocity_x", "yaw_rate"), env.unwrapped.core.command[0], strict=True))  # type: ignore[attr-defined]
        assert info["truth"]["command"] == command
        assert infos["truth"]["command"]["yaw_rate"][0] == command["yaw_rate"]
        assert infos["truth"]["command"]["_yaw_rate"].all()
        action = np.full(8, 0.1, np.float32)
        info, infos = env.step(action)[-1], batch.step(np.stack([action, action]))[-1]
        assert "truth" not in plain.step(action)[-1]
    kept = info["truth"]["position"].copy()
    env.step(np.ones(8, np.float32))
    np.testing.assert_array_equal(info["truth"]["position"], kept)  # a copy
    by_robot = Sb3VecEnv(ID, 2, seed=4, truth_info=True, **SHORT)
    by_robot.reset()
    assert by_robot.reset_infos[1]["truth"]["position"].shape == (3,)
    assert by_robot.step(np.zeros((2, 8)))[-1][1]["truth"]["quaternion"].shape == (4,)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_the_truth_of_a_batch_whose_episodes_end_at_different_times(mode: str) -> None:
    """Robots that begin anew have their own pose in the info of the same step as robots that drive on."""
    batch = gym.make_vec(ID, num_envs=3, truth_info=True, autoreset_mode=mode, **SHORT)
    batch.reset(seed=4)
    batch.unwrapped.core.episodes.steps[1] = 20  # type: ignore[attr-defined]
    for _ in range(30):
        infos = batch.step(np.full((3, 8), 0.1, np.float32))[-1]
        truth = batch.unwrapped.core.plant.truth()  # type: ignore[attr-defined]
        for name in ("position", "quaternion"):
            np.testing.assert_array_equal(infos["truth"][name], truth[name])


def test_only_simulators_know_the_truth() -> None:
    with pytest.raises(InputError, match="truth_info = True: a real robot is what it is"):
        gym.make(ID, backend="dynamixel", hardware={"emulated": True}, truth_info=True)
    with pytest.raises(InputError, match="truth_info = 1: expected True or False"):
        gym.make(ID, truth_info=1)  # type: ignore[arg-type]


# --- randomisation in info, and at the contacts -----------------------------------------------------------------------


def test_info_tells_every_change_and_only_what_changed(fake):
    env = make(randomization=TIMED, episode_length=3.0)
    _, info = env.reset(seed=0)
    plant = fake["plants"][-1]
    assert len(info["randomization"]) > 60
    last, told = plant.parameters.values.copy(), 0
    for _ in range(140):
        *_, info = env.step(np.zeros(8, np.float32))
        changed = not np.array_equal(plant.parameters.values, last)
        assert ("randomization" in info) == changed
        if changed:
            told += 1
            assert len(info["randomization"]) == 10
            for name, value in info["randomization"].items():
                assert plant.parameters[name][0] == value
        last = plant.parameters.values.copy()
    assert told > 20


def test_a_drifting_parameter_moves_a_few_times_a_second_and_smoothly(fake):
    env = make_vec(50, randomization={"events": {"drift": DRIFT}}, episode_length=5.0)
    env.reset(seed=0)
    friction = []
    for _ in range(200):
        env.step(np.zeros((50, 8)))
        friction.append(fake["plants"][-1].parameters["ground.mu_x"][:, 0].copy())
    steps = np.diff(np.array(friction), axis=0)
    assert set(np.flatnonzero(steps.any(axis=1)).tolist()) == set(range(8, 199, 10))
    assert np.abs(steps).max() < 0.6 * 1.5 / 0.5 * 0.2
    assert np.ptp(friction) > 0.4


def test_overrides_and_effects_hold_against_drift(fake):
    effects = [{"name": "friction_asymmetry", "where": ["wheel_rr"], "parameters": {"mu": 0.4}}]
    env = make(randomization=TIMED, effects=effects, episode_length=3.0)
    env.reset(seed=0, options={"parameters": {"ground.mu_x[wheel_lf]": 0.1}})
    plant = fake["plants"][-1]
    seen = []
    for _ in range(60):
        env.step(np.zeros(8, np.float32))
        seen.append(plant.parameters["ground.mu_x"][0].copy())
    assert np.all(np.array(seen)[:, [0, 3]] == [0.1, 0.4])
    assert np.ptp(np.array(seen)[:, 1]) > 0.01


# ---- on the engine ----


def drawn_friction(parameters, truth):
    """Friction each wheel should find, (N, 4, 2), by where it stands; and how far (m) it is from any patch's edge."""
    position, quaternion = truth.position, truth.quaternion
    yaw = 2 * np.arctan2(quaternion[:, 3], quaternion[:, 0])[:, None]
    signs, hip = np.array(CORNER_SIGNS), parameters["hip.position"]
    forward = signs[:, 0] * hip[:, :1] + parameters["leg.length"] * np.cos(truth.joint_position[:, :4])
    left = signs[:, 1] * hip[:, 1:2] + np.zeros_like(forward)
    x = position[:, :1] + np.cos(yaw) * forward - np.sin(yaw) * left
    y = position[:, 1:2] + np.sin(yaw) * forward + np.cos(yaw) * left
    mu, edge = parameters["ground.mu_x"].copy(), np.full(x.shape, np.inf)
    for k in range(4):
        x_min, x_max, y_min, y_max = (
            parameters[f"patch.{name}"][:, k : k + 1] for name in ("x_min", "x_max", "y_min", "y_max")
        )
        outside = np.maximum.reduce([x_min - x, x - x_max, y_min - y, y - y_max])
        exists = (x_max > x_min) & (y_max > y_min)
        mu = np.where(exists & (outside < 0), parameters["patch.mu"][:, k : k + 1], mu)
        edge = np.where(exists, np.minimum(edge, np.abs(outside)), edge)
    mu_x = mu * parameters["wheel.grip"]
    return np.stack([mu_x, mu_x * parameters["ground.mu_y"] / parameters["ground.mu_x"]], axis=-1), edge


@pytest.mark.parametrize("name", ["wide", "ice", "split", "patches"])
def test_the_friction_that_acts_is_the_one_drawn(name):
    """Standing, every wheel reports it; pushed sideways, contact forces lie on its ellipse, at every heading."""
    robot, count = load_robot(), 400
    randomization = load_randomization({"base": name, "initial_state": {"yaw": 3.14}}, robot)
    seeds = np.arange(count, dtype=np.uint64)
    parameters = randomization.parameters(seeds, seeds)
    parameters["external_force"] = 0.0
    state = randomization.state(parameters, seeds)
    state.linear_velocity_in_body[:] = [0.0, 1.0, 0.0]
    state.angular_velocity_in_body[:] = 0.0
    plant = make_plant("gibbs_appell", robot, count, PlantOptions(control_period=0.005))
    plant.reset(seeds, parameters, state=state)
    expected, edge = drawn_friction(parameters, plant.truth())
    clear = edge > 0.015
    assert clear.mean() > 0.8
    shown = plant.truth().effective_friction.reshape(count, 4, 2)
    np.testing.assert_allclose(shown[clear], expected[clear], rtol=1e-12)
    plant.step(np.column_stack([state.joint_position[:, :4], np.zeros((count, 4))]))
    force = plant.truth().contact_force.reshape(count, 4, 3)
    loaded = clear & (force[:, :, 2] > 1.0)
    assert loaded.mean() > 0.6
    used = np.linalg.norm(force[loaded][:, :2] / (expected[loaded] * force[loaded][:, 2:]), axis=-1)
    np.testing.assert_allclose(used, 1.0, rtol=1e-6)
    spread = expected[loaded][:, 0]
    assert spread.max() / spread.min() > 3.5
    plant.close()


# ---- sensors present or absent as data of the task: drawn per episode from streams of their own, told to the policy --


TERMS = {"camera_present": {}, "flow_present": {}, "flow": {"scale": 0.2}, "flow_quality": {}}
BOTH = {"sensors": {"camera": 0.5, "flow": 0.5}, "observations": TERMS}
PAGE = Path(__file__).parents[2] / "docs" / "camera.md"


def core_of(task, count=8, backend="gibbs_appell", seed=0, **settings):
    core = make_core("WLR-Velocity-v0", count, {"task": task, "backend": backend, **settings})
    for row in range(count):
        core.seed(row, seed + row)
    core.begin_episodes(core.everyone)
    return core


def columns(core, *terms):
    return core.observation[:, [k for k, column in enumerate(core.task.policy) if column.term in terms]]


def channel(core, name):
    return core.sensors.values[:, SENSOR_LAYOUT.slices[name]]


def steps(core, count):
    rows = [columns(core, *TERMS).copy()]
    for _ in range(count):
        core.step(np.full((core.count, 8), 0.2), core.everyone)
        rows.append(columns(core, *TERMS).copy())
    return np.array(rows)


def test_presence_is_drawn_per_episode_and_what_is_absent_reads_nothing():
    core = core_of(BOTH, robot="flow", count=64)
    rows = steps(core, 5)
    camera, flow = columns(core, "camera_present", "flow_present").T
    assert set(camera) == set(flow) == {0.0, 1.0}
    assert len({(a, b) for a, b in zip(camera, flow, strict=True)}) == 4  # independent of each other
    np.testing.assert_array_equal(core.parameters["camera.present"], camera)
    np.testing.assert_array_equal((rows[:, :, 4] > 0.0).any(axis=0), flow == 1.0)
    assert not channel(core, "camera_pose")[camera == 0.0].any()
    assert channel(core, "camera_pose")[camera == 1.0].any()
    before = camera.copy()
    core.begin_episodes(core.everyone)
    assert (columns(core, "camera_present")[:, 0] != before).any()
    assert abs(np.mean([before, columns(core, "camera_present")[:, 0]]) - 0.5) < 0.15
    core.close()


def test_same_episode_alone_and_in_a_batch_with_whatever_the_others_have():
    batch, alone = core_of(BOTH, robot="flow"), core_of(BOTH, robot="flow", count=1, seed=5)
    np.testing.assert_array_equal(steps(batch, 4)[:, 5], steps(alone, 4)[:, 0])


def test_drawing_presence_shifts_no_other_draw():
    plain = core_of({}, robot="flow")
    always = core_of({"sensors": {"camera": 1.0, "flow": 1.0}}, robot="flow")
    for core in (plain, always):
        for _ in range(4):
            core.step(np.full((core.count, 8), 0.2), core.everyone)
    np.testing.assert_array_equal(plain.observation, always.observation)
    np.testing.assert_array_equal(plain.parameters.values, always.parameters.values)


def test_the_page_says_what_is_tried_here():
    assert yaml.safe_load(re.findall("```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)[1]) == BOTH


def test_a_user_can_say_who_has_what():
    core = core_of(BOTH, robot="flow")
    core.begin_episodes(core.everyone, {"parameters": {"camera.present": 0.0, "flow.present": 1.0}})
    np.testing.assert_array_equal(columns(core, "camera_present", "flow_present"), np.tile([0.0, 1.0], (8, 1)))


def test_the_preset_draws_what_is_wrong_with_the_sensor():
    draws = load_randomization("flow", load_robot("flow"))
    seeds = np.arange(200, dtype=np.uint64)
    drawn = draws.parameters(seeds, seeds)
    for name, low, high in (("scale", 0.96, 1.04), ("mount_yaw", -0.06, 0.06), ("dropout", 0.0, 0.1), ("poor_floor", 0.0, 0.3)):
        values = drawn[f"flow.{name}"]
        assert low <= values.min() < values.max() <= high
    plain = load_randomization("nominal", load_robot("flow")).parameters(seeds, seeds)
    np.testing.assert_array_equal(plain["ground.mu_x"], drawn["ground.mu_x"])


def test_a_sensor_that_fails_within_an_episode_is_told():
    event = {"parameters": ["camera.present"], "when": "interval", "interval": [0.06, 0.06], "operation": "set"}
    failing = {
        "name": "failing",
        "base": "none",
        "events": {"camera": {**event, "distribution": "choice", "values": [0.0, 1.0]}},
    }
    core = core_of({"observations": TERMS}, robot="flow", randomization=failing)
    flags = []
    for _ in range(12):
        flags.append(columns(core, "camera_present")[:, 0].copy())
        np.testing.assert_array_equal(flags[-1], core.parameters["camera.present"])
        core.step(np.full((core.count, 8), 0.2), core.everyone)
    assert np.ptp(flags, axis=0).max() == 1.0


def test_contracts_of_other_tasks_stay_and_new_ones_say_it():
    plain, told = core_of({}), core_of(BOTH, robot="flow")
    assert "sensors" not in plain.contract()
    assert told.contract()["sensors"] == {"camera": 0.5, "flow": 0.5}
    assert needs_camera(plain.contract())
    assert not needs_camera(told.contract())
    assert "present" not in describe(plain.task)
    assert "**Sensors** present per episode: camera with probability 0.5, flow with probability 0.5" in describe(told.task)
    assert "flow_present" in describe(told.task)


@pytest.mark.parametrize(
    ("task", "robot", "message"),
    [
        ({"sensors": {"flow": 1.0}}, "nominal", "robot 'wlr-nominal' has no optical-flow sensor"),
        ({"sensors": {"flow": 1.5}}, "flow", "sensors.flow"),
        ({"sensors": {"lidar": 1.0}}, "flow", "lidar"),
    ],
)
def test_what_cannot_be_is_refused(task, robot, message):
    with pytest.raises(InputError, match=message):
        load_task("velocity", robot, task)
