"""What is shown of a run beside its channels: where the robot is, and how its wheels slip. Nothing of it is read back."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.body_pose import euler_angles, quaternion
from wlr_gym.data.logs.messages import BODY, FLOOR, STRING, Sent, header, make, sent
from wlr_gym.data.read import Run
from wlr_gym.data.replay import robot_of
from wlr_gym.data.run_states import has_camera, measured_state
from wlr_gym.physics.plants.base import standing_state
from wlr_gym.physics.plants.sensors import rotation
from wlr_gym.robot import CORNER_NAMES, CORNER_SIGNS, CORNERS, JOINTS, LEG_SLICE, LEGS, WHEELS, Robot
from wlr_gym.robot.interchange.urdf import urdf_text
from wlr_gym.robot.parameters import Parameters
from wlr_gym.robot.slip import contact_slip_velocity

Array = NDArray[np.float64]

POSE, TRANSFORMS, SLIP, DESCRIPTION = "/pose", "/tf", "/slip", "/robot_description"
#: Link of the URDF that is the body.
BASE = "base_link"
POSE_TYPE, TRANSFORM_TYPE, MARKER_TYPE = (
    "geometry_msgs/msg/PoseStamped",
    "tf2_msgs/msg/TFMessage",
    "visualization_msgs/msg/MarkerArray",
)
#: Markers and transforms per second.
RATE = 12.5
#: m of arrow per m/s of slip, and its shaft, m.
_LENGTH, _SHAFT = 1.0, 0.012


def display_messages(run: Run, times: list[int]) -> dict[int, list[Sent]]:
    """Return what is shown by the row's time (ns).

    ``/robot_description`` is the robot as URDF, and ``/tf`` has where its links are, by the joints' angles. With a camera's
    pose, ``/pose`` is what it saw, frame by frame; and where the body is (``/tf``), and the slip velocity of each wheel's
    contact point over the floor (``/slip``), come from the smoothed motion of camera, encoders and gyroscope. All but ``/pose``
    are sent :data:`RATE` times a second.
    """
    shown: dict[int, list[Sent]] = {}
    if has_camera(run):
        for row in np.flatnonzero(np.isfinite(run["cam_x"]) & np.isfinite(run["cam_yaw"])):
            shown.setdefault(times[row], []).append(_camera_pose(run, int(row), times[row]))
    if not all(np.isfinite(run[f"pos_{joint}"]).all() for joint in JOINTS):
        return shown  # no run that a reader takes: its channels go out all the same
    step = max(round(1.0 / RATE / float(np.median(np.diff(run["t"])))), 1)
    rows = np.arange(0, len(times), step)
    robot = robot_of(run)
    text = make(STRING, data=urdf_text(robot))
    shown.setdefault(times[0], []).append(sent(DESCRIPTION, STRING, times[0], text))
    motion = _motion(run, robot, rows, [times[row] for row in rows]) if has_camera(run) else [[] for _ in rows]
    angles = np.stack([run[f"pos_{joint}"][rows] for joint in JOINTS], axis=1)
    for row, moved, links in zip(rows, motion, _links(robot, angles, [times[row] for row in rows]), strict=True):
        shown.setdefault(times[row], []).extend([links, *moved])
    return shown


def _links(robot: Robot, angles: Array, times: list[int]) -> Iterator[Sent]:
    """Yield where the links of the URDF are: body, then each leg at its hip and its wheel at the leg's end, turned about y."""
    numbers = Parameters.nominal(robot)
    hips = numbers["hip.position"][0] * np.array([(*sign, 1.0) for sign in CORNER_SIGNS])
    length = numbers["leg.length"][0]
    level = np.array([1.0, 0.0, 0.0, 0.0])
    turns = np.stack([np.cos(angles / 2), 0 * angles, np.sin(angles / 2), 0 * angles], axis=-1)
    for time, turn in zip(times, turns, strict=True):
        links = [_transform(time, BODY, BASE, np.zeros(3), level)]
        for corner, (leg, wheel) in enumerate(zip(LEGS, WHEELS, strict=True)):
            links.append(_transform(time, BASE, f"{leg}_link", hips[corner], turn[corner]))
            end = np.array([length[corner], 0.0, 0.0])
            links.append(_transform(time, f"{leg}_link", f"{wheel}_link", end, turn[len(LEGS) + corner]))
        yield _transforms(time, links)


def _camera_pose(run: Run, row: int, time: int) -> Sent:
    z, pitch = (float(run[name][row]) if name in run else 0.0 for name in ("cam_z", "cam_pitch"))
    turn = quaternion(run["cam_yaw"][[row]], np.nan_to_num([pitch]), np.zeros(1))[0]
    place = (float(run["cam_x"][row]), float(run["cam_y"][row]), float(np.nan_to_num(z)))
    return sent(POSE, POSE_TYPE, time, make(POSE_TYPE, header=header(time, FLOOR), pose=_pose(place, turn)))


def _motion(run: Run, robot: Robot, rows: NDArray[np.intp], times: list[int]) -> list[list[Sent]]:
    many = Parameters(np.repeat(Parameters.nominal(robot).values, len(rows), axis=0))
    state = measured_state(run, run["t"][rows], standing_state(robot, many), many)
    slip = contact_slip_velocity(
        many, state.quaternion, state.linear_velocity_in_body, state.angular_velocity_in_body, state.joint_position,
        state.joint_velocity,
    )  # fmt: skip
    feet, yaw = _feet(many, state.position, state.quaternion, state.joint_position[:, LEG_SLICE])
    headings = np.stack([np.stack([np.cos(yaw), np.sin(yaw)], -1), np.stack([-np.sin(yaw), np.cos(yaw)], -1)], axis=1)
    over_floor = np.einsum("nwk,nkj->nwj", slip, headings)
    return [
        [_transforms(time, [_transform(time, FLOOR, BODY, position, turn)]), _markers(time, foot, arrow)]
        for time, position, turn, foot, arrow in zip(times, state.position, state.quaternion, feet, over_floor, strict=True)
    ]


def _feet(parameters: Parameters, position: Array, turn: Array, legs: Array) -> tuple[Array, Array]:
    """Return where the wheels touch the floor (N, 4, 2), m, and the heading (N,), rad."""
    yaw, _, _ = euler_angles(turn)
    along = np.stack([np.cos(legs), np.zeros_like(legs), -np.sin(legs)], axis=-1) * parameters["leg.length"][:, :, None]
    hips = parameters["hip.position"][:, None, :] * np.array([(*sign, 1.0) for sign in CORNER_SIGNS])
    level = rotation(yaw, np.zeros_like(yaw), np.zeros_like(yaw))
    return position[:, None, :2] + np.einsum("nij,nwj->nwi", level, hips + along)[..., :2], yaw


def _pose(place: tuple[float, float, float], turn: Array) -> object:
    point = make("geometry_msgs/msg/Point", x=place[0], y=place[1], z=place[2])
    return make("geometry_msgs/msg/Pose", position=point, orientation=_quaternion(turn))


def _quaternion(turn: Array) -> object:
    w, x, y, z = map(float, turn)
    return make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _transform(time: int, frame: str, child: str, position: Array, turn: Array) -> object:
    x, y, z = map(float, position)
    moved = make(
        "geometry_msgs/msg/Transform", translation=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z), rotation=_quaternion(turn)
    )
    return make("geometry_msgs/msg/TransformStamped", header=header(time, frame), child_frame_id=child, transform=moved)


def _transforms(time: int, transforms: list[object]) -> Sent:
    return sent(TRANSFORMS, TRANSFORM_TYPE, time, make(TRANSFORM_TYPE, transforms=transforms))


def _markers(time: int, feet: Array, arrows: Array) -> Sent:
    markers = [_arrow(time, k, feet[k], arrows[k]) for k in range(len(feet))]
    return sent(SLIP, MARKER_TYPE, time, make(MARKER_TYPE, markers=markers))


def _arrow(time: int, corner: int, foot: Array, velocity: Array) -> object:
    tip = foot + _LENGTH * velocity
    points = [make("geometry_msgs/msg/Point", x=float(x), y=float(y), z=0.005) for x, y in (foot, tip)]
    return make(
        MARKER_TYPE.replace("Array", ""),
        header=header(time, FLOOR),
        ns=f"slip of {CORNER_NAMES[CORNERS[corner]]} wheel",
        id=corner,
        type=0,  # an arrow
        action=0,
        pose=_pose((0.0, 0.0, 0.0), np.array([1.0, 0.0, 0.0, 0.0])),
        scale=make("geometry_msgs/msg/Vector3", x=_SHAFT, y=2 * _SHAFT, z=0.0),
        color=make("std_msgs/msg/ColorRGBA", r=0.9, g=0.1, b=0.1, a=1.0),
        lifetime=make("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        frame_locked=False,
        points=points,
        colors=[],
        texture_resource="",
        texture=make("sensor_msgs/msg/CompressedImage", header=header(time, FLOOR), format="", data=np.zeros(0, np.uint8)),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=make("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )
