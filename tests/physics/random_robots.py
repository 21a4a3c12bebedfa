"""Random robots in random states, and what MuJoCo makes of them: what the equations of motion are compared with."""

from typing import Any

import numpy as np
import pytest

from wlr_gym.physics.model import dynamics
from wlr_gym.robot import LEGS, WHEELS, load_robot
from wlr_gym.robot.parameters import Parameters

mujoco: Any = pytest.importorskip("mujoco")


def body_inertia(rng, scale, shape):
    """Three different principal moments that a rigid body can have: sums of pairs of second moments."""
    second = scale * rng.uniform(0.2, 2.0, (*shape, 3))
    return second.sum(axis=-1, keepdims=True) - second


def load_inertia(rng, scale, count):
    """Inertias (N, 6) of bodies with second moments of mass S about their centre: trace(S) - S, xy = -S_xy."""
    spread = rng.normal(size=(count, 3, 3))
    second = scale * spread @ spread.transpose(0, 2, 1)
    xx, yy, zz = (second[:, k, k] for k in range(3))
    return np.stack([yy + zz, xx + zz, xx + yy, -second[:, 0, 1], -second[:, 0, 2], -second[:, 1, 2]], axis=1)


def random_parameters(count, seed):
    """Robots without any symmetry, far from the nominal one; no gear friction, which is no part of the equations."""
    rng = np.random.default_rng(seed)
    parameters = Parameters.nominal(load_robot(), count)
    for name in ("gravity", "body.mass", "hip.position", "leg.length", "leg.mass", "leg.com_along_leg", "wheel.radius",
                 "wheel.mass", "wheel.spin_inertia", "wheel.transverse_inertia", "servo.armature"):  # fmt: skip
        parameters[name] *= rng.uniform(0.4, 2.5, parameters[name].shape)
    parameters["wheel.transverse_inertia"] = parameters["wheel.spin_inertia"] * rng.uniform(0.5, 3.0, (count, 4))
    parameters["hip.position"][:, 2] = rng.uniform(-0.05, 0.05, count)
    parameters["body.com_offset"] = rng.uniform(-0.1, 0.1, (count, 3))
    parameters["body.inertia"] = body_inertia(rng, 0.03, (count,))
    parameters["leg.inertia"] = body_inertia(rng, 1e-4, (count, 4)).reshape(count, 12)
    parameters["payload.mass"] = rng.uniform(0.0, 3.0, count)
    parameters["payload.position"] = rng.uniform(-0.2, 0.2, (count, 3))
    parameters["payload.inertia"] = load_inertia(rng, 0.01, count)
    parameters["ground.slope"] = rng.uniform(-0.6, 0.6, (count, 2))
    parameters["servo.coulomb_friction"] = parameters["servo.viscous_friction"] = 0.0
    parameters.validate()
    return parameters


class States:
    """One random state per robot: attitude, velocities in the body's frame, joints, generalised forces."""

    def __init__(self, count, seed):
        rng = np.random.default_rng(seed)
        quaternion = rng.normal(size=(count, 4))
        self.quaternion = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
        self.rotation = dynamics.rotation_matrix(self.quaternion)
        self.position = rng.normal(size=(count, 3))
        self.v, self.w = 2.0 * rng.normal(size=(count, 3)), 3.0 * rng.normal(size=(count, 3))
        self.angles = rng.uniform(-3.0, 3.0, (count, 8))
        self.rates = np.repeat([3.0, 30.0], 4) * rng.normal(size=(count, 8))
        self.force = rng.normal(size=(count, 14)) * np.repeat([5.0, 1.0], [6, 8])

    def accelerations(self, parameters):
        """Those of the equations (N, 14): body-frame rates of v and w, then joints."""
        state = self.quaternion, self.v, self.w, self.angles, self.rates
        return dynamics.accelerations(parameters, *state, self.force)

    def forward(self, row, model, joints=LEGS + WHEELS, sign: float | np.ndarray = 1.0, offset: float | np.ndarray = 0.0):
        """MuJoCo's data of one state and its accelerations (14,), its joints ``sign * (angle - offset)``."""
        data, rotation, v, w, force = mujoco.MjData(model), self.rotation[row], self.v[row], self.w[row], self.force[row]
        angles, rates = ([getattr(model.joint(name), at)[0] for name in joints] for at in ("qposadr", "dofadr"))
        data.qpos[:3], data.qpos[3:7], data.qpos[angles] = (
            self.position[row], self.quaternion[row], sign * (self.angles[row] - offset),
        )  # fmt: skip
        data.qvel[:3], data.qvel[3:6], data.qvel[rates] = rotation @ v, w, sign * self.rates[row]
        applied = data.qfrc_applied
        applied[:3], applied[3:6], applied[rates] = rotation @ force[:3], force[3:6], sign * force[6:]
        mujoco.mj_forward(model, data)
        linear = rotation.T @ data.qacc[:3] - np.cross(w, v)
        return data, np.array([*linear, *data.qacc[3:6], *(sign * data.qacc[rates])])


def relative_error(ours, theirs):
    """Largest difference over the largest magnitude of a row; the worst row."""
    axes = tuple(range(1, theirs.ndim))
    return (np.abs(ours - theirs).max(axis=axes) / np.abs(theirs).max(axis=axes)).max()
