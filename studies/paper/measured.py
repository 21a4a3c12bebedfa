"""Inverse dynamics driven by measured motion and slip, as the paper uses its equations: as printed, and with the right ones.

Body motion comes from vision and IMU, joints from the encoders, slip from vision: here from a record of a plant. Nothing is
integrated. The printed equations answer with the inconsistency of the data; the right ones with torques and forces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from studies.paper import printed, reduced
from studies.paper.experiments import Record
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Ticks to each side that rates are averaged over before they are differentiated: +-60 ms.
_SMOOTH = 3


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


def inverse_from_record(robot: Robot, record: Record, rear_drag: float | None = None) -> FromMeasurement:
    """Return what the measured motion of a record's first robot says about its torques.

    Args:
        robot: whose masses and lengths.
        record: with pose, velocity and slip (a simulator's, or of vision).
        rear_drag: N m, dry friction in the gear of a rear wheel; None = the robot's nominal one.
    """
    drag = robot.servo.wheel.coulomb_friction if rear_drag is None else rear_drag
    c = reduced.constants_of(Parameters.nominal(robot))
    joints, rates = record.joint_position[:, 0], record.joint_velocity[:, 0]
    pitch = record.attitude[:, 0, 1]
    v = record.velocity[:, 0]
    period = float(record.time[1] - record.time[0])
    u = np.column_stack([v[:, 0], v[:, 1], record.yaw_rate[:, 0], v[:, 2], np.gradient(pitch, period),
                         rates[:, :2].mean(axis=1), rates[:, 2:4].mean(axis=1), rates[:, 4:]])  # fmt: skip
    u = _smoothed(u)
    u_dot = np.gradient(u, period, axis=0)
    slip_dot = np.gradient(_smoothed(record.slip[:, 0].reshape(-1, 8)), period, axis=0).reshape(-1, 4, 2)
    front, rear = joints[:, :2].mean(axis=1), joints[:, 2:4].mean(axis=1)
    right = reduced.inverse_dynamics(c, front, rear, pitch, u, u_dot, -drag * np.tanh(u[:, 9:] / 0.01))
    x_s_d = {wheel: record.slip[:, 0, k, 0] for wheel, k in reduced.ORDER.items()}
    x_s_dd = {wheel: slip_dot[:, k, 0] for wheel, k in reduced.ORDER.items()}
    found = printed.forces_as_used(c, reduced.state_of(front, rear, pitch, u, u_dot, x_s_d=x_s_d, x_s_dd=x_s_dd))
    wheels = found["tau_theta"]
    return FromMeasurement(
        right,
        np.column_stack([found["tau_alpha"], found["tau_beta"]]),
        np.column_stack([wheels[wheel] for wheel in reduced.ORDER]),
    )


def _smoothed(values: Array) -> Array:
    """Moving average over the neighbouring ticks; ends repeated."""
    padded = np.pad(values, ((_SMOOTH, _SMOOTH), (0, 0)), mode="edge")
    return np.stack([padded[k : k + len(values)] for k in range(2 * _SMOOTH + 1)]).mean(axis=0)
