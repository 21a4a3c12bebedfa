"""A robot without an effect has the same bits in every kernel; one with effects has the same bits alone and in a batch."""

import numpy as np
import pytest
from rig import ROBOT

from wlr_gym.physics.plants.base import PlantOptions
from wlr_gym.physics.plants.gibbs_appell.plant import GibbsAppellPlant
from wlr_gym.robot.parameters import Parameters

pytestmark = pytest.mark.usefixtures("own_kernels")

FAMILIES = {
    "rolling_resistance": ("ground.rolling_resistance", 0.01),
    "drive": ("servo.torque_scale", 0.8),
    "backlash": ("servo.backlash", 0.01),
    "ground": ("ground.kinetic_ratio", 0.7),
    "creep": ("ground.creep_speed", 0.05),
    "creep of gears": ("servo.creep_rate", 0.05),
    "flattening": ("ground.flattening", 0.4),
}
FEATURES = {family: {"compliance", "backlash"} if family.startswith(("creep", "flat")) else {family} for family in FAMILIES}
TICKS = 20


def different_robots(count):
    """Robots that differ from each other; row i depends on i alone."""
    parameters = Parameters.nominal(ROBOT, count)
    for row in range(count):
        rng = np.random.default_rng([7, row])
        parameters["ground.mu_x"][row], parameters["ground.mu_y"][row] = rng.uniform(0.2, 0.9, (2, 4))
        parameters["body.com_offset"][row] = rng.uniform(-0.01, 0.01, 3)
        parameters["servo.viscous_friction"][row] = rng.uniform(0.0, 0.02, 8)
    return parameters


def setpoints(count):
    rows = [np.random.default_rng([8, row]) for row in range(count)]
    low, high = np.repeat([1.2, -5.0], 4), np.repeat([1.9, 5.0], 4)
    return np.stack([rng.uniform(low, high, (TICKS, 8)) for rng in rows], axis=1)


def rollout(plant, parameters, commands):
    """Truth and sensors (ticks, N, columns)."""
    plant.reset(seeds=np.arange(len(parameters), dtype=np.uint64), parameters=parameters)
    seen = [np.hstack([plant.step(row).values, plant.truth().values]) for row in commands]
    return np.array(seen)


def with_effects(parameters, families, robots=slice(None)):
    changed = parameters.copy()
    for family in families:
        name, value = FAMILIES[family]
        changed[name][robots] = value
    return changed


@pytest.mark.slow  # a kernel for every family
@pytest.mark.parametrize("family", FAMILIES)
def test_neutral_robot_keeps_its_bits(family):
    count = 9
    parameters, commands = different_robots(count), setpoints(count)
    plain = rollout(GibbsAppellPlant(ROBOT, count), parameters, commands)
    plant = GibbsAppellPlant(ROBOT, count)
    changed = rollout(plant, with_effects(parameters, [family]), commands)
    assert plant._features == FEATURES[family]
    assert np.isfinite(changed).all()
    assert not np.array_equal(changed, plain)
    np.testing.assert_array_equal(rollout(plant, parameters, commands), plain)
    beside = rollout(plant, with_effects(parameters, [family], slice(3, 6)), commands)
    np.testing.assert_array_equal(beside[:, [0, 1, 2, 6, 7, 8]], plain[:, [0, 1, 2, 6, 7, 8]])
    np.testing.assert_array_equal(beside[:, 3:6], changed[:, 3:6])


@pytest.mark.parametrize(
    ("count", "precision"), [(1, "float64"), pytest.param(9, "float64", marks=pytest.mark.slow), (17, "float32")]
)
def test_all_families_at_once(count, precision):
    """Neutral robots as in the plain kernel, robots with one family as in that family's, at every tile width."""
    parameters, commands = different_robots(count), setpoints(count)
    options = PlantOptions(precision=precision)
    plant = GibbsAppellPlant(ROBOT, count, options)
    rollout(plant, with_effects(parameters, FAMILIES), commands[:2])
    assert plant._features == set().union(*FEATURES.values())
    plain = rollout(GibbsAppellPlant(ROBOT, count, options), parameters, commands)
    np.testing.assert_array_equal(rollout(plant, parameters, commands), plain)
    if precision == "float64" and count > 1:
        for family in FAMILIES:
            changed = with_effects(parameters, [family])
            alone = rollout(GibbsAppellPlant(ROBOT, count), changed, commands)
            np.testing.assert_array_equal(rollout(plant, changed, commands), alone)
