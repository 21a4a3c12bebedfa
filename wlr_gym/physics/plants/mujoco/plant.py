"""MuJoCo as a Plant: a second, independent simulator of the same robots."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.snapshot import RowStore
from wlr_gym.physics.model.dynamics import gravity_in_floor, rotation_matrix
from wlr_gym.physics.plants.base import Capabilities, PlantOptions, PlantState, Sensors
from wlr_gym.physics.plants.forces import COORDINATES, INPUTS, MEMORY, Force, compile_forces
from wlr_gym.physics.plants.mujoco import packing
from wlr_gym.physics.plants.mujoco.batch import RobotBatch
from wlr_gym.physics.plants.mujoco.kernel import addresses, load_kernel
from wlr_gym.physics.plants.mujoco.step import STATE, TICK_SUMS
from wlr_gym.physics.plants.simulator import Simulator, refitted_lead
from wlr_gym.robot import LEG_SLICE, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: MuJoCo orders joints along the tree: leg, wheel, leg, wheel, ... In the order of ``JOINTS``:
_JOINT = np.array([0, 2, 4, 6, 1, 3, 5, 7])
_LANE = {name: index for index, name in enumerate(STATE)}
_ROTOR_LEAD = np.array([_LANE[f"rotor_lead{j}"] for j in range(8)])
_ROTOR_RATE = np.array([_LANE[f"rotor_rate{j}"] for j in range(8)])
_SUMS = slice(_LANE[TICK_SUMS[0]], _LANE[TICK_SUMS[-1]] + 1)


class MujocoPlant(Simulator):
    """Batch of robots in MuJoCo; see :class:`wlr_gym.physics.plants.base.Plant` for the contract.

    Same parameters, servo, gear and friction laws, sensors and truth as the Gibbs-Appell plant; rigid-body dynamics, contacts
    and dry friction are MuJoCo's. float64 only.

    Args:
        robot: the robot; its nominal parameters are used until ``reset`` gets others.
        count: number of robots.
        options: step size, threads.
        forces: formula forces that act on every robot.

    Raises:
        InputError: a physically impossible robot, bad options.
    """

    capabilities = Capabilities("mujoco", has_truth=True, can_set_state=True, real_time=False)

    def __init__(self, robot: Robot, count: int = 1, options: PlantOptions | None = None, forces: Sequence[Force] = ()) -> None:
        super().__init__(robot, count, options)
        if self.options.precision != "float64":
            raise InputError(
                f"precision '{self.options.precision}': the MuJoCo plant has float64 only "
                "(in an agent's settings: environment.precision=float64)"
            )
        self._step = self.options.physics_step
        self._batch = RobotBatch(robot, count, self._step, self.options.threads)
        self._state = np.zeros((count, len(STATE)))
        self._lanes = np.zeros((count, len(packing.PARAMETER_LANES)))
        self._inputs = [np.zeros((count, 8)) for _ in range(4)]
        self._formulas = compile_forces(forces) if forces else None
        self._force_inputs = np.zeros((len(INPUTS), count if forces else 1))
        self.set_force_values(np.tile(self._formulas.values if self._formulas else np.zeros(0), (count, 1)))
        self._generalised = np.zeros((len(COORDINATES), count))
        self._memory = np.zeros((len(MEMORY), count))
        self._kernel = load_kernel()
        batch = self._batch
        flat = (
            batch.qpos, batch.qvel, batch.constraint, batch.contact, self._state, self._lanes, *self._inputs,
            self._generalised.T, batch.applied, batch.armature, batch.gear_bound, batch.pair_margin,
        )  # fmt: skip
        self._table = addresses(flat, (batch.pair_friction, batch.geom_size, batch.geom_pos, batch.geom_quat))
        self._start()

    @property
    def model(self) -> object:
        """The ``mujoco.MjModel`` all robots share, with nominal numbers (for rendering)."""
        return self._batch.model

    # ---- parameters and state ----

    def _use_parameters(self, rows: NDArray[np.intp], chosen: Parameters) -> None:
        self._lanes[rows] = packing.pack(chosen, self.robot, self._step)
        self._batch.set_parameters(rows, chosen)

    def _look(self, rows: NDArray[np.intp]) -> None:
        self._kernel.observe(self._table, rows, self._truth.values, self._raw)

    def _fit_rotors(self, rows: NDArray[np.intp], chosen: Parameters) -> None:
        old, new = self.parameters["servo.backlash"][rows], chosen["servo.backlash"]
        cells = np.ix_(rows, _ROTOR_LEAD)
        self._state[cells] = refitted_lead(self._state[cells], old, new)
        cells = np.ix_(rows, _ROTOR_RATE)
        rates = self._batch.qvel[rows][:, 6 + _JOINT]
        self._state[cells] = np.where((old == 0.0) & (new > 0.0), rates, self._state[cells])

    def _write_state(self, state: PlantState, rows: NDArray[np.intp]) -> None:
        quaternion = state.quaternion[rows] / np.linalg.norm(state.quaternion[rows], axis=1, keepdims=True)
        rotation = rotation_matrix(quaternion)
        velocity = np.einsum("nij,nj->ni", rotation, state.linear_velocity_in_body[rows])
        w, rates = state.angular_velocity_in_body[rows], state.joint_velocity[rows]
        reference = state.reference_position[rows].copy()
        reference[:, LEG_SLICE] += self.parameters["joint.zero_offset"][rows]
        still = -np.einsum("nji,nj->ni", rotation, gravity_in_floor(self.parameters)[rows])
        values = np.zeros((rows.size, len(STATE)))
        groups = {
            "reference_position{}": (reference, range(8)),
            "reference_velocity{}": (state.reference_velocity[rows], range(8)),
            "rotor_rate{}": (rates if state.rotor_rate is None else state.rotor_rate[rows], range(8)),
            "gyro_{}": (w, "xyz"),
            "acceleration_{}": (still, "xyz"),
        }
        if state.rotor_lead is not None:
            groups["rotor_lead{}"] = (state.rotor_lead[rows], range(8))
        if state.supply_drop is not None:
            groups["supply_drop{}"] = (state.supply_drop[rows, None], ("",))
        for pattern, (columns, labels) in groups.items():
            for k, label in enumerate(labels):
                values[:, _LANE[pattern.format(label)]] = columns[:, k]
        position = np.hstack([state.position[rows], quaternion, state.joint_position[rows][:, np.argsort(_JOINT)]])
        speed = np.hstack([velocity, w, rates[:, np.argsort(_JOINT)]])
        if not (np.isfinite(values).all() and np.isfinite(position).all() and np.isfinite(speed).all()):
            raise InputError("state holds numbers that are not finite")
        self._memory[1:, rows] = 0.0 if state.wind_up is None else state.wind_up[rows].T
        batch = self._batch
        self._state[rows], batch.qpos[rows], batch.qvel[rows], batch.warmstart[rows] = values, position, speed, 0.0

    def _servo_state(self) -> tuple[Array, ...]:
        names = ("reference_position", "reference_velocity", "rotor_lead", "rotor_rate")
        joints = (self._state[:, [_LANE[f"{name}{j}"] for j in range(8)]] for name in names)
        return *joints, self._state[:, _LANE["supply_drop"]].copy(), self._memory[1:].T.copy()

    def _engine_stores(self) -> dict[str, RowStore]:
        inputs = {f"input{number}": values for number, values in enumerate(self._inputs)}
        by_robot = {"memory": self._memory.T, "force_values": self._force_values.T}
        return {"servos": self._state, **inputs, **by_robot, **self._batch.stores()}

    # ---- stepping ----

    def set_force_values(self, values: Array) -> None:
        """Take the constants of the formula forces per robot; see :class:`wlr_gym.physics.plants.simulator.Simulator`."""
        self._force_values = np.ascontiguousarray(values.T)

    def step(self, setpoints: Array, torque_on: NDArray[np.bool_] | None = None) -> Sensors:
        """Advance one control tick; see :meth:`wlr_gym.physics.plants.base.Plant.step`.

        Raises:
            InputError: wrong shape or a non-finite setpoint of a motor that is on.
        """
        for target, values in zip(self._inputs, self._take_setpoints(setpoints, torque_on, self._inputs[3]), strict=False):
            target[...] = values
        self._tick()
        self._sensors.measure(self._raw, self._readings.values)
        return self._readings

    def _tick(self) -> None:
        kernel, step, robots = self._kernel, self._step, (self._table, self._all)
        self._state[:, _SUMS] = 0.0
        self._memory[0] = self._time
        kernel.drift(*robots, 0.5 * step)
        for substep in range(self.substeps):
            if self._formulas:
                kernel.features(*robots, self._force_inputs)
                self._formulas.evaluate(self._force_inputs, self._force_values, self._memory, self._generalised, step)
            kernel.before(*robots, step, (substep + 0.5) * step)
            self._batch.step()
            kernel.after(*robots, step)
        kernel.drift(*robots, -0.5 * step)
        kernel.observe(*robots, self._truth.values, self._raw)
        self._time += self.options.control_period

    def close(self) -> None:
        """Nothing to release."""
