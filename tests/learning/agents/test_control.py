"""Hand-written controllers do what their formulas say, and the search for their gains finds what is known to be best."""

import math

import numpy as np
import pytest

from studies.paper import corrected
from studies.paper.quantities import PaperConstants, State
from wlr_gym.base.errors import InputError
from wlr_gym.learning import tuning
from wlr_gym.learning.evaluation.card import score
from wlr_gym.learning.evaluation.rollout import make_core, roll_out
from wlr_gym.learning.tuning import tracking_score
from wlr_gym.policy import Training, load_agent, load_policy, make_policy, read_contract
from wlr_gym.policy.control import PidConfig, task_settings
from wlr_gym.robot import load_robot

ENVIRONMENT = "WLR-Velocity-v0"
LEFT, RIGHT = [4, 6], [5, 7]
ROBOT = load_robot()
MASSLESS_LEGS = PaperConstants(m_l=0.0)


@pytest.fixture(scope="module")
def contracts():
    found = {}
    for task in ("Velocity", "Path", "Posture", "Slope"):
        core = make_core(f"WLR-{task}-v0", 1, {})
        found[task] = core.contract()
        core.close()
    return found


def observation(contract, readings):
    """One observation in which the named readings have the given values (SI), all else zero."""
    names = [column["name"] for column in contract["observation"]]
    row = np.array([[-column["scale"] * column["offset"] for column in contract["observation"]]], np.float32)
    for name, value in readings.items():
        column = contract["observation"][names.index(name)]
        row[0, names.index(name)] = column["scale"] * (value - column["offset"])
    return row


def setpoints(contract, action):
    """Leg angles (rad) and wheel rates (rad/s) of an action (8,)."""
    return np.array(
        [column["centre"] + column["scale"] * value for column, value in zip(contract["action"], action, strict=True)]
    )


def act(contract, agent, settings, readings):
    """Setpoints (8,) of a new controller for one observation."""
    policy = load_agent(agent).make_policy(contract, settings)
    return setpoints(contract, policy.act(observation(contract, readings))[0])


def test_straight_ahead_the_wheels_roll_at_the_commanded_speed(contracts):
    goal = act(contracts["Velocity"], "constant_command", {}, {"command[linear_velocity_x]": 0.1})
    np.testing.assert_allclose(goal[4:] * ROBOT.wheel.radius, 0.1, rtol=1e-5)
    np.testing.assert_allclose(goal[:4], ROBOT.home.leg_angle, atol=1e-6)


def test_the_newest_reading_of_a_history_counts():
    core = make_core(ENVIRONMENT, 1, {"task": {"observations": {"command": {"history": 3}}}})
    contract = core.contract()
    core.close()
    goal = act(contract, "constant_command", {}, {"command[linear_velocity_x]": 0.1})  # the first of that name
    np.testing.assert_allclose(goal[4:] * ROBOT.wheel.radius, 0.1, rtol=1e-5)


def test_a_left_turn_drives_the_right_wheels_faster(contracts):
    goal = act(contracts["Velocity"], "constant_command", {"steering": 2.0}, {"command[yaw_rate]": 0.3})
    speed = 2.0 * 0.3 * ROBOT.hip_position.y / ROBOT.wheel.radius
    np.testing.assert_allclose(goal[RIGHT], speed, rtol=1e-5)
    np.testing.assert_allclose(goal[LEFT], -speed, rtol=1e-5)


def test_too_slow_a_turn_is_pushed_in_proportion_and_by_the_integral(contracts):
    contract, wanted = contracts["Velocity"], {"command[yaw_rate]": 0.3}
    spread = {}
    for gyro in (0.1, 0.3):
        goal = act(contract, "pid", {"yaw_rate_p": 2.0}, wanted | {"gyro[z]": gyro})
        spread[gyro] = (goal[5] - goal[4]) * ROBOT.wheel.radius / (2 * ROBOT.hip_position.y)
    np.testing.assert_allclose(spread[0.1] - spread[0.3], 2.0 * 0.2, rtol=1e-4)
    policy = load_agent("pid").make_policy(contract, {"yaw_rate_i": 5.0, "integral_limit": 0.1})
    row = observation(contract, wanted | {"gyro[z]": 0.1})
    series = (
        np.array([setpoints(contract, policy.act(row)[0])[5] for _ in range(10)]) * ROBOT.wheel.radius / ROBOT.hip_position.y
    )
    np.testing.assert_allclose(np.diff(series)[:4], 5.0 * 0.2 * 0.02, rtol=1e-3)
    np.testing.assert_allclose(series[-1], 0.3 + 0.1, rtol=1e-4)
    policy.reset(np.ones(1, bool))
    np.testing.assert_allclose(
        setpoints(contract, policy.act(row)[0])[5] * ROBOT.wheel.radius / ROBOT.hip_position.y, series[0]
    )


def test_a_reset_forgets_the_robots_it_names_only(contracts):
    contract = contracts["Velocity"]
    policy = load_agent("pid").make_policy(contract, {"yaw_rate_i": 5.0})
    rows = np.repeat(observation(contract, {"command[yaw_rate]": 0.3}), 2, axis=0)
    first = policy.act(rows)
    policy.reset(np.array([True, False]))
    second = policy.act(rows)
    assert np.array_equal(second[0], first[0])
    assert not np.array_equal(second[1], first[1])


def test_a_path_to_the_right_is_steered_to(contracts):
    gains = {"lateral": 2.0, "heading": 1.0}
    readings = {"speed_command": 0.1, "path_error[lateral]": 0.05, "path_error[heading]": 0.2, "path_curvature[0 m]": 1.0}
    goal = act(contracts["Path"], "constant_command", gains, readings)
    turn = (goal[5] - goal[4]) * ROBOT.wheel.radius / (2 * ROBOT.hip_position.y)
    np.testing.assert_allclose(turn, 1.0 * 0.1 - 2.0 * 0.05 - 1.0 * 0.2, rtol=1e-4)


def test_swinging_legs_are_made_up_for(contracts):
    """All legs swing alike and the body is to stand still: each wheel must roll along with its own leg."""
    rate, offset = 0.4, 0.3
    readings = {f"leg_reference[{leg}]": offset for leg in ("leg_lf", "leg_rf", "leg_lr", "leg_rr")}
    readings |= {f"leg_reference_rate[{leg}]": rate for leg in ("leg_lf", "leg_rf", "leg_lr", "leg_rr")}
    goal = act(contracts["Posture"], "constant_command", {}, readings)
    angle = ROBOT.home.leg_angle + offset
    np.testing.assert_allclose(goal[:4], angle, rtol=1e-5)
    # centre of the wheel over the floor = - l sin(angle) rate = radius * absolute spin
    centre = -ROBOT.leg.length * math.sin(angle) * rate
    np.testing.assert_allclose(ROBOT.wheel.radius * (goal[4:] + rate), centre, rtol=1e-4)


def test_estimated_velocity_closes_the_loop(contracts):
    readings = {"command[linear_velocity_x]": 0.1, "estimated_linear_velocity_in_body[x]": 0.06}
    settings = {"velocity_p": 0.5, "slip_limit": 1.0}
    goal = act(contracts["Velocity"], "slip_compensating", settings, readings)
    np.testing.assert_allclose(goal[4:] * ROBOT.wheel.radius, 0.1 + 0.5 * 0.04, rtol=1e-4)


def test_wheel_slip_is_limited(contracts):
    readings = {"command[linear_velocity_x]": 0.1, "estimated_linear_velocity_in_body[x]": 0.02}
    goal = act(contracts["Velocity"], "slip_compensating", {"slip_limit": 0.03}, readings)
    np.testing.assert_allclose(goal[4:] * ROBOT.wheel.radius, 0.02 + 0.03, rtol=1e-4)


@pytest.mark.parametrize("slipping", ["front", "rear"])
def test_load_moves_to_the_axle_that_slips_less(contracts, slipping):
    """By the paper's corrected equations of the normal forces, at rest, with the lean the controller asks for."""
    contract = contracts["Velocity"]
    wheels = {"front": ("wheel_lf", "wheel_rf"), "rear": ("wheel_lr", "wheel_rr")}[slipping]
    readings = {f"estimated_slip_velocity[{wheel},x]": -0.1 for wheel in wheels}
    settings = {"load_shift": 1.0, "load_shift_time": 0.02, "slip_limit": 1.0}
    goal = act(contract, "slip_compensating", settings, readings)
    np.testing.assert_allclose(goal[:4], goal[0])
    posture = State(alpha=float(goal[0]), beta=float(goal[0]))
    front = corrected.eq16_normal_force_in_front(MASSLESS_LEGS, posture)
    rear = corrected.eq17_normal_force_behind(MASSLESS_LEGS, posture)
    assert front / (front + rear) == pytest.approx(0.4 if slipping == "front" else 0.6, abs=1e-4)


def test_the_difference_of_the_axles_slip_is_smoothed_with_its_time_constant(contracts):
    """Step response of a first-order low-pass, once per tick, seen in the share of the load the lean stands for."""
    contract, time, period = contracts["Velocity"], 0.5, 0.02
    policy = load_agent("slip_compensating").make_policy(contract, {"load_shift": 1.0, "load_shift_time": time})
    row = observation(contract, {"estimated_slip_velocity[wheel_lf,x]": 0.1, "estimated_slip_velocity[wheel_rf,x]": 0.1})
    lean = np.array([setpoints(contract, policy.act(row)[0])[0] for _ in range(25)]) - ROBOT.home.leg_angle
    shift = np.sin(lean) * ROBOT.leg.length / (2 * ROBOT.hip_position.x)
    expected = -0.1 * (1.0 - (1.0 - period / time) ** np.arange(1, 26))
    np.testing.assert_allclose(shift, expected, atol=1e-5)


def test_an_observation_that_is_needed_is_named(contracts):
    blind = {**contracts["Velocity"]}
    blind["observation"] = [column for column in blind["observation"] if not column["name"].startswith("estimated_")]
    with pytest.raises(InputError, match=r"slip_compensating' needs.*estimated_linear_velocity_in_body"):
        make_policy("slip_compensating", blind)


def test_another_robot_is_refused(contracts):
    other = {**contracts["Velocity"], "robot": {"name": "other", "hash": "0"}}
    with pytest.raises(InputError, match="robot 'wlr-nominal' is not the environment's"):
        make_policy("pid", other)


def test_search_finds_what_scores_better_and_is_reproducible(tmp_path):
    """From gains that turn far too little; four short episodes, two settings."""
    settings = {
        "steering": 0.5,
        "environment": {"episode_length": 1.0, "randomization": "none"},
        "search": {"steps": {"steering": 1.0, "yaw_rate_p": 1.0}, "rounds": 2, "episodes": 4},
    }
    scores = []
    for name in ("first", "second"):
        folder = load_agent("pid").train(Training(ENVIRONMENT, tmp_path / name, settings, progress=False))
        content = read_contract(folder)
        scores.append(content["training"]["score"])
    assert scores[0] == scores[1]
    assert content["config"]["steering"] > 1.0
    none = load_agent("pid").train(
        Training(ENVIRONMENT, tmp_path / "none", settings | {"search": {"steps": {}, "episodes": 4}}, progress=False)
    )
    assert read_contract(none)["training"]["score"] > 1.2 * scores[0]
    late = {
        "velocity": {
            "base": "none",
            "events": {
                "command_delay": {
                    "parameters": ["command.delay"],
                    "distribution": "uniform",
                    "operation": "set",
                    "low": 0.1,
                    "high": 0.1,
                }
            },
        }
    }
    late = settings | {"search": {"steps": {}, "episodes": 4, "randomization": late}}
    late = load_agent("pid").train(Training(ENVIRONMENT, tmp_path / "late", late, progress=False))
    assert read_contract(late)["training"]["score"] > read_contract(none)["training"]["score"]
    policy = load_policy(folder, content["environment"])
    assert policy.config.steering == content["config"]["steering"]  # type: ignore[attr-defined]


def test_a_search_scores_as_the_card_does():
    limits = {"velocity_error": {"rms": 0.02, "max": 0.03}, "yaw_rate_error": {"max": 0.1}}
    core = make_core(ENVIRONMENT, 3, {"episode_length": 1.0, "task": {"success": limits}})
    policy = make_policy("pid", core.contract())
    found = tracking_score(core, policy, 5)
    expected = score(roll_out(core, policy, 5))["tracking_error"].mean
    core.close()
    assert found == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"search": {"steps": {"stering": 0.4}}}, "agent 'pid': search.steps: unknown setting 'stering'.*'steering'"),
        ({"search": {"steps": {"robot": 0.4}}}, "unknown setting 'robot'"),
        ({"search": {"episodes": 1}, "environment": {"task": {"success": None}}}, "limits of a task's success, and 'velocity'"),
    ],
)
def test_what_cannot_be_searched_is_refused_before_anything_is_written(tmp_path, settings, message):
    with pytest.raises(InputError, match=message):
        load_agent("pid").train(Training(ENVIRONMENT, tmp_path / "run", settings, progress=False))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("given", "named"),
    [({"init": "velocity_blind"}, r"'init' \(--init\)"), ({"max_seconds": 60.0}, r"'max_seconds' \(--max-minutes\)")],
)
def test_what_a_search_does_not_know_is_refused(tmp_path, given, named):
    with pytest.raises(InputError, match=f"leave out {named}"):
        load_agent("pid").train(Training(ENVIRONMENT, tmp_path / "run", {}, **given))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("is_there", [False, True])
def test_an_interrupted_search_leaves_nothing_and_is_begun_anew(tmp_path, monkeypatch, is_there):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(tuning, "tracking_score", interrupted)
    folder = tmp_path / "run"
    if is_there:
        folder.mkdir()
    with pytest.raises(KeyboardInterrupt):
        load_agent("pid").train(Training(ENVIRONMENT, folder, {"search": {"episodes": 1}}, progress=False))
    assert folder.exists() == is_there
    assert list(tmp_path.rglob("*.yaml")) == []


def test_a_search_tells_how_far_it_is():
    core = make_core(ENVIRONMENT, 2, {"episode_length": 0.2})
    settings = {"search": {"rounds": 2, "episodes": 2, "steps": {"steering": 0.4, "yaw_rate_p": 1.0}}}
    told = []
    start = task_settings(PidConfig, core.contract(), settings, "pid")
    tuning.search(core, load_agent("pid").make_policy, start, lambda *one: told.append(one))
    core.close()
    texts, shares = zip(*told, strict=True)
    assert shares == (0.0, 0.0, 0.25, 0.5, 0.75)
    assert texts[0] == "searching"
    assert texts[-1].endswith("now yaw_rate_p")


def test_search_is_not_resumed(tmp_path):
    with pytest.raises(InputError, match="cannot be resumed"):
        load_agent("pid").train(Training(ENVIRONMENT, tmp_path, {}, resume=True))
