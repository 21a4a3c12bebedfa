"""The IMU's axes and signs are turned only where gravity, turns and pushes show it clearly; noise leaves them as they are."""

import numpy as np
import pytest
from foreign_logs import HALF_TRACK, RADIUS, lab_frame, made_up

from wlr_gym.data.logs import suggest_map
from wlr_gym.robot import WHEELS


@pytest.fixture
def table():
    return made_up(12.0)


def proposed(tmp_path, table):
    lab_frame(table).to_csv(tmp_path / "a.csv", index=False)
    found = suggest_map(tmp_path / "a.csv")
    return found.map, {reason.what: reason for reason in found.reasons}


def noise(table, seed, size):
    return size * np.random.default_rng(seed).standard_normal(len(table["t"]))


def is_unturned(found):
    return "imu" not in found.frames and found.channels["acc"].sign == 1


def test_an_accelerometer_without_gravity_turns_nothing(table, tmp_path):
    """As of drivers that take gravity out, and of a gyroscope that shows no turn."""
    still = {
        f"{kind}_{axis}": noise(table, k, 0.05) for k, (kind, axis) in enumerate((k, a) for k in ("acc", "gyro") for a in "xyz")
    }
    found, said = proposed(tmp_path, table | still)
    assert is_unturned(found)
    assert said["acc"].sure == said["frames.imu"].sure == "guess"
    assert "which one points up is not decided" in said["acc"].why
    assert "neither gravity nor turns decide it" in said["frames.imu"].why


def test_gravity_between_two_axes_turns_nothing(table, tmp_path):
    found, said = proposed(tmp_path, table | {"acc_x": -6.95 + noise(table, 0, 0.1), "acc_z": 6.9 + noise(table, 1, 0.1)})
    assert is_unturned(found)
    assert said["acc"].sure == "guess"


def test_pushes_that_noise_drowns_turn_nothing(table, tmp_path):
    shaken = {"acc_x": table["acc_x"] + noise(table, 0, 2.5), "acc_y": 1.3 * table["acc_x"] + noise(table, 1, 2.5)}
    found, said = proposed(tmp_path, table | shaken)
    assert is_unturned(found)
    assert "how it is pushed does not decide which axis points forward" in said["frames.imu"].why


def test_turns_of_which_half_a_period_looks_opposite_turn_nothing(table, tmp_path):
    """A gyroscope half a period late goes with the wheels as well as one mounted upside down: gravity says that it is not."""
    t, period = table["t"], 1.6
    yaw = -0.3 * np.cos(2 * np.pi * t / period)
    wheels = {wheel: (1.0 if wheel.endswith(("rf", "rr")) else -1.0) * 2 * HALF_TRACK * yaw / RADIUS for wheel in WHEELS}
    moved = {f"pos_{wheel}": angle for wheel, angle in wheels.items()}
    moved |= {f"{kind}_{wheel}": np.gradient(angle, t) for wheel, angle in wheels.items() for kind in ("vel", "cmd")}
    late = np.gradient(-0.3 * np.cos(2 * np.pi * (t / period - 0.5)), t) + noise(table, 0, 1e-3)
    found, said = proposed(tmp_path, table | moved | {"gyro_z": late, "acc_x": noise(table, 1, 0.03)})
    assert is_unturned(found)
    assert not [joint for joint, one in found.joints.items() if one.sign < 0]
    assert "which way round is not decided" in said["gyro"].why
