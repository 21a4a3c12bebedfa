"""The Gibbs-Appell engine as a Plant: batches of robots stepped by compiled kernels."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.snapshot import RowStore, Snapshot
from wlr_gym.physics.model.dynamics import gravity_in_floor, rotation_matrix
from wlr_gym.physics.plants import drive, ground, relief
from wlr_gym.physics.plants.base import MEMORY, Capabilities, PlantOptions, PlantState, Sensors
from wlr_gym.physics.plants.body import SPOTS
from wlr_gym.physics.plants.contacts import CONTACTS
from wlr_gym.physics.plants.gibbs_appell import kernel
from wlr_gym.physics.plants.gibbs_appell.kinematics import STORED, TURN
from wlr_gym.physics.plants.simulator import Simulator, refitted_lead
from wlr_gym.robot import LEG_SLICE, WHEEL_SLICE, Robot
from wlr_gym.robot.parameters import Parameters

if TYPE_CHECKING:
    from wlr_gym.physics.plants.forces import Force, ForceKernel

Array = NDArray[np.float64]

#: Passes over the friction rows per substep; see docs/physics.md for the study behind it.
SWEEPS = 4
#: Threads take so many tiles at a time: fewer cost more than they save.
TILES_AT_A_TIME = 8


#: Where the lanes of a state are among the stored ones, by the pattern of their names.
_PLACE = {
    pattern: np.array([STORED.index(pattern.format(label)) for label in labels])
    for labels, patterns in (
        ("xyz", ("p{}", "v{}", "w{}", "last_w{}", "gyro_{}", "acceleration_{}")),
        ("wxyz", ("q{}",)),
        ("xy", ("rounding_p{}",)),
        (range(4), ("leg_angle{}", "leg_rate{}", "last_leg_rate{}", "wheel_angle{}", "wheel_rate{}", "last_wheel_rate{}")),
        (range(4), ("turns{}", "zero_angle{}", "zero_rest{}", "place{}")),
        (range(8), ("reference_position{}", "reference_velocity{}", "rotor_lead{}", "rotor_rate{}")),
        (range(1), ("supply_drop",)),
        ([f"{a}{c}" for c in CONTACTS for a in "xy"], ("shear_{}",)),
    )
    for pattern in patterns
}


_FRICTION = np.array([STORED.index(f"friction_{a}{c}") for c in CONTACTS for a in "xy"])
_SPOT_FORCE = np.array([STORED.index(f"spot_force_{a}{s}") for s in SPOTS for a in "xyz"])
_NORMAL = np.array([STORED.index(f"normal{c}") for c in CONTACTS])


class CompiledTick(NamedTuple):
    """What one tick of a batch reads and writes, for compiled loops; arrays are the plant's own.

    Attributes:
        lanes, constants: state and parameters of the robots, tile by tile.
        torque_on: (N, 8) 1 where a motor is on.
        formula_values, memory: constants of the formula forces, and what they remember; the first row is the time.
        truth, raw, readings: (N, columns) truth, what sensors see of it, and what they read.
        time: (N) s.
        seeds, ticks, settings, states: of the sensors; see :meth:`wlr_gym.physics.plants.sensors.SensorModel.memory`.
        tiles: how many are moved.
        robots: how many there are.
        width: robots of a tile.
        step, period: s; of the physics and of a tick.
        substeps, sweeps: per tick, and passes over the friction rows per substep.
        has_formulas: whether formula forces act, which read the time.
    """

    lanes: NDArray[Any]
    constants: NDArray[Any]
    torque_on: Array
    formula_values: NDArray[Any]
    memory: NDArray[Any]
    truth: Array
    raw: Array
    readings: Array
    time: Array
    seeds: NDArray[np.uint64]
    ticks: NDArray[np.int64]
    settings: Array
    states: Array
    tiles: int
    robots: int
    width: int
    step: Any
    period: float
    substeps: int
    sweeps: int
    has_formulas: bool


class GibbsAppellPlant(Simulator):
    """Batch of robots on the Gibbs-Appell engine; see :class:`wlr_gym.physics.plants.base.Plant` for the contract.

    Args:
        robot: the robot; its nominal parameters are used until ``reset`` gets others.
        count: number of robots.
        options: step size, precision, threads.
        forces: formula forces that act beside what the parameters say.
        sweeps: passes over the friction rows per substep.
    """

    capabilities = Capabilities("gibbs_appell", has_truth=True, can_set_state=True, real_time=False)

    def __init__(
        self,
        robot: Robot,
        count: int = 1,
        options: PlantOptions | None = None,
        forces: Sequence[Force] = (),
        *,
        sweeps: int = SWEEPS,
    ) -> None:
        super().__init__(robot, count, options)
        self.sweeps = sweeps
        if self.options.precision not in kernel.WIDTH:
            raise unknown_name("precision", self.options.precision, kernel.WIDTH)
        self._float = np.dtype(self.options.precision).type
        self._step = self._float(self.options.physics_step)
        self._width = 1 if count == 1 else kernel.WIDTH[self.options.precision]
        self._tiles = -(-count // self._width)
        self._lanes = np.zeros((self._tiles, len(STORED) * self._width), self._float)
        self._constants = np.zeros((self._tiles, len(kernel.PARAMETER_LANES) * self._width), self._float)
        self._torque_on = np.ones((count, 8))
        self._chunks = self._shared_out(self._tiles)
        self._helpers = min(self.options.threads, len(self._chunks)) - 1
        self._pool = ThreadPoolExecutor(self._helpers, thread_name_prefix="wlr-engine") if self._helpers else None
        self._formulas: ForceKernel | None = None
        if forces:
            from wlr_gym.physics.plants.forces import compile_forces

            self._formulas = compile_forces(forces, self.options.precision)
        values = self._formulas.values if self._formulas else np.zeros(0)
        self.set_force_values(np.tile(values, (count, 1)))
        self._memory = np.zeros((self._tiles, len(MEMORY), self._width), self._float)
        self._features: frozenset[str] | None = None
        self._start()

    def _shared_out(self, tiles: int) -> list[tuple[int, int]]:
        """First and last of the tiles that a thread takes at a time."""
        count = max(1, tiles // TILES_AT_A_TIME) if self.options.threads > 1 else 1
        return list(itertools.pairwise(np.linspace(0, tiles, count + 1).astype(int).tolist()))

    # ---- parameters and state ----

    def _use_parameters(self, rows: NDArray[np.intp], chosen: Parameters) -> None:
        _scatter(self._constants, self._width, rows, kernel.pack(chosen, self.robot, self.options.physics_step))
        self._pad(self._constants)
        self._choose_kernel()

    def _look(self, rows: NDArray[np.intp]) -> None:
        tiles = np.unique(rows // self._width)
        self._kernel.look(self._lanes, self._constants, self._truth.values, self._raw, tiles, self._count, self._step)

    def _fit_rotors(self, rows: NDArray[np.intp], chosen: Parameters) -> None:
        old, new = self.parameters["servo.backlash"][rows], chosen["servo.backlash"]
        if (old == new).all():
            return
        lanes = _gather(self._lanes, self._width, rows).astype(np.float64)
        lead, rate = _PLACE["rotor_lead{}"], _PLACE["rotor_rate{}"]
        lanes[:, lead] = refitted_lead(lanes[:, lead], old, new)
        turning = self._truth.joint_velocity[rows]
        lanes[:, rate] = np.where((old == 0.0) & (new > 0.0), turning, lanes[:, rate])
        _scatter(self._lanes, self._width, rows, lanes)

    def _choose_kernel(self) -> None:
        features = drive.families(self.parameters) | ground.families(self.parameters) | relief.families(self.parameters)
        if self._formulas:
            features.add("forces")
        if "compliance" in features:  # its line search rounds otherwise beside rotors with play: the same bits with and without
            features.add("backlash")
        if self._features is None or not features <= self._features:
            self._features = frozenset(features | (self._features or frozenset()))
            formulas = self._formulas.module if self._formulas else None
            self._kernel = kernel.load_kernel(self._features, self.options.precision, self._width, formulas)

    def _pad(self, lanes: Array) -> None:
        """Fill the unused places of the last tile with copies of robot 0, so that they stay finite."""
        spare = np.arange(self._count, self._tiles * self._width)
        if spare.size:
            _scatter(lanes, self._width, spare, np.repeat(_gather(lanes, self._width, np.array([0])), spare.size, axis=0))

    def _write_state(self, state: PlantState, rows: NDArray[np.intp]) -> None:
        values = np.zeros((rows.size, len(STORED)))
        quaternion = state.quaternion[rows] / np.linalg.norm(state.quaternion[rows], axis=1, keepdims=True)
        w = state.angular_velocity_in_body[rows]
        leg_rate = state.joint_velocity[rows, LEG_SLICE] + w[:, 1:2]
        wheel_rate = state.joint_velocity[rows, WHEEL_SLICE] + leg_rate
        zero_offset = np.zeros((rows.size, 8))
        zero_offset[:, LEG_SLICE] = self.parameters["joint.zero_offset"][rows]
        reference = state.reference_position[rows] + zero_offset
        place, wheels, zero = state.position[rows, :2], state.joint_position[rows, WHEEL_SLICE], np.zeros((rows.size, 4))
        if self._float is np.float32:  # sums over hours begin small
            wheels, zero = zero, wheels
            reference[:, WHEEL_SLICE] -= zero
        turns = np.rint(zero / TURN)
        zero = zero - TURN * turns
        groups = {
            "p{}": state.position[rows],
            "q{}": quaternion,
            "v{}": state.linear_velocity_in_body[rows],
            "w{}": w,
            "last_w{}": w,
            "gyro_{}": w,
            "leg_angle{}": state.joint_position[rows, LEG_SLICE],
            "wheel_angle{}": wheels,
            "turns{}": turns,
            "zero_angle{}": zero,
            "zero_rest{}": zero - zero.astype(self._float),
            "rounding_p{}": place.astype(self._float) - place,
            "leg_rate{}": leg_rate,
            "last_leg_rate{}": leg_rate,
            "wheel_rate{}": wheel_rate,
            "last_wheel_rate{}": wheel_rate,
            "reference_position{}": reference,
            "reference_velocity{}": state.reference_velocity[rows],
            "place{}": np.ones((rows.size, 4)),
            "rotor_rate{}": (state.joint_velocity if state.rotor_rate is None else state.rotor_rate)[rows],
        }
        if state.rotor_lead is not None:
            groups["rotor_lead{}"] = state.rotor_lead[rows]
        if state.supply_drop is not None:
            groups["supply_drop"] = state.supply_drop[rows, None]
        if state.shear is not None:
            groups["shear_{}"] = state.shear[rows]
        for name, columns in groups.items():
            values[:, _PLACE[name]] = columns
        if not np.isfinite(values).all():
            raise InputError("state holds numbers that are not finite")
        still = -np.einsum("nji,nj->ni", rotation_matrix(quaternion), gravity_in_floor(self.parameters)[rows])
        values[:, _PLACE["acceleration_{}"]] = still
        _scatter(self._lanes, self._width, rows, values)
        self._pad(self._lanes)
        wound = np.zeros((rows.size, 8)) if state.wind_up is None else state.wind_up[rows]
        _scatter(self._memory, self._width, rows, wound, slice(1, None))

    def _servo_state(self) -> tuple[Array, ...]:
        values = _gather(self._lanes, self._width, self._all).astype(np.float64)
        names = ("reference_position{}", "reference_velocity{}", "rotor_lead{}", "rotor_rate{}", "supply_drop", "shear_{}")
        position, velocity, lead, rate, drop, shear = (values[:, _PLACE[name]] for name in names)
        if self._float is np.float32:
            position[:, WHEEL_SLICE] += self._truth.joint_position[:, WHEEL_SLICE] - values[:, _PLACE["wheel_angle{}"]]
        wind_up = _gather(self._memory, self._width, self._all)[:, 1:].astype(np.float64)
        return position, velocity, lead, rate, drop[:, 0], wind_up, shear

    def _contact_forces(self) -> Array:
        values = _gather(self._lanes, self._width, self._all).astype(np.float64)
        friction = values[:, _FRICTION].reshape(self._count, -1, 2) / self.options.physics_step
        return np.concatenate([friction, values[:, _NORMAL][:, :, None]], axis=2)

    def _spot_forces(self) -> Array:
        return _gather(self._lanes, self._width, self._all)[:, _SPOT_FORCE].astype(np.float64).reshape(self._count, -1, 3)

    def _fits(self) -> dict[str, Any]:
        return super()._fits() | {"sweeps": self.sweeps}

    def _engine_stores(self) -> dict[str, RowStore]:
        lanes = {"lanes": self._lanes, "memory": self._memory, "force_values": self._formula_values}
        return {name: _LaneRows(values, self._width) for name, values in lanes.items()}

    def set_state(self, snapshot: Snapshot, rows: int | Sequence[int] | NDArray[Any] | None = None) -> Sensors:
        """Put robots into the state of a snapshot; the last tile's further lanes follow its robots."""
        readings = super().set_state(snapshot, rows)
        self._pad(self._lanes)
        return readings

    def expect_all_effects(self) -> None:
        """Compile for every family of effects; see :class:`wlr_gym.physics.plants.simulator.Simulator`."""
        known = {"rolling_resistance", "drive", "backlash", "ground", "compliance"}
        self._features = frozenset(known) | (self._features or set())
        formulas = self._formulas.module if self._formulas else None
        self._kernel = kernel.load_kernel(self._features, self.options.precision, self._width, formulas)

    def set_force_values(self, values: Array) -> None:
        """Take the constants of the formula forces per robot; see :class:`wlr_gym.physics.plants.simulator.Simulator`."""
        padded = np.vstack([values, np.repeat(values[:1], self._tiles * self._width - self._count, axis=0)])
        shape = (self._tiles, self._width, values.shape[1])
        self._formula_values = np.ascontiguousarray(padded.reshape(shape).transpose(0, 2, 1), self._float)

    # ---- stepping ----

    def keep_going(self, count: int) -> None:
        """Leave the tiles without any of the first ``count`` robots; see ``Simulator.keep_going``."""
        self._chunks = self._shared_out(-(-count // self._width))

    def step(self, setpoints: Array, torque_on: NDArray[np.bool_] | None = None) -> Sensors:
        """Advance one control tick; see :meth:`wlr_gym.physics.plants.base.Plant.step`."""
        inputs = (
            *self._take_setpoints(setpoints, torque_on, self._torque_on),
            self._torque_on,
            self._formula_values,
            self._memory,
        )
        if self._formulas:  # in full precision: single precision would lose it step by step
            self._memory[:, 0].flat[: self._count] = self._time
        arguments = (self._lanes, self._constants, *inputs, self._truth.values, self._raw)
        # Whoever is done takes the next: a thread whose core has other work as well holds nobody up.
        chunks = iter(self._chunks)
        helpers = [self._pool.submit(self._run, arguments, chunks) for _ in range(self._helpers)] if self._pool else ()
        self._run(arguments, chunks)
        for helper in helpers:
            if not helper.cancel():
                helper.result()
        self._time += self.options.control_period
        return self._readings

    def _run(self, arguments: tuple[Array, ...], chunks: Iterator[tuple[int, int]]) -> None:
        for first, last in chunks:
            self._kernel.tick(*arguments, first, last, self._count, self._step, self.substeps, self.sweeps)
            self._sensors.measure(self._raw, self._readings.values, first * self._width, min(last * self._width, self._count))

    def compiled_tick(self) -> tuple[Any, CompiledTick]:
        """Return the compiled function that moves the robots by a tick, and what it works on: :meth:`step` without Python.

        The function's arguments: lanes, constants, newer setpoints, older setpoints, switch time (N, 8), torque_on,
        formula_values, memory, truth, raw, first tile, tiles, robots, step, substeps, sweeps; see :class:`CompiledTick`. Valid
        until parameters change or :meth:`keep_going` is called.
        """
        tiles = self._chunks[-1][1]
        arrays = (self._truth.values, self._raw, self._readings.values, self._time, *self._sensors.memory())
        formulas = (self._formula_values, self._memory)
        numbers = (tiles, self._count, self._width, self._step, self.options.control_period, self.substeps, self.sweeps)
        own = (self._lanes, self._constants, self._torque_on, *formulas, *arrays, *numbers, self._formulas is not None)
        return self._kernel.tick, CompiledTick(*own)

    def close(self) -> None:
        """Stop the worker threads."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None


def _scatter(lanes: Array, width: int, rows: NDArray[np.intp], values: Array, which: slice = slice(None)) -> None:
    tiles, places = np.divmod(rows, width)
    lanes.reshape(lanes.shape[0], -1, width)[:, which][tiles, :, places] = values


def _gather(lanes: Array, width: int, rows: NDArray[np.intp]) -> Array:
    tiles, places = np.divmod(rows, width)
    return lanes.reshape(lanes.shape[0], -1, width)[tiles, :, places]


class _LaneRows:
    """Lanes as rows of robots."""

    def __init__(self, lanes: Array, width: int) -> None:
        self._lanes, self._width = lanes, width

    def __getitem__(self, rows: NDArray[np.intp]) -> Array:
        return _gather(self._lanes, self._width, rows)

    def __setitem__(self, rows: NDArray[np.intp], values: Array) -> None:
        _scatter(self._lanes, self._width, rows, values)
