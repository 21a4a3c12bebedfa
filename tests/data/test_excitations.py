"""Excitations: what every motion promises, whatever the seed; and that they are of the kinds real data sets are made of."""

from pathlib import Path

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.data import read_dataset
from wlr_gym.data.excitations import CONTROL_PERIOD, EXCITATIONS, GENTLE, LEG_MARGIN, REST, TOP_SPEED, excite
from wlr_gym.physics.servo import leg_profile_step
from wlr_gym.robot import load_robot

ROBOT = load_robot()
DATA = Path(__file__).parents[3] / "shared" / "data" / "twin_dev"
MEASURED = tuple(EXCITATIONS)[:8]


@pytest.mark.parametrize("name", EXCITATIONS)
def test_motion_rests_first_and_last_and_stays_within_its_limits(name):
    low, high = ROBOT.leg_limits
    for seed in range(8):
        motion = excite(name, seed, ROBOT)
        legs, wheels = motion.setpoints[:, :4], np.nan_to_num(motion.setpoints[:, 4:])
        rest = round(REST / motion.period)
        assert 13.0 < motion.duration < 25.0
        assert np.isfinite(motion.setpoints[:, :6]).all()
        for ends in (slice(0, rest), slice(-rest + 1, None)):
            assert not wheels[ends].any()
            assert (np.ptp(legs[ends], axis=0) == 0.0).all()
        assert legs.min() >= low + LEG_MARGIN
        assert legs.max() <= high - LEG_MARGIN
        assert np.abs(wheels).max() <= TOP_SPEED < ROBOT.servo.wheel.no_load_speed


@pytest.mark.parametrize("name", EXCITATIONS)
def test_seed_decides_the_motion(name):
    one, again, other = excite(name, 3), excite(name, 3), excite(name, 4)
    assert np.array_equal(one.setpoints, again.setpoints, equal_nan=True)
    assert one.setpoints.shape != other.setpoints.shape or not np.array_equal(one.setpoints, other.setpoints, equal_nan=True)


@pytest.mark.parametrize("name", EXCITATIONS)
def test_period_samples_the_same_motion(name):
    coarse, fine = excite(name, 1, period=0.02), excite(name, 1, period=0.01)
    ticks = min(len(coarse.setpoints), len(fine.setpoints[::2]))
    assert np.array_equal(coarse.setpoints[:ticks], fine.setpoints[::2][:ticks], equal_nan=True)
    assert len(excite(name, 1, seconds=3.0).setpoints) == 150


@pytest.mark.parametrize("name", ["posture", "random", "chirp"])
def test_legs_do_not_depend_on_the_last_per_cent_of_their_profile(name):
    """A servo's profile, here half as fast as usual, makes the same of setpoints to a count if it accelerates 2 % faster."""
    goals = np.stack([excite(name, seed, ROBOT, seconds=20.0).setpoints[-650:, :4:2] for seed in (1, 2)])
    acceleration = 0.5 * GENTLE.leg_acceleration * np.array([1.0, 1.02])[:, None, None, None]
    first, second = _profiled(goals, GENTLE.leg_velocity, acceleration)
    assert np.abs(first - second).max() < 2 * np.pi / 4096


def _profiled(goals, velocity, acceleration, substeps=8):
    """References (accelerations, ticks, ...) of a leg's profile generator for goals (seeds, ticks, legs) of 20 ms each."""
    position = np.broadcast_to(goals[:, 0], (len(acceleration), *goals[:, 0].shape))
    acceleration, rate, path = acceleration[:, 0], np.zeros_like(position), []
    for goal in goals.swapaxes(0, 1):
        for _ in range(substeps):
            position, rate, _, _ = leg_profile_step(position, rate, goal, velocity, acceleration, CONTROL_PERIOD / substeps)
        path.append(position)
    return np.stack(path, axis=1)


def test_posture_sweep_rolls_the_treads():
    """While legs swing, wheel setpoints are such that all four hubs would move at one speed without slip."""
    motion = excite("posture", 2, period=1e-3)
    legs, wheels = motion.setpoints[:, :4], motion.setpoints[:, 4:]
    rates = np.gradient(legs, motion.period, axis=0)
    hub = ROBOT.wheel.radius * (wheels + rates) + ROBOT.leg.length * np.sin(legs) * rates
    speed = np.median(hub, axis=1)
    steady = np.abs(hub - speed[:, None]).max(axis=1) < 1e-4
    assert steady.mean() > 0.99  # all but the corners, where the numerical rate is a mean of both sides
    assert np.ptp(legs[:, 0]) > 0.5


def test_torque_switches():
    """Rear wheels run free while the legs turn over; nowhere else is a motor off."""
    for name in EXCITATIONS:
        off = np.isnan(excite(name).setpoints)
        assert off[:, 6:].all() == off.any() == (name in {"rear_legs", "all_legs"})
        assert not off[:, :6].any()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"name": "strait"}, "did you mean 'straight'"),
        ({"name": "turns", "seed": -1}, "seed = -1"),
        ({"name": "turns", "period": 0.0}, "period = 0: expected more than 0 s"),
        ({"name": "turns", "seconds": -2.0}, "seconds = -2: expected more than 0 s"),
    ],
)
def test_bad_input_is_named(arguments, words):
    with pytest.raises(InputError, match=words):
        excite(**arguments)


@pytest.mark.skipif(not DATA.is_dir(), reason="no measured data beside the repository")
def test_kinds_are_those_of_the_measured_data():
    """By what tells the kinds apart: which motors are off, how far legs swing, speeds, and left against right."""
    measured = {name: [] for name in MEASURED}
    for folder in ("none_a", "none_b", "payload"):
        for name, run in zip(MEASURED, read_dataset(DATA / folder).runs, strict=True):
            commands = [column for column in run.table.columns if column.startswith("cmd_")]
            measured[name].append(_traits(run.table[commands].to_numpy()))
    for name in MEASURED:
        ours = np.array([_traits(excite(name, seed, ROBOT).setpoints) for seed in range(30)])
        slack = 0.35 * (np.ptp(ours, axis=0) + np.array([0.0, 0.1, 0.5, 0.5]))
        for traits in measured[name]:
            assert (traits >= ours.min(axis=0) - slack).all(), (name, traits, ours.min(axis=0))
            assert (traits <= ours.max(axis=0) + slack).all(), (name, traits, ours.max(axis=0))


def _traits(setpoints: np.ndarray) -> np.ndarray:
    wheels = np.nan_to_num(setpoints[:, 4:])
    swing = np.ptp(setpoints[:, :4], axis=0).max()
    return np.array([np.isnan(setpoints).mean(), swing, np.abs(wheels).max(), np.abs(wheels[:, 0] - wheels[:, 1]).max()])
