"""Inverse dynamics driven by measured motion and slip, as the paper uses its equations: as printed, and with the right ones.

Body motion comes from vision and IMU, joints from the encoders, slip from vision: here from a record of a plant. Nothing is
integrated. The printed equations answer with the inconsistency of the data; the right ones with torques and forces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters
from wlr_gym.studies.paper import printed, reduced
from wlr_gym.studies.paper.experiments import Record
from wlr_gym.studies.paper.quantities import State

Array = NDArray[np.float64]

#: Ticks to each side that rates are averaged over before they are differentiated: +-60 ms.
_SMOOTH = 3
#: The paper's wheels in the order lf, rf, lr, rr.
_ORDER = {"lf": 0, "rf": 1, "lr": 2, "rr": 3}


@dataclass(frozen=True, eq=False)
class FromMeasurement:
    """Torques from one robot's record, both ways. Rows as in the record.

    Attributes:
        right: the corrected inverse dynamics. leg_torque_printed: (T, 2) (19) and (20), both motors of an axle.
        wheel_torque_printed: (T, 4) (21)-(24), lf, rf, lr, rr.
    """

    right: reduced.InverseDynamics
    leg_torque_printed: Array
    wheel_torque_printed: Array


def inverse_from_record(robot: Robot, record: Record, index: int = 0, rear_drag: float | None = None) -> FromMeasurement:
    """Return what the measured motion of one robot says about its torques.

    Args:
        robot: whose masses and lengths.
        record: with pose, velocity and slip (a simulator's, or of vision).
        index: which robot of the record.
        rear_drag: N m, dry friction in the gear of a rear wheel; None = the robot's nominal one.
    """
    drag = robot.servo.wheel.coulomb_friction if rear_drag is None else rear_drag
    c = reduced.constants_of(Parameters.nominal(robot))
    joints, rates = record.joint_position[:, index], record.joint_velocity[:, index]
    pitch = record.attitude[:, index, 1]
    v = record.velocity[:, index]
    period = float(record.time[1] - record.time[0])
    u = np.column_stack([v[:, 0], v[:, 1], record.yaw_rate[:, index], v[:, 2], np.gradient(pitch, period),
                         rates[:, :2].mean(axis=1), rates[:, 2:4].mean(axis=1), rates[:, 4:]])  # fmt: skip
    u = _smoothed(u)
    u_dot = np.gradient(u, period, axis=0)
    slip_dot = np.gradient(_smoothed(record.slip[:, index].reshape(-1, 8)), period, axis=0).reshape(-1, 4, 2)
    front, rear = joints[:, :2].mean(axis=1), joints[:, 2:4].mean(axis=1)
    right = reduced.inverse_dynamics(c, front, rear, pitch, u, u_dot, -drag * np.tanh(u[:, 9:] / 0.01))
    s = State(
        alpha=front, beta=rear, psi=pitch, alpha_d=u[:, 5], beta_d=u[:, 6], psi_d=u[:, 4],
        alpha_dd=u_dot[:, 5], beta_dd=u_dot[:, 6], psi_dd=u_dot[:, 4],
        x_d=u[:, 0], y_d=u[:, 1], z_d=u[:, 3], yaw_d=u[:, 2],
        x_dd=u_dot[:, 0], y_dd=u_dot[:, 1], z_dd=u_dot[:, 3], yaw_dd=u_dot[:, 2],
        theta_d={wheel: u[:, 7 + k] for wheel, k in _ORDER.items()},
        theta_dd={wheel: u_dot[:, 7 + k] for wheel, k in _ORDER.items()},
        x_s_d={wheel: record.slip[:, index, k, 0] for wheel, k in _ORDER.items()},
        x_s_dd={wheel: slip_dot[:, k, 0] for wheel, k in _ORDER.items()},
    )  # fmt: skip
    found = printed.forces_as_used(c, s)
    wheels = found["tau_theta"]
    return FromMeasurement(
        right,
        np.column_stack([found["tau_alpha"], found["tau_beta"]]),
        np.column_stack([wheels[wheel] for wheel in _ORDER]),
    )


def _smoothed(values: Array) -> Array:
    """Moving average over the neighbouring ticks; ends repeated."""
    padded = np.pad(values, ((_SMOOTH, _SMOOTH), (0, 0)), mode="edge")
    return np.stack([padded[k : k + len(values)] for k in range(2 * _SMOOTH + 1)]).mean(axis=0)
