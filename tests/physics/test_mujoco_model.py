"""The batch's per-robot numbers are those of the model that is built for each robot alone; work and energy balance."""

import numpy as np
import pytest
from energy import audit
from random_robots import random_parameters
from rig import ROBOT, make_plant

from wlr_gym.physics.plants.mujoco.mjcf import build_model
from wlr_gym.physics.plants.mujoco.plant import RobotBatch
from wlr_gym.robot.parameters import Parameters

INERTIAL = (
    "body_mass", "body_ipos", "body_iquat", "body_inertia", "body_pos", "body_quat", "body_subtreemass", "body_invweight0",
    "dof_armature", "dof_M0", "dof_invweight0", "jnt_axis", "jnt_pos", "geom_bodyid",
)  # fmt: skip


def test_every_robot_of_a_batch_has_the_model_built_for_it_alone():
    """Fields expanded and derived in the batch against the MJCF of each robot, compiled by itself."""
    count = 4
    parameters = random_parameters(count, 2)
    parameters["payload.inertia"][1] = 0.0, 0.01, 0.01, 0.0, 0.0, 0.0  # two point masses on a line
    batch = RobotBatch(ROBOT, count, 1e-3, threads=1)
    batch.set_parameters(np.arange(count), Parameters.nominal(ROBOT, count))
    batch.set_parameters(np.array([1, 3]), Parameters(parameters.values[[1, 3]]))
    for row in range(count):
        expected_from = parameters if row in (1, 3) else Parameters.nominal(ROBOT, count)
        alone = build_model(ROBOT, expected_from, row, wheel_shape="capsule")
        model = batch.model_of(row)
        for name in INERTIAL:
            np.testing.assert_allclose(getattr(model, name), getattr(alone, name), rtol=1e-9, atol=1e-15, err_msg=name)
        np.testing.assert_allclose(model.opt.gravity, alone.opt.gravity, atol=1e-12)


# ---- work and energy ---------------------------------------------------------------------------------------------------

STEP = 1e-3
VISCOUS = 0.005
EFFECTS = {
    "none": {},
    "rolling_resistance": {"ground.rolling_resistance": 0.02},
    "tyre_creep": {"ground.creep_speed": 0.02},
    "gear_creep_and_flat_tyres": {"servo.creep_rate": 0.3, "ground.flattening": 0.5},
    "slip_weakening": {"ground.kinetic_ratio": 0.5},
    "stribeck_and_load": {"servo.stribeck_torque": 0.1, "servo.load_friction": 0.1},
    "torque_ripple": {"servo.ripple_amplitude": 0.05, "servo.ripple_order": 8.0},
    "weak_motor": {"servo.torque_scale": 0.7},
    "supply_sag": {"servo.supply_resistance": 0.3},
    "tether": {"tether.stiffness": 3.0},
    "slope_and_payload": {"ground.slope": (0.1, 0.05), "payload.mass": 0.5, "payload.position": (0.03, 0.02, 0.05)},
}


def edit(parameters):
    parameters["ground.mu_x"], parameters["ground.mu_y"] = 0.5, 0.35
    parameters["servo.viscous_friction"] = VISCOUS
    for robot, changes in enumerate(EFFECTS.values()):
        for name, value in changes.items():
            parameters[name][robot] = value


@pytest.fixture(scope="module")
def driven():
    """Work of every force over 3 s of random driving, all robots alike."""
    count, rng = len(EFFECTS), np.random.default_rng(0)
    plant = make_plant(count, edit, step=STEP, period=STEP, backend="mujoco")

    def draw():
        return np.tile(np.hstack([rng.uniform(1.1, 2.0, 4), rng.uniform(-5.0, 5.0, 4)]), (count, 1))

    return audit(plant, 3000, 250, draw, VISCOUS)


def test_energy_balance_closes_with_every_effect(driven):
    assert driven.done.min() > 1.0
    assert dict(zip(EFFECTS, driven.missing, strict=True)) == pytest.approx(dict.fromkeys(EFFECTS, 0.0), abs=1e-4)


@pytest.mark.parametrize("term", ["gear", "friction", "rolling"])
def test_no_friction_adds_energy(driven, term):
    work, robots = driven.work[term], slice(1, 2) if term == "rolling" else slice(None)
    assert work.sum(axis=0)[robots].max() < -1e-3
    assert work.max() < 1e-5  # J per step: a slip that reverses within a step is averaged over its ends
