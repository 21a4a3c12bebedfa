"""Formula effects on the rig: the force formulas of the simulators (:mod:`wlr_gym.physics.plants.forces`) on its one joint.

A formula may read what one joint of the robot could: ``angle`` (rad), ``rate`` (rad/s), ``motor_torque`` (N m, of the substep
before) and ``supply_voltage`` (V). The rig's joint stands in for a joint of the robot, so the checks and units are the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from wlr_gym.base.errors import InputError
from wlr_gym.physics.effects.effect import PatchEffect
from wlr_gym.physics.plants.forces import Force, features_read, generalised_forces, make_force

Value = Any

_STAND_IN = "wheel_lf"
#: Input of the force kernel of the robot -> lane of the rig.
_LANES = {"joint_position_4": "angle", "joint_velocity_4": "rate", "motor_torque_4": "motor_torque", "supply_voltage": "supply"}


def rig_force(effect: PatchEffect) -> Force:
    """Return the checked force of a formula effect.

    Raises:
        InputError: a formula that is broken, has another unit than N m, or reads what the rig has not.
    """
    force = make_force((_STAND_IN,), effect.formula, effect.parameters, effect.units)
    generalised_forces([force], _Inputs(dict.fromkeys(_LANES.values(), 0.0)))
    return force


def total_force(forces: Sequence[Force], lanes: Mapping[str, Value], values: Sequence[Value]) -> Value:
    """Return the torque (N m) of all forces on the joint; ``values`` are their constants, one after the other."""
    return generalised_forces(forces, _Inputs(lanes), values)[_STAND_IN]


def lanes_read(force: Force, lanes: Mapping[str, Value]) -> dict[str, tuple[str, Value]]:
    """Return what a force depends on: name -> unit, value."""
    read = features_read(force, _Inputs(lanes)).items()
    return {name.removesuffix(f"_{_STAND_IN}"): found for name, found in read}


class _Inputs(Mapping[str, Value]):
    """The rig's lanes under the names of the robot's."""

    def __init__(self, lanes: Mapping[str, Value]) -> None:
        self._lanes = lanes

    def __getitem__(self, name: str) -> Value:
        if name not in _LANES:
            raise InputError(f"a formula on the test rig reads angle, rate, motor_torque and supply_voltage, not {name}")
        return self._lanes[_LANES[name]]

    def __iter__(self) -> Iterator[str]:
        return iter(_LANES)

    def __len__(self) -> int:
        return len(_LANES)
