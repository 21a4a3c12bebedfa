"""Energy balance of a driven robot on a slope: what the motors put in is stored or dissipated, term by term."""

import numpy as np
import pytest
from energy import mechanical_energy, wheel_gaps
from rig import make_plant

from wlr_gym.physics.plants.base import Truth

COUNT = 4
STEP = 1e-3
VISCOUS = 0.005
ROLLING = 0.01
MU = np.array([[0.3, 0.3], [0.5, 0.4], [0.6, 0.2], [0.4, 0.4]])


def edit(parameters):
    parameters["ground.slope"] = (0.1, 0.05)
    parameters["ground.mu_x"], parameters["ground.mu_y"] = MU.T
    parameters["ground.rolling_resistance"] = ROLLING
    parameters["servo.viscous_friction"] = VISCOUS
    parameters["servo.profile_velocity"] = 2.0
    parameters["servo.profile_acceleration"] = np.repeat([15.0, 10.0], 4)


def rates(truth):
    """Joint rates (N, 8), slip velocity (N, 8) and absolute spins of the wheels (N, 4)."""
    spin = truth.angular_velocity_in_body[:, 1:2] + truth.joint_velocity[:, :4] + truth.joint_velocity[:, 4:]
    return np.hstack([truth.joint_velocity, truth.slip_velocity, spin])


@pytest.fixture(scope="module")
def audit():
    """Work (ticks, N) of every force over 10 s of random driving, by name, and the energy at the ends."""
    rng = np.random.default_rng(0)
    plant = make_plant(COUNT, edit, step=STEP, period=STEP)
    parameters = plant.parameters
    names = ("motor", "gear", "viscous", "friction", "normal", "rolling")
    work = {name: np.zeros((10_000, COUNT)) for name in names}
    shown = np.zeros((10_000, COUNT))
    start = mechanical_energy(parameters, plant.truth())
    old = Truth(plant.truth().values.copy())
    old_gap, old_rates = wheel_gaps(parameters, old), rates(old)
    setpoints = np.zeros((COUNT, 8))
    for tick in range(10_000):
        if tick % 500 == 0:
            setpoints = np.hstack([rng.uniform(1.0, 2.1, (COUNT, 4)), rng.uniform(-5.0, 5.0, (COUNT, 4))])
        plant.step(setpoints)
        truth = plant.truth()
        gap, new_rates = wheel_gaps(parameters, truth), rates(truth)
        joint, slip, spin = np.split(0.5 * STEP * (new_rates + old_rates), [8, 16], axis=1)
        force = truth.contact_force.reshape(COUNT, 4, 3)
        work["motor"][tick] = (truth.motor_torque * joint).sum(axis=1)
        work["gear"][tick] = (truth.friction_torque * joint).sum(axis=1)
        work["viscous"][tick] = -VISCOUS * (joint**2).sum(axis=1) / STEP
        work["friction"][tick] = (force[..., :2].reshape(COUNT, 8) * slip).sum(axis=1)
        work["normal"][tick] = (force[..., 2] * (gap - old_gap)).sum(axis=1)
        work["rolling"][tick] = (truth.rolling_torque * spin).sum(axis=1)
        shown[tick] = truth.mechanical_energy
        old_gap, old_rates = gap, new_rates
    return start, mechanical_energy(parameters, plant.truth()), work, shown


def test_energy_balance_closes(audit):
    start, end, work, _ = audit
    total = sum(term.sum(axis=0) for term in work.values())
    done = np.abs(work["motor"]).sum(axis=0)
    error = np.abs(end - start - total) / done
    assert done.min() > 1.0
    assert error.max() < 1e-5


@pytest.mark.parametrize("term", ["gear", "viscous", "friction", "rolling"])
def test_every_friction_dissipates(audit, term):
    work = audit[2][term]
    assert work.sum(axis=0).max() < -1e-3
    assert work.max() < 1e-6  # J per tick: slip that reverses within a tick is averaged over its ends


def test_mechanical_energy_is_the_motors_work(audit):
    _, _, work, shown = audit
    np.testing.assert_allclose(shown, work["motor"], atol=1e-12)


def test_stalled_motors_turn_electrical_energy_into_heat():
    """A stalled motor draws V I with I = V/R and does no work."""

    def hold(parameters):
        parameters["servo.coulomb_friction"] = 50.0

    plant = make_plant(2, hold)
    setpoints = np.tile(np.concatenate([np.full(4, np.pi / 2), np.full(4, 100.0)]), (2, 1))
    plant.step(setpoints)
    truth = plant.truth()
    motor = plant.robot.servo.wheel
    current = motor.stall_torque / (12.0 / motor.no_load_speed)
    electrical = 4 * 12.0 * current * 0.02
    np.testing.assert_allclose(truth.electrical_energy, electrical, rtol=1e-5)
    assert np.abs(truth.mechanical_energy).max() < 1e-5 * electrical
