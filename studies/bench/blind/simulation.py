"""Simulate one run of a robot copy: tables of its numbers and of what is hidden, for the compiled loop."""

# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from studies.bench.blind.copies import CORNERS, Copy
from studies.bench.blind.drive import SAMPLE, WIDTH, drive
from studies.bench.blind.truth import Hidden
from studies.bench.blind.world import BlindWorld, floor_gravity

Array = NDArray[np.float64]
#: Of meeting teeth, N m/rad: legs, wheels.
TOOTH_STIFFNESS = (3000.0, 600.0)
#: N m s/rad per rotor inertia.
TOOTH_DAMPING = 700.0


@dataclass(frozen=True)
class BlindProfile:
    """Profile registers of a data set, rad/s2, rad/s, rad/s2; 0 = off."""

    wheel_acceleration: float
    leg_velocity: float
    leg_acceleration: float


def simulate(
    world: BlindWorld,
    copy: Copy,
    hidden: Hidden,
    profile: BlindProfile,
    times: Array,
    setpoints: Array,
    start: Array,
    duration: float,
) -> Array:
    """Drive the robot through one run.

    Args:
        world: compiled model.
        times: (n,) s, when the setpoints are written.
        setpoints: (n, 8) rad, rad/s, NaN = torque off.
        start: (4,) leg angles at which the robot is set down, rad, true.
        duration: s.

    Returns:
        (samples, WIDTH) records every ``SAMPLE`` seconds from time 0.

    Raises:
        FloatingPointError: the simulated robot blew up.
    """
    model, data = world.model, mujoco.MjData(world.model)
    data.qpos[world.position[:4]] = start
    has_rotor = world.motor_position != world.position
    data.qpos[world.motor_position[has_rotor]] = data.qpos[world.position[has_rotor]]
    data.qpos[2] = (copy.leg_length * np.sin(start) + copy.radius * hidden.radius_scale).max()
    records = np.zeros((round(duration / SAMPLE) + 1, WIDTH))
    addresses = (world.position, world.rate, world.motor_rate, world.motor_position)
    tables = (_joint_table(copy, hidden), _corner_table(copy, hidden), _general_table(copy, hidden, profile), copy.floor_waves)
    drive(model._address, data._address, data.qpos, data.qvel, addresses, tables, times, setpoints, records)
    if not np.isfinite(records).all():
        raise FloatingPointError("the simulated robot blew up")
    return records


def _joint_table(copy: Copy, hidden: Hidden) -> Array:
    constant = copy.data_sheet_voltage / copy.no_load_speed
    resistance = constant * copy.data_sheet_voltage / copy.stall_torque
    return np.array(
        [
            copy.kp,
            copy.kd,
            constant,
            resistance,
            copy.coulomb + hidden.coulomb,
            copy.viscous + hidden.viscous,
            hidden.stick_extra,
            hidden.stick_speed,
            hidden.load_ratio,
            hidden.motor_scale,
            *hidden.ripple,
            copy.command_delay + hidden.delay,
            np.concatenate([copy.joint_zero + hidden.zero, np.zeros(4)]),
            hidden.play,
            np.repeat(TOOTH_STIFFNESS, 4),
            TOOTH_DAMPING * copy.armature,
        ]
    )


def _corner_table(copy: Copy, hidden: Hidden) -> Array:
    hips = CORNERS * copy.hip
    return np.array(
        [
            hips[:, 0],
            hips[:, 1],
            copy.radius * hidden.radius_scale,
            np.where(np.isnan(hidden.wheel_mu), copy.mu, hidden.wheel_mu),
            hidden.creep_speed,
            hidden.rolling,
            hidden.out_of_round,
            *hidden.leg_spring,
            *hidden.elastic,
            np.repeat(hidden.cross_ratio, 2),
        ]
    )


def _general_table(copy: Copy, hidden: Hidden, profile: BlindProfile) -> Array:
    return np.array(
        [
            copy.leg_length,
            copy.supply,
            hidden.supply_resistance,
            profile.wheel_acceleration,
            profile.leg_velocity,
            profile.leg_acceleration,
            *hidden.force,
            *hidden.tether,
            hidden.drag,
            hidden.veer,
            *hidden.pull,
            *hidden.patch,
            hidden.mu_ratio,
            *hidden.weak_slip,
            *floor_gravity(copy, hidden),
            copy.normal_stiffness,
            copy.floor_creep,
            copy.gear_creep,
            copy.flattening,
            copy.weight / 4 / copy.normal_stiffness,
        ]
    )
