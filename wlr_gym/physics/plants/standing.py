"""How a robot stands where the floor is not flat: the pose in which its contact springs, which only push, carry its weight.

Newton's steps on the energy of springs and weight over height, pitch and roll, traced into a kernel of its own: a robot stands
alike, to the bit, alone and in a batch.
"""

from __future__ import annotations

import sys
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.codegen import Graph, Inputs, emit, load_module, ops, source_of, straight_line_source
from wlr_gym.physics.codegen.ops import Lanes, Out, Value, Vector
from wlr_gym.physics.plants import relief
from wlr_gym.robot import CORNER_SIGNS, LEG_SLICE, WHEELS, Robot
from wlr_gym.robot.parameters import Parameters

#: Newton's steps.
STEPS = 30
#: Stiffness of a spring that does not touch, over its own, in those steps; and the longest of them (m, rad).
LOOSE = 0.02
LONGEST = 0.02

_CORNERS = range(len(WHEELS))
_POSE = ("pz", "pitch", "roll")
_ATTITUDE = tuple(f"q{a}" for a in "wxyz")
_GIVEN = (
    "px", "py", "yaw", "weight", *(f"moment_{a}" for a in "xyz"), *(f"{name}{i}" for name in ("axle_x", "axle_y", "axle_z",
    "stiffness") for i in _CORNERS),
)  # fmt: skip
_LANES = (*_POSE, *_ATTITUDE, *_GIVEN, *relief.RELIEF_LANES)


def settle_on_relief(robot: Robot, parameters: Parameters, state: Any, features: frozenset[str]) -> None:
    """Put standing robots on their wheels: height, pitch and roll; place and heading stay.

    Args:
        robot: theirs.
        parameters: (N).
        state: (N) :class:`wlr_gym.physics.plants.base.PlantState`, changed in place.
        features: families of relief that the robots stand on.
    """
    lanes = relief.pack(parameters, robot) | _given(parameters, state)
    w, _, _, z = state.quaternion.T
    height = relief.floor_height(lanes, state.position[:, 0], state.position[:, 1], features)
    height = height + np.mean([parameters["wheel.radius"][:, i] - lanes[f"axle_z{i}"] for i in _CORNERS], axis=0)
    lanes |= {"pz": height, "yaw": 2.0 * np.arctan2(z, w)}
    count = len(parameters)
    values = np.stack([lanes.get(name, np.zeros(count)) for name in _LANES], axis=1)
    tag = "_".join(["standing", *sorted(features)])
    load_module(tag, lambda: _source(features), key=_SOURCE_KEY).settle(values, STEPS)
    state.position[:, 2] = values[:, 0]
    state.quaternion[:] = values[:, len(_POSE) : len(_POSE) + len(_ATTITUDE)]


def _given(parameters: Parameters, state: Any) -> dict[str, NDArray[np.float64]]:
    hips = parameters["hip.position"][:, None, :] * np.array([[x, y, 1.0] for x, y in CORNER_SIGNS])
    angle = state.joint_position[:, LEG_SLICE]
    along = np.stack([np.cos(angle), np.zeros_like(angle), -np.sin(angle)], axis=2)
    axles = hips + parameters["leg.length"][:, :, None] * along
    legs = hips + parameters["leg.com_along_leg"][:, :, None] * along
    masses = [(parameters["body.mass"], parameters["body.com_offset"])]
    masses += [(parameters["payload.mass"], parameters["payload.position"])]
    for i in _CORNERS:
        masses += [(parameters["leg.mass"][:, i], legs[:, i]), (parameters["wheel.mass"][:, i], axles[:, i])]
    gravity = parameters["gravity"]
    moment = [gravity * sum(mass * place[:, k] for mass, place in masses) for k in range(3)]
    given = {"px": state.position[:, 0], "py": state.position[:, 1], "weight": gravity * sum(mass for mass, _ in masses)}
    given |= {f"moment_{a}": moment[k] for k, a in enumerate("xyz")}
    given |= {f"axle_{a}{i}": axles[:, i, k] for i in _CORNERS for k, a in enumerate("xyz")}
    return given | {f"stiffness{i}": parameters["ground.normal_stiffness"][:, i] for i in _CORNERS}


def _newton_step(lanes: Lanes, features: frozenset[str]) -> Out:
    """Move height, pitch and roll towards rest."""
    (sy, cy), (sp, cp), (sr, cr) = (ops.sin_cos(lanes[name]) for name in ("yaw", "pitch", "roll"))
    turn = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    place = [lanes[f"p{a}"] for a in "xyz"]

    def levers(arm: Vector) -> Vector:
        """How much a vertical force at an arm (floor frame) does for height, pitch (nose down) and roll."""
        return [1.0, -(cy * arm[0] + sy * arm[1]), cy * arm[1] - sy * arm[0]]

    def in_floor(vector: Vector) -> Vector:
        return [row[0] * vector[0] + row[1] * vector[1] + row[2] * vector[2] for row in turn]

    _, pitching, rolling = levers(in_floor([lanes[f"moment_{a}"] for a in "xyz"]))
    force: Vector = [-lanes["weight"], -pitching, -rolling]
    stiffness: list[Vector] = [[0.0] * 3 for _ in range(3)]
    for i in _CORNERS:
        arm = in_floor([lanes[f"axle_{a}{i}"] for a in "xyz"])
        centre = [place[k] + arm[k] for k in range(3)]
        touches = relief.touches(lanes, i, centre, [row[1] for row in turn], features)
        depth = reduce(ops.maximum, [touch.depth for touch in touches])
        lever, spring = levers(arm), lanes[f"stiffness{i}"]
        push = ops.maximum(depth, 0.0) * spring
        acting = ops.where_positive(depth, spring, LOOSE * spring)
        for j in range(3):
            force[j] = force[j] + push * lever[j]
            for k in range(3):
                stiffness[j][k] = stiffness[j][k] + acting * (lever[j] * lever[k])
    rise = _solved(stiffness, force)
    longest = reduce(ops.maximum, [ops.absolute(value) for value in rise])
    share = ops.minimum(LONGEST / (longest + 1e-12), 1.0)
    pz, pitch, roll = (lanes[name] + share * value for name, value in zip(_POSE, rise, strict=True))
    return {"pz": pz, "pitch": pitch, "roll": roll} | _attitude(lanes["yaw"], pitch, roll)


def _solved(matrix: list[Vector], vector: Vector) -> Vector:
    """Solve a symmetric positive 3x3 system by elimination."""
    a, x = [row[:] for row in matrix], vector[:]
    for k in range(3):
        inverse = 1.0 / a[k][k]
        for r in range(k + 1, 3):
            factor = a[r][k] * inverse
            a[r] = [a[r][c] - factor * a[k][c] for c in range(3)]
            x[r] = x[r] - factor * x[k]
    for k in reversed(range(3)):
        for c in range(k + 1, 3):
            x[k] = x[k] - a[k][c] * x[c]
        x[k] = x[k] / a[k][k]
    return x


def _attitude(yaw: Value, pitch: Value, roll: Value) -> Out:
    (sy, cy), (sp, cp), (sr, cr) = (ops.sin_cos(0.5 * angle) for angle in (yaw, pitch, roll))
    values = (
        cy * cp * cr + sy * sp * sr,
        cy * cp * sr - sy * sp * cr,
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
    )
    return dict(zip(_ATTITUDE, values, strict=True))


def _source(features: frozenset[str]) -> str:
    owner = Graph()
    places = {name: f"w[{k}]" for k, name in enumerate(_LANES)}
    step = _newton_step(Inputs(owner), features)
    body = emit(step, places.__getitem__, lambda name, text: f"{places[name]} = {text}", "", fused=True)
    lines = [
        *straight_line_source("step_of_robot", ["w"], body),
        "",
        "@compiled(error_model='numpy')",
        "def settle(values, steps):",
        "    for i in range(len(values)):",
        "        w = numbers_of(values[i])",
        "        for _ in range(steps):",
        "            step_of_robot(w)",
        "",
    ]
    return "\n".join(lines)


_SOURCE_KEY = "\0".join([source_of(relief, ops, sys.modules[__name__]), *_LANES])
