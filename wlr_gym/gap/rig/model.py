"""The rig's calibrated parameters, and what the compiled law reads of them and of the effects.

Servo: XL330-M288-T by its data sheet (ROBOTIS e-manual: stall torque 0.52 N m, no load 103 rev/min, both at 5 V). That its gear
has dry and viscous friction is known; how much is fitted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.gap.problem import Quantity, Setting
from wlr_gym.gap.rig import law
from wlr_gym.gap.rig.effects import NO_TORQUE_LIMIT, RIG_EFFECTS, Numbers
from wlr_gym.gap.rig.formula import rig_force
from wlr_gym.gap.rig.recording import FULL_DUTY, Recording
from wlr_gym.physics import servo
from wlr_gym.physics.effects.effect import PatchEffect
from wlr_gym.physics.effects.library import UNKNOWN_EFFECT
from wlr_gym.physics.plants import drive
from wlr_gym.physics.plants.drive import TEETH_DAMPING
from wlr_gym.physics.plants.forces import Force

Array = NDArray[np.float64]

#: The rig's one joint, where its effects act.
JOINT = "servo"
#: Data sheet: N m at stall.
STALL_TORQUE = 0.52
#: Data sheet: rad/s without load.
NO_LOAD_SPEED = 103 * 2 * math.pi / 60
#: V, of both.
DATA_SHEET_VOLTAGE = 5.0
#: m/s2.
GRAVITY = 9.81
#: Duty per rad and unit of the Position P Gain register: counts of 2 pi/4096, /256 to PWM counts (the data confirm it).
DUTY_PER_GAIN = 4096 / (2 * math.pi) / (256 * FULL_DUTY)
#: deg C at which the winding has its nominal resistance.
REFERENCE_TEMPERATURE = 25.0
#: Of the gear's teeth where it has play, N m/rad.
TEETH_STIFFNESS = 50.0

#: What calibration may move. The motor is given as in its data sheet (:func:`wlr_gym.physics.servo.motor_constants` makes
#: torque constant and resistance of it), which says nothing of friction, rotor and delay: wide tolerances about a small
#: servo's.
QUANTITIES: tuple[Quantity, ...] = (
    Quantity("stall_torque", "N m", STALL_TORQUE, 0.25 * STALL_TORQUE, 0.1, 2.0),
    Quantity("no_load_speed", "rad/s", NO_LOAD_SPEED, 0.15 * NO_LOAD_SPEED, 3.0, 40.0),
    Quantity("armature", "kg m2", 0.001, 0.001, 1e-5, 0.01),
    Quantity("length_error", "m", 0.0, 0.002, -0.02, 0.02),
    Quantity("arm_mass", "kg", 0.02, 0.02, 0.0, 0.2),
    Quantity("delay", "s", 0.002, 0.003, -0.003, 0.05),
    Quantity("zero", "rad", 0.0, 0.02, -0.2, 0.2),
    Quantity("coulomb_friction", "N m", 0.03, 0.03, 0.0, 0.5),
    Quantity("viscous_friction", "N m s/rad", 0.005, 0.01, 0.0, 0.2),
)


_NEUTRAL: Numbers = {
    "coulomb_friction": 0.0, "viscous_friction": 0.0, "stribeck_torque": 0.0, "stribeck_speed": 0.1, "load_friction": 0.0,
    "play": 0.0, "ripple_amplitude": 0.0, "ripple_order": 1.0, "ripple_phase": 0.0, "torque_scale": 1.0,
    "saturation": 0.0, "torque_limit": NO_TORQUE_LIMIT, "quadratic_friction": 0.0, "thermal": 0.0,
}  # fmt: skip


@dataclass(frozen=True)
class RigModel:
    """Numbers of a model by name, SI, and the formula forces on its joint."""

    numbers: Numbers
    forces: tuple[Force, ...] = ()


def model_of(setting: Setting, quantities: Sequence[Quantity], known: Sequence[PatchEffect] = ()) -> RigModel:
    """Return the model of a setting: its quantities, then the effects that are known, then its own.

    Raises:
        InputError: an effect the rig does not know, a parameter missing, or a broken formula.
    """
    numbers = dict(_NEUTRAL)
    numbers.update({q.name: float(value) for q, value in zip(quantities, setting.quantities, strict=True)})
    forces = []
    for effect in (*known, *setting.effects):
        if effect.name == UNKNOWN_EFFECT:
            forces.append(rig_force(effect))
        elif effect.name in RIG_EFFECTS:
            apply_effect(numbers, effect)
        else:
            raise unknown_name("effect of the test rig", effect.name, RIG_EFFECTS)
    return RigModel(numbers, tuple(forces))


def apply_effect(numbers: Numbers, effect: PatchEffect) -> None:
    """Write one effect into ``numbers``."""
    law_of = RIG_EFFECTS[effect.name]
    values = {}
    for key, parameter in law_of.parameters.items():
        if key not in effect.parameters and not parameter.optional:
            raise InputError(f"{effect.name}: has no '{key}' ({parameter.unit})")
        assert isinstance(parameter.neutral, float | int)
        values[key] = float(effect.parameters.get(key, parameter.neutral))
    law_of.apply(numbers, values)


def pack(models: Sequence[RigModel], recording: Recording, step: float) -> Array:
    """Return what the compiled law reads (models, len(law.PARAMETERS)) for one recording's load and gain."""
    table = {name: np.array([model.numbers[name] for model in models]) for name in models[0].numbers}
    arm, length = table["arm_mass"], recording.length + table["length_error"]
    armature, play = table["armature"], table["play"]
    constant, resistance = servo.motor_constants(table["stall_torque"], table["no_load_speed"], DATA_SHEET_VOLTAGE)
    link = (recording.mass + arm / 3.0) * length**2
    with_rotor = link + armature
    back_emf_damping = constant**2 / resistance
    moved = np.where(play > 0.0, armature, with_rotor)
    lanes = {
        "volt_gain": constant / resistance,
        "back_emf_damping": back_emf_damping,
        "inverse_constant": 1.0 / constant,
        "viscous": table["viscous_friction"],
        "weight": drive.fitted_weight(step * (back_emf_damping * table["torque_scale"] + table["viscous_friction"]) / moved),
        "inverse_stribeck_speed": 1.0 / table["stribeck_speed"],
        "half_play": 0.5 * play,
        "rotor_inertia": armature,
        "teeth_stiffness": np.full(len(models), TEETH_STIFFNESS),
        "teeth_damping": TEETH_DAMPING * np.sqrt(TEETH_STIFFNESS * armature),
        "gain": np.full(len(models), recording.gain * DUTY_PER_GAIN),
        "gravity": GRAVITY * length * (recording.mass + arm / 2.0),
        "inertia": np.where(play > 0.0, link, with_rotor),
        "coulomb": table["coulomb_friction"],
    }
    return np.stack([lanes[name] if name in lanes else table[name] for name in law.PARAMETERS], axis=1)
