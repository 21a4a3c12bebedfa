"""The robot as a plant and in an environment, on the emulated robot in emulated time. The conformance suite has the rest."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")

from robot_rig import ROBOT, Phase, StoppedError, machine_of

import wlr_gym  # noqa: F401  (registers the environments)
from wlr_gym.base.errors import InputError
from wlr_gym.data.runs import read_run
from wlr_gym.envs.core import MEASURED, measured_truth
from wlr_gym.envs.settings import EnvironmentOptions
from wlr_gym.learning.evaluation.rollout import make_core, roll_out
from wlr_gym.physics.effects import Patch
from wlr_gym.physics.plants import REAL, SIMULATORS, make_plant
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, PlantOptions, RobotOptions, Sensors, read_robot_options
from wlr_gym.robot.parameters import Parameters

QUIET = PlantOptions(sensor_noise=False)
ID = "WLR-Velocity-v0"
EMULATED = {"emulated": True}


def robot_plant(options: PlantOptions = QUIET, **changes: Any) -> Any:
    return make_plant("dynamixel", ROBOT, 1, options, hardware=RobotOptions(emulated=True, **changes))


def setpoints_at(tick):
    return np.r_[np.pi / 2 + 0.05 * np.sin(0.1 * tick + np.arange(4)), 1.5 * np.sin(0.05 * tick) * np.ones(4)][None]


# ---- plant -------------------------------------------------------------------------------------------------------------


def test_it_reads_what_the_simulator_behind_it_reads():
    """The way over registers, packets and counts adds nothing but their resolution: same physics, same sensors."""
    robot, simulator = robot_plant(), make_plant("gibbs_appell", ROBOT, 1, QUIET)
    robot.reset()
    simulator.reset()
    for _ in range(25):  # the robot's ramp
        simulator.step(setpoints_at(0) * [[0] * 4 + [1] * 4] + [[np.pi / 2] * 4 + [0] * 4])
    theirs, ours = [], []
    for tick in range(100):
        setpoints = setpoints_at(tick)
        setpoints[0, :4] = np.pi / 2 + np.rint((setpoints[0, :4] - np.pi / 2) / 0.0015339807878856412) * 0.0015339807878856412
        setpoints[0, 4:] = np.rint(setpoints[0, 4:] / 0.02398082392240917) * 0.02398082392240917
        ours.append(robot.step(setpoints).values[0].copy())
        theirs.append(simulator.step(setpoints).values[0].copy())
    ours, theirs = Sensors(np.array(ours)), Sensors(np.array(theirs))
    np.testing.assert_allclose(ours.joint_position[:, :4], theirs.joint_position[:, :4], atol=0.002)
    np.testing.assert_allclose(ours.joint_position[:, 4:], theirs.joint_position[:, 4:], atol=0.01)
    np.testing.assert_allclose(ours.joint_velocity, theirs.joint_velocity, atol=0.03)
    np.testing.assert_allclose(ours.joint_effort, theirs.joint_effort, atol=0.02)
    np.testing.assert_allclose(ours.gyro, theirs.gyro, atol=0.003)
    np.testing.assert_allclose(ours.accelerometer, theirs.accelerometer, atol=0.15)
    robot.close()


def test_the_same_run_gives_the_same_bits():
    def rollout():
        plant = robot_plant(PlantOptions())
        plant.reset()
        rows = np.array([plant.step(setpoints_at(tick)).values[0].copy() for tick in range(40)])
        plant.close()
        return rows

    np.testing.assert_array_equal(rollout(), rollout())


def test_reset_goes_to_the_state_and_zeroes_the_wheels():
    plant, sensors = robot_plant(), None
    state = make_plant("gibbs_appell", ROBOT, 1, QUIET).mechanical_state()
    state.joint_position[0, :4] = [1.3, 1.4, 1.7, 1.8]
    for _ in range(2):
        sensors = plant.reset(state=state)
        np.testing.assert_allclose(sensors.joint_position[0, :4], [1.3, 1.4, 1.7, 1.8], atol=0.05)
        np.testing.assert_array_equal(sensors.joint_position[0, 4:], 0.0)
        for tick in range(20):
            sensors = plant.step(setpoints_at(tick + 20))
        assert np.abs(sensors.joint_position[0, 4:]).min() > 0.1
    assert sensors is not None
    assert sensors.camera_is_new[0] == 0.0
    assert sensors.camera_age[0] == pytest.approx(0.4)
    assert np.isfinite(sensors.values).all()
    plant.close()
    plant.close()
    assert plant.loop.phase is Phase.TORQUE_OFF


@pytest.mark.parametrize("count", [0, 2, 1.5, True])
def test_there_is_one_robot(count):
    with pytest.raises(InputError, match="expected 1"):
        make_plant("dynamixel", ROBOT, count, QUIET, hardware=RobotOptions(emulated=True))


def test_what_a_robot_cannot_do_is_refused():
    plant = robot_plant()
    for ask in (plant.truth, plant.mechanical_state):
        with pytest.raises(InputError, match="real robot"):
            ask()
    with pytest.raises(InputError, match=r"setpoints have shape \(8,\)"):
        plant.step(np.zeros(8))
    other = Parameters.nominal(ROBOT)
    other["ground.mu_x"] = 0.3
    with pytest.raises(InputError, match=r"ground.mu_x\[wheel_lf\]: parameters of a real robot cannot be set"):
        plant.reset(parameters=other)
    plant.close()


def test_options_by_hand_and_by_mapping(tmp_path):
    assert read_robot_options(None) == RobotOptions()
    assert read_robot_options("mine.yaml") == RobotOptions(hardware="mine.yaml")
    assert read_robot_options({"emulated": True, "log": str(tmp_path)}) == RobotOptions(emulated=True, log=tmp_path)
    with pytest.raises(InputError, match=r"unknown field 'emulate' \(did you mean 'emulated'"):
        read_robot_options({"emulate": True})
    with pytest.raises(InputError, match="hardware = 3"):
        read_robot_options(3)
    assert set(REAL) & set(SIMULATORS) == set()


def test_options_fit_the_backend():
    with pytest.raises(InputError, match="'mujoco' takes no hardware"):
        make_plant("mujoco", ROBOT, 1, QUIET, hardware=RobotOptions())
    with pytest.raises(InputError, match="'dynamixel' takes no forces"):
        make_plant("dynamixel", ROBOT, 1, QUIET, [object()])  # type: ignore[list-item]


def test_without_a_robot_the_port_is_named(tmp_path):
    plant = make_plant("dynamixel", ROBOT, 1, QUIET, hardware=RobotOptions(ports={"legs": str(tmp_path / "none")}))
    with pytest.raises(InputError, match="none: cannot be opened"):
        plant.reset()
    plant.close()
    with pytest.raises(InputError, match="unknown port 'arms'"):
        make_plant("dynamixel", ROBOT, 1, QUIET, hardware=RobotOptions(ports={"arms": "x"}))


# ---- environment -------------------------------------------------------------------------------------------------------


@pytest.fixture
def env():
    env = gym.make(ID, backend="dynamixel", hardware=EMULATED)
    yield env
    env.close()


def test_an_episode_on_the_robot(env):
    observation, info = env.reset(seed=3, options={"command": {"linear_velocity_x": 0.05, "yaw_rate": 0.1}})
    core, reward = env.unwrapped.core, np.nan
    assert env.observation_space.contains(observation)
    assert info["randomization"] == {}
    for _ in range(20):
        observation, reward, terminated, truncated, info = env.step(np.zeros(8, np.float32))
        assert env.observation_space.contains(observation)
        assert np.isfinite(reward)
        assert not terminated
        assert not truncated
    assert set(info) == {"reward_terms"}
    assert set(info["reward_terms"]) == {"track_yaw_rate", "action_rate", "leg_posture", "torque_saturation", "termination"}
    assert reward == pytest.approx(sum(info["reward_terms"].values()))
    assert "track_linear_velocity" in core.unmeasured
    assert {"tilt", "slip"} <= set(core.unmeasured)


def test_rewards_are_those_of_the_simulator_where_they_are_measured():
    """The same task, the same terms, on a robot and on the simulator behind it (noise of the gyroscope aside)."""
    rewards = {}
    for backend, more in (("dynamixel", {"hardware": EMULATED}), ("gibbs_appell", {"randomization": "none"})):
        core = make_core(ID, 1, {"backend": backend, **more})
        core.seed(0, 1)
        core.begin_episodes(core.everyone, {"command": {"linear_velocity_x": 0.0, "yaw_rate": 0.0}})
        for tick in range(20):
            core.step(np.r_[0.1 * np.sin(0.3 * tick + np.arange(4)), [0.0] * 4][None], core.everyone)
        rewards[backend] = dict(zip(core.task.rewards, core.scores.sums[0], strict=True))
        core.close()
    ours, theirs = rewards.values()
    assert set(ours) < set(theirs)
    for name, value in ours.items():
        assert value == pytest.approx(theirs[name], rel=0.02, abs=2e-4), name


def test_a_robot_adds_no_delay_and_no_noise_of_ours(env):
    env.reset(seed=0)
    core = env.unwrapped.core
    assert not core.pipeline.delays.any()
    assert not core.pipeline.bias.any()
    names = [column["name"] for column in core.contract()["observation"]]
    column = names.index("leg_position[leg_lf]")
    assert core.observation[0, column] == np.float32(core.plant.loop.status.position[0] - np.pi / 2)


def test_a_policy_fits_robot_and_simulator_alike(env):
    from wlr_gym.policy import check_contract

    simulator: Any = gym.make(ID)
    check_contract(simulator.unwrapped.contract(), env.unwrapped.contract(), "policy")
    simulator.close()


def test_a_stopped_robot_says_so(env):
    env.reset(seed=0)
    machine_of(env.unwrapped.core).inject("overload leg_lf")
    with pytest.raises(StoppedError, match="alert: leg_lf"):
        [env.step(np.zeros(8, np.float32)) for _ in range(20)]
    with pytest.raises(InputError, match="stopped with a fault"):
        env.reset()


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"observation": "dict"}, "no privileged observation"),
        ({"randomization": "wide"}, "a real robot is what it is"),
        ({"effects": "icy_patch"}, "a real robot is what it is"),
        ({"render_mode": "rgb_array"}, "where a real robot stands is not known"),
        ({"task": {"observations": {"camera_yaw": {}}}}, "this robot has no camera"),
        ({"hardware": {"emulate": True}}, "unknown field"),
    ],
)
def test_what_only_a_simulator_can_do_is_refused(keywords, words):
    with pytest.raises(InputError, match=words):
        gym.make(ID, **{"backend": "dynamixel", "hardware": EMULATED, **keywords})


@pytest.mark.parametrize("effects", [[], (), Patch(), None])
def test_no_effects_are_none(effects):
    assert EnvironmentOptions(backend="dynamixel", hardware=EMULATED, effects=effects).is_real


def test_a_robot_is_not_scored(env):
    from wlr_gym.policy import make_policy

    core = env.unwrapped.core
    with pytest.raises(InputError, match="no truth to score by"):
        roll_out(core, make_policy("do_nothing", core.contract()))
    assert core.plant.loop.phase is Phase.TORQUE_OFF


def test_hardware_is_for_the_robot():
    with pytest.raises(InputError, match="only for backend 'dynamixel'"):
        gym.make(ID, hardware=EMULATED)
    with pytest.raises(InputError, match="expected 1"):
        gym.make_vec(ID, num_envs=2, vectorization_mode="vector_entry_point", backend="dynamixel", hardware=EMULATED)


def test_runs_are_logged(tmp_path):
    env = gym.make(ID, backend="dynamixel", hardware={**EMULATED, "log": tmp_path})
    env.reset(seed=0)
    for _ in range(10):
        env.step(np.zeros(8, np.float32))
    env.close()
    assert len(read_run(tmp_path / "run_01.csv").table) == 10 + 30


def test_measured_truth_is_the_sensors_and_nothing_else():
    values = np.random.default_rng(0).normal(size=(1, SENSOR_LAYOUT.width))
    truth = measured_truth(Sensors(values))
    known = np.zeros(TRUTH_LAYOUT.width, bool)
    for channel, sensor in MEASURED.items():
        known[TRUTH_LAYOUT.slices[channel]] = True
        np.testing.assert_array_equal(TRUTH_LAYOUT.view(truth, channel), SENSOR_LAYOUT.view(values, sensor))
    assert np.isnan(truth[0, ~known]).all()
