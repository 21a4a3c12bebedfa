"""The measured-run format as data: columns with unit, meaning and sensor noise, and the ``meta.yaml`` model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import Field

from wlr_gym.base.settings import SettingsModel
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Vector3
from wlr_gym.robot.parameter_table import XYZ

#: File suffixes a run may have.
SUFFIXES = (".csv", ".parquet")
META_FILE = "meta.yaml"
#: Robot of the runs of a folder, where it is none that ships.
ROBOT_FILE = "robot.yaml"


@dataclass(frozen=True)
class Column:
    """One column of a run.

    Attributes:
        name: as in the file's header.
        group: columns of one kind share it (``pos_leg``, ``gyro``, ``cam_xy``); limits and tables go by group.
        unit: SI unit.
        doc: meaning.
        required: a run without it is refused.
        may_be_nan: single values may be missing by design.
        noisy: carries analogue noise well above its resolution, so that exactly repeated values are suspicious.
    """

    name: str
    group: str
    unit: str
    doc: str
    required: bool = False
    may_be_nan: bool = False
    noisy: bool = False


def _joint_columns(kind: str, unit: tuple[str, str], doc: str, **flags: bool) -> list[Column]:
    """One column per joint; ``unit`` holds the unit for legs and for wheels."""
    legs = [Column(f"{kind}_{leg}", f"{kind}_leg", unit[0], doc, **flags) for leg in LEGS]
    return legs + [Column(f"{kind}_{wheel}", f"{kind}_wheel", unit[1], doc, **flags) for wheel in WHEELS]


_NO_READING, _NO_FRAME = "NaN without a new valid reading", "NaN without a new frame"
_MARKER = "marker's centre (`marker_offset` in meta.yaml; default: the body's origin)"

_TABLE: list[Column] = [
    Column(
        "t", "t", "s", "host clock when the row's sensors were read; strictly increasing, nominally 20 ms apart", required=True
    ),
    *_joint_columns(
        "cmd",
        ("rad", "rad/s"),
        "setpoint sent to the servo in this control step, after the row's sensors were read; NaN = torque off (free-spinning)",
        required=True,
        may_be_nan=True,
    ),
    *_joint_columns(
        "pos", ("rad", "rad"), "encoder; wheels unwrapped, relative to their leg, zero at the run's start", required=True
    ),
    *_joint_columns("vel", ("rad/s", "rad/s"), "the servo's own velocity reading"),
    *_joint_columns(
        "eff",
        ("N m", "N m"),
        "motor torque estimate: current (legs) or load (wheels) times the nominal torque constant at the output shaft, "
        "before gear friction",
    ),
    *[Column(f"gyro_{axis}", "gyro", "rad/s", "angular velocity, body frame", noisy=True) for axis in XYZ],
    *[Column(f"acc_{axis}", "acc", "m/s2", "specific force, body frame (+9.81 on z at rest)", noisy=True) for axis in XYZ],
    *[
        Column(name, "cam_xy", "m", f"vision position of the {_MARKER} in the floor frame; {_NO_FRAME}", may_be_nan=True)
        for name in ("cam_x", "cam_y")
    ],
    Column("cam_yaw", "cam_yaw", "rad", f"vision heading in the floor frame; {_NO_FRAME}", may_be_nan=True),
    Column("cam_z", "cam_z", "m", f"vision height of the {_MARKER}; {_NO_FRAME}", may_be_nan=True),
    Column("cam_pitch", "cam_pitch", "rad", f"vision pitch, nose down positive; {_NO_FRAME}", may_be_nan=True),
    Column("volt", "volt", "V", "supply voltage"),
    Column("cam_age", "cam_age", "s", "age of the last vision pose when the row's sensors were read; live cameras only"),
    *[
        Column(f"flow_{axis}", "flow", "rad/s", f"optical flow along body {axis}, {law}; {_NO_READING}", may_be_nan=True)
        for axis, law in (("x", "v_x/h - w_y"), ("y", "v_y/h + w_x"))
    ],
    Column("flow_quality", "flow_quality", "-", f"surface quality of the flow sensor, 0 to 1; {_NO_READING}", may_be_nan=True),
    Column("flow_age", "flow_age", "s", "time since the interval of the last valid flow reading ended"),
]

#: All columns by name, in the order files are written.
COLUMNS: dict[str, Column] = {column.name: column for column in _TABLE}
REQUIRED = tuple(name for name, column in COLUMNS.items() if column.required)
COMMANDS = tuple(f"cmd_{joint}" for joint in JOINTS)
#: Of an optical-flow sensor, where there is one.
FLOW = ("flow_x", "flow_y", "flow_quality", "flow_age")
#: What the robot measured and a replay predicts: everything but clocks, commands and optical flow.
CHANNELS = tuple(name for name in COLUMNS if name not in ("t", "cam_age", *COMMANDS, *FLOW))
CAMERA = ("cam_x", "cam_y", "cam_yaw", "cam_z", "cam_pitch")
ANGLES_OF_THE_BODY = ("cam_yaw", "cam_pitch")


class Profile(SettingsModel):
    """Servo profile registers: 0 = no profile, step references."""

    wheel_acceleration: float = Field(default=0.0, ge=0)
    leg_velocity: float = Field(default=0.0, ge=0)
    leg_acceleration: float = Field(default=0.0, ge=0)


class RunMeta(SettingsModel):
    """What ``meta.yaml`` says about the runs beside it.

    Attributes:
        robot: path of a robot file (relative to the meta file) or name of a robot.
        robot_hash: fingerprint of the robot in that file when the runs were recorded; None = not noted.
        profile: servo profile, rad/s2 and rad/s.
        ground: what the operator noted about the floor.
        marker_offset: marker centre in the body frame, m.
        notes: free text.
    """

    robot: str | None = None
    robot_hash: str | None = None
    profile: Profile = Profile()
    ground: str | None = None
    marker_offset: Vector3 = (0.0, 0.0, 0.0)
    notes: str | None = None

    @property
    def states_profile(self) -> bool:
        """Whether the servo profile was given; where not, it is assumed that there is none."""
        return "profile" in self.model_fields_set

    def content(self) -> dict[str, Any]:
        """Return what a file says of it: all but what was not given."""
        return self.model_dump(mode="json", exclude_none=True, exclude=None if self.states_profile else {"profile"})
