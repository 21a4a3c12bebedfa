"""Randomisation: intended distributions, right operation from nominal, streams that do not disturb each other."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from velocity import uniform

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import data_directory
from wlr_gym.envs.tasks import load_randomization
from wlr_gym.envs.tasks.entries import tolerance_of
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

SEEDS = np.arange(4000, dtype=np.uint64)
MASS = uniform("body.mass", 2.0, 3.0)


@pytest.fixture(scope="module")
def robot():
    return load_robot()


def draw(robot, seeds: Any = SEEDS, startup: Any = None, **events: Any):
    randomization = load_randomization({"events": events}, robot)
    return randomization.parameters(seeds if startup is None else startup, seeds)


def test_uniform_set_is_shared_or_per_label_as_asked(robot):
    friction = uniform("ground.mu_x ground.mu_y", 0.3, 0.9)
    shared = draw(robot, floor=friction)
    assert np.all(shared["ground.mu_x"] == shared["ground.mu_x"][:, :1])
    assert np.array_equal(shared["ground.mu_x"], shared["ground.mu_y"])
    assert shared["ground.mu_x"].mean() == pytest.approx(0.6, abs=0.01)
    assert shared["ground.mu_x"].std() == pytest.approx(0.6 / np.sqrt(12), rel=0.05)
    by_wheel = draw(robot, floor={**friction, "per": "label"})
    assert np.array_equal(by_wheel["ground.mu_x"], by_wheel["ground.mu_y"])
    assert abs(np.corrcoef(by_wheel["ground.mu_x"][:, 0], by_wheel["ground.mu_x"][:, 1])[0, 1]) < 0.05
    independent = draw(robot, floor={**friction, "per": "element"})
    assert abs(np.corrcoef(independent["ground.mu_x"][:, 0], independent["ground.mu_y"][:, 0])[0, 1]) < 0.05


def test_tolerance_is_one_sigma_of_the_robot_file_cut_at_two(robot):
    drawn = draw(robot, mass={"parameters": ["body.mass"], "distribution": "tolerance", "cut": 2.0})["body.mass"]
    sigma = robot.tolerances["body.mass"].sigma("body.mass", robot.body.mass)
    assert np.abs(drawn - robot.body.mass).max() <= 2.0 * sigma * (1 + 1e-9)
    assert drawn.std() == pytest.approx(0.8796 * sigma, rel=0.04)  # standard deviation of a normal cut at 2 sigma


def test_tolerance_units(robot):
    assert tolerance_of(robot, "joint.zero_offset[leg_lf]") == ("add", pytest.approx(np.deg2rad(0.5)))
    assert tolerance_of(robot, "servo.viscous_friction[leg_lf]") == ("add", 0.01)
    assert tolerance_of(robot, "servo.viscous_friction[wheel_lf]") == ("add", 0.002)
    assert tolerance_of(robot, "wheel.radius[wheel_lf]") == ("scale", 0.005)


@pytest.mark.parametrize(
    ("key", "text", "largest"),
    [("command.delay", "5 ms", 0.010), ("body.com_offset", "3 mm", 0.006), ("servo.kp", "5 %", 0.1 * 55.24)],
)
def test_a_robot_file_with_other_units_is_drawn_from_as_it_says(tmp_path, key, text, largest):
    """The nominal randomisation cuts at two tolerances."""
    (tmp_path / "robot.yaml").write_text(f"base: nominal\nname: other\ntolerances: {{{key}: {text}}}\n")
    env = gym.make("WLR-Velocity-v0", robot=tmp_path / "robot.yaml", randomization="nominal")
    env.reset(seed=1)
    core: Any = env.unwrapped.core  # pyright: ignore[reportAttributeAccessIssue]
    off = np.abs(core.parameters[key] - Parameters.nominal(load_robot())[key])
    env.close()
    assert 0.0 < off.max() <= largest * (1 + 1e-9)


def test_one_sided_quantities_stay_one_sided_without_piling_up_at_zero(robot):
    delay = draw(robot, delay={"parameters": ["command.delay"], "distribution": "tolerance", "cut": 2.0})["command.delay"]
    assert delay.min() >= 0.0
    assert np.mean(delay == 0.0) < 0.01


def test_scale_and_add_start_from_nominal_and_combine(robot):
    twice = {"parameters": ["body.mass"], "distribution": "choice", "operation": "scale", "values": [2.0]}
    plus = {"parameters": ["body.mass"], "distribution": "choice", "operation": "add", "values": [0.5]}
    for events in ({"a": twice, "b": plus}, {"b": plus, "a": twice}):
        assert np.all(draw(robot, **events)["body.mass"] == 2 * robot.body.mass + 0.5)


def test_inertias_stay_physical(robot):
    wild = uniform("body.inertia leg.inertia", 0.3, 2.0, "scale", per="element")
    drawn = draw(robot, inertia=wild)
    for inertia in (drawn["body.inertia"], drawn["leg.inertia"].reshape(-1, 4, 3)):
        assert np.all(2 * inertia.max(axis=-1) <= inertia.sum(axis=-1) * (1 + 1e-12))


def test_a_new_event_shifts_no_other_and_batch_size_does_not_matter(robot):
    radius = uniform("wheel.radius", 0.9, 1.1, "scale", per="label")
    alone = draw(robot, mass=MASS)["body.mass"]
    together = draw(robot, radius=radius, mass=MASS)
    assert np.array_equal(alone, together["body.mass"])
    assert np.array_equal(draw(robot, SEEDS[7:8], radius=radius)["wheel.radius"][0], together["wheel.radius"][7])


def test_startup_draws_follow_the_robot_and_reset_draws_the_episode(robot):
    once = {"mass": {**MASS, "when": "startup"}}
    same = np.zeros_like(SEEDS)
    assert np.unique(draw(robot, SEEDS, same, **once)["body.mass"]).size == 1
    assert np.unique(draw(robot, SEEDS, same, mass=MASS)["body.mass"]).size > 3000


def test_interval_events_redraw_only_themselves(robot):
    randomization = load_randomization("wide", robot)
    first, later = (randomization.parameters(SEEDS[:50], SEEDS[:50], np.full((50, 1), k)) for k in (0, 1))
    changed = (first.values != later.values).any(axis=0)
    elements = [name for name, differs in zip(randomization.elements, changed[randomization.columns], strict=True) if differs]
    assert elements == ["external_force[x]", "external_force[y]"]
    wait = randomization.next_strike(SEEDS, np.zeros((len(SEEDS), 1), np.int64), 0.02)
    assert wait.min() >= 50
    assert wait.max() <= 150


@pytest.mark.parametrize("name", sorted(path.stem for path in (data_directory("configs") / "randomization").glob("*.yaml")))
def test_shipped_randomizations_stay_in_the_table_bounds(robot, name):
    randomization = load_randomization(name, robot)
    drawn = randomization.parameters(SEEDS, SEEDS)
    drawn.validate()
    fixed = np.setdiff1d(np.arange(drawn.values.shape[1]), randomization.columns)
    assert np.array_equal(drawn.values[:, fixed], Parameters.nominal(robot, len(SEEDS)).values[:, fixed])
    if name != "none":
        still = drawn.values[:, randomization.columns].std(axis=0) == 0
        half = {"patch.x_min[patch_1]", "patch.x_max[patch_1]", "patch.y_max[patch_1]"}
        across = {f"patch.y_{end}[patch_{k}]" for end in ("min", "max") for k in (1, 2, 3, 4)}
        stated = {"split": half, "slippery": half, "stripes": across}.get(name, set())
        assert {element for element, fixed in zip(randomization.elements, still, strict=True) if fixed} == stated


def test_slopes_below_the_friction_limit_know_tyres_and_leave_the_other_axis_alone(robot):
    slope = uniform("ground.slope[pitch]", 0.02, 0.2, "below_friction_limit")
    mu = uniform("ground.mu_x", 0.1, 0.7)
    grip = uniform("wheel.grip", 0.4, 1.0, "scale", per="label")
    drawn = draw(robot, slope=slope, tyres=grip, floor=mu)
    limit = np.arctan((drawn["ground.mu_x"] * drawn["wheel.grip"]).mean(axis=1))
    margin = (limit - drawn["ground.slope"][:, 0])[drawn["ground.slope"][:, 0] > 0.0]
    assert margin.min() == pytest.approx(0.02, abs=1e-3)
    assert margin.max() == pytest.approx(0.2, abs=1e-3)
    assert drawn["ground.slope"].min() == 0.0
    assert np.all(drawn["ground.slope"][:, 1] == 0.0)
    with pytest.raises(InputError, match=r"one slope, got ground.slope\[pitch\], ground.slope\[roll\]"):
        draw(robot, slope=slope | {"parameters": ["ground.slope"]})
    with pytest.raises(InputError, match=r"goes with 'ground.slope' only, not with 'body.mass'"):
        draw(robot, slope=slope | {"parameters": ["body.mass"]})


def test_nominal_floor_friction_reaches_both_ends(robot):
    friction = load_randomization("nominal", robot).parameters(SEEDS, SEEDS)["ground.mu_x"]
    assert 0.3 <= friction.min() < 0.31
    assert 0.89 < friction.max() <= 0.9


def test_initial_state_stands_on_the_floor(robot):
    randomization = load_randomization({"initial_state": {"leg_angle": 0.3, "yaw": 3.0, "linear_velocity": 0.1}}, robot)
    parameters = Parameters.nominal(robot, 200)
    state = randomization.state(parameters, SEEDS[:200])
    legs = state.joint_position[:, :4]
    assert np.ptp(legs) > 0.5
    wheel_bottom = state.position[:, 2:] - robot.leg.length * np.sin(legs) - robot.wheel.radius
    assert np.abs(wheel_bottom.mean(axis=1)).max() < 1.5e-3
    assert np.allclose(np.linalg.norm(state.quaternion, axis=1), 1.0)
    assert np.ptp(np.arctan2(state.quaternion[:, 3], state.quaternion[:, 0])) > 2.0
    assert np.array_equal(state.reference_position[:, :4], legs)


NO_RANGE = {"low": None, "high": None}


@pytest.mark.parametrize(
    ("event", "expected"),
    [
        ({**MASS, "parameters": ["body.mas"]}, "did you mean 'body.mass'"),
        ({**MASS, "parameters": ["wheel.radius[wheel_lg]"]}, "did you mean 'wheel_l"),
        ({**MASS, "low": 4.0}, "is above high"),
        ({**MASS, "low": None}, "needs 'low'"),
        ({**MASS, "operation": None}, "'operation' is missing"),
        ({**MASS, "operation": "multiply"}, "operation = 'multiply'"),
        ({**MASS, "distribution": "gamma"}, "distribution = 'gamma'"),
        ({**MASS, **NO_RANGE, "distribution": "choice"}, "needs 'values"),
        ({**MASS, "distribution": "loguniform", "low": 0.0}, "needs low > 0"),
        (
            {**MASS, **NO_RANGE, "distribution": "normal", "mean": 1.0, "sigma": "sensors.imu.gyro_bia"},
            "neither a number nor the path",
        ),
        (
            {"distribution": "tolerance", "parameters": ["gravity"]},
            "event 'mass': robot 'wlr-nominal' states no tolerance for parameter",
        ),
        ({**MASS, "values": [1.0]}, "'values' does not go with 'uniform', which takes operation, low, high"),
        ({**MASS, "distribution": "tolerance", **NO_RANGE}, "'operation' does not go with 'tolerance'"),
        ({**MASS, "when": "interval"}, "goes with 'when: interval'"),
        ({**MASS, "hihg": 3.0}, "did you mean 'high'"),
        ({**MASS, "parameters": ["wheel.radius", "wheel.radius[wheel_lr]"]}, "wheel.radius[wheel_lr] occurs twice"),
        ({**MASS, "parameters": ["patch.mu[patch_2]"]}, "no event says where patch.mu[patch_2] lies: expected 'area'"),
    ],
)
def test_bad_events_are_refused(robot, event, expected):
    with pytest.raises(InputError, match=expected.replace("[", r"\[")):
        load_randomization({"events": {"mass": {k: v for k, v in event.items() if v is not None}}}, robot)


def test_what_scales_all_patches_takes_those_that_lie_somewhere(robot):
    event = uniform("patch.mu", 0.5, 0.5, "scale")
    given = {base: load_randomization({"base": base, "events": {"worn": event}}, robot) for base in ("split", "patches")}
    for base, randomization in given.items():
        before = load_randomization(base, robot).parameters(SEEDS, SEEDS)["patch.mu"]
        assert np.allclose(randomization.parameters(SEEDS, SEEDS)["patch.mu"], 0.5 * before)
    with pytest.raises(InputError, match=r"no event says where patch.mu\[patch_1\] lies"):
        load_randomization({"events": {"worn": event}}, robot)


FLOOR = {"parameters": ["ground.mu_x"], "operation": "set"}
FRICTION = {**FLOOR, "distribution": "uniform", "low": 10.0, "high": 20.0}


@pytest.mark.parametrize(
    "event",
    [
        FRICTION,
        {**FRICTION, "low": 0.5},
        {**FRICTION, "low": -1.0, "high": 0.5},
        {**FRICTION, "distribution": "loguniform"},
        {**FLOOR, "distribution": "choice", "values": [0.5, 20.0]},
        {**FLOOR, "distribution": "normal", "mean": 20.0, "sigma": 1.0},
    ],
)
def test_a_range_to_set_lies_within_the_bounds(robot, event):
    with pytest.raises(
        InputError, match=r"event 'floor': sets ground.mu_x\[wheel_lf\] in \[.*bounds \[0, 5\] \(a pure number\)"
    ):
        load_randomization({"events": {"floor": event}}, robot)


def test_the_tail_of_a_normal_is_clipped_at_the_bounds(robot):
    tail = {**FLOOR, "distribution": "normal", "mean": 0.2, "sigma": 0.2}
    friction = draw(robot, floor=tail)["ground.mu_x"]
    assert friction.min() == 0.0


def test_two_events_may_not_set_the_same_element(robot):
    with pytest.raises(InputError, match="'a' and 'b' both set body"):
        load_randomization({"events": {"a": MASS, "b": MASS}}, robot)


def test_a_key_that_the_bases_distribution_does_not_read_is_refused(robot):
    with pytest.raises(
        InputError, match=r"events\.wheel_radius: 'sigma' does not go with 'tolerance', which takes sigmas, cut"
    ):
        load_randomization({"base": "nominal", "events": {"wheel_radius": {"sigma": 2.0}}}, robot)


def test_another_distribution_leaves_nothing_of_the_bases(robot):
    normal = {"distribution": "normal", "mean": 0.5, "sigma": 0.1}
    event = load_randomization({"base": "nominal", "events": {"floor_friction": normal}}, robot).config.events["floor_friction"]
    assert (event.mean, event.sigma, event.low, event.high) == (0.5, 0.1, None, None)
    assert event.operation == "set"


def test_a_complete_config_written_with_its_defaults_loads_again(robot):
    config = load_randomization("wide", robot).config
    assert load_randomization(config.model_dump(mode="json", exclude_none=True), robot).config == config


def test_removing_an_event_that_is_not_there_is_refused(robot):
    with pytest.raises(InputError, match=r"floor_frictoin = null removes nothing.*did you mean 'floor_friction'"):
        load_randomization({"base": "ice", "events": {"floor_frictoin": None}}, robot)


@pytest.mark.parametrize(
    ("key", "value"), [("leg_angle", 99), ("yaw", 7), ("linear_velocity", 11), ("angular_velocity", 101), ("leg_angle", -0.1)]
)
def test_initial_states_out_of_reach_are_refused(robot, key, value):
    with pytest.raises(InputError, match=rf"initial_state.{key} = {value}"):
        load_randomization({"initial_state": {key: value}}, robot)


def test_a_base_is_looked_for_beside_the_file(robot, tmp_path):
    (tmp_path / "lower.yaml").write_text("base: nominal\ninitial_state: {yaw: 0.5}\n")
    (tmp_path / "upper.yaml").write_text("base: lower.yaml\n")
    config = load_randomization(tmp_path / "upper.yaml", robot).config
    assert config.initial_state.yaw == 0.5
    assert config.events.keys() == load_randomization("nominal", robot).config.events.keys()
    (tmp_path / "lower.yaml").write_text(f"base: ../{tmp_path.name}/upper.yaml\n")
    with pytest.raises(InputError, match="is its own base"):
        load_randomization(tmp_path / "upper.yaml", robot)


def test_errors_name_event_and_file_it_stands_in(robot, tmp_path):
    lower, upper = tmp_path / "lower.yaml", tmp_path / "upper.yaml"
    bad = "{parameters: [ground.mu], distribution: uniform, operation: set, low: 0.1, high: 0.2}"
    good = "{parameters: [body.mass], distribution: uniform, operation: set, low: 2.0, high: 3.0}"
    lower.write_text(f"events: {{strip: {bad}}}\n")
    upper.write_text(f"base: {lower}\nevents: {{other: {good}}}\n")
    with pytest.raises(InputError, match=r"lower\.yaml: event 'strip': unknown parameter 'ground\.mu'"):
        load_randomization(upper, robot)
    upper.write_text(f"base: {lower}\nevents: {{strip: {bad}}}\n")
    with pytest.raises(InputError, match=r"upper\.yaml: event 'strip': unknown parameter 'ground\.mu'"):
        load_randomization(upper, robot)
    lower.write_text(f"events: {{strip: {good}}}\n")
    upper.write_text(f"base: {lower}\nevents: {{other: {good}}}\n")
    with pytest.raises(InputError, match=r"upper\.yaml over .*lower\.yaml: events 'strip' and 'other' both set body\.mass"):
        load_randomization(upper, robot)
    lower.write_text("events: {strip: {distribution: uniform, lwo: 1}}\n")
    with pytest.raises(
        InputError, match=r"lower\.yaml: 2 faults\n  'events\.strip\.parameters' is missing\n.*did you mean 'low'"
    ):
        load_randomization(upper, robot)
    lower.write_text("[1, 2]\n")
    with pytest.raises(InputError, match=r"lower\.yaml: .*expected keys and values"):
        load_randomization(upper, robot)
