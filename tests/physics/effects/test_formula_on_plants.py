"""A formula that says the same as a named effect moves every simulator alike; and environments hand formulas on."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import wlr_gym  # noqa: F401  (registers the environments)
from wlr_gym.physics.effects import apply_patch, load_patch
from wlr_gym.physics.plants import SIMULATORS, make_plant
from wlr_gym.physics.plants.base import PlantOptions
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()


def formula(where: str, text: str, units: dict[str, str], **values: float) -> dict:
    return {"name": "unknown_effect", "where": where, "formula": text, "parameters": values, "units": units}


PUSH = {"name": "external_force", "parameters": {"fx": 3.0, "fy": -1.0}}
PUSH_FORMULAS = [
    formula("floor_force_x", "f", {"f": "N"}, f=3.0),
    formula("floor_force_y", "-f", {"f": "N"}, f=1.0),
]
TETHER = {"name": "tether", "parameters": {"stiffness": 8.0, "x": 0.5, "y": -0.4}}
TETHER_FORMULAS = [
    formula("floor_force_x", "-k * (position_x - x)", {"k": "N/m", "x": "m"}, k=8.0, x=0.5),
    formula("floor_force_y", "-k * (position_y - y)", {"k": "N/m", "y": "m"}, k=8.0, y=-0.4),
]


def end_of(backend: str, effects: list[dict]) -> tuple[np.ndarray, np.ndarray]:
    """Pose and joint angles after a second of driving a curve."""
    patch = load_patch(effects)
    plant = make_plant(backend, ROBOT, 1, PlantOptions(sensor_noise=False), patch.forces)
    try:
        plant.reset(parameters=apply_patch(patch, Parameters.nominal(ROBOT)))
        for _ in range(50):
            plant.step(np.array([[*[ROBOT.home.leg_angle] * 4, 1.0, 3.0, 1.0, 3.0]]))
        truth = plant.truth()
        return truth["position"][0].copy(), truth["joint_position"][0].copy()
    finally:
        plant.close()


@pytest.mark.slow
@pytest.mark.parametrize("backend", SIMULATORS)
@pytest.mark.parametrize(
    ("effect", "formulas"), [(PUSH, PUSH_FORMULAS), (TETHER, TETHER_FORMULAS)], ids=["external_force", "tether"]
)
def test_a_formula_for_a_named_effect_moves_the_robot_alike(backend, effect, formulas):
    named, written, nominal = (end_of(backend, effects) for effects in ([effect], formulas, []))
    change = np.abs(named[0] - nominal[0]).max()
    assert change > 1e-4
    np.testing.assert_allclose(written[0], named[0], atol=1e-3 * change)
    np.testing.assert_allclose(written[1], named[1], atol=1e-3 * np.abs(named[1] - nominal[1]).max())


@pytest.mark.parametrize("backend", SIMULATORS)
def test_a_spring_moves_its_own_leg(backend):
    spring = formula("leg_lr", "-k * (leg_angle - a0)", {"k": "N m/rad", "a0": "rad"}, k=0.8, a0=0.5)
    moved = np.abs(end_of(backend, [spring])[1] - end_of(backend, [])[1])[:4]
    assert np.argmax(moved) == 2
    assert moved[2] > 3 * np.delete(moved, 2).max()
    # the servo holds the leg with the stiffness kp K/R, give or take gear friction in either run
    leg = ROBOT.servo.leg
    stiffness = leg.kp * leg.stall_torque / ROBOT.servo.supply_voltage
    torque = 0.8 * (ROBOT.home.leg_angle - 0.5)
    assert moved[2] == pytest.approx(torque / stiffness, abs=2 * leg.coulomb_friction / stiffness)


@pytest.mark.slow
def test_environments_give_formulas_to_their_plant():
    def yaw_rate(effects: list[dict] | None) -> float:
        env = gymnasium.make("WLR-Velocity-v0", effects=effects, randomization="none", episode_length=1.0)
        try:
            env.reset(seed=0, options={"command": {"linear_velocity_x": 0.0, "yaw_rate": 0.0}})
            for _ in range(20):
                env.step(np.zeros(8, np.float32))
            return float(env.unwrapped.core.plant.truth()["angular_velocity_in_body"][0, 2])  # type: ignore[attr-defined]
        finally:
            env.close()

    twist = formula("body_torque_yaw", "m", {"m": "N m"}, m=8.0)
    assert abs(yaw_rate(None)) < 1e-3
    assert yaw_rate([twist]) > 0.1
