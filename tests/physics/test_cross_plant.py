"""Both simulators, same setpoints and parameters: where the robots are after ten seconds, and what their motors did.

Excitations as in the measured data, without and with every named effect at its default severity. Bounds are those of the
project: base pose within 2 % of the travel and 2 degrees of yaw, motor torques within 5 % rms; docs/compare.md has the
numbers.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from rig import BACKENDS, ROBOT

from wlr_gym.data.comparison import severe_patch
from wlr_gym.data.excitations import EXCITATIONS, Motion, excite
from wlr_gym.data.replay import profile_parameters
from wlr_gym.physics.effects import EFFECTS, apply_patch
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, standing_state
from wlr_gym.robot.parameters import Parameters

#: Effects that act on the readings alone, which both plants take from the same sensor model.
ON_SENSORS = ("gyro_bias", "imu_misalignment", "camera_misalignment", "camera_delay", "flow_misalignment")
DYNAMIC = tuple(name for name in EFFECTS if name not in ON_SENSORS)
SECONDS = 10.0


@dataclass(frozen=True)
class Case:
    """One robot: an excitation with one effect, or none."""

    motion: str
    effect: str = ""


@dataclass(frozen=True)
class Parting:
    """How far two plants are apart: base position over travel, yaw (degrees), motor torques (rms over rms)."""

    position: np.ndarray
    yaw: np.ndarray
    torque: np.ndarray


def parameters_of(cases: list[Case], motions: list[Motion]) -> Parameters:
    """Nominal robots with their motion's servo profile and their effect."""
    rows = []
    for case, motion in zip(cases, motions, strict=True):
        one = profile_parameters(Parameters.nominal(ROBOT), motion.profile)
        rows.append((apply_patch(severe_patch(case.effect), one) if case.effect else one).values)
    return Parameters(np.concatenate(rows))


def rollout(backend: str, cases: list[Case], step: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Drive every case as one robot of a batch; return poses (ticks, N, 3: x, y, yaw) and motor torques (ticks, N, 8)."""
    motions = [excite(case.motion, seed=1, robot=ROBOT, seconds=seconds) for case in cases]
    parameters = parameters_of(cases, motions)
    plant = make_plant(backend, ROBOT, len(cases), PlantOptions(physics_step=step, sensor_noise=False))
    setpoints = np.stack([motion.setpoints for motion in motions], axis=1)
    state = standing_state(ROBOT, parameters)
    plant.reset(parameters=parameters, state=state)
    poses, torques = [], []
    for tick in setpoints:
        plant.step(np.nan_to_num(tick), np.isfinite(tick))
        truth = plant.truth()
        w, x, y, z = truth.quaternion.T
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        poses.append(np.column_stack([truth.position[:, :2], yaw]))
        torques.append(truth.motor_torque.copy())
    return np.array(poses), np.array(torques)


def parting(cases: list[Case], step: float, seconds: float = SECONDS) -> Parting:
    """Drive both plants and tell how far they part."""
    first, second = (rollout(backend, cases, step, seconds) for backend in BACKENDS)
    return apart_from(first, second)


def apart_from(first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]) -> Parting:
    """Tell how far two rollouts are apart; a single robot of the second is compared with each of the first."""
    (pose, torque), (other, other_torque) = first, second
    travel = np.linalg.norm(np.diff(pose[:, :, :2], axis=0), axis=2).sum(axis=0)
    apart = np.linalg.norm(pose[-1, :, :2] - other[-1, :, :2], axis=1)
    turned = np.abs(np.angle(np.exp(1j * (pose[-1, :, 2] - other[-1, :, 2]))))
    error = np.sqrt(np.square(torque - other_torque).mean(axis=(0, 2)) / np.square(torque).mean(axis=(0, 2)))
    return Parting(apart / np.maximum(travel, 0.05), np.degrees(turned), error)


def outside(cases: list[Case], values: np.ndarray, bound: float) -> dict[str, float]:
    """The cases, by their names, whose value is not within its bound."""
    named = {f"{case.motion} {case.effect}": float(value) for case, value in zip(cases, values, strict=True)}
    return {name: value for name, value in named.items() if not value < bound}


def test_every_excitation_ends_at_the_same_place():
    cases = [Case(motion) for motion in EXCITATIONS]
    apart = parting(cases, 1e-3)
    assert not outside(cases, apart.position, 0.02)
    assert not outside(cases, apart.yaw, 2.0)
    assert not outside(cases, apart.torque, 0.05)


#: Effects that do not show in a motion: nothing saturates; nothing slides sideways, or comes to the patch.
UNSEEN = {"s_curve": ("supply_sag",), "posture": ("supply_sag", "friction_anisotropy", "friction_patch"), "steps": ()}


@pytest.mark.parametrize(
    ("motion", "effects"), [("s_curve", DYNAMIC), ("posture", DYNAMIC), ("steps", ("supply_sag", "weak_motor"))]
)
def test_every_effect_ends_at_the_same_place(motion, effects):
    """Within the bounds, and ten times closer than the effect itself moves torques or place: neither plant could lack it."""
    cases = [Case(motion), *(Case(motion, effect) for effect in effects)]
    engine, mujoco = (rollout(backend, cases, 1e-3, SECONDS) for backend in ("gibbs_appell", "mujoco"))
    apart = apart_from(mujoco, engine)
    assert not outside(cases, apart.position, 0.02)
    assert not outside(cases, apart.yaw, 2.0)
    assert not outside(cases, apart.torque, 0.05)
    size = apart_from(engine, (engine[0][:, :1], engine[1][:, :1]))
    share = np.minimum(apart.torque / np.maximum(size.torque, 1e-12), apart.position / np.maximum(size.position, 1e-12))
    seen = [k for k, case in enumerate(cases) if case.effect and case.effect not in UNSEEN[motion]]
    assert not outside([cases[k] for k in seen], share[seen], 0.1)


def test_the_difference_shrinks_with_the_step():
    cases = [Case(motion) for motion in ("straight", "turns", "s_curve", "posture")]
    coarse, fine = (parting(cases, step, seconds=5.0) for step in (2e-3, 5e-4))
    assert np.median(fine.position) < 0.5 * np.median(coarse.position)
    assert np.median(fine.torque) < 0.5 * np.median(coarse.torque)
