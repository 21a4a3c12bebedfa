"""Terms of tasks: rewards, measures, computed observations, the controller that is one of these."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest

from studies.paper.experiments import LEG_SPEED, TESTS
from wlr_gym.base.errors import InputError
from wlr_gym.envs.tasks import load_task
from wlr_gym.envs.tasks import signals as paths
from wlr_gym.envs.tasks.compiled_terms import compile_computed, compile_scores
from wlr_gym.envs.tasks.signals import PlanarPose, Signals, true_pose
from wlr_gym.envs.tasks.task import limits_of, scales_of, succeeded
from wlr_gym.envs.tasks.terms import COMPUTED, MEASURES, REWARDS, ScalarTerm
from wlr_gym.envs.tasks.terms.observations import ComputedTerm
from wlr_gym.learning.evaluation.metrics import errors_of
from wlr_gym.learning.evaluation.rollout import Measure, make_core
from wlr_gym.policy import Policy, load_agent
from wlr_gym.robot import JOINTS, load_robot

POSTURE_COMMANDS = ("front_leg_first", "front_leg_second", "rear_leg_first", "rear_leg_second")
LINE, CURVE, CIRCLE = 0.5, 1.5, 2.5


def signals(**values: Any) -> Signals:
    return Signals(lambda name: values[name.removeprefix("command.").removeprefix("robot.").replace(".", "_")])


def error(shape, x, y, yaw: Any = 0.0, *, bend=1.0, wavelength=1.5, offset=0.0, turn=0.0) -> paths.PathError:
    given = {"path_shape": shape, "path_curvature": bend, "path_wavelength": wavelength}
    pose = PlanarPose(np.asarray(x), np.asarray(y), np.asarray(yaw))
    return paths.error_from_path(signals(**given, path_offset=offset, path_heading=turn), pose)


def test_line():
    found = error(LINE, [1.0, 1.0], [0.02, -0.03], [0.1, -0.1])
    assert found.lateral == pytest.approx([0.02, -0.03])
    assert found.heading == pytest.approx([0.1, -0.1])
    assert np.all(np.array(found.curvature) == 0.0)


def test_line_that_begins_aside_and_turned():
    distance, turn = 0.7, 0.2
    x, y = distance * math.cos(turn) - 0.01 * math.sin(turn), 0.05 + distance * math.sin(turn) + 0.01 * math.cos(turn)
    found = error(LINE, x, y, turn + 0.03, offset=0.05, turn=turn)
    assert found.lateral == pytest.approx(0.01)
    assert found.heading == pytest.approx(0.03)


@pytest.mark.parametrize("bend", [1.6, -1.6, 0.2, -0.01])
def test_circle(bend):
    """On the circle nothing is wrong; inside a left turn is left of the path."""
    angle = np.linspace(0.05, 0.8, 9)
    for inside in (0.0, 0.03, -0.04):
        radius = 1.0 / abs(bend) - inside
        x, y = radius * np.sin(angle), np.sign(bend) * (1.0 / abs(bend) - radius * np.cos(angle))
        found = error(CIRCLE, x, y, np.sign(bend) * angle, bend=bend)
        assert found.lateral == pytest.approx(np.sign(bend) * inside, abs=1e-12)
        assert found.heading == pytest.approx(0.0, abs=1e-12)
        assert np.all(found.curvature[2] == bend)


@pytest.mark.parametrize(("bend", "wavelength"), [(1.6, 1.0), (1.6, 2.0), (-1.6, 1.3), (0.1, 1.0)])
def test_s_curve(bend, wavelength):
    """Points put at a known distance to the side of a point of the curve are found there."""
    k = 2 * math.pi / wavelength
    amplitude = bend / k**2
    s = np.linspace(0.0, 2.5, 60)
    slope = amplitude * k * np.sin(k * s)
    stretch = np.sqrt(1 + slope**2)
    for side in (0.0, 0.02, -0.05):
        x, y = s - side * slope / stretch, amplitude * (1 - np.cos(k * s)) + side / stretch
        found = error(CURVE, x, y, np.arctan(slope) + 0.1, bend=bend, wavelength=wavelength)
        assert found.lateral == pytest.approx(side, abs=2e-6)
        assert found.heading == pytest.approx(0.1, abs=1e-4)
        assert found.curvature[0] == pytest.approx(bend * np.cos(k * s) / stretch**3, abs=1e-3)
    ahead = error(CURVE, 0.0, 0.0, bend=bend, wavelength=wavelength).curvature[1]
    assert ahead == pytest.approx(bend * math.cos(k * 0.1), rel=0.05)


def test_paths_can_be_driven():
    """Wheels that turn the robot as sharply as any path asks stay below their no-load speed (with the slip skids need)."""
    robot = load_robot()
    terms = load_task("path", robot).config.commands.terms
    speed, bend = terms["linear_velocity_x"][1], terms["path_curvature"][1]
    hip = robot.hip_position
    rim = speed + speed * bend * (hip.y + hip.x**2 / hip.y)
    assert rim / robot.wheel.radius < 0.9 * robot.servo.wheel.no_load_speed


def sweep(time, first, second, rate):
    given = {
        "front_leg_first": first[0],
        "front_leg_second": second[0],
        "rear_leg_first": first[1],
        "rear_leg_second": second[1],
    }
    home = load_robot().home.leg_angle
    found = paths.leg_references(signals(**given, leg_rate=rate, time=time, home_leg_angle=home))
    return np.array([angle for angle, _ in found]), np.array([rate for _, rate in found])


@pytest.mark.parametrize("name", TESTS)
def test_the_papers_tests_are_among_the_sweeps(name):
    test = TESTS[name]
    task = load_task("posture", load_robot())
    terms = task.config.commands.terms
    for limits in (terms["front_leg_first"], terms["rear_leg_second"]):
        assert limits == pytest.approx((math.radians(30), math.radians(150)), abs=1e-4)
    assert terms["leg_rate"][0] < LEG_SPEED < terms["leg_rate"][1]
    first, second = np.repeat(test.start, 2), np.repeat(test.end, 2)
    begins = paths.SWEEP_BEGINS
    assert sweep(begins, test.start, test.end, LEG_SPEED)[0] == pytest.approx(first)
    angle, rate = sweep(begins + 1.0, test.start, test.end, LEG_SPEED)
    assert angle == pytest.approx(first + np.sign(second - first) * LEG_SPEED)
    assert rate == pytest.approx(np.sign(second - first) * LEG_SPEED)
    angle, rate = sweep(task.config.episode_length, test.start, test.end, LEG_SPEED)
    assert angle == pytest.approx(second)
    assert rate == pytest.approx(0.0)


def test_leg_rates_are_the_slopes_of_the_leg_angles():
    step = 1e-6
    for time in (0.5, 2.9, 3.5, 4.5, 6.0, 15.0):
        angle, rate = sweep(time, (0.6, 2.5), (2.4, 1.0), 0.4)
        later, _ = sweep(time + step, (0.6, 2.5), (2.4, 1.0), 0.4)
        assert (later - angle) / step == pytest.approx(rate, abs=1e-5)


def test_climbing_ends_when_its_time_is_over():
    for time, speed in ((0.0, 0.0), (0.3, 0.03), (0.5, 0.05), (7.0, 0.05), (7.2, 0.03), (7.5, 0.0), (9.0, 0.0)):
        assert paths.climb_speed(signals(climb_speed=0.05, climb_time=7.0, time=time)) == pytest.approx(speed, abs=1e-12)


def test_motion_is_seen_from_the_start():
    """A robot that stood at (2, 1) turned by 2 rad and drove 0.5 m ahead and 0.1 m to its left."""
    yaw0, yaw = 2.0, 2.0 + 1.5
    values = {"start[x]": 2.0, "start[y]": 1.0, "start[yaw]": yaw0}
    values["truth.position[x]"] = 2.0 + 0.5 * math.cos(yaw0) - 0.1 * math.sin(yaw0)
    values["truth.position[y]"] = 1.0 + 0.5 * math.sin(yaw0) + 0.1 * math.cos(yaw0)
    values |= {"truth.quaternion[w]": math.cos(yaw / 2), "truth.quaternion[z]": math.sin(yaw / 2)}
    pose = true_pose(Signals(lambda name: values.get(name, 0.0)))
    assert (pose.x, pose.y, pose.yaw) == pytest.approx((0.5, 0.1, 1.5))


def test_success_is_staying_within_the_limits_to_the_end():
    config = load_task(
        "velocity", load_robot(), {"success": {"velocity_error": {"rms": 0.1}, "yaw_rate_error": {"rms": None, "max": 1.0}}}
    ).config
    assert list(config.measures)[:2] == ["velocity_error", "yaw_rate_error"]
    measures = np.zeros((4, 5, len(config.measures)))
    active = np.ones((4, 5), bool)
    measures[0, 1, 0] = 0.3  # rms 0.15
    measures[0, 2, 1] = -1.1
    measures[:, 3, 0] = -0.09
    measures[3, 4, :] = 9.0
    active[3, 4] = False  # over by then
    fell = np.zeros(5, bool)
    kept = [Measure(name, "", "", max=0.0) for name in config.measures]  # all kinds are asked for
    limits, errors = limits_of(config), errors_of(kept, measures, active)
    assert list(limits) == [("velocity_error", "rms"), ("yaw_rate_error", "max")]
    assert succeeded(limits, errors, fell).tolist() == [True, False, False, True, True]
    fell[0] = True
    assert not succeeded(limits, errors, fell)[0]


@pytest.mark.parametrize(
    ("name", "changes", "expected"),
    [
        ("velocity", {"measures": {"path_lateral_error": {}}}, "needs the command 'path_curvature'"),
        ("velocity", {"observations": {"leg_reference": {}}}, "needs the command 'front_leg_first'"),
        ("velocity", {"rewards": {"track_climb_speed": {"weight": 1.0}}}, "needs the command 'climb_speed'"),
        ("path", {"success": {"path_lateral_eror": {"rms": 0.1}}}, "did you mean 'path_lateral_error'"),
        ("path", {"success": {"path_lateral_error": {"rms": 0.0}}}, "path_lateral_error.rms"),
        ("velocity", {"measures": {"velocity_eror": {}}}, "did you mean 'velocity_error'"),
        ("velocity", {"commands": {"ramp": {"yaw": 1.0}}}, "did you mean 'yaw_rate'"),
        ("path", {"commands": {"terms": {"path_wavelength": [0.0, 1.0]}}}, r"path_wavelength = \[0.0, 1.0\]: expected 0.1 m"),
        ("velocity", {"curriculum": {"commands": {"start": 0.0, "steps": 1}}}, "curriculum.commands.start"),
        ("velocity", {"observations": {"estimated_slip": {}}}, "did you mean 'estimated_slip"),
    ],
)
def test_terms_that_cannot_work_are_refused(name, changes, expected):
    with pytest.raises(InputError, match=expected):
        load_task(name, load_robot(), changes)


def still(given: dict[str, float]) -> Signals:
    """Signals of a robot that stands where it started, legs at home, but for those given."""
    home = load_robot().home.leg_angle
    legs = ("truth.joint_position[leg_{}]", ("lf", "rf", "lr", "rr")), ("command.{}", POSTURE_COMMANDS)
    table = {pattern.format(name): home for pattern, names in legs for name in names}
    table |= {"truth.quaternion[w]": 1.0, "robot.home.leg_angle": home, "time": 3.5, **given}
    return Signals(lambda signal: table.get(signal, 0.0))


def cost(name: str, given: dict[str, float], **parameters: float) -> float:
    return float(REWARDS[name].function(still(given), **parameters))


def test_measures_by_hand():
    """What is too much is positive: speed, turning and aside to the left."""

    def measure(name: str, given: dict[str, float]) -> float:
        return float(MEASURES[name].function(still(given)))

    home, ahead = load_robot().home.leg_angle, {"truth.linear_velocity_in_body[x]": 0.07}
    assert measure("velocity_error", ahead | {"command.linear_velocity_x": 0.1}) == pytest.approx(-0.03)
    assert measure("climb_speed_error", ahead) == pytest.approx(0.07)
    turning = {"truth.angular_velocity_in_body[z]": 0.2, "command.yaw_rate": -0.1}
    assert measure("yaw_rate_error", turning) == pytest.approx(0.3)
    aside = {"truth.position[y]": 0.02, "truth.quaternion[w]": math.cos(0.05), "truth.quaternion[z]": math.sin(0.05)}
    assert measure("lateral_error", aside) == pytest.approx(0.02)
    assert measure("heading_error", aside) == pytest.approx(0.1)
    on_line = aside | {"command.path_wavelength": 1.0, "command.path_offset": 0.05}
    assert measure("path_lateral_error", on_line) == pytest.approx(-0.03)
    assert measure("path_heading_error", on_line) == pytest.approx(0.1)
    bent = {"truth.joint_position[leg_lf]": home + 0.2, "truth.joint_position[leg_rr]": home - 0.2}
    assert measure("leg_error", bent) == pytest.approx(0.2 / math.sqrt(2.0))
    slip = {"truth.slip_displacement[wheel_lf,x]": 0.003, "truth.slip_displacement[wheel_lf,y]": -0.004}
    assert measure("slip_speed", slip | {"task.control_period": 0.02}) == pytest.approx(0.005 / 0.02 / 4)


def test_costs_by_hand():
    ahead, turning = "truth.linear_velocity_in_body[x]", "truth.angular_velocity_in_body[z]"
    assert cost("velocity_error", {ahead: -0.04, turning: 0.03}) == pytest.approx(2.0 + 0.5)
    assert cost("velocity_error", {"command.linear_velocity_x": 0.1, ahead: 0.1}) == 0.0
    aside = {"truth.position[y]": -0.02}
    assert cost("course_error", aside, lateral=0.01) == pytest.approx(2.0 / 1.25)
    assert cost("course_error", {"truth.position[y]": 1e6}) == pytest.approx(8.0, rel=1e-3)
    assert cost("path_error", aside | {"command.path_wavelength": 1.0}, lateral=0.02) == pytest.approx(1.0 / 1.125)
    bent = {"truth.joint_position[leg_lf]": load_robot().home.leg_angle + 0.2}
    assert cost("leg_error", bent, scale=0.1) == pytest.approx(0.5)
    assert cost("climb_speed_error", {ahead: -0.03}, scale=0.015) == pytest.approx(2.0)
    climbing = {"command.climb_speed": 0.05, "command.climb_time": 9.0, ahead: 0.05}
    assert cost("track_climb_speed", climbing) == pytest.approx(1.0)
    assert cost("track_climb_speed", climbing | {ahead: 0.02}, width=0.03) == pytest.approx(math.exp(-1.0))


def test_large_errors_cost_the_most():
    """Ten times the error, a hundred times the cost; beyond five scales no more."""
    errors = [{"truth.linear_velocity_in_body[x]": v} for v in (0.002, 0.02, 0.1, 1.0)]
    costs = [cost("squared_velocity_error", error) for error in errors]
    assert costs == pytest.approx([0.01, 1.0, 25.0, 25.0])
    turning = {"command.yaw_rate": 0.06, "truth.angular_velocity_in_body[z]": -0.06}
    assert cost("squared_velocity_error", turning) == pytest.approx(4.0)


def test_what_the_observer_gets_wrong_costs():
    wrong = {"estimate.linear_velocity_in_body[x]": 0.05, "truth.linear_velocity_in_body[x]": 0.06}
    assert cost("estimate_error", wrong, scale=0.01) == pytest.approx(1.0 / 1.125)
    assert cost("estimate_error", {}, scale=0.01) == 0.0


def test_a_scale_takes_the_place_of_the_limit_in_the_tracking_error_only():
    changes = {"success": {"velocity_error": {"rms": 0.1, "scale": 0.4}, "yaw_rate_error": None}}
    config = load_task("velocity", load_robot(), changes).config
    assert limits_of(config) == {("velocity_error", "rms"): 0.1}
    assert scales_of(config) == {("velocity_error", "rms"): 0.4}
    largest = {"velocity_error": {"rms": None, "max": 0.2, "scale": 0.4}}  # a scale of no limit: nothing
    config = load_task("velocity", load_robot(), {"success": changes["success"] | largest}).config
    assert scales_of(config) == {("velocity_error", "max"): 0.2}


@pytest.mark.parametrize(
    ("law", "words"),
    [
        (lambda v: v**2, "x * x for x**2"),
        (abs, "ops.absolute for abs"),
        (np.exp, "ops.exp for np.exp"),
        (math.exp, "ops.exp for np.exp"),
        (lambda v: 1.0 if v > 0 else 0.0, "ops.where_positive for if"),
        (lambda v: 1.0 if v else 0.0, "ops.where_positive for if"),
        (lambda v: [v], " returned list: expected a single number"),
        (lambda v: None, " returned NoneType: expected a single number"),
    ],
    ids=["power", "abs", "numpy", "math", "comparison", "truth", "list", "nothing"],
)
def test_mistakes_in_a_reward_of_ones_own_are_named(monkeypatch, law, words):
    monkeypatch.setitem(REWARDS, "own", ScalarTerm("own", lambda s: law(s.truth("position")[0]), {}, {}, ""))
    task = load_task("velocity", overrides={"rewards": {"own": {"weight": 1.0}}})
    with pytest.raises(InputError, match=f"^reward 'own'.*{re.escape(words)}"):
        compile_scores(task)


@pytest.mark.parametrize(("count", "got"), [(0, "0 of 1 values"), (2, "2 of 1 values"), (None, "no list")])
def test_a_computed_term_returns_a_list_of_its_elements(monkeypatch, count, got):
    def own(signals):
        return signals.action[0] if count is None else signals.action[:count]

    monkeypatch.setitem(COMPUTED, "speed_command", ComputedTerm(own, ("speed_command",)))
    task = load_task("velocity", overrides={"observations": {"speed_command": {}}})
    message = f"observation term 'speed_command' returned {got}: expected [speed_command]"
    with pytest.raises(InputError, match=re.escape(message)):
        compile_computed(task)


# ---- the controller that the environment computes is the agent ``slip_compensating``: two implementations, one law ---


PROMPT = {"joints": {"delay": [0.0, 0.0]}, "imu": {"delay": [0.0, 0.0]}}
#: Every gain at work, none as it ships.
GAINS = {
    "steering": 1.7, "yaw_rate_p": 3.0, "yaw_rate_i": 4.0, "velocity_p": 2.0, "velocity_i": 3.0, "lateral": 3.0, "heading": 1.5,
    "uphill": 0.05, "legs_inward": 0.1, "lean_time": 0.5, "leg_i": 0.7,
    "integral_limit": 0.05, "slip_limit": 0.05, "load_shift": 2.0, "load_shift_time": 0.3,
    "warp": 0.04, "warp_rise": 300.0, "warp_reach": 2.0, "forward_lead": 0.1, "turn_lead": 0.07,
}  # fmt: skip
TASKS = ("velocity", "path", "posture", "slope")


class Controlled:
    """Robots whose task tells them the action of the controller, and its memory, with seeds 0, 1, ..."""

    def __init__(self, task: str, gains=GAINS, count=4, action=None, options=None, **keywords) -> None:
        term, warp = f"{task}_controller", f"{task}_memory"
        gains = gains | ({"warp": 0.0, "forward_lead": 0.0, "turn_lead": 0.0} if task == "posture" else {})
        terms = {term: {}} | ({warp: {}} if gains.get("warp") else {})
        changes = {"latency": PROMPT, "controller": gains, "observations": terms, "action": action or {}}
        self.core = make_core(f"WLR-{task.title()}-v0", count, {"task": changes, **keywords})
        self._columns = [k for k, column in enumerate(self.core.task.policy) if column.term == term]
        self.begin(options)

    def begin(self, options=None) -> None:
        for row in range(self.core.count):
            self.core.seed(row, row)
        self.core.begin_episodes(self.core.everyone, options)

    @property
    def action(self) -> np.ndarray:
        return self.core.observation[:, self._columns[: len(JOINTS)]]

    @property
    def leaned(self) -> np.ndarray:
        """Leg setpoints from home, rad."""
        return self.action[:, :4] * self.core.task.actions[0].scale

    @property
    def memory(self) -> np.ndarray:
        return self.core.observation[:, self._columns[len(JOINTS) :]]

    def step(self, action=None) -> None:
        self.core.step(self.action.copy() if action is None else action, self.core.everyone)


def agent_of(core, gains=GAINS) -> Policy:
    policy = load_agent("slip_compensating").make_policy(core.contract(), gains)
    policy.reset(core.everyone)
    return policy


@pytest.mark.parametrize("task", TASKS)
def test_action_is_that_of_the_agent(task):
    robots = Controlled(task, randomization="split")
    agent, seen = agent_of(robots.core, robots.core.contract()["controller"]), []
    for _ in range(150):
        seen.append(agent.act(robots.core.observation))
        np.testing.assert_allclose(robots.action, seen[-1], atol=2e-6)
        robots.step(seen[-1])
    assert np.ptp(seen, axis=0).max() > 0.1


@pytest.mark.parametrize(
    "changes",
    [
        {"lean_time": 0.0},
        {"legs_inward": -0.1},
        {"legs_inward": 0.0},
        {"legs_inward": 0.35, "load_shift": 0.0},
        {"legs_inward": 0.2},
    ],
    ids=["at once", "outward", "home", "beyond the action", "beyond the action with load shift"],
)
def test_legs_of_agent_and_task_agree_whatever_the_gains(changes):
    """Also where the action does not reach as far as the legs are to go, and after one robot alone begins anew."""
    robots = Controlled("velocity", GAINS | changes, action={"leg_scale": 0.15})
    core, second = robots.core, np.arange(4) == 1
    agent = agent_of(core, GAINS | changes)
    for tick in range(90):
        actions = agent.act(core.observation)
        np.testing.assert_allclose(robots.action, actions, atol=2e-6)
        robots.step(actions)
        if tick == 40:
            core.begin_episodes(second)
            agent.reset(second)


def test_memory_is_of_the_episode_and_in_snapshots():
    robots = Controlled("velocity")
    first = robots.memory.copy()
    for _ in range(40):
        robots.step()
    assert (np.abs(robots.memory) > np.abs(first)).any()
    robots.begin()
    np.testing.assert_array_equal(robots.memory, first)


def test_gains_are_data():
    """Another gain compiles nothing and acts."""
    command = {"command": {"linear_velocity_x": 0.0, "yaw_rate": 0.3}}
    robots = Controlled("velocity", {"steering": 0.0}, options=command)
    np.testing.assert_allclose(robots.action, 0.0, atol=1e-6)
    assert robots.core.contract()["controller"]["steering"] == 0.0


def test_controller_needs_gains():
    with pytest.raises(InputError, match=r"observation term 'velocity_controller' needs 'controller'"):
        load_task("velocity", None, {"observations": {"velocity_controller": {}}})
    with pytest.raises(InputError, match="yaw_rate_p"):
        load_task("velocity", None, {"controller": {"yaw_rate_pp": 1.0}})


def test_memory_that_a_gain_needs():
    terms = {"velocity_controller": {}}
    with pytest.raises(InputError, match=r"controller.turn_lead is not 0: 'velocity_controller' needs .*'velocity_memory'"):
        load_task("velocity", None, {"controller": {"turn_lead": 0.1}, "observations": terms})
    with pytest.raises(InputError, match=r"controller.warp is not 0: 'posture_controller' cannot do it: its legs sweep"):
        load_task("posture", None, {"controller": {"warp": 0.1}, "observations": {"posture_controller": {}}})


def test_controller_of_another_task_is_refused():
    with pytest.raises(InputError, match=r"'path_controller' needs the command 'path_"):
        load_task("velocity", None, {"controller": {}, "observations": {"path_controller": {}}})


LEAN = {"legs_inward": 0.2, "lean_time": 1.0}


def test_legs_reach_under_the_body_evenly_from_the_start():
    """As the gain says: a tenth of the way per 0.1 s of 1 s, front and rear legs towards each other, and no further."""
    robots, leaned = Controlled("velocity", LEAN, 1, randomization="none"), []
    for _ in range(60):
        leaned.append(robots.leaned[0])
        robots.step(np.zeros((1, 8), np.float32))
    wanted = 0.2 * np.minimum(np.arange(1, 61) * 0.02, 1.0)
    np.testing.assert_allclose(np.abs(leaned), wanted[:, None].repeat(4, axis=1), atol=1e-6)
    assert (np.sign(leaned[-1]) == [1, 1, -1, -1]).all() or (np.sign(leaned[-1]) == [1, -1, 1, -1]).all()


def test_legs_are_not_thrown_from_where_an_episode_begins():
    """The first leg setpoints are where the legs stand; on they go at the rate of the gain."""
    start = {"name": "crooked", "base": "none", "initial_state": {"leg_angle": 0.1}}
    robots = Controlled("velocity", LEAN, randomization=start)
    stand, sent = robots.core.state.joint_position[:, :4] - robots.core.task.robot.home.leg_angle, []
    for _ in range(100):
        sent.append(robots.leaned)
        robots.step()
    assert np.ptp(stand) > 0.05
    assert np.abs(sent[0] - stand).max() < 0.2 * 0.02 + 0.002  # the encoder's resolution
    assert np.abs(np.diff(sent, axis=0)).max() < 0.2 * 0.02 + 1e-6
    np.testing.assert_allclose(np.abs(sent[-1]), 0.2, atol=1e-6)


def test_legs_that_sweep_are_held_against_loads():
    """With the integral the servos' sag under load goes from the legs' angles; without it, it stays."""
    errors = []
    for gain in (0.0, 2.0):
        gains = GAINS | {"legs_inward": 0.0, "load_shift": 0.0, "leg_i": gain}
        robots = Controlled("posture", gains, randomization="none")
        for _ in range(190):
            robots.step()
        errors.append(abs(robots.core.measures[3, robots.core.task.measures.index("leg_error")]))
    assert errors[1] < 0.5 * errors[0]
