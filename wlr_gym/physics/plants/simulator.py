"""What every simulator does alike: buffers, taking and checking parameters, resets, setpoints of motors that are off."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.compiled import compiled
from wlr_gym.base.errors import InputError
from wlr_gym.base.snapshot import RowStore, Snapshot, check_fit, read_rows, take_snapshot, write_snapshot
from wlr_gym.physics.plants import relief
from wlr_gym.physics.plants.base import (
    SENSOR_LAYOUT,
    TRUTH_LAYOUT,
    Capabilities,
    Contacts,
    PlantOptions,
    PlantState,
    Sensors,
    Truth,
    check_setpoints,
    hold_where_off,
    standing_state,
)
from wlr_gym.physics.plants.body import SHALLOW, SPOTS, lowest_corner, spots_at
from wlr_gym.physics.plants.contacts import CONTACTS, contacts_at
from wlr_gym.physics.plants.sensors import RAW_LAYOUT, SensorModel, check_flow
from wlr_gym.robot import LEG_SLICE, WHEELS, Robot
from wlr_gym.robot.parameter_table import SPECS
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]
Rows = NDArray[np.intp]


#: Of the platform's mass: what moves at least against one wheel's spring.
LIGHTEST_SHARE = 0.05


class Simulator(ABC):
    """Base of the simulators; see :class:`wlr_gym.physics.plants.base.Plant` for the contract.

    A simulator ends its constructor with :meth:`_start`, and defines ``step`` and what is abstract here.
    """

    capabilities: Capabilities
    _formulas: Any = None

    def __init__(self, robot: Robot, count: int, options: PlantOptions | None) -> None:
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
            raise InputError(f"number of robots is {count!r}, expected 1 or more")
        self.robot = robot
        self.options: PlantOptions = options or PlantOptions()
        self.substeps: int = self.options.substeps
        self.parameters: Parameters = Parameters.nominal(robot, count)
        self._count = count
        self._all = np.arange(count)
        self._truth = Truth(np.zeros((count, TRUTH_LAYOUT.width)))
        self._raw = np.zeros((count, RAW_LAYOUT.width))
        self._readings = Sensors(np.zeros((count, SENSOR_LAYOUT.width)))
        self._time: Array = np.zeros(count)
        self._setpoints: Setpoints = SetpointHistory(count, self.options.control_period)
        self._sensors = SensorModel(robot, self.options, count)
        self._robot_content = robot.model_dump(mode="json", exclude={"name", "joints", "dynamixel_ids"})

    def _start(self) -> None:
        self.reset(seeds=np.zeros(self._count, np.uint64), parameters=self.parameters)

    @abstractmethod
    def _use_parameters(self, rows: Rows, chosen: Parameters) -> None:
        """Hand checked parameters (len(rows)) of robots ``rows`` to the simulation."""

    @abstractmethod
    def _fit_rotors(self, rows: Rows, chosen: Parameters) -> None:
        """Move the rotors of gears whose play changes (:func:`refitted_lead`); a new rotor turns with its joint."""

    @abstractmethod
    def _write_state(self, state: PlantState, rows: Rows) -> None:
        """Put robots ``rows`` where ``state`` (N) says."""

    @abstractmethod
    def _servo_state(self) -> tuple[Array, ...]:
        """Return copies of the servos' references (N, 8), rad (legs: as read) and rad/s, of lead and rate of the rotors (N, 8),
        of the supply's drop (N,), of the joints' wind-up (N, 8) and of the treads' shear (N, 16), m."""

    @abstractmethod
    def _engine_stores(self) -> dict[str, RowStore]:
        """Return what the simulation itself remembers of its robots from one tick to the next."""

    @abstractmethod
    def _look(self, rows: Rows) -> None:
        """Fill truth and raw sensor signals of robots ``rows``."""

    def expect_all_effects(self) -> None:  # noqa: B027 (a simulator may have nothing to do)
        """Get ready for every effect at once, where each would otherwise need a kernel of its own; the bits do not change."""

    @abstractmethod
    def set_force_values(self, values: Array) -> None:
        """Take the constants of the formula forces per robot: (N, constants of all forces one after the other)."""

    @property
    def count(self) -> int:
        """Number of robots."""
        return self._count

    def reset(
        self,
        seeds: NDArray[np.uint64] | None = None,
        parameters: Parameters | None = None,
        mask: NDArray[np.bool_] | None = None,
        state: PlantState | None = None,
    ) -> Sensors:
        """Start robots anew; see :meth:`wlr_gym.physics.plants.base.Plant.reset`."""
        rows = self._rows(mask)
        if state is not None and len(state) != self._count:
            raise InputError(f"state holds {len(state)} robots, the plant {self._count}")
        if seeds is not None:
            seeds = _checked(seeds, self._count)
        if parameters is not None:
            self._take_parameters(parameters, rows)
        start = standing_state(self.robot, self.parameters) if state is None else state
        self._write_state(start, rows)
        self._time[rows] = 0.0 if start.time is None else start.time[rows]
        self._setpoints.reset(rows, start, self.parameters)
        self._look(rows)
        if state is not None:
            self._check_depth(rows)
        self._sensors.reset(self._raw, self._readings.values, seeds, mask=mask)
        return self._readings

    def _check_depth(self, rows: Rows) -> None:
        """Refuse robots that start with an axle below the surface of a floor with relief, or with body or legs in the floor:
        nothing says which way is out."""
        chosen, truth = Parameters(self.parameters.values[rows]), Truth(self._truth.values[rows])
        is_plane = not relief.families(chosen)
        if is_plane and (lowest_corner(self.robot, truth) > 0.0).all():
            return
        found = spots_at(self.robot, chosen, truth, np.zeros((len(rows), len(SPOTS), 3)))
        robot, spot = np.unravel_index(int(np.argmax(found.depth)), found.depth.shape)
        if found.depth[robot, spot] > SHALLOW:
            raise InputError(
                f"state: the body or a leg of robot {rows[robot]} is {found.depth[robot, spot]:.3g} m deep in the floor: "
                f"expected at most {SHALLOW:g} m"
            )
        if is_plane:
            return
        found = contacts_at(self.robot, chosen, truth, np.zeros((len(rows), len(CONTACTS), 3)))
        excess = found.depth - np.tile(chosen["wheel.radius"], 2)
        robot, contact = np.unravel_index(int(np.argmax(excess)), excess.shape)
        if excess[robot, contact] > 0.0:
            wheel = int(contact) % len(WHEELS)
            deep, radius = found.depth[robot, contact], chosen["wheel.radius"][robot, wheel]
            raise InputError(
                f"state: {WHEELS[wheel]} of robot {rows[robot]} is {deep:.3g} m deep in the floor: expected less than its "
                f"radius, {radius:.3g} m; settle() puts standing robots on their floor"
            )

    def set_parameters(self, parameters: Parameters, mask: NDArray[np.bool_] | None = None) -> None:
        """Change parameters in mid-run (interval randomisation, drifting friction); the state stays."""
        rows = self._rows(mask)
        self._take_parameters(parameters, rows)
        self._setpoints.set_delays(rows, self.parameters)

    def mechanical_state(self) -> PlantState:
        """Return a copy of the mechanical and servo state."""
        truth, has_play = self._truth, self.parameters["servo.backlash"] > 0.0
        position, velocity, lead, rate, drop, wind_up, shear = self._servo_state()
        position[:, LEG_SLICE] -= self.parameters["joint.zero_offset"]
        body = ("position", "quaternion", "linear_velocity_in_body", "angular_velocity_in_body")
        return PlantState(
            **{name: truth[name].copy() for name in (*body, "joint_position", "joint_velocity")},
            reference_position=position,
            reference_velocity=velocity,
            rotor_lead=np.where(has_play, lead, 0.0),
            rotor_rate=np.where(has_play, rate, truth.joint_velocity),
            supply_drop=drop,
            time=self._time.copy(),
            wind_up=wind_up,
            shear=shear,
        )

    # ---- snapshots ----

    def _fits(self) -> dict[str, Any]:
        """What a plant must be like to take this one's state."""
        options = self.options
        return {
            "backend": self.capabilities.name,
            "robot": self._robot_content,
            "precision": options.precision,
            "control_period": options.control_period,
            "physics_step": options.physics_step,
            "sensor_noise": options.sensor_noise,
            "formulas": self._formulas.module if self._formulas else "",
        }

    def _stores(self) -> dict[str, RowStore]:
        """Everything that decides what comes next, but for the parameters."""
        return {
            "truth": self._truth.values,
            "raw": self._raw,
            "readings": self._readings.values,
            "time": self._time,
            **self._setpoints.stores(),
            **self._sensors.stores(),
            **self._engine_stores(),
        }

    def get_state(self, rows: int | Sequence[int] | NDArray[Any] | None = None) -> Snapshot:
        """Return everything that decides what comes next; see :meth:`wlr_gym.physics.plants.base.Plant.get_state`."""
        stores = {"parameters": self.parameters.values, **self._stores()}
        return take_snapshot(stores, read_rows(rows, self._count), self._fits())

    def set_state(self, snapshot: Snapshot, rows: int | Sequence[int] | NDArray[Any] | None = None) -> Sensors:
        """Put robots into the state of a snapshot; see :meth:`wlr_gym.physics.plants.base.Plant.set_state`."""
        index = read_rows(rows, self._count)
        check_fit(snapshot, index, self._fits(), ["parameters", *self._stores()])
        values = snapshot.arrays["parameters"]
        changed = (self.parameters.values[index] != values).any(axis=1)
        if changed.any():
            self.parameters.values[index] = values
            new = np.unique(index[changed])  # MuJoCo wants them in order
            self._use_parameters(new, Parameters(self.parameters.values[new]))
        write_snapshot(snapshot, self._stores(), index)  # the new parameters may have moved the state to other arrays
        self._setpoints.set_delays(index, self.parameters)
        return self._readings

    def use_setpoints(self, setpoints: Setpoints) -> None:
        """Take the setpoints from a schedule of one's own instead of the history of those written."""
        self._setpoints = setpoints

    def keep_going(self, count: int) -> None:  # noqa: B027 (a simulator may have no use for it)
        """From now on nobody looks at any but the first ``count`` robots: a simulator need not move the others."""

    def _take_setpoints(self, setpoints: Array, torque_on: NDArray[np.bool_] | None, on: Array) -> tuple[Array, Array, Array]:
        """Write into ``on`` (N, 8) which motors are on; return newer and older setpoints and the switch time of this tick."""
        if torque_on is None:
            on.fill(1.0)
        elif self._setpoints.given:
            on[...] = torque_on
        else:
            setpoints = hold_where_off(setpoints, torque_on, self._present_setpoints())
            on[...] = np.asarray(torque_on, dtype=bool)
        return self._setpoints.push(setpoints if self._setpoints.given else check_setpoints(setpoints, self._count))

    def _rows(self, mask: NDArray[np.bool_] | None) -> Rows:
        if mask is None:
            return self._all
        given = np.asarray(mask)
        if given.shape != (self._count,) or given.dtype != np.bool_:
            raise InputError(f"mask has shape {given.shape} and type {given.dtype}, expected ({self._count},) booleans")
        return np.flatnonzero(mask)

    def _take_parameters(self, parameters: Parameters, rows: Rows) -> None:
        if len(parameters) != self._count:
            raise InputError(f"parameters hold {len(parameters)} robots, the plant {self._count}")
        chosen = Parameters(parameters.values[rows])
        chosen.validate()
        check_flow(self.robot, chosen)
        check_contact_resolution(chosen, self.options.physics_step)
        self._fit_rotors(rows, chosen)
        self.parameters.values[rows] = chosen.values
        self._use_parameters(rows, chosen)
        self._sensors.set_errors(rows, self.parameters)

    def _present_setpoints(self) -> Array:
        """Setpoints that keep every joint as it is: leg angles as the servo reads them, wheels at rest."""
        present = np.zeros((self._count, 8))
        present[:, LEG_SLICE] = self._truth.joint_position[:, LEG_SLICE] + self.parameters["joint.zero_offset"]
        return present

    @abstractmethod
    def _contact_forces(self) -> Array:
        """Return the forces (N, 8, 3) on the wheels at their contacts, along the contacts' axes, N."""

    @abstractmethod
    def _spot_forces(self) -> Array:
        """Return the forces (N, 20, 3) on body and shanks, floor frame, N."""

    def contacts(self) -> Contacts:
        """Return where wheels, body and legs touch the floor now, and the forces of the last step there."""
        robots = self.robot, self.parameters, self._truth
        return contacts_at(*robots, self._contact_forces()).with_more(spots_at(*robots, self._spot_forces()))

    def truth(self) -> Truth:
        """Return the true state after the last step or reset; overwritten by the next step."""
        return self._truth


def refitted_lead(lead: Array, old: Array, new: Array) -> Array:
    """Return how far rotors lead their joints when the play of their gears changes from ``old`` to ``new`` (rad).

    How far the teeth are pressed together is kept; without play there is no rotor of its own.
    """
    pressed = np.maximum(np.abs(lead) - 0.5 * old, 0.0)
    kept = np.where(old > 0.0, np.minimum(np.abs(lead), 0.5 * new) + pressed, 0.0)
    return np.where(old == new, lead, np.where(new > 0.0, np.copysign(kept, lead), 0.0))


def most_damping(parameters: Parameters, step: float) -> float:
    """Return the contact damping (N s/m) that the step just resolves, for the lightest robot of the batch."""
    return float(2.0 * LIGHTEST_SHARE * parameters["body.mass"].min() / step)


def check_contact_resolution(parameters: Parameters, step: float) -> None:
    """Refuse a contact spring that the step cannot resolve (explicit spring: step^2 k / m well below 4).

    The mass that moves against one wheel's spring is at least about a twentieth of the platform (a light leg swinging up
    against its own rotor inertia).
    """
    stiffness = parameters["ground.normal_stiffness"].max(axis=1)
    damping = parameters["ground.normal_damping"].max(axis=1)
    mass = LIGHTEST_SHARE * parameters["body.mass"]
    worst = np.maximum(step * step * stiffness / mass / 2.0, step * damping / mass / 2.0)
    robot = int(np.argmax(worst))
    if worst[robot] > 1.0:
        raise InputError(
            f"ground.normal_stiffness {stiffness[robot]:g} N/m and ground.normal_damping {damping[robot]:g} N s/m are too "
            f"stiff for a physics step of {step:g} s and a body of {parameters['body.mass'][robot]:g} kg: shorten physics_step "
            f"below {step / worst[robot] ** 0.5:.2g} s or soften the contact"
        )


def _checked(seeds: Any, count: int) -> NDArray[np.uint64]:
    try:
        found = np.asarray(seeds, np.uint64)
    except (OverflowError, TypeError, ValueError):
        found = None
    if found is None or found.shape != (count,) or not np.array_equal(found, seeds):
        raise InputError(f"seeds = {seeds!r}: expected whole numbers from 0 on, one for each robot, here {count}")
    return found


# ---- delayed setpoints: a command acts some time after it was written, per joint and robot ---------------------------


class Setpoints(Protocol):
    """Where a simulator gets the setpoints of a tick from; see :class:`SetpointHistory`.

    Attributes:
        given: they come from elsewhere; what is written to the simulator is ignored.
    """

    given: bool

    def reset(self, rows: NDArray[np.intp], state: PlantState, parameters: Parameters) -> None: ...

    def set_delays(self, rows: NDArray[np.intp], parameters: Parameters) -> None: ...

    def push(self, setpoints: Array) -> tuple[Array, Array, Array]: ...

    def stores(self) -> dict[str, RowStore]: ...


@compiled
def _read(ring: Any, head: int, ticks: Any, newer: Any, older: Any) -> None:
    """Read the setpoints written so many ``ticks`` (N, 8) ago, and those of a tick before, from a ring (depth, N, 8)."""
    depth, count, width = ring.shape
    for i in range(count):
        for j in range(width):
            place = head - ticks[i, j]
            newer[i, j] = ring[place % depth, i, j]
            older[i, j] = ring[(place - 1) % depth, i, j]


class SetpointHistory:
    """Ring of the last setpoints, from which each joint reads at its own ``command.delay``.

    Within one control tick a joint follows the older of two neighbouring setpoints until ``switch_time``, then the newer one.
    """

    given = False

    def __init__(self, count: int, control_period: float) -> None:
        self._period = control_period
        depth = int(np.ceil(SPECS["command.delay"].high / control_period)) + 2
        self._ring = np.zeros((depth, count, 8))
        self._head = 0
        self._ticks = np.zeros((count, 8), np.intp)
        self._switch_time = np.zeros((count, 8))
        self._delayed = False

    def reset(self, rows: NDArray[np.intp], state: PlantState, parameters: Parameters) -> None:
        """Forget old setpoints: legs are told to stay where their reference is, wheels to keep their reference speed.

        Setpoints are in terms of the reading, references in terms of the true angle.
        """
        hold = state.reference_velocity[rows].copy()
        hold[:, LEG_SLICE] = state.reference_position[rows, LEG_SLICE] + parameters["joint.zero_offset"][rows]
        self._ring[:, rows] = hold
        self.set_delays(rows, parameters)

    def set_delays(self, rows: NDArray[np.intp], parameters: Parameters) -> None:
        """Take new delays; setpoints already written act at their new time."""
        delay = parameters["command.delay"][rows]
        self._ticks[rows] = np.floor(delay / self._period + 1e-9)
        self._switch_time[rows] = np.maximum(delay - self._ticks[rows] * self._period, 0.0)
        self._delayed = bool(parameters["command.delay"].any())

    def push(self, setpoints: Array) -> tuple[Array, Array, Array]:
        """Take this tick's setpoints (N, 8); return the newer and the older ones and the switch time (s), each (N, 8)."""
        self._head = (self._head + 1) % len(self._ring)
        self._ring[self._head] = setpoints
        if not self._delayed:
            return setpoints, setpoints, self._switch_time
        newer, older = np.empty_like(setpoints), np.empty_like(setpoints)
        _read(self._ring, self._head, self._ticks, newer, older)
        return newer, older, self._switch_time

    def stores(self) -> dict[str, RowStore]:
        """Return the setpoints that were written, newest first (delays are parameters)."""
        return {"setpoints": _NewestFirst(self)}


class _NewestFirst:
    """The ring as rows (M, depth, 8) of robots, wherever its head is."""

    def __init__(self, history: SetpointHistory) -> None:
        self._history = history

    def _places(self, rows: NDArray[np.intp]) -> tuple[NDArray[Any], NDArray[Any]]:
        depth = len(self._history._ring)
        return (self._history._head - np.arange(depth)[None, :]) % depth, rows[:, None]

    def __getitem__(self, rows: NDArray[np.intp]) -> Array:
        return self._history._ring[self._places(rows)]

    def __setitem__(self, rows: NDArray[np.intp], values: Array) -> None:
        self._history._ring[self._places(rows)] = values
