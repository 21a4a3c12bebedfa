"""MuJoCo as a Plant: a second, independent simulator of the same robots."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.snapshot import RowStore
from wlr_gym.physics.model.dynamics import gravity_in_floor, rotation_matrix
from wlr_gym.physics.plants import relief
from wlr_gym.physics.plants.base import COORDINATES, INPUTS, MEMORY, Capabilities, PlantOptions, PlantState, Sensors
from wlr_gym.physics.plants.body import SPOTS
from wlr_gym.physics.plants.contacts import CONTACTS
from wlr_gym.physics.plants.forces import Force, compile_forces
from wlr_gym.physics.plants.mujoco.kernel import PARAMETER_LANES, addresses, load_kernel, pack
from wlr_gym.physics.plants.mujoco.mjcf import build_model, principal_inertia
from wlr_gym.physics.plants.mujoco.step import CAPSULE_HALF_LENGTH, FEATURES, ON_RELIEF, STATE, TICK_SUMS
from wlr_gym.physics.plants.simulator import Simulator, refitted_lead
from wlr_gym.robot import CORNER_SIGNS, LEG_SLICE, LEGS, WHEELS, Robot
from wlr_gym.robot.parameter_table import SPECS
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: MuJoCo orders joints along the tree: leg, wheel, leg, wheel, ... In the order of ``JOINTS``:
_JOINT = np.array([0, 2, 4, 6, 1, 3, 5, 7])
_LANE = {name: index for index, name in enumerate(STATE)}
_ROTOR_LEAD = np.array([_LANE[f"rotor_lead{j}"] for j in range(8)])
_ROTOR_RATE = np.array([_LANE[f"rotor_rate{j}"] for j in range(8)])
_SHEAR = np.array([_LANE[f"shear_{a}{c}"] for c in CONTACTS for a in "xy"])
_FORCES = np.array([_LANE[f"force_{a}{c}"] for c in CONTACTS for a in "xyz"])
_SPOT_FORCES = np.array([_LANE[f"spot_force_{a}{s}"] for s in SPOTS for a in "xyz"])
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
        self._state = np.zeros((count, len(STATE)))
        self._lanes = np.zeros((count, len(PARAMETER_LANES)))
        self._inputs = [np.zeros((count, 8)) for _ in range(4)]
        self._formulas = compile_forces(forces) if forces else None
        self._force_inputs = np.zeros((len(INPUTS), count if forces else 1))
        self.set_force_values(np.tile(self._formulas.values if self._formulas else np.zeros(0), (count, 1)))
        self._generalised = np.zeros((len(COORDINATES), count))
        self._memory = np.zeros((len(MEMORY), count))
        self._use_model(on_relief=False)
        self._start()

    def _use_model(self, on_relief: bool) -> None:
        """Make the batch for level floors or for relief, and load the kernel that goes with it."""
        self._on_relief = on_relief
        batch = self._batch = RobotBatch(self.robot, self._count, self._step, self.options.threads, on_relief)
        self._kernel = load_kernel(ON_RELIEF if on_relief else FEATURES)
        flat = (
            batch.qpos, batch.qvel, batch.constraint, batch.contact, self._state, self._lanes, *self._inputs,
            self._generalised.T, batch.applied, batch.armature, batch.gear_bound,
        )  # fmt: skip
        self._table = addresses(flat, batch.per_contact)

    def _move_to_relief(self) -> None:
        """The first piece, wave or bump of any robot: every robot goes on in the model that knows of them."""
        old, parameters = self._batch, self.parameters
        self._use_model(on_relief=True)
        self._batch.set_parameters(self._all, parameters)
        for name in CARRIED:
            getattr(self._batch, name)[:] = getattr(old, name)

    @property
    def model(self) -> object:
        """The ``mujoco.MjModel`` all robots share, with nominal numbers (for rendering)."""
        return self._batch.model

    # ---- parameters and state ----

    def _use_parameters(self, rows: NDArray[np.intp], chosen: Parameters) -> None:
        self._lanes[rows] = pack(chosen, self.robot, self._step)
        if not self._on_relief and relief.families(chosen):
            self._move_to_relief()
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
        groups["place{}"] = (np.ones((rows.size, 4)), range(4))
        if state.rotor_lead is not None:
            groups["rotor_lead{}"] = (state.rotor_lead[rows], range(8))
        if state.supply_drop is not None:
            groups["supply_drop{}"] = (state.supply_drop[rows, None], ("",))
        if state.shear is not None:
            values[:, _SHEAR] = state.shear[rows]
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
        return *joints, self._state[:, _LANE["supply_drop"]].copy(), self._memory[1:].T.copy(), self._state[:, _SHEAR]

    def _contact_forces(self) -> Array:
        return self._state[:, _FORCES].reshape(self._count, -1, 3).copy()

    def _spot_forces(self) -> Array:
        return self._state[:, _SPOT_FORCES].reshape(self._count, -1, 3)

    def _engine_stores(self) -> dict[str, RowStore]:
        inputs = {f"input{number}": values for number, values in enumerate(self._inputs)}
        by_robot = {"memory": self._memory.T, "force_values": self._force_values.T}
        return {"servos": self._state, **inputs, **by_robot, **self._batch.stores()}

    # ---- stepping ----

    def set_force_values(self, values: Array) -> None:
        """Take the constants of the formula forces per robot; see :class:`wlr_gym.physics.plants.simulator.Simulator`."""
        self._force_values = np.ascontiguousarray(values.T)

    def step(self, setpoints: Array, torque_on: NDArray[np.bool_] | None = None) -> Sensors:
        """Advance one control tick; see :meth:`wlr_gym.physics.plants.base.Plant.step`."""
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


# ---- a batch in MuJoCo: one model, per-robot numbers as expanded fields, live arrays for the substep kernel ----------


# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)


#: Impedance of contacts. It adds d/(1-d) times the apparent mass to the contact, and a push off the floor of that mass times
#: friction times slip speed over the step: as small as MuJoCo allows, the contact is the parameters' spring and damper.
CONTACT_IMPEDANCE = 1e-4
#: Regularisation of friction over apparent inverse mass. What sticks creeps at step x friction force/apparent mass times this.
FRICTION_SOFTNESS = 1e-3
#: Impedance of gear friction, MuJoCo's largest.
GEAR_IMPEDANCE = 0.9999
#: Radius (m) of the bounding sphere of the geoms that touch: they move about in their wheels, see step.py.
BOUND = 0.5
#: Parameters from which mj_setConst derives constants.
_GEOMETRY = ("body", "payload", "leg", "wheel", "hip")
_INERTIAL = (*(name for name in SPECS if name.partition(".")[0] in _GEOMETRY and name != "wheel.grip"), "servo.armature")


def build_batch_model(robot: Robot, physics_step: float, on_relief: bool = False) -> mujoco.MjModel:
    """Return the model that all robots of a batch share.

    On relief each of a wheel's two contacts has a geom and a plane of its own, which are placed before every step. (MuJoCo's
    height field would not do: each of its prisms is a contact with a spring of its own, on which wheels shake.)
    """

    def extend(spec: mujoco.MjSpec) -> None:
        option = spec.option
        option.integrator = mujoco.mjtIntegrator.mjINT_EULER
        option.impratio = (1.0 - CONTACT_IMPEDANCE) / CONTACT_IMPEDANCE / FRICTION_SOFTNESS
        option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET) | int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
        if on_relief:
            _add_planes(spec)
        for geom, floor in zip(SECOND_GEOMS if on_relief else WHEELS, PLANES if on_relief else ["floor"] * 4, strict=True):
            _add_force_sensor(spec, geom, floor)

    parameters = Parameters.nominal(robot)
    model = build_model(
        robot, parameters, contacts=not on_relief, physics_step=physics_step, wheel_shape="capsule", extend=extend
    )
    model.dof_damping[:] = 0.0
    model.dof_solref[:] = -1.0, -GEAR_IMPEDANCE / physics_step
    model.dof_solimp[:, :2] = GEAR_IMPEDANCE
    model.pair_dim[:] = 3
    model.pair_solimp[:, :2] = CONTACT_IMPEDANCE
    model.pair_solreffriction[:] = -1.0, -CONTACT_IMPEDANCE / physics_step
    return model


#: Geoms that touch on relief, and the planes that they touch, contact by contact.
SECOND_GEOMS = (*WHEELS, *(f"{wheel}_second" for wheel in WHEELS))
PLANES = tuple(f"floor_of_{name}" for name in SECOND_GEOMS)


def _add_planes(spec: mujoco.MjSpec) -> None:
    for contact, (name, plane) in enumerate(zip(SECOND_GEOMS, PLANES, strict=True)):
        if contact >= len(WHEELS):
            first = spec.geom(WHEELS[contact % len(WHEELS)])
            spec.body(WHEELS[contact % len(WHEELS)]).add_geom(
                name=name, type=first.type, size=first.size, quat=first.quat, contype=0, conaffinity=0, group=3
            )
        body = spec.worldbody.add_body(name=plane, mocap=True)
        body.add_geom(name=plane, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1], contype=0, conaffinity=0, group=3)
        spec.add_pair(geomname1=plane, geomname2=name, condim=3)


def _add_force_sensor(spec: mujoco.MjSpec, wheel: str, floor: str) -> None:
    """Total force of the floor on a wheel, in the floor frame."""
    geom = mujoco.mjtObj.mjOBJ_GEOM
    sensor = spec.add_sensor(
        name=wheel, type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=geom, objname=floor, reftype=geom, refname=wheel
    )
    net_force = 3
    sensor.intprm = [1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), net_force, 1]


#: What a step takes from the one before it, alike in both models: not what every step places anew.
CARRIED = ("qpos", "qvel", "warmstart", "applied", "armature", "gear_bound")


class RobotBatch:
    """``count`` robots in a :class:`mujoco.batch.Batch`.

    Attributes:
        qpos, qvel, applied, warmstart, constraint, contact: live arrays (N, ...) of MuJoCo's state, inputs and results.
        armature, gear_bound: live model fields (N, ...).
        per_contact: live arrays (N, contacts, ...): friction and margin of the pair, size, position and attitude of the geom
            that touches, and, on relief, position and attitude of the plane; of the wheels' first and of their second contacts.
    """

    def __init__(self, robot: Robot, count: int, physics_step: float, threads: int, on_relief: bool = False) -> None:
        self.model = model = build_batch_model(robot, physics_step, on_relief)
        self._batch = batch = Batch(model, count, threads)
        self._body = {name: model.body(name).id for name in ("body", "payload", *LEGS, *WHEELS)}
        self.geoms = [model.geom(name).id for name in (SECOND_GEOMS if on_relief else WHEELS)]
        self._wheels = [self._body[name] for name in WHEELS] * (len(self.geoms) // len(WHEELS))
        self.qpos, self.qvel = batch.bind("qpos"), batch.bind("qvel")
        self.applied, self.warmstart = batch.bind("qfrc_applied"), batch.bind("qacc_warmstart")
        self.constraint, self.contact = batch.bind("qfrc_constraint"), batch.bind("sensordata")
        self.armature, self.gear_bound = batch.expand("dof_armature"), batch.expand("dof_frictionloss")
        friction, margin = batch.expand("pair_friction"), batch.expand("pair_margin")[:, :, None]
        self._solref = batch.expand("pair_solref")
        self._gravity = batch.expand("opt.gravity")
        self._mass, self._inertia = batch.expand("body_mass"), batch.expand("body_inertia")
        self._axes = batch.expand("body_iquat")
        self._centre, self._place = batch.expand("body_ipos"), batch.expand("body_pos")
        self._size, self._pos, self._quat = (batch.expand(f"geom_{name}") for name in ("size", "pos", "quat"))
        self._bound = batch.expand("geom_rbound")
        self._inverse_weight = batch.expand("body_invweight0")
        for derived in ("dof_invweight0", "body_subtreemass", "dof_M0"):
            batch.expand(derived)
        self._size[:, self.geoms, 1] = CAPSULE_HALF_LENGTH
        pairs = [int(np.flatnonzero((model.pair_geom1 == geom) | (model.pair_geom2 == geom))[0]) for geom in self.geoms]
        self.per_contact = [view for field in (friction, margin) for view in _in_steps(field, pairs)]
        self.per_contact += [view for field in (self._size, self._pos, self._quat) for view in _in_steps(field, self.geoms)]
        if on_relief:
            self.per_contact += [batch.bind("mocap_pos"), batch.bind("mocap_quat")]
        self._known: Array | None = None

    def set_parameters(self, rows: NDArray[np.intp], parameters: Parameters) -> None:
        """Take the parameters (len(rows)) of robots ``rows``."""
        inertial = np.hstack([parameters[name].reshape(len(rows), -1) for name in _INERTIAL])
        if self._known is None:
            self._known = np.full((len(self.qpos), inertial.shape[1]), np.nan)
        changed = (self._known[rows] != inertial).any(axis=1)
        self._known[rows] = inertial
        self._gravity[rows] = gravity_in_floor(parameters)
        if changed.any():
            self._set_inertia(rows[changed], Parameters(parameters.values[changed]))
        self._set_contact_springs(rows, parameters)

    def _set_inertia(self, rows: NDArray[np.intp], parameters: Parameters) -> None:
        body, signs = self._body, np.array(CORNER_SIGNS)
        self._set_body(rows, body["body"], parameters["body.mass"], parameters["body.com_offset"], parameters["body.inertia"])
        self._mass[rows, body["payload"]] = parameters["payload.mass"]
        self._place[rows, body["payload"]] = parameters["payload.position"]
        self._inertia[rows, body["payload"]], self._axes[rows, body["payload"]] = principal_inertia(
            parameters["payload.inertia"]
        )
        leg_inertia = parameters["leg.inertia"].reshape(-1, 4, 3)[:, :, [2, 1, 0]]  # the leg's frame has x along the leg
        zero = np.zeros(len(rows))
        for corner, (leg, wheel) in enumerate(zip(LEGS, WHEELS, strict=True)):
            sign = np.array([*signs[corner], 1.0])
            self._place[rows, body[leg]] = parameters["hip.position"] * sign
            centre = np.stack([parameters["leg.com_along_leg"][:, corner], zero, zero], axis=1)
            self._set_body(rows, body[leg], parameters["leg.mass"][:, corner], centre, leg_inertia[:, corner])
            self._place[rows, body[wheel]] = np.stack([parameters["leg.length"][:, corner], zero, zero], axis=1)
            across, spin = parameters["wheel.transverse_inertia"][:, corner], parameters["wheel.spin_inertia"][:, corner]
            self._set_body(
                rows, body[wheel], parameters["wheel.mass"][:, corner], 0.0, np.stack([across, spin, across], axis=1)
            )
        self._derive_constants(rows, parameters)

    def _set_body(self, rows: NDArray[np.intp], body: int, mass: Array, centre: Array | float, inertia: Array) -> None:
        self._mass[rows, body], self._centre[rows, body], self._inertia[rows, body] = mass, centre, inertia

    def _derive_constants(self, rows: NDArray[np.intp], parameters: Parameters) -> None:
        """Run mj_setConst with the rotors' own inertia and the touching geoms anywhere but in their wheels' frame."""
        self.armature[rows[:, None], 6 + np.array([0, 2, 4, 6, 1, 3, 5, 7])] = parameters["servo.armature"]
        touching = rows[:, None], self.geoms
        self._pos[touching] = 0.0, CAPSULE_HALF_LENGTH, 0.0
        self._quat[touching] = np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0
        self._batch.set_const(rows)
        self._bound[touching] = BOUND
        self._quat[(*touching, 3)] = 0.0

    def _set_contact_springs(self, rows: NDArray[np.intp], parameters: Parameters) -> None:
        """Set ``solref`` to the parameters' spring and damper: MuJoCo scales it by the contact's apparent mass at home.

        MuJoCo: force = (K d pos + B vel)/R with K = solref0/d^2, B = solref1/d, R = (1 - d)/d/apparent mass.
        """
        scale = (1.0 - CONTACT_IMPEDANCE) * self._inverse_weight[rows[:, None], self._wheels, 0]
        each = np.arange(len(self.geoms)) % len(WHEELS)
        self._solref[rows, :, 0] = -scale * parameters["ground.normal_stiffness"][:, each]
        self._solref[rows, :, 1] = -scale * parameters["ground.normal_damping"][:, each]

    def divide_virtual_mass(self, divisor: float) -> None:
        """Make the mass that the impedance adds to contacts, and its push on sliding wheels, ``divisor`` times smaller.

        That push grows as the step shrinks, and MuJoCo allows no smaller impedance. Springs, dampers and friction stay as
        they are from the next :meth:`set_parameters` on, which must leave inertia and geometry alone.
        """
        self._inverse_weight[:, [self._body[name] for name in WHEELS]] *= divisor
        self._batch.expand("opt.impratio")[:] *= divisor

    def stores(self) -> dict[str, RowStore]:
        """Return what a step takes from the one before it."""
        return {name: getattr(self, name) for name in CARRIED}

    def model_of(self, robot: int) -> mujoco.MjModel:
        """Return a copy of the model with the numbers of one robot."""
        return self._batch.get_model(robot)

    def step(self) -> None:
        """One MuJoCo step of every robot."""
        self._batch.step()


def _in_steps(field: Array, numbers: Sequence[int]) -> list[Array]:
    """Return views (N, 4, ...) of rows of a model field (N, K, ...): of each four, which follow each other in equal steps."""
    stride = numbers[1] - numbers[0]
    return [field[:, start : start + 3 * stride + 1 : stride] for start in numbers[:: len(WHEELS)]]
