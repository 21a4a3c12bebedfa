"""The Plant contract: what every simulator and the real robot offer to an environment.

A plant is a batch of N robots. Arrays have N first, float64, SI units, joint order of ``wlr_gym.robot.JOINTS``. The
world frame is the floor frame (x, y in the floor, z its normal); on a slope gravity is what is inclined.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import LARGEST_NOISE_SEED, InputError, require_seed, unknown_name
from wlr_gym.base.snapshot import Snapshot
from wlr_gym.physics.plants import relief
from wlr_gym.physics.plants.standing import settle_on_relief
from wlr_gym.robot import JOINTS, LEG_SLICE, WHEELS, Robot
from wlr_gym.robot.parameter_table import XYZ
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Channel:
    """One named group of columns in a signal matrix: element labels, unit, frame and meaning."""

    name: str
    labels: tuple[str, ...]
    unit: str
    doc: str

    @property
    def elements(self) -> list[str]:
        """Full element names: ``gyro[x]``, or the bare name of a scalar."""
        return [f"{self.name}[{label}]" for label in self.labels] or [self.name]


class Layout:
    """Which columns of a signal matrix hold which channel."""

    def __init__(self, channels: tuple[Channel, ...]) -> None:
        self.channels: dict[str, Channel] = {channel.name: channel for channel in channels}
        self.slices: dict[str, slice] = {}
        start = 0
        for channel in channels:
            self.slices[channel.name] = slice(start, start + len(channel.elements))
            start += len(channel.elements)
        self.width = start
        self.elements: tuple[str, ...] = tuple(element for channel in channels for element in channel.elements)
        self._columns = {name: part if self.channels[name].labels else part.start for name, part in self.slices.items()}

    def view(self, values: Array, name: str) -> Array:
        """Return the columns of ``name``: shape (N,) for a scalar channel, (N, size) otherwise."""
        if name not in self._columns:
            raise unknown_name("channel", name, self.channels)
        return values[:, self._columns[name]]


_WHEEL_XY = tuple(f"{wheel},{axis}" for wheel in WHEELS for axis in ("x", "y"))
_WHEEL_XYZ = tuple(f"{wheel},{axis}" for wheel in WHEELS for axis in XYZ)

_EFFORT = "motor current (legs) or load (wheels) times the nominal torque constant, before gear friction"

SENSOR_LAYOUT = Layout(
    (
        Channel("joint_position", JOINTS, "rad", "encoder; wheels relative to their leg, unwrapped, zero at the run's start"),
        Channel("joint_velocity", JOINTS, "rad/s", "the servo's own velocity reading"),
        Channel("joint_effort", JOINTS, "N m", _EFFORT),
        Channel("gyro", XYZ, "rad/s", "angular velocity, body frame"),
        Channel("accelerometer", XYZ, "m/s2", "specific force (+9.81 on z at rest), body frame"),
        Channel("supply_voltage", (), "V", "at the servos"),
        Channel("camera_pose", ("x", "y", "yaw"), "m, m, rad", "last vision pose of the body origin, seen from the start pose"),
        Channel("joint_age", (), "s", "time since the joint readings were taken"),
        Channel("imu_age", (), "s", "time since the IMU was read"),
        Channel("camera_age", (), "s", "time since the shown camera frame was exposed"),
        Channel("camera_is_new", (), "-", "1 when this tick delivered a new camera frame, else 0"),
        Channel(
            "flow", ("x", "y"), "rad/s", "turn of the floor below the flow sensor: v_x/h - w_y, v_y/h + w_x; last valid reading"
        ),
        Channel("flow_quality", (), "-", "surface quality of the flow sensor over its maximum; 0 = no valid reading"),
        Channel("flow_age", (), "s", "time since the shown flow's interval ended"),
        Channel("flow_is_new", (), "-", "1 when this tick delivered a new valid flow reading, else 0"),
    )
)

TRUTH_LAYOUT = Layout(
    (
        Channel("position", XYZ, "m", "body origin in the floor frame"),
        Channel("quaternion", ("w", "x", "y", "z"), "-", "attitude: body to floor frame"),
        Channel("linear_velocity_in_body", XYZ, "m/s", "of the body origin, body frame"),
        Channel("angular_velocity_in_body", XYZ, "rad/s", "of the body, body frame"),
        Channel("joint_position", JOINTS, "rad", "true joint angles"),
        Channel("joint_velocity", JOINTS, "rad/s", "true joint rates, relative to the parent link"),
        Channel("motor_torque", JOINTS, "N m", "motor torque at the output shaft before gear friction, last substep"),
        Channel("friction_torque", JOINTS, "N m", "gear friction on each joint, last substep"),
        Channel("rolling_torque", WHEELS, "N m", "rolling resistance on each wheel about its axle, last substep"),
        Channel(
            "contact_force", _WHEEL_XYZ, "N", "on the wheel, in all: along its heading, along its axle, normal; last substep"
        ),
        Channel(
            "slip_velocity", _WHEEL_XY, "m/s", "of the contact point over the floor: along the wheel's heading, along its axle"
        ),
        Channel("slip_displacement", _WHEEL_XY, "m", "slip velocity integrated over the last control tick"),
        Channel("effective_friction", _WHEEL_XY, "-", "friction coefficients at each wheel: along its heading, along its axle"),
        Channel("mechanical_energy", (), "J", "work of all motors on their shafts over the last control tick"),
        Channel(
            "electrical_energy", (), "J", "energy drawn from the supply over the last control tick (braking counts as negative)"
        ),
        Channel("body_clearance", (), "m", "height of the body box's lowest corner above the floor"),
    )
)


#: Where a force given as a formula (:mod:`wlr_gym.physics.plants.forces`) may act -> unit of its value.
#: Joints: like the motor's torque, on the child link, its opposite on the parent.
#: ``body_force``: on the body origin, along the body's axes; ``floor_force``: on the body origin, along the floor's axes;
#: ``body_torque``: on the body, about its own x, y and z axes.
COORDINATES: dict[str, str] = {
    **dict.fromkeys(JOINTS, "N m"),
    **{f"body_force_{axis}": "N" for axis in XYZ},
    **{f"floor_force_{axis}": "N" for axis in XYZ},
    **{f"body_torque_{axis}": "N m" for axis in ("roll", "pitch", "yaw")},
}

#: What a simulator hands over per robot and physics step, at the step's start: quantities of ``TRUTH_LAYOUT`` by column
#: (motor torques and normal forces are those of the step before), and the supply voltage (V).
INPUTS: tuple[str, ...] = (
    *(f"position_{a}" for a in XYZ),
    *(f"quaternion_{a}" for a in "wxyz"),
    *(f"linear_velocity_in_body_{a}" for a in XYZ),
    *(f"angular_velocity_in_body_{a}" for a in XYZ),
    *(f"joint_position_{j}" for j in range(8)),
    *(f"joint_velocity_{j}" for j in range(8)),
    *(f"motor_torque_{j}" for j in range(8)),
    *(f"contact_force_{i}_z" for i in range(4)),
    *(f"slip_velocity_{i}_{a}" for i in range(4) for a in "xy"),
    "supply_voltage",
)
#: What formulas know besides: time since the start of the run or episode (s), and how far each joint is wound up.
MEMORY: tuple[str, ...] = ("time", *(f"wind_up_{j}" for j in range(8)))


class UnknownChannelError(InputError, AttributeError):
    """A channel that does not exist. Also an AttributeError: that is what ``hasattr`` and ``getattr`` ask for."""


class _Signals:
    layout: Layout
    __slots__ = ("values",)

    def __init__(self, values: Array) -> None:
        if values.dtype != np.float64 or not values.flags.c_contiguous:  # kernels read rows by their place in memory
            raise InputError(f"{type(self).__name__}: expected float64 numbers row by row (C order), got {values.dtype}")
        self.values: Array = values

    def __getattr__(self, name: str) -> Array:
        if name.startswith("__"):
            raise AttributeError(name)
        try:
            return self.layout.view(self.values, name)
        except InputError as error:
            raise UnknownChannelError(str(error)) from None

    def __getitem__(self, name: str) -> Array:
        return self.layout.view(self.values, name)


class Sensors(_Signals):
    """What the robot can measure: matrix (N, SENSOR_LAYOUT.width), channels by attribute (``sensors.gyro``)."""

    layout = SENSOR_LAYOUT
    __slots__ = ()


class Truth(_Signals):
    """What only a simulator knows: matrix (N, TRUTH_LAYOUT.width), channels by attribute (``truth.slip_velocity``)."""

    layout = TRUTH_LAYOUT
    __slots__ = ()


@dataclass(frozen=True, eq=False)
class Contacts:
    """Where robots touch the floor: K places each. Contacts i and i + 4 are those of wheel i, the deeper one first.

    From 8 on they are those of body and shanks (:data:`wlr_gym.physics.plants.body.SPOTS`). A wheel has a second contact only
    where pieces stand on the floor, the others have one only where they touch; without one the depth is -inf, all else is 0.

    Attributes:
        point: (N, K, 3) of the robot that is deepest, floor frame, m.
        depth: (N, K) how far it is in the floor, m; negative = how far away.
        normal, heading, lateral: (N, K, 3) of the floor outwards, of the wheel or body along it, of the axles along it; floor
            frame.
        force: (N, K, 3) on the robot along heading, lateral and normal, last substep, N.
    """

    point: Array
    depth: Array
    normal: Array
    heading: Array
    lateral: Array
    force: Array

    def with_more(self, other: Contacts) -> Contacts:
        """Return these contacts, and others of the same robots after them."""
        return Contacts(*(np.concatenate([vars(self)[name], vars(other)[name]], axis=1) for name in vars(self)))


@dataclass(frozen=True)
class Capabilities:
    """What a plant can do.

    Attributes:
        name: ``gibbs_appell``, ``mujoco`` or ``dynamixel``.
        has_truth: ``truth()`` works.
        can_set_state: ``mechanical_state``, ``get_state`` and ``set_state`` work (simulators).
        real_time: ``step`` blocks until the control period is over (robot).
    """

    name: str
    has_truth: bool
    can_set_state: bool
    real_time: bool


@dataclass
class PlantState:
    """Mechanical and servo state of a batch. Shapes (N, ...); floor frame unless named otherwise.

    Attributes:
        position: (N, 3) body origin, m.
        quaternion: (N, 4) body to floor frame, (w, x, y, z).
        linear_velocity_in_body: (N, 3) m/s.
        angular_velocity_in_body: (N, 3) rad/s.
        joint_position: (N, 8) true joint angles, rad.
        joint_velocity: (N, 8) rad/s, relative to the parent link.
        reference_position: (N, 8) position the servo's profile generator stands at, rad.
        reference_velocity: (N, 8) velocity it stands at, rad/s.
        rotor_lead: (N, 8) angle of each rotor beyond its joint, at the output shaft, rad: only where the gear has play. None =
            in the middle of the play.
        rotor_rate: (N, 8) rate of each rotor relative to the parent link, rad/s. None = turning with its joint.
        supply_drop: (N,) drop of the supply below its open-circuit voltage, V. None = none.
        time: (N,) since the start of the run or episode, s; only formula forces ask for it. None = its start.
        wind_up: (N, 8) of the joints, where a formula force asks for it (:data:`wlr_gym.physics.plants.forces.MEMORY`). None =
            none.
        shear: (N, 16) of elastic treads, m, at each contact along heading and axle. None = none.
    """

    position: Array
    quaternion: Array
    linear_velocity_in_body: Array
    angular_velocity_in_body: Array
    joint_position: Array
    joint_velocity: Array
    reference_position: Array
    reference_velocity: Array
    rotor_lead: Array | None = None
    rotor_rate: Array | None = None
    supply_drop: Array | None = None
    time: Array | None = None
    wind_up: Array | None = None
    shear: Array | None = None

    def __len__(self) -> int:
        return self.position.shape[0]

    def copy(self) -> PlantState:
        """Return an independent copy."""
        return PlantState(**{name: np.array(value) for name, value in vars(self).items() if value is not None})


def standing_state(robot: Robot, parameters: Parameters, leg_angle: float | None = None) -> PlantState:
    """Return every robot standing still on the floor with all legs at ``leg_angle`` (default: home), at x = y = yaw = 0.

    The body is put where the four contact springs carry the weight, so a level robot starts without a bounce.
    """
    count = len(parameters)
    angle = robot.home.leg_angle if leg_angle is None else leg_angle
    height = parameters["leg.length"] * np.sin(angle) + parameters["wheel.radius"] - parameters["hip.position"][:, 2:3]
    mass = (
        parameters["body.mass"]
        + parameters["payload.mass"]
        + parameters["leg.mass"].sum(axis=1)
        + parameters["wheel.mass"].sum(axis=1)
    )
    sag = mass * parameters["gravity"] / parameters["ground.normal_stiffness"].sum(axis=1)
    joints = np.zeros((count, 8))
    joints[:, LEG_SLICE] = angle
    position = np.zeros((count, 3))
    position[:, 2] = height.mean(axis=1) - sag
    quaternion = np.zeros((count, 4))
    quaternion[:, 0] = 1.0
    zeros = np.zeros((count, 3))
    state = PlantState(
        position, quaternion, zeros, zeros.copy(), joints, np.zeros((count, 8)), joints.copy(), np.zeros((count, 8))
    )
    settle(robot, parameters, state)
    return state


def settle(robot: Robot, parameters: Parameters, state: PlantState) -> None:
    """Put standing robots (N) on their wheels where the floor is not flat: height, pitch and roll; place and heading stay.

    ``state`` is changed in place; on a plane it stays as it is.
    """
    if features := relief.families(parameters):
        settle_on_relief(robot, parameters, state, frozenset(features))


@dataclass(frozen=True)
class PlantOptions:
    """Numerical choices every simulator shares.

    Attributes:
        control_period: s per ``step`` call.
        physics_step: s per substep; must divide the control period.
        precision: ``float64`` (reference) or ``float32`` (fast training mode) where the plant has it.
        threads: worker threads for large batches; results do not depend on it.
        sensor_noise: False switches noise and quantisation off (biases and filters stay).
    """

    control_period: float = 0.02
    physics_step: float = 0.001
    precision: str = "float64"
    threads: int = 1
    sensor_noise: bool = True

    def __post_init__(self) -> None:
        for name in ("control_period", "physics_step"):
            if isinstance(value := getattr(self, name), bool) or not isinstance(value, Real):
                raise InputError(f"{name} = {value!r}, expected a number of seconds")
            object.__setattr__(self, name, float(value))
        if isinstance(self.threads, bool) or not isinstance(self.threads, Integral):
            raise InputError(f"threads = {self.threads!r}, expected a whole number")
        object.__setattr__(self, "threads", int(self.threads))
        if not isinstance(self.precision, str):
            raise InputError(f"precision = {self.precision!r}, expected 'float64' or 'float32'")
        if not (0.0 < self.physics_step <= self.control_period):
            raise InputError(f"physics_step {self.physics_step!r} s must be in (0, control_period = {self.control_period!r} s]")
        if abs(self.substeps * self.physics_step - self.control_period) > 1e-9 * self.control_period:
            raise InputError(
                f"physics_step {self.physics_step!r} s does not divide the control period {self.control_period!r} s"
            )
        if self.threads < 1:
            raise InputError(f"threads = {self.threads}, expected 1 or more")

    @property
    def substeps(self) -> int:
        """Physics steps per control tick."""
        return round(self.control_period / self.physics_step)


def check_setpoints(setpoints: Array, count: int) -> Array:
    """Return setpoints as a float64 (count, 8) matrix.

    Raises:
        InputError: wrong shape, or a non-finite setpoint; names robot and joint.
    """
    setpoints = np.ascontiguousarray(setpoints, dtype=np.float64)
    if setpoints.shape != (count, len(JOINTS)):
        raise InputError(f"setpoints have shape {setpoints.shape}, expected ({count}, {len(JOINTS)})")
    if not math.isfinite(setpoints.sum()) and (bad := ~np.isfinite(setpoints)).any():
        row, joint = np.argwhere(bad)[0]
        raise InputError(
            f"setpoint of {JOINTS[joint]} (robot {row} of the batch) is {setpoints[row, joint]}, expected a finite number"
        )
    return setpoints


def hold_where_off(setpoints: Array, torque_on: NDArray[np.bool_], present: Array) -> Array:
    """Return setpoints in which a motor that is off is told to stay as it is.

    As on the servo, whose setpoint returns to the present position (speed 0) when torque is switched on: what was asked of a
    motor while it was off, NaN included, never acts later.

    Args:
        setpoints: (N, 8).
        torque_on: (N, 8).
        present: (N, 8) setpoints that keep each joint as it is: leg readings (rad), zero wheel speeds.
    """
    for name, value in (("setpoints", setpoints), ("torque_on", torque_on)):
        if np.shape(value) != present.shape:
            raise InputError(f"{name} has shape {np.shape(value)}, expected {present.shape}")
    return np.where(np.asarray(torque_on, dtype=bool), setpoints, present)


class Plant(Protocol):
    """A batch of robots. One ``step`` is one control tick."""

    robot: Robot
    options: PlantOptions
    capabilities: Capabilities
    parameters: Parameters

    @property
    def count(self) -> int:
        """Number of robots."""
        ...

    def reset(
        self,
        seeds: NDArray[np.uint64] | None = None,
        parameters: Parameters | None = None,
        mask: NDArray[np.bool_] | None = None,
        state: PlantState | None = None,
    ) -> Sensors:
        """Start robots anew and return their first sensor readings.

        Args:
            seeds: (N,) noise seeds; None keeps the present ones.
            parameters: (N) batch of parameters; rows of robots outside ``mask`` are ignored. None keeps them.
            mask: (N,) which robots; None = all.
            state: where to put them; None = :func:`standing_state`.
        """
        ...

    def step(self, setpoints: Array, torque_on: NDArray[np.bool_] | None = None) -> Sensors:
        """Write setpoints (N, 8: leg angles rad, wheel speeds rad/s) and advance one control tick.

        ``torque_on`` (N, 8) False leaves a motor open-circuit (free-spinning); None = all on. The returned matrix is
        overwritten by the next step; copy what must be kept.
        """
        ...

    def set_parameters(self, parameters: Parameters, mask: NDArray[np.bool_] | None = None) -> None:
        """Change parameters in mid-run (interval randomisation, drifting friction); the state stays."""
        ...

    def truth(self) -> Truth:
        """Return the true state after the last step or reset (simulators only)."""
        ...

    def mechanical_state(self) -> PlantState:
        """Return a copy of the mechanical and servo state, for ``reset(state=...)`` (simulators only)."""
        ...

    def get_state(self, rows: int | Sequence[int] | NDArray[Any] | None = None) -> Snapshot:
        """Return everything that decides what comes next, sensors and parameters included (simulators only).

        Args:
            rows: numbers of robots, or a mask (N,); None = all.

        Raises:
            InputError: not robots of this plant, or a real robot.
        """
        ...

    def set_state(self, snapshot: Snapshot, rows: int | Sequence[int] | NDArray[Any] | None = None) -> Sensors:
        """Put robots into the state of a snapshot, from which they go on bit for bit (simulators only); return the readings.

        Args:
            snapshot: of one robot, for all of ``rows``, or of one for each, from any batch with the same robot and options.
            rows: numbers of robots, or a mask (N,); None = all.

        Raises:
            InputError: a snapshot that does not fit (names the first difference), or a real robot; nothing has changed then.
        """
        ...

    def close(self) -> None:
        """Release threads, windows or ports."""
        ...


# ---- which real robot ``backend="dynamixel"`` drives, and how it is connected ----------------------------------------


@dataclass(frozen=True)
class RobotOptions:
    """Which real robot, and how it is connected (``backend="dynamixel"``).

    Attributes:
        hardware: name in ``configs/hardware/`` or path of a YAML file: wiring, mounting, safety limits.
        ports: bus name or ``imu`` -> device, where it differs from the file's.
        emulated: an emulated robot in this process and in emulated time, instead of ports.
        dry_run: do everything but write to the servos: nothing moves.
        log: folder for the logs of runs; None = none.
        guard: start the watchdog process, which switches torque off when this one is killed.
        deadman: s the operator may be silent; None = the hardware file's.
        effects: what the emulated robot has that its file does not say, as ``effects=`` of a simulator; no environment,
            policy or log is told of it.
        floor: that the emulated robot drives on, as ``floor=`` of a simulator, drawn by ``seed``; the logs' ``meta.yaml`` has
            it, of a real robot too.
        camera: above the floor: name in ``configs/camera/`` or path of a YAML file; None = there is none.
        poses: file that the emulated robot on ``ports`` writes its true pose into, for a camera that films it by rendering;
            None = the camera is a real one.
        seed: of the noise of an emulated robot.

    Raises:
        InputError: effects for a robot that is not emulated, a seed out of range.
    """

    hardware: str | Path = "nominal"
    ports: Mapping[str, str] = field(default_factory=dict)
    emulated: bool = False
    dry_run: bool = False
    log: Path | None = None
    guard: bool = True
    deadman: float | None = None
    effects: Any = None
    floor: Any = None
    camera: str | Path | None = None
    poses: Path | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.effects and not self.emulated:
            raise InputError("effects: a real robot has its own; they are for simulators and the emulated robot")
        require_seed("seed", self.seed, LARGEST_NOISE_SEED)


def read_robot_options(given: object) -> RobotOptions:
    """Return options from options, the name or path of a hardware file, a mapping of fields, or None."""
    if given is None or isinstance(given, RobotOptions):
        return given or RobotOptions()
    if isinstance(given, str | Path):
        return RobotOptions(hardware=given)
    if not isinstance(given, Mapping):
        raise InputError(f"hardware = {given!r}: expected a name, a path or a mapping")
    valid = [item.name for item in fields(RobotOptions)]
    for name in given:
        if name not in valid:
            raise unknown_name("field", str(name), valid, "hardware")
    options = RobotOptions(**given)
    return options if options.log is None else replace(options, log=Path(options.log))
