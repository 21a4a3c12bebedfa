"""The blind tests' simulator against the engine: no shared code, same numbers, same motion."""

import numpy as np
import pytest

from wlr_gym.bench.blind.cases import named
from wlr_gym.bench.blind.copies import Copy, read_robot
from wlr_gym.bench.blind.dataset import simulate_runs, write
from wlr_gym.bench.blind.truth import NAMED
from wlr_gym.parameters import Parameters
from wlr_gym.paths import data_directory
from wlr_gym.robot import load_robot
from wlr_gym.runs import read_run
from wlr_gym.runs.replay import replay

ROBOT = read_robot(data_directory("configs") / "robot" / "nominal.yaml")
SHARP = ("vel_leg", "vel_wheel", "eff_wheel", "gyro", "acc", "cam_x", "cam_y", "cam_z", "cam_pitch", "cam_yaw", "volt")


def parameters_of(copy: Copy) -> Parameters:
    """The copy's numbers as the engine's parameters."""
    parameters = Parameters.nominal(load_robot())
    numbers = {
        "body.mass": copy.mass,
        "body.inertia": copy.inertia,
        "body.com_offset": copy.com,
        "leg.mass": copy.leg_mass,
        "leg.inertia": copy.leg_inertia.reshape(-1),
        "wheel.radius": copy.radius,
        "servo.kp": copy.kp,
        "servo.stall_torque": copy.stall_torque,
        "servo.no_load_speed": copy.no_load_speed,
        "servo.armature": copy.armature,
        "servo.coulomb_friction": copy.coulomb,
        "servo.viscous_friction": copy.viscous,
        "servo.supply_voltage": copy.supply,
        "ground.mu_x": copy.mu,
        "ground.mu_y": copy.mu,
        "ground.slope": copy.slope,
        "joint.zero_offset": np.pad(copy.joint_zero, (0, 4))[: parameters["joint.zero_offset"].shape[-1]],
        "imu.gyro_bias": copy.gyro_bias,
        "imu.accel_bias": copy.accel_bias,
        "camera.mount_yaw": copy.camera_yaw,
        "camera.delay": copy.camera_age,
        "command.delay": copy.command_delay,
    }
    for name, value in numbers.items():
        parameters[name] = np.broadcast_to(np.asarray(value, dtype=float), np.shape(parameters[name]))
    return parameters


def errors(folder, effects, seed, kind, patch):
    """Segment errors in noise units by kind of channel, the engine given the copy's numbers and a patch."""
    tables, meta, copy = simulate_runs(ROBOT, effects, seed, (kind,))
    write(folder, tables, meta)
    result = replay(read_run(folder / "run_01.parquet"), parameters=parameters_of(copy), effects=patch)

    def pooled(prefix):
        found = [e.segment_rms / e.noise for name, e in result.errors.items() if name.startswith(prefix)]
        return float(np.sqrt(np.mean(np.square(found))))

    return {prefix: pooled(prefix) for prefix in (*SHARP, "pos_leg", "pos_wheel", "eff_leg")}


def test_engine_with_the_true_numbers_agrees_to_the_noise(tmp_path):
    found = errors(tmp_path, [], 7, 3, None)
    assert all(found[prefix] < 1.35 for prefix in SHARP), found
    # one count of the encoder is 0.44 mrad 1 sigma; the tension at rest is not measured
    assert found["pos_leg"] < 2.0
    assert found["eff_leg"] < 2.5
    assert found["pos_wheel"] < 4.0


#: Effect -> kind of run in which it shows. Play in the wheels is told apart below.
_SHOWS = dict.fromkeys(NAMED, 7) | {"friction_patch": 2, "friction_level": 2, "supply_sag": 2, "camera_misalignment": 3}


#: Generator and engine part by more than allowed at severity 4 in these, and nobody knows yet which of them is wrong.
_UNEXPLAINED = pytest.mark.xfail(strict=True, reason="generator and engine part by more than the bound; unexplained")
_OPEN = ("viscous_friction", "stribeck_friction", "friction_patch")


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(name, marks=[_UNEXPLAINED] if name in _OPEN else []) for name in NAMED])
def test_true_effect_closes_the_gap(name, tmp_path):
    effect = named(name, 4.0, np.random.default_rng(2))
    if name == "backlash":
        effect |= {"where": ["leg_lr", "leg_rr"], "parameters": {"angle": 0.03}}
    if name == "friction_patch":
        effect["parameters"] |= {"x_min": -0.1, "x_max": 0.4}
    kind = _SHOWS[name]
    without = errors(tmp_path / "a", [effect], 8, kind, None)
    with_it = errors(tmp_path / "b", [effect], 8, kind, [effect])
    worst = max(without, key=lambda prefix: without[prefix])
    assert with_it[worst] < 0.5 * without[worst], (worst, without[worst], with_it[worst])
    assert all(with_it[prefix] < 2.5 for prefix in SHARP), with_it
