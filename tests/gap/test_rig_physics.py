"""The simulated rig against closed forms."""

import math

import numpy as np
import pytest
from numpy.typing import ArrayLike

from wlr_gym.gap.problem import Setting
from wlr_gym.gap.rig import pendulum
from wlr_gym.gap.rig.pendulum import QUANTITIES, model_of, pack
from wlr_gym.gap.rig.pendulum_recordings import Recording
from wlr_gym.physics.plants.drive import TEETH_DAMPING, fitted_weight
from wlr_gym.physics.servo import motor_constants, motor_torque

K, R = motor_constants(0.52, 10.8, 5.0)
STEP = 1e-3
NEUTRAL = {
    "volt_gain": K / R, "back_emf_damping": K * K / R, "inverse_constant": 1.0 / K, "viscous": 0.0, "weight": 0.5,
    "stribeck_torque": 0.0, "inverse_stribeck_speed": 1.0, "ripple_amplitude": 0.0, "ripple_order": 1.0, "ripple_phase": 0.0,
    "half_play": 0.0, "rotor_inertia": 0.001, "teeth_stiffness": 50.0, "teeth_damping": TEETH_DAMPING * math.sqrt(50 * 0.001),
    "gain": 1e6, "zero": 0.0, "gravity": 0.48, "inertia": 0.006, "coulomb": 0.0, "torque_scale": 1.0, "load_friction": 0.0,
    "saturation": 0.0, "torque_limit": 10.0, "quadratic_friction": 0.0, "thermal": 0.0,
}  # fmt: skip
FREE = {"gravity": 0.0}
ANGLE, RATE, VOLTAGE, TORQUE, FRICTION = range(5)


def run(seconds, angle=0.0, rate=0.0, goal: ArrayLike = 0.0, supply=7.4, on=1.0, warmth=0.0, lag=0.0, step=STEP, **changes):
    """Simulate one model; the default gain makes the servo put the whole supply on its motor, towards ``goal``."""
    count = round(seconds / step)
    parameters = NEUTRAL | changes
    moved = parameters["rotor_inertia"] if parameters["half_play"] else parameters["inertia"]
    damping = parameters["back_emf_damping"] * parameters["torque_scale"] + parameters["viscous"]
    parameters["weight"] = float(fitted_weight(np.array(step * damping / moved)))
    setpoints = np.broadcast_to(np.asarray(goal, float), (count,)).copy()
    inputs = np.stack([np.broadcast_to(np.asarray(v, float), (count,)) for v in (supply, on, warmth)], axis=1)
    starts = np.full(count, -1)
    starts[0] = 0
    row = np.array([[parameters[name] for name in pendulum.PARAMETERS]])
    return pendulum.simulate(row, np.array([lag]), setpoints, inputs, starts, np.array([[angle, rate]]), step)[0]


# --- pendulum


def test_small_swings_have_the_pendulums_period():
    found = run(5.0, angle=0.01, on=0.0)
    time = np.arange(len(found)) * STEP
    omega = math.sqrt(0.48 / 0.006)
    np.testing.assert_allclose(found[:, ANGLE], 0.01 * np.cos(omega * time), atol=0.01 * 2e-3)


def test_large_swings_keep_their_energy_and_gain_none():
    def energy(found):
        return 0.5 * 0.006 * found[:, RATE] ** 2 - 0.48 * np.cos(found[:, ANGLE])

    errors = []
    for step in (2e-3, 1e-3):
        e = energy(run(20.0, angle=2.5, on=0.0, step=step))
        errors.append(np.ptp(e))
        assert abs(e[-1000:].mean() - e[:1000].mean()) < 1e-4
    assert errors[1] < 0.3 * errors[0]


def test_viscous_friction_alone_decays_exactly_at_any_step():
    for step in (1e-3, 2e-2):
        found = run(1.0, rate=3.0, on=0.0, viscous=0.05, back_emf_damping=0.0, step=step, **FREE)
        time = np.arange(len(found)) * step
        np.testing.assert_allclose(found[:, RATE], 3.0 * np.exp(-time * 0.05 / 0.006), rtol=1e-9)


def test_dry_friction_holds_the_pendulum_without_creep_up_to_its_bound():
    angle = 0.5
    load = 0.48 * math.sin(angle)
    held = run(3.0, angle=angle, on=0.0, coulomb=1.001 * load)
    assert (held[:, RATE] == 0.0).all()
    assert (held[:, ANGLE] == angle).all()
    np.testing.assert_allclose(held[:, FRICTION], load, rtol=1e-12)
    assert abs(run(3.0, angle=angle, on=0.0, coulomb=0.999 * load)[:, RATE]).max() > 1e-3


def test_dry_friction_stops_a_free_wheel_after_the_work_it_can_do():
    found = run(1.0, rate=4.0, on=0.0, coulomb=0.05, **FREE)
    assert found[-1, RATE] == 0.0
    assert found[-1, ANGLE] == pytest.approx(0.5 * 0.006 * 16 / 0.05, rel=1e-3)


# --- motor


def test_step_of_voltage_gives_the_motors_exponential():
    found = run(1.0, goal=1e3, supply=6.0, **FREE)
    time = np.arange(len(found)) * STEP
    np.testing.assert_allclose(found[:, RATE], 6.0 / K * (1.0 - np.exp(-time * K * K / R / 0.006)), rtol=1e-9, atol=1e-12)


def test_motor_torque_is_that_of_servo_py():
    found = run(0.3, goal=1e3, supply=6.0, **FREE)
    middle = 0.5 * (found[1:, RATE] + found[:-1, RATE])
    np.testing.assert_allclose(found[:-1, TORQUE], motor_torque(K, R, 6.0, middle), rtol=1e-3)


def test_open_winding_neither_drives_nor_brakes():
    found = run(1.0, rate=5.0, goal=1e3, on=0.0, **FREE)
    np.testing.assert_allclose(found[:, RATE], 5.0, rtol=1e-12)
    assert (found[:, TORQUE] == 0.0).all()


def test_duty_is_proportional_to_the_error_and_ends_at_the_supply():
    blocked = {"coulomb": 50.0, "gain": 0.7}
    errors = np.array([-3.0, -0.5, 0.25, 5.0])
    volts = [run(0.01, goal=e + 0.1, angle=0.0, supply=7.0, zero=0.1, **blocked)[-1, VOLTAGE] for e in errors]
    # the reading starts at 0: the true angle at -zero
    np.testing.assert_allclose(volts, 7.0 * np.clip(0.7 * (errors + 0.1), -1, 1), rtol=1e-12)


def test_delay_shifts_the_response_also_by_parts_of_a_step():
    ramp = np.minimum(np.arange(2000) * STEP, 1.0)
    prompt = run(2.0, goal=ramp, gain=2.0)
    for lag in (7.0, 7.5):
        late = run(2.0, goal=ramp, gain=2.0, lag=lag)
        time = np.arange(2000) * STEP
        shifted = np.interp(time - lag * STEP, time, prompt[:, ANGLE])
        assert np.abs(late[:, ANGLE] - shifted).max() < 2e-4
        assert np.abs(late[:, ANGLE] - prompt[:, ANGLE]).max() > 5e-3


# --- effects


def blocked(**changes):
    """Motor at full supply against a brake: its torque and the friction that holds it."""
    return run(0.01, goal=1e3, coulomb=50.0, **FREE, **changes)[-1]


def test_saturated_torque_falls_behind_the_current():
    current = 7.4 / R
    assert blocked(saturation=0.6)[TORQUE] == pytest.approx(K * current / (1.0 + 0.6 * current), rel=1e-12)


def test_torque_limit_limits_and_leaves_less_alone():
    assert blocked(torque_limit=0.3)[TORQUE] == pytest.approx(0.3, rel=1e-12)
    assert blocked(torque_limit=0.3, supply=1.0)[TORQUE] == pytest.approx(K / R, rel=1e-12)


def test_warm_winding_has_more_resistance():
    assert blocked(thermal=0.0039, warmth=20.0)[TORQUE] == pytest.approx(K / R * 7.4 / 1.078, rel=1e-12)


def test_weak_motor_gives_its_share():
    assert blocked(torque_scale=0.7)[TORQUE] == pytest.approx(0.7 * K / R * 7.4, rel=1e-12)


@pytest.mark.parametrize(
    ("change", "bound"),
    [({"load_friction": 0.2}, lambda t: 0.02 + 0.2 * t), ({"quadratic_friction": 0.5}, lambda t: 0.02 + 0.5 * t * t)],
)
def test_friction_grows_with_the_motors_torque(change, bound):
    """Steadily turning, the motor's torque is the friction's bound; at rest it is what must be overcome."""
    found = run(3.0, goal=1e3, supply=3.0, coulomb=0.02, **change, **FREE)
    assert found[-1, RATE] > 1.0
    torque = found[-1, TORQUE]
    assert torque == pytest.approx(bound(torque), rel=1e-6)
    assert -found[-1, FRICTION] == pytest.approx(torque, rel=1e-6)


def test_stribeck_friction_fades_with_speed():
    changes = {"coulomb": 0.02, "stribeck_torque": 0.05, "inverse_stribeck_speed": 1.0 / 0.5}
    stuck = run(1.0, goal=1e3, supply=0.99 * 0.07 * R / K, **changes, **FREE)
    assert (stuck[:, RATE] == 0.0).all()
    rate, friction = run(3.0, goal=1e3, supply=1.05 * 0.07 * R / K, **changes, **FREE)[-1, [RATE, FRICTION]]
    assert -friction == pytest.approx(0.02 + 0.05 * math.exp(-((rate / 0.5) ** 2)), rel=1e-6)


def test_ripple_is_a_potential():
    found = run(5.0, rate=4.0, on=0.0, ripple_amplitude=0.01, ripple_order=5.0, ripple_phase=0.3, **FREE)
    energy = 0.5 * 0.006 * found[:, RATE] ** 2 + 0.01 / 5.0 * np.cos(5.0 * found[:, ANGLE] + 0.3)
    assert np.ptp(energy) < 2e-4 * energy.mean()
    assert np.ptp(found[:, RATE]) > 0.1


def test_inside_its_play_the_link_swings_without_rotor_and_gear_friction():
    """Rotor held by its friction: a swing smaller than the play has the bare link's period and keeps its size."""
    found = run(3.0, angle=0.02, on=0.0, half_play=0.05, coulomb=0.1, inertia=0.005)
    time = np.arange(len(found)) * STEP
    np.testing.assert_allclose(found[:, ANGLE], 0.02 * np.cos(math.sqrt(0.48 / 0.005) * time), atol=0.02 * 3e-3)


def test_beyond_its_play_the_rotor_goes_along():
    """A slow pull of the motor takes up the play, then moves link and rotor as one."""
    lost = run(1.0, goal=1e3, supply=1.0, half_play=0.05, coulomb=0.01, inertia=0.005, **FREE)
    rigid = run(1.0, goal=1e3, supply=1.0, coulomb=0.01, **FREE)
    assert lost[-1, RATE] == pytest.approx(rigid[-1, RATE], rel=2e-2)


def test_a_link_rests_on_teeth_that_the_gears_friction_holds():
    """Gravity presses the link against its play; the rotor's dry friction carries it, without creep."""
    found = run(4.0, angle=0.5, on=0.0, half_play=0.01, coulomb=0.3, inertia=0.005)
    rest = found[-500:]
    assert np.abs(rest[:, RATE]).max() < 1e-9
    assert 0.44 < rest[-1, ANGLE] < 0.49  # past the gap; the blow may push the rotor on by (load x gap)/(friction - load)
    np.testing.assert_allclose(rest[:, FRICTION], 0.48 * np.sin(rest[:, ANGLE]), rtol=1e-6)


def test_arm_and_load_give_gravity_and_inertia():
    """A load at its end and a uniform arm: m l + m_arm l/2 and m l^2 + m_arm l^2/3."""
    recording = read_recording_of(mass=0.49, length=0.098)
    numbers = {quantity.name: quantity.nominal for quantity in QUANTITIES} | {"arm_mass": 0.06, "length_error": 0.002}
    model = model_of(Setting(np.array(list(numbers.values()))), QUANTITIES)
    lanes = dict(zip(pendulum.PARAMETERS, pack([model], recording, STEP)[0], strict=True))
    assert lanes["gravity"] == pytest.approx(9.81 * 0.1 * (0.49 + 0.03))
    assert lanes["inertia"] == pytest.approx(0.01 * (0.49 + 0.02) + numbers["armature"])
    assert lanes["volt_gain"] == pytest.approx(0.52 / 5.0)
    assert lanes["gain"] == pytest.approx(200 * 4096 / (2 * math.pi) / (256 * 885))


def read_recording_of(mass, length):
    none = np.zeros(0)
    return Recording("none", "none", mass, length, None, 200.0, 7.4, *([none] * 8), enabled=none.astype(bool))


# --- the compiled law is the scalar one


@pytest.mark.parametrize("half_play", [0.0, 0.004])
def test_kernel_does_what_the_law_says(half_play):
    changes = {
        "half_play": half_play, "coulomb": 0.02, "viscous": 0.004, "stribeck_torque": 0.01, "load_friction": 0.15,
        "ripple_amplitude": 0.01, "ripple_order": 3.0, "saturation": 0.2, "torque_limit": 0.5, "quadratic_friction": 0.2,
        "thermal": 0.0039, "torque_scale": 0.9, "gain": 2.0, "zero": 0.02,
    }  # fmt: skip
    goal = np.sin(np.arange(1500) * 7 * STEP)
    found = run(1.5, goal=goal, warmth=9.0, **changes)
    parameters = NEUTRAL | changes
    moved = parameters["rotor_inertia"] if half_play else parameters["inertia"]
    damping = parameters["back_emf_damping"] * 0.9 + 0.004
    parameters["weight"] = float(fitted_weight(np.array(STEP * damping / moved)))
    features = frozenset({"drive", "backlash"} if half_play else {"drive"})
    lead = half_play * np.sign(goal[0] - 0.0)
    state = {"angle": -0.02, "rate": 0.0, "rotor_lead": lead, "rotor_rate": 0.0}
    for k in range(1500):
        assert found[k, ANGLE] == pytest.approx(state["angle"], abs=1e-9)
        lanes = {**parameters, **state, "goal": goal[k], "supply": 7.4, "on": 1.0, "warmth": 9.0}
        new = pendulum.substep(lanes, STEP, features)
        assert found[k, TORQUE] == pytest.approx(new["motor_torque"], abs=1e-7)
        state = {name: float(new[name]) for name in pendulum.STATE}
    assert np.ptp(found[:, ANGLE]) > 0.2
