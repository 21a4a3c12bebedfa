"""Energy of the robot from its readable mass matrix: what simulators must keep."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.model.dynamics import (
    absolute_rates,
    gravity_in_floor,
    inertial_constants,
    mass_matrix_and_bias,
    rotation_matrix,
)
from wlr_gym.physics.plants.base import Truth
from wlr_gym.robot import LEG_SLICE
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]


def kinetic_energy(parameters: Parameters, v: Array, w: Array, joint_position: Array, joint_velocity: Array) -> Array:
    """Return the kinetic energy (N,), rotors included, J."""
    leg_rate, wheel_rate = absolute_rates(w, joint_velocity)
    mass_matrix, _ = mass_matrix_and_bias(parameters, joint_position, w, leg_rate, wheel_rate)
    velocity = np.concatenate([v, w, leg_rate, wheel_rate], axis=1)
    return 0.5 * np.einsum("ni,nij,nj->n", velocity, mass_matrix, velocity)


def potential_energy(parameters: Parameters, position: Array, quaternion: Array, joint_position: Array) -> Array:
    """Return the potential energy (N,) in the inclined gravity field, zero with all mass at the floor frame's origin, J."""
    constants = inertial_constants(parameters)
    mass = constants["platform_mass"] + constants["assembly_mass"].sum(axis=1)
    moment = mass[:, None] * position + np.einsum(
        "nij,nj->ni", rotation_matrix(quaternion), _first_moment(constants, joint_position)
    )
    return -np.einsum("ni,ni->n", gravity_in_floor(parameters), moment)


def mechanical_energy(parameters: Parameters, state: Any) -> Array:
    """Return kinetic and potential energy (N,), J, of robots in a plant's truth or mechanical state."""
    motion = state.linear_velocity_in_body, state.angular_velocity_in_body, state.joint_position, state.joint_velocity
    place = state.position, state.quaternion, state.joint_position
    return kinetic_energy(parameters, *motion) + potential_energy(parameters, *place)


def stored(plant: Any) -> Array:
    """Return the energy (N,) of bodies, rotors, pressed teeth and tether, J; the contact springs' is counted as work."""
    truth, state, parameters = plant.truth(), plant.mechanical_state(), plant.parameters.copy()
    play, armature = parameters["servo.backlash"], parameters["servo.armature"].copy()
    parameters["servo.armature"] = np.where(play > 0.0, 0.0, armature)
    pressed = np.maximum(np.abs(state.rotor_lead) - 0.5 * play, 0.0)
    rotor = armature * state.rotor_rate**2 + parameters["servo.gear_stiffness"] * pressed**2
    reach = truth.position[:, :2] - parameters["tether.anchor"]
    tether = parameters["tether.stiffness"] * (reach**2).sum(axis=1)
    return mechanical_energy(parameters, truth) + 0.5 * (np.where(play > 0.0, rotor, 0.0).sum(axis=1) + tether)


@dataclass
class Audit:
    """What a drive did, in J: change of stored energy (N,), work of every force (ticks, N) by name, and the truth's own."""

    change: Array
    work: dict[str, Array]
    shown: Array

    @property
    def done(self) -> Array:
        """Work of the motors (N,), whatever its sign."""
        return np.abs(self.work["motor"]).sum(axis=0)

    @property
    def missing(self) -> Array:
        """Share (N,) of the motors' work that is neither stored nor done on anything."""
        return (self.change - sum(term.sum(axis=0) for term in self.work.values())) / self.done


def audit(plant: Any, ticks: int, every: int, draw: Callable[[], Array], viscous: float = 0.0) -> Audit:
    """Drive by setpoints (N, 8) drawn anew after ``every`` ticks of one physics step, and add up what every force does."""
    step, count, parameters = plant.options.control_period, plant.count, plant.parameters
    has_play = parameters["servo.backlash"].any()

    def look() -> tuple[Truth, Array, Array]:
        """Truth, gaps of the wheels, and rates of rotors (8), slip (8) and absolute spins of the wheels (4)."""
        truth = Truth(plant.truth().values.copy())
        rotor = plant.mechanical_state().rotor_rate if has_play else truth.joint_velocity
        spin = truth.angular_velocity_in_body[:, 1:2] + truth.joint_velocity[:, :4] + truth.joint_velocity[:, 4:]
        return truth, wheel_gaps(parameters, truth), np.hstack([rotor, truth.slip_velocity, spin])

    names = ("motor", "gear", "viscous", "friction", "normal", "rolling")
    work, shown = {name: np.zeros((ticks, count)) for name in names}, np.zeros((ticks, count))
    start, (_, old_gap, old_rates), setpoints = stored(plant), look(), draw()
    for tick in range(ticks):
        setpoints = draw() if tick and tick % every == 0 else setpoints
        plant.step(setpoints)
        truth, gap, rates = look()
        turned, slid, spun = np.split(0.5 * step * (rates + old_rates), [8, 16], axis=1)
        force = truth.contact_force.reshape(count, 4, 3)
        done = {
            "motor": truth.motor_torque * turned,
            "gear": truth.friction_torque * turned,
            "viscous": -viscous * turned**2 / step,
            "friction": force[..., :2].reshape(count, 8) * slid,
            "normal": force[..., 2] * (gap - old_gap),
            "rolling": truth.rolling_torque * spun,
        }
        for name, term in done.items():
            work[name][tick] = term.sum(axis=1)
        shown[tick], old_gap, old_rates = truth.mechanical_energy, gap, rates
    return Audit(stored(plant) - start, work, shown)


def wheel_gaps(parameters: Parameters, truth: Truth) -> Array:
    """Return the height (N, 4) of every thin-disc wheel's lowest point over the floor, m."""
    normal = rotation_matrix(truth.quaternion)[:, 2]
    angle = truth.joint_position[:, :4]
    axle = parameters["hip.position"][:, None, :] * [[1, 1, 1], [1, -1, 1], [-1, 1, 1], [-1, -1, 1]]
    axle += parameters["leg.length"][..., None] * np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], axis=-1)
    reach = parameters["wheel.radius"] * np.hypot(normal[:, :1], normal[:, 2:])
    return truth.position[:, 2:] + np.einsum("nwk,nk->nw", axle, normal) - reach


def _first_moment(constants: dict[str, Array], joint_position: Array) -> Array:
    """First moment of the whole robot about the body origin (N, 3), body frame, kg m."""
    mass, moment, angle = constants["assembly_mass"], constants["first_moment"], joint_position[:, LEG_SLICE]
    x = mass * constants["hip_x"] + moment * np.cos(angle)
    z = mass * constants["hip_z"] - moment * np.sin(angle)
    assemblies = np.stack([x, mass * constants["hip_y"], z], axis=2).sum(axis=1)
    return constants["platform_first_moment"] + assemblies
