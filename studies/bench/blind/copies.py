"""A copy of the robot: the nominal numbers, each drawn within its tolerance once per data set."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

Array = NDArray[np.float64]
LEGS = ("leg_lf", "leg_rf", "leg_lr", "leg_rr")
WHEELS = ("wheel_lf", "wheel_rf", "wheel_lr", "wheel_rr")
JOINTS = LEGS + WHEELS
#: Signs of x and y of the corners lf, rf, lr, rr.
CORNERS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
#: Draws are cut at this many standard deviations.
CUT = 2.0
#: m/s; dry friction of the floor is full from this speed on where nothing yields.
FLOOR_CREEP = 5e-6
#: rad/s; the same in gears.
GEAR_CREEP = 2e-5
#: Ranges of the same where tyres, floor and gears yield as those of a simulator with soft contacts do.
YIELDING_FLOOR = (0.5e-3, 2e-3)
YIELDING_GEAR = (1e-3, 1e-2)
#: Range of the stiffness of such tyres, as a share of the robot file's.
SOFTNESS = (0.3, 1.0)
#: Range of the share of its deflection, beyond that under the robot at rest, by which such a tyre rolls on a smaller radius.
FLATTENING = (0.2, 0.5)
#: m; range of the rms height of the floor that such robots drive on: :data:`WAVES` waves of random heading and phase, whose
#: lengths (m) lie in WAVE_LENGTH.
BUMPS = (0.045e-3, 0.13e-3)
WAVES = 8
WAVE_LENGTH = (0.1, 0.8)


@dataclass(frozen=True)
class Copy:
    """One robot and its surroundings; SI units, joints and corners in the order of ``JOINTS`` and ``CORNERS``."""

    mass: float
    inertia: Array  # (3,) about the platform's own centre of mass
    com: Array  # (3,)
    hip: Array  # (2,) x and y without signs
    leg_length: float
    leg_mass: Array  # (4,)
    leg_com: float
    leg_inertia: Array  # (4, 3) leg straight down
    wheel_mass: float
    spin_inertia: float
    transverse_inertia: float
    radius: Array  # (4,)
    gravity: float
    kp: Array  # (8,)
    kd: Array
    stall_torque: Array
    no_load_speed: Array
    armature: Array
    coulomb: Array
    viscous: Array
    data_sheet_voltage: float
    nominal_torque_constant: Array  # (8,)
    supply: float
    mu: float
    slope: Array  # (2,) rad: x uphill, y uphill
    normal_stiffness: float
    floor_creep: float
    gear_creep: float
    joint_zero: Array  # (4,)
    camera_yaw: float
    camera_age: float
    command_delay: float
    flattening: float
    floor_waves: Array  # (WAVES, 4) height, wave numbers along x and y, phase
    steepness: float  # share of the floor's own slope that contacts follow
    gyro_bias: Array  # (3,)
    accel_bias: Array  # (3,)

    @property
    def weight(self) -> float:
        """N."""
        return (self.mass + float(self.leg_mass.sum()) + 4 * self.wheel_mass) * self.gravity


def read_robot(path: Path) -> dict[str, Any]:
    """Read a robot file."""
    with open(path, encoding="utf-8") as file:
        return yaml.safe_load(file)


def nominal(robot: dict[str, Any]) -> Copy:
    """Return the copy that is exactly the robot file: no tolerance, no bias, no delay."""
    servo, leg, wheel, body = robot["servo"], robot["leg"], robot["wheel"], robot["body"]
    supply = float(servo["supply_voltage"])

    def motors(key: str) -> Array:
        return np.repeat([float(servo["leg"][key]), float(servo["wheel"][key])], 4)

    return Copy(
        mass=float(body["mass"]),
        inertia=np.array(body["inertia"], dtype=float),
        com=np.array(body["com_offset"], dtype=float),
        hip=np.array([robot["hip_position"]["x"], robot["hip_position"]["y"]], dtype=float),
        leg_length=float(leg["length"]),
        leg_mass=np.full(4, float(leg["mass"])),
        leg_com=float(leg["com_along_leg"]),
        leg_inertia=np.tile(np.array(leg["inertia"], dtype=float), (4, 1)),
        wheel_mass=float(wheel["mass"]),
        spin_inertia=float(wheel["spin_inertia"]),
        transverse_inertia=float(wheel["transverse_inertia"]),
        radius=np.full(4, float(wheel["radius"])),
        gravity=float(robot["gravity"]),
        kp=motors("kp"),
        kd=motors("kd"),
        stall_torque=motors("stall_torque"),
        no_load_speed=motors("no_load_speed"),
        armature=motors("armature"),
        coulomb=motors("coulomb_friction"),
        viscous=motors("viscous_friction"),
        data_sheet_voltage=supply,
        nominal_torque_constant=supply / motors("no_load_speed"),
        supply=supply,
        mu=float(robot["ground"]["mu_x"]),
        slope=np.zeros(2),
        normal_stiffness=float(robot["ground"]["normal_stiffness"]),
        floor_creep=FLOOR_CREEP,
        gear_creep=GEAR_CREEP,
        joint_zero=np.zeros(4),
        camera_yaw=0.0,
        camera_age=0.0,
        command_delay=0.0,
        flattening=0.0,
        floor_waves=np.zeros((WAVES, 4)),
        steepness=0.0,
        gyro_bias=np.zeros(3),
        accel_bias=np.zeros(3),
    )


def draw(robot: dict[str, Any], rng: np.random.Generator) -> Copy:
    """Draw a copy: every tolerance of the robot file once, every servo, wheel and leg its own; 1 sigma, cut at two."""
    base, tolerance, imu = nominal(robot), robot["tolerances"], robot["sensors"]["imu"]

    def cut(*shape: int) -> Array:
        values = rng.standard_normal(shape)
        while (outside := np.abs(values) > CUT).any():
            values[outside] = rng.standard_normal(int(outside.sum()))
        return values

    def relative(value: Any, key: str, *shape: int) -> Any:
        return value * (1.0 + float(tolerance[key]) * cut(*shape))

    def absolute(key: str) -> float:
        number, unit = str(tolerance[key]).split()[:2]
        return float(number) * (np.pi / 180 if unit == "deg" else 1.0)

    viscous = np.repeat([0.01, 0.002], 4) * np.abs(cut(8))
    return replace(
        base,
        mass=relative(base.mass, "body.mass"),
        inertia=_possible(lambda: relative(base.inertia, "body.inertia", 3)),
        com=base.com + absolute("body.com_offset") * cut(3),
        leg_mass=relative(base.leg_mass, "leg.mass", 4),
        leg_inertia=np.array([_possible(lambda: relative(base.leg_inertia[0], "leg.inertia", 3)) for _ in range(4)]),
        radius=relative(base.radius, "wheel.radius", 4),
        kp=relative(base.kp, "servo.kp", 8),
        stall_torque=relative(base.stall_torque, "servo.stall_torque", 8),
        no_load_speed=relative(base.no_load_speed, "servo.no_load_speed", 8),
        armature=relative(base.armature, "servo.armature", 8),
        coulomb=relative(base.coulomb, "servo.coulomb_friction", 8),
        viscous=base.viscous + viscous,
        supply=relative(base.supply, "servo.supply_voltage"),
        mu=relative(base.mu, "ground.mu"),
        slope=absolute("ground.slope") * cut(2),
        joint_zero=absolute("joint_zero") * cut(4),
        camera_yaw=float(absolute("camera.mount_yaw") * cut()),
        camera_age=float(absolute("camera.delay") * rng.random()),
        command_delay=float(absolute("command.delay") * np.abs(cut())),
        gyro_bias=float(imu["gyro_bias"]) * cut(3),
        accel_bias=float(imu["accel_bias"]) * cut(3),
    )


def yielding(copy: Copy, rng: np.random.Generator, bumps: float | None = None) -> Copy:
    """Return the copy on soft tyres and a bumpy floor, with friction that creeps: what no two simulators share.

    With ``bumps`` (m, rms) the floor is as high as that, and it pushes along its own normal instead of upwards.
    """

    def drawn(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    return replace(
        copy,
        floor_creep=drawn(*YIELDING_FLOOR),
        gear_creep=drawn(*YIELDING_GEAR),
        normal_stiffness=copy.normal_stiffness * drawn(*SOFTNESS),
        flattening=drawn(*FLATTENING),
        floor_waves=_waves(drawn(*BUMPS) if bumps is None else bumps, rng),
        steepness=float(bumps is not None),
    )


def _waves(height: float, rng: np.random.Generator) -> Array:
    """Draw a floor whose rms height is ``height``."""
    shortest, longest = np.log(WAVE_LENGTH)
    number = 2.0 * np.pi / np.exp(rng.uniform(shortest, longest, WAVES))
    heading, phase = rng.uniform(0.0, 2.0 * np.pi, (2, WAVES))
    each = np.full(WAVES, height * np.sqrt(2.0 / WAVES))
    return np.stack([each, number * np.cos(heading), number * np.sin(heading), phase], axis=1)


def with_body_of(copy: Copy, other: Copy) -> Copy:
    """Return ``other`` with what the sensors and clocks of ``copy`` have: biases, the camera's age, the commands' delay."""
    kept = ("camera_age", "command_delay", "gyro_bias", "accel_bias")
    return replace(other, **{name: getattr(copy, name) for name in kept})


def _possible(attempt: Any) -> Array:
    """Draw again until no principal inertia exceeds the sum of the others."""
    while True:
        inertia = attempt()
        if (2 * inertia.max() < inertia.sum()) and inertia.min() > 0:
            return inertia
