"""Both simulators on relief: the same motion, bits that depend on nothing beside a robot, changes in mid-run, random states."""

from __future__ import annotations

import numpy as np
import pytest
from relief_rig import enter_grid
from rig import BACKENDS, HOME, ROBOT, drive, make_plant

from studies.bench.climbing import climb_by_two_poses, climb_one_by_one, perturb
from studies.bench.fuzz import fuzz
from wlr_gym.base.random import spawn_seeds
from wlr_gym.physics import maps, plants
from wlr_gym.physics.floor import load_floor
from wlr_gym.physics.plants.base import PlantOptions, standing_state
from wlr_gym.robot.parameters import Parameters

#: Simulators and their precisions.
EXACT = [("gibbs_appell", "float64"), ("gibbs_appell", "float32"), ("mujoco", "float64")]
PRESETS = ("flat", "rough", "gravel", "kerbs", "ramps", "stairs")


# ---- the same motion -------------------------------------------------------------------------------------------------


def _poses(backend, floor, step, seconds=4.0):
    """Positions (N, 3) at the end of a drive at 0.25 m/s in slightly different directions over a preset, m."""
    count = 6

    def edit(parameters):
        load_floor(floor, ROBOT).write(parameters, spawn_seeds(3, count))
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = 0.7

    plant = make_plant(count, edit, backend=backend, step=step)
    setpoints = np.tile(HOME, (count, 1))
    setpoints[:, 4:] = 0.25 / ROBOT.wheel.radius * (1.0 + np.linspace(-0.1, 0.1, count)[:, None] * [1.0, -1.0, 1.0, -1.0])
    return drive(plant, seconds, setpoints).position


@pytest.mark.parametrize("floor", PRESETS)
def test_both_simulators_drive_over_a_preset_alike(floor):
    """After a metre within 0.2 mm (measured: 0.04 mm), and no further than the error of their steps, told by halving them."""
    ours, theirs = (_poses(backend, floor, 1e-3) for backend in BACKENDS)
    halved = (_poses(backend, floor, 5e-4) for backend in BACKENDS)
    apart, of_the_step = np.linalg.norm(ours - theirs, axis=1), np.zeros(len(ours))
    for coarse, fine in zip((ours, theirs), halved, strict=True):
        of_the_step += np.linalg.norm(coarse - fine, axis=1)
    assert ours[:, 0].min() > 0.7
    assert apart.max() < 2e-4
    assert apart.max() < 3.0 * of_the_step.max() + 2e-6


# ---- scripted climbs -------------------------------------------------------------------------------------------------


def test_the_engine_climbs_twice_its_wheel_radius_with_one_wheel_at_a_time():
    up, load = climb_one_by_one("gibbs_appell", ROBOT, 0.07, [0.1, 0.3, 0.6])
    assert up.all()
    assert (load[:4] < ROBOT.servo.leg.stall_torque).all()


@pytest.mark.slow
def test_mujoco_climbs_twice_its_wheel_radius_with_one_wheel_at_a_time():
    assert climb_one_by_one("mujoco", ROBOT, 0.07, 0.3)[0].all()


#: Height and friction of a kerb, and how far ahead and behind the wheels stand: with more, rear legs touch its edge; with less,
#: friction does not lift the rear wheels.
TWO_POSES = ((0.055, 0.6, 0.11), (0.08, 0.9, 0.08))


@pytest.mark.parametrize("backend", ["gibbs_appell", pytest.param("mujoco", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("height", "friction", "reach"), TWO_POSES)
def test_perturbed_robots_climb_by_two_poses(backend, height, friction, reach):
    """24 of 24, with everything within its tolerance, cut at two sigma."""
    assert climb_by_two_poses(backend, ROBOT, [height] * 24, friction, perturb(ROBOT, 1), reach=reach).sum() == 24


# ---- bits ------------------------------------------------------------------------------------------------------------

KINDS = ("bumps", "waves", "kerb", "third", "stairs", "all", "grid")
HILLS = enter_grid(np.random.default_rng(6).uniform(0.0, 0.01, (40, 50)))
SPOTS = maps.enter_map(np.random.default_rng(7).uniform(0.2, 0.9, (50, 60)))
COUNT = 37


def _mixed(rows):
    """Robots of a batch that stand on floors of every kind; robot k of the batch is always the same."""
    parameters, rng = Parameters.nominal(ROBOT, COUNT), np.random.default_rng(5)
    kind = np.array([KINDS[k % len(KINDS)] for k in range(COUNT)])

    def where(*names, value):
        return np.where(np.isin(kind, names), value, 0.0)

    parameters["bumps.height"], parameters["bumps.seed"] = where("bumps", "all", value=0.01), rng.integers(0, 80_000, COUNT)
    parameters["wave.height[wave_1]"] = where("waves", "all", value=0.004)
    parameters["grid.number"], parameters["grid.cell"] = where("grid", "all", value=HILLS), 0.1
    parameters["grid.heading"], parameters["friction_map.number"] = rng.uniform(-3.0, 3.0, COUNT), where("grid", value=SPOTS)
    parameters["piece.x"] = 0.3 + 0.1 * np.arange(8) * (kind == "stairs")[:, None]
    parameters["piece.height[piece_1]"] = where("kerb", "all", "stairs", value=0.01)
    parameters["piece.height[piece_3]"] = where("third", "all", value=0.015) + where("stairs", value=0.03)
    parameters["piece.height[piece_2]"] = where("stairs", value=0.02)
    parameters["ground.mu_x"] = parameters["ground.mu_y"] = rng.uniform(0.3, 0.9, (COUNT, 1))
    return Parameters(parameters.values[rows])


def _rollout(backend, rows, precision="float64", threads=1, ticks=50):
    rows = np.asarray(rows)
    parameters, rng = _mixed(rows), np.random.default_rng(1)
    plant = plants.make_plant(backend, ROBOT, len(rows), PlantOptions(precision=precision, threads=threads))
    plant.reset(rows.astype(np.uint64), parameters, state=standing_state(ROBOT, parameters))
    for draw in rng.standard_normal((ticks, COUNT, 8))[:, rows]:
        plant.step(HOME + np.array([0, 0, 0, 0, 6, 6, 6, 6]) + np.repeat([0.2, 2.0], 4) * draw)
    return plant.truth().values.copy()


@pytest.mark.parametrize(
    ("backend", "precision"), [("gibbs_appell", "float64"), ("gibbs_appell", "float32"), ("mujoco", "float64")]
)
def test_bits_depend_on_no_neighbour_thread_or_place_in_the_batch(backend, precision):
    """Neither on what others stand on: alone, a robot's kernel knows of its own kind of floor only."""
    together = _rollout(backend, range(COUNT), precision)
    assert np.isfinite(together).all()
    assert np.array_equal(_rollout(backend, range(COUNT), precision, threads=2), together)
    assert np.array_equal(_rollout(backend, range(COUNT)[::-1], precision)[::-1], together)
    for alone in (0, 6) if precision == "float32" else (0, 1, 2, 4, 33, 34):  # a kernel to compile for each kind
        assert np.array_equal(_rollout(backend, [alone], precision)[0], together[alone]), KINDS[alone % len(KINDS)]


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_robot_on_a_level_floor_moves_alike_where_others_stand_on_relief(backend):
    """A thin disc rolls for it in either kernel; only rounding differs."""

    def run(edit):
        plant = make_plant(2, edit, backend=backend)
        return drive(plant, 1.0, HOME + np.array([0.3, -0.2, 0.1, 0.0, 5, 3, 5, 3])).values[0].copy()

    def beside(parameters):
        parameters["piece.x[piece_1]"], parameters["piece.height[piece_1]"] = 0.4, [0.0, 0.02]

    assert np.allclose(run(beside), run(None), rtol=0, atol=1e-6)


# ---- changes in mid-run ----------------------------------------------------------------------------------------------


def _add_kerb(plant):
    changed = plant.parameters.copy()
    changed["piece.x[piece_1]"], changed["piece.height[piece_1]"] = 2.0, 0.02
    plant.set_parameters(changed)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_kerb_that_appears_in_mid_run_leaves_the_state_as_it_was(backend):
    """Far ahead of robots that drive straight on, it changes nothing but rounding; what comes then is as if never changed."""
    setpoints = HOME + np.array([0, 0, 0, 0, 5, 5, 5, 5])
    plant, other = (make_plant(3, None, backend=backend) for _ in range(2))
    for one in (plant, other):
        drive(one, 0.5, setpoints)
    before, servos = plant.truth().values.copy(), vars(plant.mechanical_state().copy())
    _add_kerb(plant)
    assert np.array_equal(plant.truth().values, before)
    for name, value in vars(plant.mechanical_state()).items():
        assert np.array_equal(value, servos[name]), name
    assert np.allclose(drive(plant, 0.5, setpoints).values, drive(other, 0.5, setpoints).values, rtol=0, atol=1e-5)


def _on_stairs(count, backend, precision="float64"):
    def edit(parameters):
        load_floor("stairs", ROBOT).write(parameters, spawn_seeds(7, count))

    return make_plant(count, edit, backend=backend, precision=precision)


@pytest.mark.parametrize(
    ("backend", "precision"), [("gibbs_appell", "float64"), ("gibbs_appell", "float32"), ("mujoco", "float64")]
)
def test_a_snapshot_on_relief_goes_on_bit_for_bit(backend, precision):
    setpoints = np.tile(HOME + np.array([0.1, 0, 0, -0.1, 7, 7, 7, 7]), (3, 1))
    plant = _on_stairs(3, backend, precision)
    drive(plant, 1.2, setpoints)  # on an edge
    snapshot = plant.get_state()
    after = drive(plant, 0.6, setpoints).values
    plant.set_state(snapshot)
    assert np.array_equal(drive(plant, 0.6, setpoints).values, after)
    fresh = _on_stairs(3, backend, precision)
    fresh.set_state(snapshot)
    assert np.array_equal(drive(fresh, 0.6, setpoints).values, after)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_snapshot_of_relief_goes_into_a_plant_that_knew_none(backend):
    setpoints = np.tile(HOME + np.array([0, 0, 0, 0, 7, 7, 7, 7]), (2, 1))
    plant, level = _on_stairs(2, backend), make_plant(2, None, backend=backend)
    drive(plant, 1.2, setpoints)
    level.set_state(plant.get_state())
    assert np.array_equal(drive(level, 0.4, setpoints).values, drive(plant, 0.4, setpoints).values)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_reset_of_some_leaves_the_others_alone(backend):
    setpoints = np.tile(HOME + np.array([0, 0, 0, 0, 7, 7, 7, 7]), (4, 1))
    plant, other = _on_stairs(4, backend), _on_stairs(4, backend)
    for one in (plant, other):
        drive(one, 1.0, setpoints)
    mask = np.array([False, True, False, True])
    plant.reset(mask=mask)
    reset, undisturbed = (drive(one, 0.5, setpoints).values for one in (plant, other))
    assert np.array_equal(reset[~mask], undisturbed[~mask])
    fresh = _on_stairs(4, backend)
    assert np.array_equal(drive(fresh, 0.5, setpoints).position[mask], plant.truth().position[mask])


# ---- random states ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("floor", PRESETS[1:])
def test_random_states_and_setpoints_stay_finite(floor):
    """No contact throws a robot: it is thrown at some metres per second, and falls from 0.1 m."""
    fuzzed = fuzz(floor, substeps=40_000, seed=0)
    assert fuzzed.lost == 0
    assert fuzzed.fastest < 10.0


def test_random_states_and_setpoints_stay_finite_in_single_precision():
    assert fuzz("stairs", substeps=40_000, seed=2, precision="float32").lost == 0
