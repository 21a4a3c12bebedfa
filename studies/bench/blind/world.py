"""The robot as a MuJoCo model: bodies and joints. A gear with play gets a rotor on a joint of its own."""

# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from studies.bench.blind.copies import CORNERS, JOINTS, LEGS, WHEELS, Copy
from studies.bench.blind.truth import Hidden

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BlindWorld:
    """A compiled model and where things are in it.

    Attributes:
        model: MuJoCo model.
        position, rate: indices (8,) of the joints in qpos and qvel.
        motor_position, motor_rate: the same of the motors; those of the joint unless its gear has play.
    """

    model: mujoco.MjModel
    position: NDArray[np.intp]
    rate: NDArray[np.intp]
    motor_position: NDArray[np.intp]
    motor_rate: NDArray[np.intp]


def build(copy: Copy, hidden: Hidden) -> BlindWorld:
    """Compile the robot copy with what is hidden in it."""
    model = mujoco.MjModel.from_xml_string(_xml(copy, hidden))

    def addresses(names: list[str]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in names]
        return model.jnt_qposadr[ids].astype(np.intp), model.jnt_dofadr[ids].astype(np.intp)

    position, rate = addresses(list(JOINTS))
    motors = [f"{name}_rotor" if hidden.play[k] > 0 else name for k, name in enumerate(JOINTS)]
    motor_position, motor_rate = addresses(motors)
    return BlindWorld(model, position, rate, motor_position, motor_rate)


def floor_gravity(copy: Copy, hidden: Hidden) -> Array:
    """Gravity (3,) in the frame of the inclined floor, m/s2."""
    pitch, roll = copy.slope + hidden.slope
    down = np.array([-np.sin(pitch), -np.sin(roll), 0.0])
    down[2] = -np.sqrt(1.0 - down @ down)
    return copy.gravity * down


def _numbers(*values: float) -> str:
    return " ".join(f"{value:.12g}" for value in values)


def _rotor(joint: str, armature: float, play: float) -> tuple[str, str]:
    """Return the rotor's body and the joint's own armature: play puts the motor's inertia on a joint beside it."""
    if play == 0:
        return "", _numbers(armature)
    body = (
        f'<body name="{joint}_rotor"><inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>'
        f'<joint name="{joint}_rotor" type="hinge" axis="0 1 0" armature="{_numbers(armature)}"/></body>'
    )
    return body, "0"


def _corner(index: int, copy: Copy, hidden: Hidden) -> str:
    leg, wheel = LEGS[index], WHEELS[index]
    x, y = CORNERS[index] * copy.hip
    leg_rotor, leg_armature = _rotor(leg, copy.armature[index], hidden.play[index])
    wheel_rotor, wheel_armature = _rotor(wheel, copy.armature[4 + index], hidden.play[4 + index])
    across, along, own = copy.leg_inertia[index][1], copy.leg_inertia[index][0], copy.leg_inertia[index][2]
    return f"""
    <body name="{leg}" pos="{_numbers(x, y, 0)}">
      <inertial pos="{_numbers(copy.leg_com, 0, 0)}" mass="{_numbers(copy.leg_mass[index])}"
        diaginertia="{_numbers(own, across, along)}"/>
      <joint name="{leg}" type="hinge" axis="0 1 0" armature="{leg_armature}"/>
      <body name="{wheel}" pos="{_numbers(copy.leg_length, 0, 0)}">
        <inertial pos="0 0 0" mass="{_numbers(copy.wheel_mass)}"
          diaginertia="{_numbers(copy.transverse_inertia, copy.spin_inertia, copy.transverse_inertia)}"/>
        <joint name="{wheel}" type="hinge" axis="0 1 0" armature="{wheel_armature}"/>
      </body>{wheel_rotor}
    </body>{leg_rotor}"""


def _xml(copy: Copy, hidden: Hidden) -> str:
    corners = "".join(_corner(index, copy, hidden) for index in range(4))
    mass, *place = hidden.payload
    payload = ""
    if mass > 0:
        inertial = f'<inertial pos="0 0 0" mass="{_numbers(mass)}" diaginertia="1e-9 1e-9 1e-9"/>'
        payload = f'<body pos="{_numbers(*place)}">{inertial}</body>'
    return f"""
<mujoco>
  <compiler angle="radian" balanceinertia="false"/>
  <option gravity="{_numbers(*floor_gravity(copy, hidden))}"/>
  <worldbody>
    <body name="body" pos="0 0 0.17">
      <freejoint/>
      <inertial pos="{_numbers(*(copy.com + hidden.com))}" mass="{_numbers(copy.mass)}"
        diaginertia="{_numbers(*copy.inertia)}"/>
      {payload}{corners}
    </body>
  </worldbody>
</mujoco>"""
