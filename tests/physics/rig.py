"""A test bench for the engine: batches of nominal robots with a few things changed, driven for a while."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.plants.base import PlantOptions, PlantState, Truth, standing_state
from wlr_gym.physics.plants.forces import Force
from wlr_gym.physics.plants.gibbs_appell.plant import SWEEPS, GibbsAppellPlant
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()
G = ROBOT.gravity
WEIGHT = ROBOT.total_mass * G
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
STEPS = (2.5e-4, 1e-3, 4e-3)
LEGS_DOWN = np.full(4, np.pi / 2)
HOME = np.concatenate([LEGS_DOWN, np.zeros(4)])
MIRROR = [1, 0, 3, 2, 5, 4, 7, 6]


def make_plant(
    count: int,
    edit: Callable[[Parameters], None] | None = None,
    place: Callable[[PlantState], None] | None = None,
    *,
    step: float = 1e-3,
    period: float = 0.02,
    sweeps: int = SWEEPS,
    precision: str = "float64",
    threads: int = 1,
    forces: Sequence[Force] = (),
) -> GibbsAppellPlant:
    """Return ``count`` robots with ``edit`` applied to their parameters and ``place`` to their standing state."""
    parameters = Parameters.nominal(ROBOT, count)
    if edit is not None:
        edit(parameters)
    state = standing_state(ROBOT, parameters)
    if place is not None:
        place(state)
    options = PlantOptions(control_period=period, physics_step=step, precision=precision, threads=threads, sensor_noise=False)
    plant = GibbsAppellPlant(ROBOT, count, options, forces, sweeps=sweeps)
    plant.reset(parameters=parameters, state=state)
    return plant


def drive(plant: GibbsAppellPlant, seconds: float, setpoints=HOME, torque_on=None) -> Truth:
    """Hold ``setpoints`` (8,) or (N, 8) for ``seconds``; return a copy of the truth at the end."""
    setpoints = np.array(np.broadcast_to(setpoints, (plant.count, 8)))
    for _ in range(round(seconds / plant.options.control_period)):
        plant.step(setpoints, torque_on)
    return Truth(plant.truth().values.copy())


def lock(parameters: Parameters, robots=slice(None)) -> None:
    """Gear friction that no torque here overcomes: wheels and legs stand still on the body."""
    parameters["servo.coulomb_friction"][robots] = 50.0


def free_wheels(parameters: Parameters, robots=slice(None)) -> None:
    """Wheels without gear friction, legs locked."""
    lock(parameters, robots)
    parameters["servo.coulomb_friction"][robots, 4:] = 0.0


def wheels_off(count: int) -> np.ndarray:
    """Torque switches (N, 8): legs on, wheels off."""
    torque_on = np.ones((count, 8), bool)
    torque_on[:, 4:] = False
    return torque_on


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


def record(plant: GibbsAppellPlant, seconds: float, setpoints=HOME, torque_on=None) -> np.ndarray:
    """Hold ``setpoints`` for ``seconds``; return the truth matrices after every control tick, (ticks, N, columns)."""
    setpoints = np.array(np.broadcast_to(setpoints, (plant.count, 8)))
    history = []
    for _ in range(round(seconds / plant.options.control_period)):
        plant.step(setpoints, torque_on)
        history.append(plant.truth().values.copy())
    return np.array(history)


def gears(plant: GibbsAppellPlant) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far the rotors lead their joints (rad) and their rates (rad/s), each (N, 8)."""
    state = plant.mechanical_state()
    assert state.rotor_lead is not None
    assert state.rotor_rate is not None
    return state.rotor_lead, state.rotor_rate
