"""Robots on kerbs, ramps, waves and bumps against closed forms and rigid statics."""

from __future__ import annotations

import numpy as np
import pytest
from energy import mechanical_energy
from relief_statics import highest_kerb, wheel_loads
from rig import BACKENDS, MASS, RADIUS, ROBOT, WEIGHT, G, drive, lock, make_plant

from studies.bench.climbing import KERB, Climber, climb_straight
from wlr_gym.base.random import spawn_seeds
from wlr_gym.physics.floor import load_floor
from wlr_gym.physics.model.dynamics import inertial_constants, rotation_matrix

FRICTIONS = (0.4, 0.6, 0.9)
PRESETS = ("rough", "gravel", "kerbs", "ramps", "stairs")


# ---- kerbs with still legs -------------------------------------------------------------------------------------------


def _thresholds(backend, frictions, around, reach, count=7, **given):
    """Highest kerbs (m) of a row of them around a height each that robots with still legs climb, and the row's step."""
    heights = np.array([np.linspace(height - reach, height + reach, count) for height in around])
    up = climb_straight(backend, ROBOT, heights.ravel(), np.repeat(frictions, count), **given).reshape(heights.shape)
    assert up[:, 0].all()
    assert not up[:, -1].any()
    assert (np.diff(up.astype(int), axis=1) <= 0).all()  # none above one that is too high
    return np.where(up, heights, 0.0).max(axis=1), 2 * reach / (count - 1)


def test_still_legs_climb_kerbs_as_high_as_statics_says():
    """Within 0.06 wheel radii of rigid statics: the floor's springs add 0.03, the drive's momentum 0.01."""
    statics = [highest_kerb(friction, 1e-3) for friction in FRICTIONS]
    found, _ = _thresholds("gibbs_appell", FRICTIONS, statics, 0.06 * RADIUS)
    assert np.abs(found - statics).max() < 0.06 * RADIUS
    for friction, height in zip(FRICTIONS[:2], found, strict=False):  # with half the weight on each axle, without a pitch
        steepest = 2.0 * np.arctan(friction)  # tan(steepest - atan mu) = mu
        assert height == pytest.approx(RADIUS * (1.0 - np.cos(steepest)), abs=0.06 * RADIUS)


def test_on_a_stiff_floor_still_legs_climb_what_rigid_statics_says():
    """Springs ten times as stiff: from 0.02 wheel radii below up to 0.03 above."""

    def stiffen(parameters):
        parameters["ground.normal_stiffness"] *= 10.0
        parameters["ground.normal_damping"] *= 10.0**0.5

    statics = np.array([highest_kerb(friction, 1e-3) for friction in FRICTIONS])
    heights = np.concatenate([statics - 0.02 * RADIUS, statics + 0.03 * RADIUS])
    up = climb_straight("gibbs_appell", ROBOT, heights, np.tile(FRICTIONS, 2), edit=stiffen, physics_step=2.5e-4)
    assert up.tolist() == [True] * 3 + [False] * 3


@pytest.mark.slow
def test_both_simulators_climb_kerbs_of_the_same_height():
    """Within 0.03 wheel radii."""
    around = np.array([0.27, 0.48, 0.78]) * RADIUS
    found, step = zip(*(_thresholds(backend, FRICTIONS, around, 0.04 * RADIUS, 5) for backend in BACKENDS), strict=True)
    assert np.abs(found[0] - found[1]).max() + step[0] <= 0.03 * RADIUS


# ---- ramps -----------------------------------------------------------------------------------------------------------


def _on_ramp(backend, slope, friction):
    """Robots with locked joints at rest in the middle of long ramps."""

    def edit(parameters):
        lock(parameters)
        parameters["piece.x[piece_1]"], parameters["piece.height[piece_1]"] = -0.8, 1.0
        parameters["piece.front_slope[piece_1]"] = slope
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = np.reshape(friction, (-1, 1))

    return make_plant(len(slope), edit, backend=backend)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_locked_robot_sticks_on_a_ramp_up_to_the_angle_of_friction_and_slides_beyond(backend):
    """Half a degree below and above; sliding it gains g (sin - mu cos)."""
    friction = np.tile([0.2, 0.4, 0.6], 2)
    slope = np.arctan(friction) + np.radians(np.repeat([-0.5, 0.5], 3))
    plant = _on_ramp(backend, slope, friction)
    pitch = 2.0 * np.arcsin(plant.truth().quaternion[:, 2])
    assert np.allclose(-pitch, slope, atol=0.01)
    drive(plant, 0.5)
    start = plant.truth().position.copy()
    speed = np.linalg.norm(plant.truth().linear_velocity_in_body, axis=1)
    after = drive(plant, 0.5)
    way = np.linalg.norm(after.position - start, axis=1)
    assert (way[:3] < 2e-5).all()
    gained = np.linalg.norm(after.linear_velocity_in_body, axis=1) - speed
    expected = 0.5 * G * (np.sin(slope) - friction * np.cos(slope))
    assert gained[3:] == pytest.approx(expected[3:], rel=0.03)


# ---- waves -----------------------------------------------------------------------------------------------------------


def _coast(step):
    """Error of the energy of robots that slide over frictionless waves for 1.5 s, over their kinetic energy."""
    count = 4

    def edit(parameters):
        parameters["wave.height[wave_1]"], parameters["wave.length[wave_1]"] = [0.005, 0.01, 0.02, 0.02], [0.3, 0.5, 0.8, 0.8]
        parameters["wave.heading[wave_1]"] = [0.0, 0.3, 0.0, 0.5]
        lock(parameters)
        for name in ("ground.mu_x", "ground.mu_y", "ground.normal_damping"):
            parameters[name] = 0.0

    def push(state):
        state.linear_velocity_in_body[:, 0] = 0.5

    plant = make_plant(count, edit, push, step=step)
    stiffness = plant.parameters["ground.normal_stiffness"]

    def energy():
        pressed = np.maximum(plant.contacts().depth[:, :4], 0.0)
        return mechanical_energy(plant.parameters, plant.truth()) + 0.5 * (stiffness * pressed**2).sum(axis=1)

    before = energy()
    drive(plant, 1.5)
    return np.abs(energy() - before) / (0.5 * MASS * 0.5**2)


def test_energy_is_kept_over_frictionless_waves():
    """Within 0.1 % of the kinetic energy at 1 ms: measured, 0.03 %."""
    assert _coast(1e-3).max() < 0.001


# ---- loads -----------------------------------------------------------------------------------------------------------


def _centre_of_mass(plant):
    """Centres of mass (N, 3), floor frame, m."""
    truth, constants = plant.truth(), inertial_constants(plant.parameters)
    mass, moment, angle = constants["assembly_mass"], constants["first_moment"], truth.joint_position[:, :4]
    place = [mass * constants["hip_x"] + moment * np.cos(angle), mass * constants["hip_y"],
             mass * constants["hip_z"] - moment * np.sin(angle)]  # fmt: skip
    first = np.stack([part.sum(axis=1) for part in place], axis=1) + constants["platform_first_moment"]
    return truth.position + np.einsum("nij,nj->ni", rotation_matrix(truth.quaternion), first) / MASS


def _wrench(plant):
    """Force (N, 3) of the floor on robots and its moment (N, 3) about their centres of mass."""
    found = plant.contacts()
    axes = np.stack([found.heading, found.lateral, found.normal], axis=2)
    force = np.einsum("ncij,nci->ncj", axes, found.force)
    arm = found.point - _centre_of_mass(plant)[:, None]
    return force.sum(axis=1), np.cross(arm, force).sum(axis=1)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("floor", PRESETS)
def test_contacts_carry_the_weight_of_a_robot_at_rest(backend, floor):
    """Their forces along their own axes add up to it, and to no moment about the centre of mass."""
    count = 6

    def edit(parameters):
        lock(parameters)
        load_floor(floor, ROBOT).write(parameters, spawn_seeds(3, count))

    def place(state):
        if floor not in ("rough", "gravel"):
            state.position[:, 0] = 0.0

    plant = make_plant(count, edit, place, backend=backend)
    drive(plant, 1.5)
    force, moment = _wrench(plant)
    assert force == pytest.approx(np.tile([0.0, 0.0, WEIGHT], (count, 1)), abs=0.01 * WEIGHT)
    assert np.abs(moment).max() < 0.01 * WEIGHT * ROBOT.hip_position.x


@pytest.mark.parametrize("backend", BACKENDS)
def test_three_wheels_carry_what_rigid_statics_says(backend):
    """Front wheels on kerbs, the left one lifted off: the legs put the centre of mass over the other three."""
    climber = Climber(backend, ROBOT, [0.01, 0.03], 0.6, legs=(70.0, 70.0, 30.0, 30.0), gap=-0.1)
    climber.move({"lf": 20.5}, 0.0, 1.0)
    climber.hold(1.0)
    plant = climber.plant
    load, place = plant.contacts().force[:, :, 2], plant.contacts().point
    assert (climber.wheels()[:, 1, 0] > KERB).all()
    assert (load[:, 4:] == 0.0).all()
    assert (load[:, 0] == 0.0).all()
    for row, centre in enumerate(_centre_of_mass(plant)):
        expected = wheel_loads(place[row, 1:4, :2], centre[:2], WEIGHT)
        assert load[row, 1:4] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_symmetric_robot_with_a_plank_under_one_wheel_stands_on_a_diagonal(backend):
    """Rigid legs: the raised wheel and the one across carry nearly all; a third keeps the robot from tipping."""

    def edit(parameters):
        lock(parameters)
        x, y = ROBOT.hip_position.x, ROBOT.hip_position.y
        heading = np.arctan2(y, x)
        parameters["piece.height[piece_1]"], parameters["piece.length[piece_1]"] = [0.01, 0.03], 0.1
        parameters["piece.heading[piece_1]"] = heading
        parameters["piece.x[piece_1]"], parameters["piece.y[piece_1]"] = x - 0.05 * np.cos(heading), y - 0.05 * np.sin(heading)

    plant = make_plant(2, edit, backend=backend)
    drive(plant, 2.0)
    found = plant.contacts()
    for row, centre in enumerate(_centre_of_mass(plant)):
        carrying = np.flatnonzero(found.force[row, :, 2] > 0.0)
        load = found.force[row, carrying, 2]
        assert load == pytest.approx(wheel_loads(found.point[row, carrying, :2], centre[:2], WEIGHT), abs=0.01 * WEIGHT)
        assert load[np.isin(carrying % 4, (0, 3))].sum() > 0.95 * WEIGHT
