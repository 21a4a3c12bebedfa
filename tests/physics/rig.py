"""A test bench for the simulators: batches of nominal robots with a few things changed, driven for a while."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics import plants
from wlr_gym.physics.plants.base import TRUTH_LAYOUT, Plant, PlantOptions, PlantState, Truth, standing_state
from wlr_gym.physics.plants.forces import Force
from wlr_gym.physics.plants.gibbs_appell.plant import GibbsAppellPlant
from wlr_gym.robot import Robot, load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()
G = ROBOT.gravity
MASS = ROBOT.total_mass
WEIGHT = MASS * G
RADIUS = ROBOT.wheel.radius
_NOMINAL = Parameters.nominal(ROBOT)
BODY_MASS = float(_NOMINAL["body.mass"][0])
LEG_MASS = float(_NOMINAL["leg.mass"][0, 0])
#: A leg about its own centre of mass, axis parallel to the axle, kg m2.
LEG_PITCH_INERTIA = float(_NOMINAL["leg.inertia[leg_lf,y]"][0])
WHEEL_MASS = float(_NOMINAL["wheel.mass"][0, 0])
#: Hip to the leg's own centre of mass, m.
LEG_COM = float(_NOMINAL["leg.com_along_leg"][0, 0])
#: Rotor and disc of a wheel about its axle, kg m2.
WHEEL_INERTIA = ROBOT.wheel.spin_inertia + ROBOT.servo.wheel.armature
BACKENDS = plants.SIMULATORS
STEPS = (2.5e-4, 1e-3, 4e-3)
LEGS_DOWN = np.full(4, np.pi / 2)
HOME = np.concatenate([LEGS_DOWN, np.zeros(4)])
MIRROR = [1, 0, 3, 2, 5, 4, 7, 6]
#: What is changed of nominal parameters: a function, names and values (``servo.kp of wheels``: of these joints), or several.
Edit = Callable[[Parameters], None] | Mapping[str, Any] | Sequence[Any] | None
_JOINTS = {"": slice(None), "legs": (slice(None), slice(4)), "wheels": (slice(None), slice(4, 8))}


def change(parameters: Parameters, edit: Edit) -> None:
    """Change parameters in place."""
    if callable(edit):
        edit(parameters)
    elif isinstance(edit, Mapping):
        for name, value in edit.items():
            name, _, joints = name.partition(" of ")
            parameters[name][_JOINTS[joints]] = value
    else:
        for one in edit or ():
            change(parameters, one)


def make_plant(
    count: int,
    edit: Edit = None,
    place: Callable[[PlantState], None] | None = None,
    *,
    backend: str = "gibbs_appell",
    robot: Robot = ROBOT,
    step: float = 1e-3,
    period: float = 0.02,
    sweeps: int | None = None,
    precision: str = "float64",
    threads: int = 1,
    forces: Sequence[Force] = (),
) -> Any:
    """Return ``count`` robots with ``edit`` applied to their parameters and ``place`` to their standing state."""
    parameters = Parameters.nominal(robot, count)
    change(parameters, edit)
    state = standing_state(robot, parameters)
    if place is not None:
        place(state)
    options = PlantOptions(control_period=period, physics_step=step, precision=precision, threads=threads, sensor_noise=False)
    if sweeps is None:
        plant: Any = plants.make_plant(backend, robot, count, options, forces)
    else:
        plant = GibbsAppellPlant(robot, count, options, forces, sweeps=sweeps)
    plant.reset(parameters=parameters, state=state)
    return plant


def drive(plant: Plant, seconds: float, setpoints=HOME, torque_on=None) -> Truth:
    """Hold ``setpoints`` (8,) or (N, 8) for ``seconds``; return a copy of the truth at the end."""
    setpoints = np.array(np.broadcast_to(setpoints, (plant.count, 8)))
    for _ in range(round(seconds / plant.options.control_period)):
        plant.step(setpoints, torque_on)
    return Truth(plant.truth().values.copy())


def record(plant: Plant, seconds: float, setpoints=HOME, torque_on=None) -> np.ndarray:
    """Hold ``setpoints`` for ``seconds``; return the truth matrices after every control tick, (ticks, N, columns)."""
    setpoints = np.array(np.broadcast_to(setpoints, (plant.count, 8)))
    history = []
    for _ in range(round(seconds / plant.options.control_period)):
        plant.step(setpoints, torque_on)
        history.append(plant.truth().values.copy())
    return np.array(history)


def channel(history: np.ndarray, name: str) -> np.ndarray:
    """Return a channel of what :func:`record` returns, (ticks, N, columns of the channel)."""
    return history[..., TRUTH_LAYOUT.slices[name]]


def lock(parameters: Parameters, robots=slice(None)) -> None:
    """Gear friction that no torque here overcomes: wheels and legs stand still on the body."""
    parameters["servo.coulomb_friction"][robots] = 50.0


def free_wheels(parameters: Parameters, robots=slice(None)) -> None:
    """Wheels without gear friction, legs locked."""
    lock(parameters, robots)
    parameters["servo.coulomb_friction"][robots, 4:] = 0.0


def wheels_off(count: int) -> np.ndarray:
    """Torque switches (N, 8): legs on, wheels off."""
    return np.tile(np.arange(8) < 4, (count, 1))


def turn(state: PlantState, yaw) -> None:
    """Turn standing robots to headings ``yaw`` (N,), rad."""
    state.quaternion[:] = np.column_stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)])


def contact_force(truth: Truth) -> np.ndarray:
    """Contact forces (N, 4, 3): heading, axle, normal."""
    return truth.contact_force.reshape(-1, 4, 3)


def float_in_space(parameters: Parameters, robots=slice(None)) -> None:
    """No gravity and no friction; with :func:`lift`, nothing touches the floor."""
    parameters["gravity"][robots] = 0.0
    parameters["servo.coulomb_friction"][robots] = 0.0


def lift(state: PlantState) -> None:
    """Put the robots high above the floor."""
    state.position[:, 2] = 1.0


def own_path(truth: Truth, yaw: np.ndarray) -> np.ndarray:
    """Place (N, 3) of robots that began at headings ``yaw``, in the frame of their start, m."""
    x, y, z = truth.position.T
    return np.column_stack([np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x, z])


def gears(plant: GibbsAppellPlant) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far the rotors lead their joints (rad) and their rates (rad/s), each (N, 8)."""
    state = plant.mechanical_state()
    assert state.rotor_lead is not None
    assert state.rotor_rate is not None
    return state.rotor_lead, state.rotor_rate
