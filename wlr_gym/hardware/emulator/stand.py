"""An emulated robot on a stand: springs hold its body with the wheels off the ground, and it has somebody's hands beside it."""

from __future__ import annotations

from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.emulator.machine import Machine, MachineOptions
from wlr_gym.physics.effects.patch import Source, apply_patch, load_patch
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import standing_state
from wlr_gym.physics.plants.forces import Force, force_values, make_force
from wlr_gym.physics.plants.simulator import Simulator
from wlr_gym.physics.servo import winding
from wlr_gym.robot import JOINTS, WHEELS, Robot
from wlr_gym.robot.parameters import Parameters

#: m that the body hangs above the floor.
HEIGHT = 0.5
#: N m of a hand that holds a wheel or a leg.
GRIP = 10.0
#: Springs and dampers of the stand: stiff in place, and slow to follow a hand that tilts the body (0.5 s).
_PLACE = {"k": 4000.0, "c": 250.0}
_ATTITUDE = {"k": 40.0, "c": 20.0}
_ANGLES = ("roll", "pitch", "yaw")


class EmulatedStand:
    """An emulated robot on a stand.

    Args:
        robot, hardware: as for :class:`Machine`.
        effects: what the robot has that its file does not say.
        parameters: of the robot before the effects; None = nominal.
        options: of the machine.

    Attributes:
        machine: the robot.
        stall_current: A of a wheel's motor at stall.
    """

    def __init__(
        self,
        robot: Robot,
        hardware: Hardware,
        effects: Source = None,
        parameters: Parameters | None = None,
        options: MachineOptions | None = None,
    ) -> None:
        patch, options = load_patch(effects), options or MachineOptions()
        self._forces = patch.forces
        plant = make_plant(options.backend, robot, 1, options.plant_options(), [*_stand_forces(), *patch.forces])
        assert isinstance(plant, Simulator), "the emulator runs on simulators only"
        self._plant: Simulator = plant
        changed = apply_patch(patch, parameters or Parameters.nominal(robot))
        state = standing_state(robot, changed)
        state.position[0, 2] = HEIGHT
        self.machine: Machine = Machine(robot, hardware, options, plant=plant, parameters=changed, state=state)
        self._friction = dict(zip(JOINTS, changed["servo.coulomb_friction"][0].tolist(), strict=True))
        self.stall_current: float = robot.servo.supply_voltage / float(winding(robot)[1][-1])

    def tilt(self, **angles: float) -> None:
        """Begin to turn the body to ``roll``, ``pitch`` and ``yaw`` (rad; the others to 0); it gets there in about 2 s."""
        self._plant.set_force_values(force_values([*_stand_forces(**angles), *self._forces])[None])

    def brake(self, joint: str) -> None:
        """Hold a wheel or a leg by hand."""
        self.machine.coupling.set_friction(joint, GRIP)

    def release(self, joint: str) -> None:
        """Let go of it."""
        self.machine.coupling.set_friction(joint, self._friction.get(joint, 0.0))

    def wheel_current(self) -> float:
        """Return what the wheels draw from the supply, A: motor currents times the part of the time they are switched on."""
        shafts = [self.machine.servos[wheel].shaft for wheel in WHEELS]
        return sum(abs(shaft.output()[1]) * abs(shaft.load) for shaft in shafts) * self.stall_current


def _stand_forces(**angles: float) -> list[Force]:
    """Return what holds the body in place, at ``roll``, ``pitch`` and ``yaw`` (rad); 0 where one is not named."""
    units = {"k": "N/m", "c": "N s/m"}
    height = "k * (height - position_z) - c * velocity_z"
    forces = [
        make_force(["floor_force_z"], height, {**_PLACE, "height": HEIGHT}, {**units, "height": "m"}),
        make_force(["floor_force_x"], "-k * position_x - c * floor_velocity_x", _PLACE, units),
        make_force(["floor_force_y"], "-k * position_y - c * floor_velocity_y", _PLACE, units),
    ]
    units = {"k": "N m/rad", "c": "N m s/rad", "tilt": "rad"}
    for name in _ANGLES:
        formula = f"k * (tilt - {name}) - c * {name}_rate"
        forces.append(make_force([f"body_torque_{name}"], formula, {**_ATTITUDE, "tilt": angles.get(name, 0.0)}, units))
    return forces
