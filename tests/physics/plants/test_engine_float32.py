"""Single precision over hours and kilometres: it follows double precision as well as at the start."""

from __future__ import annotations

import numpy as np
import pytest

from wlr_gym.physics.plants.base import PlantOptions, PlantState, standing_state
from wlr_gym.physics.plants.forces import make_force
from wlr_gym.physics.plants.gibbs_appell.plant import GibbsAppellPlant
from wlr_gym.robot import WHEEL_SLICE, load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()
COUNT = 16
QUIET = {"sensor_noise": False}


def start(parameters: Parameters, angle: float, place: float) -> PlantState:
    """Standing, with wheels that have turned by ``angle`` (rad), ``place`` (m) from the origin."""
    state = standing_state(ROBOT, parameters)
    state.joint_position[:, WHEEL_SLICE] += angle
    state.reference_position[:, WHEEL_SLICE] += angle
    state.position[:, :2] += place
    return state


def setpoints() -> np.ndarray:
    """Ahead, back, arcs and turns on the spot."""
    legs = np.full((COUNT, 4), ROBOT.home.leg_angle)
    rng = np.random.default_rng(1)
    speed, turn = rng.uniform(-6, 6, (COUNT, 1)), rng.uniform(-2, 2, (COUNT, 1))
    return np.hstack([legs, speed + turn * np.array([[-1.0, 1.0, -1.0, 1.0]])])


def drive(
    precision: str, ticks: int, angle: float = 0.0, place: float = 0.0, strip: float | None = None
) -> dict[str, np.ndarray]:
    """Return travel (m), yaw (rad) and wheel turns (rad) since the start; ``strip``: friction of a part of the floor."""
    plant = GibbsAppellPlant(ROBOT, COUNT, PlantOptions(precision=precision, **QUIET))
    parameters = Parameters.nominal(ROBOT, COUNT)
    if strip is not None:
        parameters["patch.mu"][:, 0] = strip
        for bound, value in {"x_min": 0.5, "x_max": 1.0, "y_min": -9.0, "y_max": 9.0}.items():
            parameters[f"patch.{bound}"][:, 0] = place + value
    readings = plant.reset(parameters=parameters, state=start(parameters, angle, place))
    given, travel, yaw = setpoints(), np.zeros(COUNT), np.zeros(COUNT)
    begin, last = readings["joint_position"].copy(), plant._raw[:, -3:].copy()
    for _ in range(ticks):
        readings = plant.step(given)
        pose = plant._raw[:, -3:]
        travel += np.linalg.norm(pose[:, :2] - last[:, :2], axis=1)
        yaw += (pose[:, 2] - last[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
        last = pose.copy()
    turned = (readings["joint_position"] - begin)[:, WHEEL_SLICE]
    place_now = plant.truth()["position"][:, :2] - place
    return {"travel": travel, "yaw": yaw, "turned": turned.copy(), "place": place_now}


def test_wheels_that_have_turned_far_and_places_far_away_change_nothing() -> None:
    near, far = drive("float32", 250, strip=0.3), drive("float32", 250, angle=1e5, place=900.0, strip=0.3)
    double = drive("float64", 250, strip=0.3)
    for name, bound in {"travel": 2e-4, "yaw": 5e-4, "turned": 2e-3, "place": 1e-3}.items():
        assert np.abs(near[name] - double[name]).max() < bound, name
        assert np.abs(far[name] - double[name]).max() < bound, name


def test_encoders_and_places_have_no_jumps_and_states_go_on() -> None:
    plant = GibbsAppellPlant(ROBOT, COUNT, PlantOptions(precision="float32", **QUIET))
    state = start(plant.parameters, 3.0, 1e3)
    readings = plant.reset(state=state)
    given, before, place = setpoints(), readings["joint_position"].copy(), plant.truth()["position"].copy()
    np.testing.assert_allclose(plant.mechanical_state().reference_position, state.reference_position, atol=1e-6)
    np.testing.assert_allclose(plant.truth()["joint_position"], state.joint_position, atol=1e-6)
    for _ in range(60):  # more than a turn of a wheel
        readings = plant.step(given)
        assert np.abs(readings["joint_position"] - before)[:, WHEEL_SLICE].max() < 0.2
        assert np.abs(plant.truth()["position"] - place).max() < 0.01
        before, place = readings["joint_position"].copy(), plant.truth()["position"].copy()
    assert np.ptp(before[:, WHEEL_SLICE]) > 6.0
    other = GibbsAppellPlant(ROBOT, COUNT, PlantOptions(precision="float32", **QUIET))
    other.reset(state=plant.mechanical_state())
    np.testing.assert_array_equal(other.truth()["joint_position"], plant.truth()["joint_position"])
    np.testing.assert_array_equal(other.truth()["position"], plant.truth()["position"])
    np.testing.assert_allclose(
        other.mechanical_state().reference_position, plant.mechanical_state().reference_position, atol=1e-7
    )


@pytest.mark.slow
def test_formulas_see_the_whole_wheel_angle() -> None:
    angles = []
    for precision in ("float32", "float64"):
        force = make_force(("body_force_x",), "k * wheel_angle_lf", {"k": 1e-3}, {"k": "N/rad"})
        plant = GibbsAppellPlant(ROBOT, 1, PlantOptions(precision=precision, **QUIET), (force,))
        plant.reset(state=start(plant.parameters, 5000.0, 0.0))
        for _ in range(25):
            plant.step(np.hstack([np.full((1, 4), ROBOT.home.leg_angle), np.zeros((1, 4))]))
        angles.append(plant.truth()["motor_torque"][0, WHEEL_SLICE].mean())
    assert abs(angles[1]) > 0.01  # 5 N on the body
    assert angles[0] == pytest.approx(angles[1], rel=1e-3)


@pytest.mark.slow
def test_an_hour_of_driving() -> None:
    """Travel within 0.1 %, and yaw within 0.1 % of robots that turn by more than 0.015 rad/s (a slower turn is as far off)."""
    hour = 3600 * 50
    single, double = drive("float32", hour), drive("float64", hour)
    assert np.abs(single["travel"] / double["travel"] - 1.0).max() < 1e-3
    assert np.abs(single["turned"] / double["turned"] - 1.0).max() < 1e-3
    turning = np.abs(double["yaw"]) > 0.015 * 3600.0
    assert turning.sum() >= 12
    assert np.abs(single["yaw"] / double["yaw"] - 1.0)[turning].max() < 1e-3
    assert np.abs(single["yaw"] - double["yaw"]).max() < 0.06
