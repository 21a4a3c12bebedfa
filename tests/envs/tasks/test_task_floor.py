"""Floors: patches, split friction, drift; presets laid over each other."""

import numpy as np
import pytest
from velocity import uniform

from wlr_gym.base.errors import InputError
from wlr_gym.envs.tasks import load_randomization
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

SEEDS = np.arange(2000, dtype=np.uint64)
AREA = {"x_min": [-1.0, 1.0], "length": [0.2, 0.5], "y_min": [0.0, 2.0], "width": [0.0, 0.1]}
PATCHES = uniform("patch.mu", 0.1, 0.3, per="label", area=AREA)
DRIFT = uniform("ground.mu_x ground.mu_y", 0.2, 0.8, when="drift", interval=[2.0, 3.0], per="label")
PUSH = uniform("external_force", -1.0, 1.0, when="interval", interval=[1.0, 2.0])
PAYLOAD = uniform("payload.mass", 0.0, 1.0)


@pytest.fixture(scope="module")
def robot():
    return load_robot()


def draw(robot, seeds=SEEDS, time=0.0, **events):
    return load_randomization({"events": events}, robot).parameters(seeds, seeds, None, np.full(len(seeds), time))


# ---- patches ----


def test_patches_have_the_asked_places_and_sizes_each_on_its_own(robot):
    drawn = draw(robot, patches=PATCHES)
    for low, high, edge, size in (("x_min", "x_max", (-1, 1), (0.2, 0.5)), ("y_min", "y_max", (0, 2), (0.0, 0.1))):
        lower, extent = drawn[f"patch.{low}"], drawn[f"patch.{high}"] - drawn[f"patch.{low}"]
        for values, (first, last) in ((lower, edge), (extent, size)):
            assert values.mean() == pytest.approx((first + last) / 2, abs=0.03 * (last - first))
            assert values.min() >= first - 1e-12
            assert values.max() <= last + 1e-12
            assert values.std() == pytest.approx((last - first) / np.sqrt(12), rel=0.05)
            assert abs(np.corrcoef(values[:, 0], values[:, 1])[0, 1]) < 0.08
        assert abs(np.corrcoef(lower[:, 0], extent[:, 0])[0, 1]) < 0.08
    assert abs(np.corrcoef(drawn["patch.mu"][:, 2], drawn["patch.x_min"][:, 2])[0, 1]) < 0.08
    assert 0.1 <= drawn["patch.mu"].min() < drawn["patch.mu"].max() <= 0.3


def test_edges_left_out_lie_at_the_floors_end(robot):
    drawn = draw(robot, left={**PATCHES, "parameters": ["patch.mu[patch_2]"], "area": {"y_min": [0.1, 0.1]}})
    area = [drawn[f"patch.{edge}[patch_2]"] for edge in ("x_min", "x_max", "y_min", "y_max")]
    assert all(np.all(values == expected) for values, expected in zip(area, (-1e3, 1e3, 0.1, 1e3), strict=True))
    nominal = Parameters.nominal(robot)
    for edge in ("mu", "x_min", "x_max", "y_min", "y_max"):
        assert np.all(drawn[f"patch.{edge}"][:, [0, 2, 3]] == nominal[f"patch.{edge}"][:, [0, 2, 3]])


@pytest.mark.parametrize(
    ("event", "expected"),
    [
        ({**PATCHES, "parameters": ["patch.mu", "ground.mu_x"]}, "'area' goes with 'patch.mu' only"),
        ({**PATCHES, "area": {"length": [0.1, 0.2]}}, "expected 'x_min' too"),
        ({**PATCHES, "area": {"y_min": [0, 0], "width": [-0.1, 0.2]}}, "area.width.0 = -0.1: expected 0 or more"),
        ({**PATCHES, "area": {"x_min": [1, 0]}}, r"area.x_min = \[1, 0\]: expected \[low, high\] with low <= high"),
        ({**PATCHES, "area": {"x_min": [0, 5000]}}, "area.x_min.1 = 5000: expected 1000 or less"),
        ({**PATCHES, "area": {"x_mn": [0, 1]}}, "did you mean 'x_min'"),
        ({**DRIFT, "interval": None}, "goes with 'when: interval' or 'when: drift'"),
        ({**DRIFT, "interval": [0, 1]}, "interval.0 = 0: expected more than 0"),
    ],
)
def test_bad_floors_are_refused(robot, event, expected):
    event = {key: value for key, value in event.items() if value is not None}
    with pytest.raises(InputError, match=expected):
        load_randomization({"events": {"floor": event}}, robot)


# ---- drift ----


def paths(robot, seeds=SEEDS[:200], end=20.0, step=0.02, **events):
    """(time, robots, wheels) of ground.mu_x."""
    randomization = load_randomization({"events": events}, robot)
    times = np.arange(0.0, end, step)
    return np.array([randomization.parameters(seeds, seeds, None, np.full(len(seeds), time))["ground.mu_x"] for time in times])


def test_drift_is_a_smooth_path_with_the_asked_range(robot):
    path = paths(robot, drift=DRIFT)
    assert 0.2 <= path.min() < 0.21
    assert 0.79 < path.max() <= 0.8
    steepest = 0.6 * 1.5 / 2.0  # the whole range within the shortest interval, 3 u^2 - 2 u^3 at its steepest
    assert np.abs(np.diff(path, axis=0)).max() <= steepest * 0.02 * (1 + 1e-9)
    bend = 0.6 * 6.0 / 2.0**2  # and its sharpest bend: no kinks
    assert np.abs(np.diff(path, 2, axis=0)).max() <= 2 * bend * 0.02**2
    assert np.abs(np.corrcoef(path[0, :, 0], path[400, :, 0])[0, 1]) < 0.2
    assert abs(np.corrcoef(path[0, :, 0], path[0, :, 1])[0, 1]) < 0.2
    start = paths(robot, SEEDS, end=0.02, drift=DRIFT)[0]
    assert start.std() == pytest.approx(0.6 / np.sqrt(12), rel=0.03)


def test_drift_is_a_function_of_seed_and_time_alone(robot):
    many = draw(robot, time=7.3, drift=DRIFT)
    one = draw(robot, SEEDS[11:12], time=7.3, drift=DRIFT)
    assert np.array_equal(many.values[11], one.values[0])
    randomization = load_randomization({"events": {"drift": DRIFT}}, robot)
    times = np.linspace(0, 20, 200)
    mixed = randomization.parameters(SEEDS[:200], SEEDS[:200], None, times)
    for row in (0, 50, 199):
        alone = randomization.parameters(SEEDS[row : row + 1], SEEDS[row : row + 1], None, times[row : row + 1])
        assert np.array_equal(mixed.values[row], alone.values[0])


def test_knots_keep_the_choice_of_values(robot):
    values = [0.2, 0.5, 0.8]
    event = {key: value for key, value in DRIFT.items() if key not in ("low", "high")}
    path = paths(robot, end=9.0, drift={**event, "interval": [1.0, 1.0], "distribution": "choice", "values": values})
    assert set(path[::50].ravel().tolist()) <= set(values)
    assert np.unique(path).size > 100


def test_an_event_more_or_less_shifts_no_other(robot):
    events = {"patches": PATCHES, "drift": DRIFT, "push": PUSH, "weight": PAYLOAD}

    def values(chosen, order=1):
        randomization = load_randomization({"events": dict(list(chosen.items())[::order])}, robot)
        strikes = np.full((len(SEEDS), len(randomization.intervals)), 3)
        return randomization, randomization.parameters(SEEDS, SEEDS, strikes, np.full(len(SEEDS), 5.3)).values

    _, together = values(events)
    assert np.array_equal(together, values(events, -1)[1])
    for left_out in events:
        alone, drawn = values({name: event for name, event in events.items() if name != left_out})
        assert np.array_equal(drawn[:, alone.columns], together[:, alone.columns])
    for name, event in events.items():
        alone, drawn = values({name: event})
        assert np.array_equal(drawn[:, alone.columns], together[:, alone.columns])


def test_timed_elements_are_those_that_change_within_an_episode(robot):
    randomization = load_randomization({"events": {"patches": PATCHES, "drift": DRIFT, "push": PUSH}}, robot)
    mu = [f"ground.mu_{axis}[{wheel}]" for axis in "xy" for wheel in ("wheel_lf", "wheel_rf", "wheel_lr", "wheel_rr")]
    assert randomization.timed_elements == (*mu, "external_force[x]", "external_force[y]")
    assert load_randomization("nominal", robot).timed_elements == ()


# ---- presets ----


def test_ice_is_slippery(robot):
    friction = load_randomization("ice", robot).parameters(SEEDS, SEEDS)["ground.mu_x"]
    assert 0.05 <= friction.min() < 0.051
    assert 0.19 < friction.max() <= 0.2


def test_split_has_two_sides_along_the_start_heading(robot):
    randomization = load_randomization("split", robot)
    drawn = randomization.parameters(SEEDS, SEEDS)
    left, right = drawn["patch.mu[patch_1]"], drawn["ground.mu_x[wheel_lf]"]
    assert abs(np.corrcoef(np.log(left), np.log(right))[0, 1]) < 0.08
    assert np.mean(np.abs(np.log(left / right)) > np.log(2)) > 0.4
    assert np.abs(drawn["patch.y_min[patch_1]"]).max() <= 0.1
    state = randomization.state(drawn, SEEDS)
    assert np.abs(2 * np.arctan2(state.quaternion[:, 3], state.quaternion[:, 0])).max() <= 0.2


@pytest.mark.parametrize("name", ["ice", "split", "patches"])
def test_presets_change_only_the_floor_of_the_nominal_one(robot, name):
    drawn, nominal = (load_randomization(chosen, robot).parameters(SEEDS, SEEDS) for chosen in (name, "nominal"))
    drawn.validate()
    for parameter in nominal:
        if not parameter.startswith(("ground.mu", "patch.")):
            assert np.array_equal(drawn[parameter], nominal[parameter]), parameter


def test_a_base_is_laid_under_key_by_key(robot):
    own = {"base": "nominal", "events": {"floor_friction": {"low": 0.5}, "body_mass": None, "payload": PAYLOAD}}
    randomization = load_randomization(own, robot)
    config = randomization.config
    assert (config.events["floor_friction"].low, config.events["floor_friction"].high) == (0.5, 0.9)
    assert "body_mass" not in config.events
    assert "payload" in config.events
    assert config.base is None
    assert load_randomization(config, robot).config == config
    assert load_randomization({**own, "sensor_noise": False}, robot).config.sensor_noise is False


def test_bad_bases_are_refused(robot):
    for name in ("nominl", {"base": "nominl"}):
        with pytest.raises(InputError, match="did you mean 'nominal'"):
            load_randomization(name, robot)
    with pytest.raises(InputError, match="base = 3"):
        load_randomization({"base": 3}, robot)
    with pytest.raises(InputError, match="did you mean 'base'"):
        load_randomization({"bas": "nominal"}, robot)
