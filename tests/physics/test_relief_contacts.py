"""Contacts of wheels on relief: what they remember, starts in the air and in the floor, two of one wheel, along a kerb."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from relief_rig import enter_grid
from rig import BACKENDS, HOME, RADIUS, ROBOT, WEIGHT, drive, make_plant

from wlr_gym.base.errors import InputError
from wlr_gym.data.run_states import slip_of
from wlr_gym.physics.plants import contacts
from wlr_gym.physics.plants.gibbs_appell.kinematics import STORED
from wlr_gym.robot import FIRST_WHEEL

#: Half the distance of the axles along x, m, and the legs' length where they stand upright.
REACH = ROBOT.hip_position.x
KERB = {"piece.x[piece_1]": 0.0, "piece.height[piece_1]": 0.02}


# ---- what contacts remember ------------------------------------------------------------------------------------------


def _kept(places, before, load=(1.0, 1.0)):
    """What contacts 0 and 4 remember of 10 and 20, at places now and before."""
    now = [SimpleNamespace(number=number, place=place) for number, place in zip((0, 4), places, strict=True)]
    lanes = {"place0": before[0], "place4": before[1], "impulse0": 10.0, "impulse4": 20.0, "load0": load[0], "load4": load[1]}
    found = contacts.remembered(lanes, now, ["impulse"], "load")  # pyright: ignore[reportArgumentType]
    assert (found["place0"], found["place4"]) == places
    return found["impulse0"], found["impulse4"]


def test_memory_follows_contacts_that_change_places():
    assert _kept((1.0, 2.0), (1.0, 2.0)) == (10.0, 20.0)
    assert _kept((2.0, 1.0), (1.0, 2.0)) == (20.0, 10.0)
    assert _kept((2.0, 3.0), (1.0, 2.0)) == (20.0, 0.0)  # the edge is the deeper one now, another piece is new
    assert _kept((3.0, 4.0), (1.0, 2.0)) == (0.0, 0.0)


def test_what_carried_no_load_has_nothing_to_remember_elsewhere():
    assert _kept((2.0, 1.0), (1.0, 2.0), load=(1.0, 0.0)) == (0.0, 10.0)
    assert _kept((1.0, 2.0), (1.0, 2.0), load=(0.0, 0.0)) == (10.0, 20.0)


def test_a_tread_in_the_air_has_no_shear():
    """It is wound up by driving off; without gravity the floor's springs throw the robot up."""
    plant = make_plant(2, {"ground.slip_compliance": 0.05, "piece.height[piece_1]": 0.02, "piece.x[piece_1]": 5.0})
    shear = [STORED.index(f"shear_{axis}{i}") for i in range(4) for axis in "xy"]
    drive(plant, 0.06, HOME + np.repeat([0.0, 6.0], 4))
    assert np.abs(plant._lanes.reshape(-1, len(STORED), 8)[0, shear, :2]).max() > 1e-5
    weightless = plant.parameters.copy()
    weightless["gravity"] = 0.0
    plant.set_parameters(weightless)
    assert (drive(plant, 0.3).contact_force == 0.0).all()
    assert (plant._lanes.reshape(-1, len(STORED), 8)[0, shear, :2] == 0.0).all()


# ---- starts ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", BACKENDS)
def test_robots_dropped_on_a_kerb_come_to_rest_on_it(backend):
    """From 30 mm; front wheels on its top, rear wheels before it."""

    def lifted(state):
        state.position[:, 2] += 0.03

    plant = make_plant(2, KERB, lifted, backend=backend)
    assert (plant.truth().contact_force == 0.0).all()
    truth = drive(plant, 2.0)
    assert np.abs(truth.linear_velocity_in_body).max() < 1e-3
    assert truth.contact_force[:, 2::3].sum(axis=1) == pytest.approx(WEIGHT, rel=2e-3)
    pitch = 2.0 * truth.quaternion[:, 2]
    assert pitch == pytest.approx(-0.02 / (2.0 * REACH), rel=0.1)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_start_deep_inside_the_floor_is_refused(backend):
    def sunk(state):
        state.position[1, 2] -= 1.2 * RADIUS

    with pytest.raises(InputError, match=r"state: wheel_.. of robot 1 is 0.04\d+ m deep in the floor: expected less than"):
        make_plant(2, KERB, sunk, backend=backend)


# ---- two contacts of a wheel -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_truth_knows_the_forces_of_both_contacts_of_a_wheel(backend):
    """Front wheels pressed against a riser: what the truth says along the deeper contact's axes is the sum of both."""
    plant = make_plant(2, {"piece.x[piece_1]": 0.3, "piece.height[piece_1]": 0.06, "ground.mu_x": 0.3}, backend=backend)
    truth = drive(plant, 1.5, HOME + np.repeat([0.0, 4.0], 4))
    found = plant.contacts()
    axes = np.stack([found.heading, found.lateral, found.normal], axis=2)[0]
    each = np.einsum("ck,ckj->cj", found.force[0], axes)
    assert (np.linalg.norm(each[[4, 5]], axis=1) > 0.3).all()
    told = np.einsum("wk,wkj->wj", truth.contact_force[0].reshape(4, 3), axes[:4])
    assert told == pytest.approx(each[:4] + each[4:8], abs=1e-9)
    assert (each[8:] == 0.0).all()
    assert told[:, 2].sum() == pytest.approx(WEIGHT, rel=0.02)


@pytest.mark.parametrize("backend", BACKENDS)
def test_slip_told_of_a_state_is_that_of_the_truth(backend):
    hills = enter_grid(np.random.default_rng(1).uniform(0.0, 0.008, (40, 40)))
    setpoints = HOME + np.array([0.2, -0.1, 0.1, 0.0, 9.0, 6.0, 9.0, 4.0])
    for edit in (None, {"grid.number": hills, "grid.cell": 0.1, "grid.heading": 0.4}):
        plant = make_plant(3, [edit, {"ground.mu_x": 0.2}], backend=backend)
        truth = drive(plant, 0.7, setpoints)
        told = slip_of(ROBOT, plant.parameters, plant.mechanical_state())
        assert np.abs(truth.slip_velocity).max() > 0.01
        assert told.reshape(3, 8) == pytest.approx(truth.slip_velocity, abs=1e-9)


def test_wheels_roll_along_a_kerb_alike_in_both_simulators():
    """Robots steered against a riser beside them, higher than their axles, which the left wheels' sides touch."""
    beside = ROBOT.hip_position.y + 0.5 * ROBOT.wheel.width + 0.003
    kerb = {"piece.y[piece_1]": beside, "piece.heading[piece_1]": np.pi / 2, "piece.height[piece_1]": 0.08}
    ends: list[Any] = []
    for backend in BACKENDS:
        plant = make_plant(2, [kerb, {"ground.mu_x": 0.5, "ground.mu_y": 0.5}], backend=backend)
        truth = drive(plant, 2.0, HOME + np.repeat([0.0, 1.0], [FIRST_WHEEL, 4]) * [0, 0, 0, 0, 5.0, 5.5, 5.0, 5.5])
        assert np.isfinite(truth.values).all()
        ends.append(truth.position)
        found = plant.contacts()
        assert found.point[:, [0, 2, 4, 6], 1].max() < beside + 2e-3
        assert (found.depth[:, 4:] > 0.0).any()
    assert ends[0][:, 0].min() > 0.25
    assert np.abs(ends[0] - ends[1]).max() < 3e-3
