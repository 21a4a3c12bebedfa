"""Sensors present or absent as data of the task: drawn per episode from streams of their own, told to the policy."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from wlr_gym.base.errors import InputError
from wlr_gym.envs.tasks import describe, load_randomization, load_task
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.physics.plants.base import SENSOR_LAYOUT
from wlr_gym.policy import needs_camera
from wlr_gym.robot import load_robot

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
