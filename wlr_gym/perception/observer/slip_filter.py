"""One control step of the observer: small Kalman filters per robot, compiled; every robot on its own.

Frames: *start* (the floor frame as the body stood at the reset: x along its heading), *heading* (turns with the body about the
floor's normal; x along the wheels, y to the left in the floor), *body*. Velocities are estimated in the heading frame, each
direction by a filter of its own, heading and gyroscope bias by a third.

State of a direction (p, v, l, e): position, velocity, leak of the accelerometer, error of the flow sensor. p' = v; v' = a - l
with the measured acceleration a; l, what leaks into the accelerometer (bias, and gravity on an unknown slope), a random walk;
e, ahead the scale of the optical flow less 1, to the side its rotation. The filters keep covariances only: the means live in
frames that turn.

A step predicts (the gyroscope turns, the accelerometer drives, the uncertainty grows) and takes in wheels, camera and flow.
"""

from __future__ import annotations

import math
from collections import namedtuple
from typing import Any

from wlr_gym.base.compiled import compiled
from wlr_gym.perception.observer.trust import LEAST_LOAD, gather, judge
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, Channel, Layout
from wlr_gym.robot import FIRST_WHEEL, WHEELS

_WHEEL_XY = tuple(f"{wheel},{axis}" for wheel in WHEELS for axis in ("x", "y"))

ESTIMATE_LAYOUT = Layout(
    (
        Channel("position", ("x", "y"), "m", "body origin in the start frame: the floor frame as the body stood at the reset"),
        Channel("yaw", (), "rad", "heading in the start frame, unwrapped"),
        Channel("yaw_sigma", (), "rad", "1 sigma of the yaw"),
        Channel("linear_velocity_in_body", ("x", "y"), "m/s", "of the body origin, body frame"),
        Channel("linear_velocity_sigma", ("x", "y"), "m/s", "1 sigma of the linear velocity"),
        Channel("yaw_rate", (), "rad/s", "about the floor's normal"),
        Channel("gravity_in_body", ("x", "y", "z"), "-", "direction of gravity in the body frame, unit length"),
        Channel(
            "slip_velocity", _WHEEL_XY, "m/s", "of the contact point over the floor: along the wheel's heading, along its axle"
        ),
        Channel("slip_sigma", _WHEEL_XY, "m/s", "1 sigma of the slip velocity"),
        Channel("traction_force", WHEELS, "N", "of the floor on the wheel along its heading, from the wheel's effort"),
        Channel("normal_force", WHEELS, "N", "of the floor on the wheel, from leg angles and accelerometer"),
        Channel("traction_use", WHEELS, "-", "size of the traction force over the normal force"),
        Channel("friction_demand", (), "-", "force of the floor on the whole robot: along the floor over normal to it"),
        Channel(
            "camera_innovation", (), "-", "size of the last camera frame's largest normalised innovation; 0 = no frame of late"
        ),
        Channel("camera_rejected", (), "-", "1 = the last camera frame was not believed, else 0"),
        Channel("flow_innovation", (), "-", "size of the last flow reading's larger normalised innovation; 0 = none of late"),
        Channel("flow_rejected", (), "-", "1 = the last flow reading was not believed, else 0"),
    )
)


def _starts(layout: Layout) -> Any:
    """Return the first column of each channel, by its name: a named tuple, as compiled code takes it for constants."""
    return namedtuple("Starts", layout.slices)(*(columns.start for columns in layout.slices.values()))


SENSOR, ESTIMATE = _starts(SENSOR_LAYOUT), _starts(ESTIMATE_LAYOUT)
_WHEEL_RATE, _WHEEL_EFFORT = SENSOR.joint_velocity + FIRST_WHEEL, SENSOR.joint_effort + FIRST_WHEEL


# --- the filter of one direction --------------------------------------------------------------------------------------


# Where the state's elements stand, after the position; their number.
VELOCITY, LEAK, LENS = 1, 2, 3
DIRECTION_SIZE = 4


@compiled
def predict_direction(p: Any, step: float, velocity_noise: float, leak_noise: float) -> None:
    """P = F P F' + diag(0, velocity_noise, leak_noise, 0) over ``step`` s; ``p`` (4, 4) is changed."""
    half = 0.5 * step * step
    for k in range(DIRECTION_SIZE):
        p[0, k] += step * p[1, k] - half * p[2, k]
        p[1, k] -= step * p[2, k]
    for k in range(DIRECTION_SIZE):
        p[k, 0] += step * p[k, 1] - half * p[k, 2]
        p[k, 1] -= step * p[k, 2]
    p[VELOCITY, VELOCITY] += velocity_noise
    p[LEAK, LEAK] += leak_noise


@compiled
def see_velocity(p: Any, age: float, flow: float, column: Any) -> float:
    """Put P h' of the measurement of the velocity ``age`` s ago less e ``flow`` into ``column`` (4,); return h P h'.

    ``flow``: m/s, that the flow sensor measures; 0 = the wheels measure.
    """
    for k in range(DIRECTION_SIZE):
        column[k] = p[k, VELOCITY] + age * p[k, LEAK] - flow * p[k, LENS]
    return column[VELOCITY] + age * column[LEAK] - flow * column[LENS]


@compiled
def see_position(p: Any, age: float, column: Any) -> float:
    """Put P h' of the measurement of the position ``age`` s ago into ``column`` (4,); return h P h'."""
    half = 0.5 * age * age
    for k in range(DIRECTION_SIZE):
        column[k] = p[k, 0] - age * p[k, VELOCITY] - half * p[k, LEAK]
    return column[0] - age * column[VELOCITY] - half * column[LEAK]


@compiled
def correct_direction(p: Any, column: Any, innovation: float, total: float, change: Any) -> None:
    """Take in a measurement that came out ``innovation`` above its prediction, with the variance ``total`` of that.

    ``p`` (4, 4) stays symmetric and positive; ``column``: (4,) P h'; ``change`` (4,) becomes what the state changes.
    """
    share = 1.0 / total
    for j in range(DIRECTION_SIZE):
        gain = column[j] * share
        change[j] = gain * innovation
        for k in range(j + 1):
            p[j, k] = p[k, j] = p[j, k] - gain * column[k]


@compiled
def correct(r: Any, k: int, innovation: float, total: float) -> None:
    """Correct direction ``k`` by the measurement whose P h' is in ``r.column``."""
    correct_direction(r.covariance[k], r.column, innovation, total, r.change)
    c, s = r.pointing[0], r.pointing[1]
    r.position[0] += (c if k == 0 else -s) * r.change[0]
    r.position[1] += (s if k == 0 else c) * r.change[0]
    r.velocity[k] += r.change[VELOCITY]
    r.leak[k] += r.change[LEAK]
    r.lens[k] += r.change[LENS]


@compiled
def correct_yaw(r: Any, of_yaw: float, of_bias: float, innovation: float, total: float) -> None:
    """Correct yaw and gyroscope bias by a measurement of of_yaw yaw + of_bias bias; ``total``: the innovation's variance."""
    p = r.yaw_covariance
    yaw, bias = of_yaw * p[0] + of_bias * p[1], of_yaw * p[1] + of_bias * p[2]
    r.yaw += yaw / total * innovation
    r.gyro_bias += bias / total * innovation
    p[0] -= yaw * yaw / total
    p[1] -= yaw * bias / total
    p[2] -= bias * bias / total


# --- wheels and floor -------------------------------------------------------------------------------------------------


@compiled
def look(robot: Any, sensors: Any, r: Any) -> None:
    """Find heading, left and contact points for floor normal and rate of turn of the body, and how each wheel rolls.

    ``r.rolling[i]`` is the velocity of the body origin along heading and left with which wheel ``i`` would not slip;
    ``r.lift[i]`` that along the normal with which it would stay on the floor (equations of :mod:`wlr_gym.robot.slip`).
    """
    nx, ny, nz = r.normal[0], r.normal[1], r.normal[2]
    scale = 1.0 / math.sqrt(nx * nx + nz * nz + 1e-12)
    hx, hz = nz * scale, -nx * scale
    r.heading[0], r.heading[1], r.heading[2] = hx, 0.0, hz
    r.left[0], r.left[1], r.left[2] = ny * hz, nz * hx - nx * hz, -ny * hx
    wx, wy, wz = r.rate[0], r.rate[1], r.rate[2]
    reach = robot.wheel_radius * scale
    for i in range(4):
        leg_rate, wheel_rate = sensors[SENSOR.joint_velocity + i], sensors[_WHEEL_RATE + i]
        r.leg[i, 0], r.leg[i, 1] = math.cos(sensors[i]), math.sin(sensors[i])
        leg_x, leg_z = robot.leg_length * r.leg[i, 0], -robot.leg_length * r.leg[i, 1]
        rim_x, rim_z = -reach * nx, -reach * nz
        x = robot.hip[i, 0] + leg_x + rim_x
        y = robot.hip[i, 1]
        z = robot.hip[i, 2] + leg_z + rim_z
        ux = wy * z - wz * y + leg_rate * (leg_z + rim_z) + wheel_rate * rim_z
        uy = wz * x - wx * z
        uz = wx * y - wy * x - leg_rate * (leg_x + rim_x) - wheel_rate * rim_x
        r.point[i, 0], r.point[i, 1], r.point[i, 2] = _along_floor(r, x, y, z)
        ahead, aside, up = _along_floor(r, ux, uy, uz)
        r.rolling[i, 0], r.rolling[i, 1], r.lift[i] = -ahead, -aside, -up


@compiled
def _along_floor(r: Any, x: float, y: float, z: float) -> Any:
    """Return a vector of the body frame along heading, left and normal."""
    h, left, n = r.heading, r.left, r.normal
    return h[0] * x + h[2] * z, left[0] * x + left[1] * y + left[2] * z, n[0] * x + n[1] * y + n[2] * z


@compiled
def _centre_of_mass(robot: Any, r: Any) -> Any:
    """Centre of mass of the whole robot along heading, left and normal, m."""
    x, y, z = robot.body_mass * robot.body_com[0], robot.body_mass * robot.body_com[1], robot.body_mass * robot.body_com[2]
    assembly = robot.leg_mass + robot.wheel_mass
    moment = robot.leg_mass * robot.leg_com + robot.wheel_mass * robot.leg_length
    for i in range(4):
        x += assembly * robot.hip[i, 0] + moment * r.leg[i, 0]
        y += assembly * robot.hip[i, 1]
        z += assembly * robot.hip[i, 2] - moment * r.leg[i, 1]
    return _along_floor(r, x / robot.mass, y / robot.mass, z / robot.mass)


@compiled
def carry(robot: Any, r: Any) -> Any:
    """Find the normal forces that hold the robot: ``r.load`` (4,) N; return the tilt of the floor they imply.

    Four feet on a floor are one too many for statics; their springs decide. The body sinks into the springs as a plane:
    N_i = k max(0, a + b x_i + c y_i - z_i), with a, b, c such that force and both moments about the centre of mass balance
    those of the measured acceleration (the robot is taken not to tumble). It is the engine's own rest state. Corrected
    equations (16), (17) of the paper are its level case with legs pairwise equal.

    Returns:
        b, c: slope of the true floor over the assumed one along heading and left; 0, 0 when fewer than three wheels carry.
    """
    fx, fy, fz = r.force[0], r.force[1], max(r.force[2], 1.0)
    cx, cy, cz = _centre_of_mass(robot, r)
    height = cz - 0.25 * (r.point[0, 2] + r.point[1, 2] + r.point[2, 2] + r.point[3, 2])
    weight = robot.mass * fz / robot.stiffness
    mx = weight * cx - robot.mass * height * fx / robot.stiffness
    my = weight * cy - robot.mass * height * fy / robot.stiffness
    r.carries[:] = 1.0
    a = b = c = 0.0
    for _ in range(4):
        n = sx = sy = sxx = sxy = syy = sz = sxz = syz = 0.0
        for i in range(4):
            on = r.carries[i]
            x, y, z = r.point[i, 0], r.point[i, 1], r.point[i, 2]
            n += on
            sx += on * x
            sy += on * y
            sxx += on * x * x
            sxy += on * x * y
            syy += on * y * y
            sz += on * z
            sxz += on * x * z
            syz += on * y * z
        if n < 2.5:
            break
        p, q, s = weight + sz, mx + sxz, my + syz
        k00, k01, k02 = sxx * syy - sxy * sxy, sy * sxy - sx * syy, sx * sxy - sy * sxx
        k11, k12, k22 = n * syy - sy * sy, sx * sy - n * sxy, n * sxx - sx * sx
        inverse = 1.0 / (n * k00 + sx * k01 + sy * k02)
        a = (k00 * p + k01 * q + k02 * s) * inverse
        b = (k01 * p + k11 * q + k12 * s) * inverse
        c = (k02 * p + k12 * q + k22 * s) * inverse
        changed = False
        for i in range(4):
            on = 1.0 if a + b * r.point[i, 0] + c * r.point[i, 1] > r.point[i, 2] else 0.0
            changed = changed or on != r.carries[i]
            r.carries[i] = on
        if not changed:
            break
    total = 0.0
    for i in range(4):
        r.load[i] = max(0.0, robot.stiffness * (a + b * r.point[i, 0] + c * r.point[i, 1] - r.point[i, 2]))
        total += r.load[i]
    share = robot.mass * fz / max(total, LEAST_LOAD)
    for i in range(4):
        r.load[i] *= share
    return b, c


@compiled
def pull(robot: Any, sensors: Any, r: Any) -> None:
    """Find the traction of every wheel, ``r.traction`` (4,) N: effort less gear friction and spin inertia, over the radius.

    Equations (25) to (28) of the paper as corrected.
    """
    for i in range(4):
        rate = sensors[_WHEEL_RATE + i]
        spin = rate + sensors[SENSOR.joint_velocity + i] + r.rate[1]
        spin_up = (spin - r.spin[i]) / robot.period
        dry = robot.gear_friction * math.tanh(rate / robot.velocity_count)
        torque = sensors[_WHEEL_EFFORT + i] - dry - robot.spin_inertia * spin_up
        r.traction[i] = torque / robot.wheel_radius
        r.spin[i] = spin


# --- prediction -------------------------------------------------------------------------------------------------------


# What the prediction takes for granted; 1 sigma where it is an uncertainty. Chosen on simulated runs: docs/slip_observer.md.
_ALIAS = 0.25  # share of the change of an IMU reading from step to step that one sample per step misses
_GYRO_WANDER = 1e-5  # rad/s per root second: random walk of the gyroscope's bias
_SETTLE = 1.5  # s: how fast the tilt follows the legs
_SMOOTH = 0.06  # s: low-pass of the friction demand


@compiled
def rate_noise(robot: Any, changed: Any) -> Any:
    """Variance (rad2/s2) of a gyroscope's reading that has changed by so much, rad/s."""
    missed = _ALIAS * changed
    return robot.gyro_noise**2 + missed * missed


@compiled
def shaking(robot: Any, changed: Any, square: Any) -> Any:
    """Variance (m2/s4) of what one reading of the specific force per step misses, that has ``changed`` by so much, m/s2.

    ``square``: mean square of the legs' rates; how much both count was learned.
    """
    return (robot.alias * changed) ** 2 + robot.velocity_legs**2 * square


@compiled
def leak_noise(robot: Any, square: Any) -> Any:
    """Variance per s (m2/s5) of the walk of the accelerometer's leak; ``square``: mean square of the legs' rates."""
    return robot.leak_wander**2 + robot.leak_legs**2 * square


@compiled
def turn(robot: Any, r: Any) -> None:
    """Turn floor normal and heading with the gyroscope."""
    before, dt = r.yaw_rate, robot.period
    for k in range(3):
        r.last_rate[k] = r.rate[k]
        r.rate[k] = r.seen[SENSOR.gyro + k]
    mx, my, mz = _mean_rate(r, dt)
    nx, ny, nz = r.normal[0], r.normal[1], r.normal[2]
    set_normal(r, nx - (my * nz - mz * ny), ny - (mz * nx - mx * nz), nz - (mx * ny - my * nx))
    r.yaw_rate = r.normal[0] * r.rate[0] + r.normal[1] * r.rate[1] + r.normal[2] * r.rate[2] - r.gyro_bias
    turned = dt * ((0.5 - robot.lag) * before + (0.5 + robot.lag) * r.yaw_rate)
    r.yaw += turned
    r.turned = turned
    c = r.yaw_covariance
    c[0] += dt * (dt * c[2] - 2.0 * c[1]) + dt * dt * rate_noise(robot, r.yaw_rate - before)
    c[1] -= dt * c[2]
    c[2] += _GYRO_WANDER**2 * dt


@compiled
def _mean_rate(r: Any, factor: float) -> Any:
    """Return the mean angular velocity over the step, body frame, times a factor."""
    w, last = r.rate, r.last_rate
    return 0.5 * factor * (w[0] + last[0]), 0.5 * factor * (w[1] + last[1]), 0.5 * factor * (w[2] + last[2])


@compiled
def set_normal(r: Any, x: float, y: float, z: float) -> None:
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    r.normal[0], r.normal[1], r.normal[2] = x * scale, y * scale, z * scale


@compiled
def measure_force(r: Any) -> None:
    """Turn the accelerometer's reading into the heading frame: ``r.last_force``."""
    x, y, z = r.seen[SENSOR.accelerometer], r.seen[SENSOR.accelerometer + 1], r.seen[SENSOR.accelerometer + 2]
    r.last_force[0], r.last_force[1], r.last_force[2] = _along_floor(r, x, y, z)


@compiled
def sense_force(robot: Any, r: Any) -> None:
    """Mean specific force over the step, how much it changed along the floor, and friction demand."""
    last = (r.last_force[0], r.last_force[1], r.last_force[2])
    measure_force(r)
    for k in range(3):
        r.force[k] = (0.5 - robot.lag) * last[k] + (0.5 + robot.lag) * r.last_force[k]
    along = math.sqrt((r.force[0] - r.leak[0]) ** 2 + (r.force[1] - r.leak[1]) ** 2)
    demand = along / max(r.force[2], 0.2 * robot.gravity)
    r.demand += (1.0 - math.exp(-robot.period / _SMOOTH)) * (demand - r.demand)
    r.shaken = math.sqrt((r.last_force[0] - last[0]) ** 2 + (r.last_force[1] - last[1]) ** 2)


@compiled
def move(robot: Any, r: Any) -> None:
    """Carry pose and velocity over the step."""
    dt, turned = robot.period, r.turned
    # in the frame of the step's middle: turned by half, kicked, turned by half
    ch, sh = math.cos(0.5 * turned), math.sin(0.5 * turned)
    c, s = ch * ch - sh * sh, 2.0 * ch * sh
    gx, gy = r.slope[0], r.slope[1]
    r.slope[0], r.slope[1] = c * gx + s * gy, c * gy - s * gx
    ax = r.force[0] - r.leak[0] - 0.5 * (gx + r.slope[0])
    ay = r.force[1] - r.leak[1] - 0.5 * (gy + r.slope[1])
    r.kick[0], r.kick[1] = ax, ay
    r.pointing[0], r.pointing[1] = math.cos(r.yaw), math.sin(r.yaw)
    cm, sm = ch * r.pointing[0] + sh * r.pointing[1], ch * r.pointing[1] - sh * r.pointing[0]
    vx, vy = r.velocity[0], r.velocity[1]
    r.last_velocity[0], r.last_velocity[1] = vx, vy
    bx, by = ch * vx + sh * vy, ch * vy - sh * vx
    ex, ey = bx + dt * ax, by + dt * ay
    r.velocity[0], r.velocity[1] = ch * ex + sh * ey, ch * ey - sh * ex
    mx, my = 0.5 * dt * (bx + ex), 0.5 * dt * (by + ey)
    r.position[0] += cm * mx - sm * my
    r.position[1] += sm * mx + cm * my
    kick_x, kick_y = dt * (cm * ax - sm * ay), dt * (sm * ax + cm * ay)
    length = r.raw.shape[0]
    now, last = int(r.tick) % length, int(r.tick - 1.0) % length
    r.raw[now, 0] = r.raw[last, 0] + dt * (r.raw_velocity[0] + 0.5 * kick_x)
    r.raw[now, 1] = r.raw[last, 1] + dt * (r.raw_velocity[1] + 0.5 * kick_y)
    r.raw[now, 2] = r.raw[last, 2] + turned
    r.raw_velocity[0] += kick_x
    r.raw_velocity[1] += kick_y


@compiled
def spread(robot: Any, r: Any) -> None:
    """Carry the uncertainty over the step."""
    dt = robot.period
    square = 0.0
    for i in range(4):
        square += 0.25 * r.seen[SENSOR.joint_velocity + i] ** 2
    r.legs = math.sqrt(square)
    # how bias and slope share what the accelerometer read at first is a guess, which shows as the robot turns
    guess = (robot.leak_turn * r.guess * r.turned) ** 2
    r.inclined = min(1.0, (r.slope[0] ** 2 + r.slope[1] ** 2) / robot.accel_bias**2)
    wander = leak_noise(robot, square) * dt + guess
    velocity_noise = dt * dt * (robot.accel_noise**2 + r.wander[0] * shaking(robot, r.shaken, square))
    for k in range(2):
        predict_direction(r.covariance[k], dt, velocity_noise, r.wander[1] * wander)


@compiled
def settle(robot: Any, r: Any) -> None:
    """Loads of the wheels; let the tilt follow the legs."""
    b, c = carry(robot, r)
    share = robot.period / _SETTLE
    b, c = share * b, share * c
    set_normal(
        r,
        r.normal[0] - b * r.heading[0] - c * r.left[0],
        r.normal[1] - c * r.left[1],
        r.normal[2] - b * r.heading[2] - c * r.left[2],
    )


# --- how the wheels roll, joints at rest ------------------------------------------------------------------------------


_QUIET = 0.0005  # m/s: noise of a wheel's rolling speed from step to step
#: Squared normalised innovation beyond which what all wheels say counts for less: they have jumped away from the IMU.
_ROLLING_GATE = 16.0
_DOUBT = 3.0  # s: how long the wheels are doubted once a camera has contradicted them and no longer does
RADIUS = 0.005  # relative error of one wheel's radius
_GRIPPING_SLIP = 0.003  # m/s: slip below which a wheel counts as gripping


@compiled
def guess_velocity(r: Any) -> None:
    """Begin with the geometric median of the wheels' rolling velocities: some spin while a robot is put down."""
    for _ in range(4):
        total, x, y = 1e-12, 0.0, 0.0
        for i in range(4):
            dx, dy = r.rolling[i, 0] - r.velocity[0], r.rolling[i, 1] - r.velocity[1]
            weight = 1.0 / math.sqrt(dx * dx + dy * dy + _GRIPPING_SLIP**2)
            total += weight
            x += weight * r.rolling[i, 0]
            y += weight * r.rolling[i, 1]
        r.velocity[0], r.velocity[1] = x / total, y / total


@compiled
def see_rolling(robot: Any, r: Any) -> None:
    """Take in how the wheels roll, each as far as it is trusted: their weighted mean is a measurement of the velocity."""
    speed, share = 0.0, 1.0 - robot.period / _DOUBT
    for i in range(4):
        speed += 0.25 * r.rolling[i, 0]
    for k in range(2):
        precision, moment = 0.0, 0.0
        for i in range(4):
            lead = r.lead[i] if k == 0 else 0.0
            precision += r.trust[i, k]
            moment += r.trust[i, k] * (r.rolling[i, k] - r.velocity[k] - lead)
        innovation = moment / precision
        if abs(innovation) < 0.5 * r.doubt:
            r.doubt *= share
        variance = 1.0 / precision + _QUIET**2 + (0.5 * RADIUS * speed) ** 2 + r.doubt**2
        total = see_velocity(r.covariance[k], 0.0, 0.0, r.column) + variance
        correct(r, k, innovation, max(total, innovation * innovation / _ROLLING_GATE))


@compiled
def see_rest(robot: Any, r: Any) -> None:
    """While every joint rests, the gyroscope reads its bias."""
    for k in range(8):
        if abs(r.seen[SENSOR.joint_velocity + k]) > 0.5 * robot.velocity_count:
            return
    total = r.yaw_covariance[2] + robot.gyro_noise**2
    if r.yaw_rate * r.yaw_rate < 16.0 * total:
        correct_yaw(r, 0.0, 1.0, r.yaw_rate, total)


# --- camera: late frames, frames that are not believed, a camera that has been moved ----------------------------------


CAMERA_GATE = 20.0  # squared normalised innovation beyond which a frame is refused
_CAMERA_PATIENCE = 0.25  # s: refused frames that are off by the same for so long say that the camera has been moved
_LONG_PATIENCE = 0.5  # s: frames that steadily move away for so long say that the robot does, whatever wheels and IMU say
_SAME, _SAME_YAW = 0.006, 0.03  # m, rad: what counts as the same
_CAMERA_SILENCE = 0.5  # s without a frame after which nothing is said about the last one


@compiled
def see_camera(robot: Any, sensors: Any, r: Any) -> None:
    """Take in a camera pose where there is a new one; it shows where the robot was ``camera_age`` ago.

    Frames come in two ways: as they are, and in the frame of a camera that has been moved (``r.anchor``). A frame that fits
    neither is refused. When frames have been off by the same for a while, it is the camera that has been moved: a robot does
    not jump. The estimate then stays, and only motion is learned from the camera. When they steadily move away, it is the
    robot that slides. A frame that repeats the last one to the last bit is no new picture.
    """
    r.frame_time += robot.period
    x, y, yaw = sensors[SENSOR.camera_pose], sensors[SENSOR.camera_pose + 1], sensors[SENSOR.camera_pose + 2]
    if robot.camera == 0.0 or not r.seen[SENSOR.camera_is_new] > 0.5 or not math.isfinite(x + y + yaw):
        if r.frame_time > _CAMERA_SILENCE:
            r.camera_off = r.camera_rejected = r.refused = 0.0
        return
    repeated = x == r.frame[0] and y == r.frame[1] and yaw == r.frame[2]
    r.frame[0], r.frame[1], r.frame[2] = x, y, yaw
    age = min(max(r.seen[SENSOR.camera_age], 0.0), r.tick * robot.period, (r.raw.shape[0] - 2) * robot.period)
    then = _pose_before(robot, age, r)
    error = (x - then[0], y - then[1], yaw - then[2])
    off = _off(robot, age, error, r)
    if off <= CAMERA_GATE:
        r.anchor[:] = 0.0
    elif r.anchor[0] != 0.0 or r.anchor[1] != 0.0 or r.anchor[2] != 0.0:
        c, s = math.cos(r.anchor[2]), math.sin(r.anchor[2])
        moved_x, moved_y = r.anchor[0] + c * x - s * y, r.anchor[1] + s * x + c * y
        error = (moved_x - then[0], moved_y - then[1], yaw + r.anchor[2] - then[2])
        off = _off(robot, age, error, r)
    r.camera_off = math.sqrt(off)
    if off > CAMERA_GATE or (repeated and off > 1.0):
        r.camera_rejected = 1.0
        if not repeated:
            _refuse((x, y, yaw), then, error, r)
    elif not repeated:
        r.camera_rejected = r.refused = 0.0
        for k in range(2):
            variance = see_position(r.covariance[k], age, r.column) + robot.camera_noise**2
            correct(r, k, _along(k, error, r), variance)
        correct_yaw(r, 1.0, age, error[2], _yaw_variance(robot, age, r))
    r.frame_time = 0.0


@compiled
def _pose_before(robot: Any, age: float, r: Any) -> Any:
    """Return where the robot was ``age`` s ago, start frame: its estimate less the IMU's way since."""
    length = r.raw.shape[0]
    back = r.tick - age / robot.period
    whole = math.floor(back)
    part = back - whole
    now, a = int(r.tick) % length, int(whole) % length
    b = (a + 1) % length if part > 0.0 else a
    c, s = r.pointing[0], r.pointing[1]
    # what the corrections since then have added to the velocity
    ex = c * r.velocity[0] - s * r.velocity[1] - r.raw_velocity[0]
    ey = s * r.velocity[0] + c * r.velocity[1] - r.raw_velocity[1]
    x = r.position[0] - (r.raw[now, 0] - r.raw[a, 0] - part * (r.raw[b, 0] - r.raw[a, 0])) - ex * age
    y = r.position[1] - (r.raw[now, 1] - r.raw[a, 1] - part * (r.raw[b, 1] - r.raw[a, 1])) - ey * age
    return x, y, r.yaw - (r.raw[now, 2] - r.raw[a, 2] - part * (r.raw[b, 2] - r.raw[a, 2]))


@compiled
def _yaw_variance(robot: Any, age: float, r: Any) -> float:
    p = r.yaw_covariance
    return p[0] + 2.0 * age * p[1] + age * age * p[2] + robot.camera_yaw_noise**2


@compiled
def _along(k: int, error: Any, r: Any) -> float:
    """Return what of an error (x, y, yaw) in the start frame lies along heading (0) or left (1)."""
    c, s = r.pointing[0], r.pointing[1]
    return c * error[0] + s * error[1] if k == 0 else c * error[1] - s * error[0]


@compiled
def _off(robot: Any, age: float, error: Any, r: Any) -> float:
    """Return the largest squared normalised innovation of a frame that is off by so much in the start frame."""
    off = error[2] * error[2] / _yaw_variance(robot, age, r)
    for k in range(2):
        along = _along(k, error, r)
        off = max(off, along * along / (see_position(r.covariance[k], age, r.column) + robot.camera_noise**2))
    return off


@compiled
def _refuse(frame: Any, then: Any, error: Any, r: Any) -> None:
    """Follow how refused frames are off: by the same, then the camera has been moved; or steadily moving away.

    ``frame``, ``then``, ``error``: the frame's pose, the robot's at its time, and by how much it is off, (x, y, yaw).
    """
    if r.refused == 0.0:
        for k in range(3):
            r.first_off[k] = r.off[k] = error[k]
        r.refused = 1e-9
        return
    before = r.refused
    r.refused += r.frame_time
    ahead = r.frame_time / before if before > r.frame_time else 0.0
    jump_x = error[0] - r.off[0] - ahead * (r.off[0] - r.first_off[0])
    jump_y = error[1] - r.off[1] - ahead * (r.off[1] - r.first_off[1])
    if abs(jump_x) > _SAME or abs(jump_y) > _SAME or abs(error[2] - r.off[2]) > _SAME_YAW:
        r.refused = 0.0
        return
    for k in range(3):
        r.off[k] = error[k]
    moved = max(abs(error[0] - r.first_off[0]), abs(error[1] - r.first_off[1]))
    if r.refused >= _CAMERA_PATIENCE and moved < _SAME:
        turned = then[2] - frame[2]
        c, s = math.cos(turned), math.sin(turned)
        r.anchor[0], r.anchor[1] = then[0] - c * frame[0] + s * frame[1], then[1] - s * frame[0] - c * frame[1]
        r.anchor[2] = turned
        r.refused = 0.0
    elif r.refused >= _LONG_PATIENCE:
        for k in range(2):
            r.covariance[k, 0, 0] += error[0] * error[0] + error[1] * error[1]
            r.covariance[k, VELOCITY, VELOCITY] += (moved / r.refused) ** 2
        r.doubt = moved / r.refused
        r.refused = 0.0


# --- optical flow: a velocity, with a scale and a rotation that are learned on the way --------------------------------


SCALE, ROTATION = 0.03, 0.03  # of the sensor and its mounting, 1 sigma
FLOW_GATE = 16.0  # squared normalised innovation beyond which a reading is refused
_FLOW_PATIENCE = 0.5  # s of refused readings, moving as the IMU says, after which it is the estimate that may be wrong
_REPEATS = 8.0  # readings in a row, the same to the last bit, after which the sensor counts as stuck
_FLOW_SILENCE = 0.5  # s without a reading after which nothing is said about the last one
_LEAST_HEIGHT = 0.02  # m: shortest distance from lens to floor that is taken for one


@compiled
def see_flow(robot: Any, sensors: Any, r: Any) -> None:
    """Take in a flow reading where there is a new one: flow_x = v_x/h - w_y, flow_y = v_y/h + w_x of the lens, body frame."""
    r.flow_time += robot.period
    x, y = sensors[SENSOR.flow], sensors[SENSOR.flow + 1]
    if robot.flow == 0.0 or not r.seen[SENSOR.flow_is_new] > 0.5 or not math.isfinite(x + y):
        if r.flow_time > _FLOW_SILENCE:
            r.flow_off = r.flow_rejected = r.flow_refused = 0.0
        return
    r.repeats = r.repeats + 1.0 if x == r.reading[0] and y == r.reading[1] else 0.0
    stuck = r.repeats >= _REPEATS
    r.reading[0], r.reading[1] = x, y
    mean, height = _seen_velocity(robot, x, y, r)
    if height < _LEAST_HEIGHT:
        return
    age = max(r.seen[SENSOR.flow_age], 0.0) + 0.5 * robot.period  # of the middle of its interval
    poor = max(robot.flow_quality / max(r.seen[SENSOR.flow_quality], 1e-3), 1.0)
    noise = (height * poor * robot.flow_noise) ** 2
    blur = (poor * robot.flow_speed_noise) ** 2
    off, ahead = 0.0, r.velocity[0] - age * r.kick[0]
    for k in range(2):
        r.flow_variance[k] = noise + blur * mean[k] * mean[k]
        r.flow_error[k] = mean[k] - (r.velocity[k] - age * r.kick[k])
        spread = see_velocity(r.covariance[k], age, ahead, r.column)
        off = max(off, r.flow_error[k] ** 2 / (spread + r.flow_variance[k]))
    r.flow_off = math.sqrt(off)
    if off > FLOW_GATE or stuck:
        r.flow_rejected = 1.0 if off > 1.0 else 0.0
        r.flow_refused = 0.0 if stuck else r.flow_refused + min(r.flow_time, 2.0 * robot.period)
        if r.flow_refused > _FLOW_PATIENCE:
            for k in range(2):
                r.covariance[k, 1, 1] += r.flow_error[k] ** 2
            r.flow_refused = 0.0
    else:
        r.flow_rejected = r.flow_refused = 0.0
        for k in range(2):
            total = see_velocity(r.covariance[k], age, ahead, r.column) + r.flow_variance[k]
            correct(r, k, r.flow_error[k], total)
    r.flow_time = 0.0


@compiled
def _seen_velocity(robot: Any, x: float, y: float, r: Any) -> Any:
    """Return the body origin's velocity along heading and left by a reading, and the lens's distance to the floor."""
    n, lens = r.normal, robot.lens
    floor, rise = _carried(r)
    height = (n[0] * lens[0] + n[1] * lens[1] + n[2] * lens[2] - floor) / n[2]
    c, s = math.cos(r.lens[1]), math.sin(r.lens[1])
    x, y = (1.0 + r.lens[0]) * (c * x - s * y), (1.0 + r.lens[0]) * (s * x + c * y)
    wx, wy, wz = _mean_rate(r, 1.0)
    bx = height * (x + wy) - (wy * lens[2] - wz * lens[1]) - rise * n[0]
    by = height * (y - wx) - (wz * lens[0] - wx * lens[2]) - rise * n[1]
    along = bx / r.heading[0]
    return (along, (by - along * r.heading[1]) / r.left[1]), height


@compiled
def _carried(r: Any) -> Any:
    """Return height (m) and rise (m/s) of the wheels over the floor along its normal, by their loads."""
    floor, carried, rise = 0.0, 1e-12, 0.0
    for i in range(4):
        floor += r.load[i] * r.point[i, 2]
        rise += r.load[i] * r.lift[i]
        carried += r.load[i]
    return floor / carried, rise / carried


# --- the step ---------------------------------------------------------------------------------------------------------


_START_PLACE = 1e-4  # m, 1 sigma at the start


@compiled
def reset(robot: Any, states: Any, mask: Any, sensors: Any, values: Any) -> None:
    """Start masked robots anew, whose states are 0; see :class:`wlr_gym.perception.observer.observer.SlipObserver`."""
    for i in range(mask.shape[0]):
        if mask[i]:
            _start(robot[0], sensors[i], states[i])
            _report(robot[0], states[i], values[i])


@compiled
def update(robot: Any, states: Any, mask: Any, sensors: Any, values: Any, work: Any) -> None:
    """Advance masked robots by one control step."""
    for i in range(mask.shape[0]):
        if mask[i]:
            _advance(robot[0], sensors[i], states[i], work[0])
            _report(robot[0], states[i], values[i])


@compiled
def _start(robot: Any, sensors: Any, r: Any) -> None:
    """Begin level and at rest; what the accelerometer reads along the floor is bias or, where it is much, a slope."""
    r.seen[SENSOR.accelerometer + 2] = robot.gravity
    _take(sensors, r)
    r.frame[:] = math.inf  # as none will be
    r.reading[:] = math.inf
    r.wander[:] = 1.0
    r.normal[2] = 1.0
    r.yaw_covariance[2] = robot.gyro_bias**2
    for k in range(3):
        r.rate[k] = r.last_rate[k] = r.seen[SENSOR.gyro + k]
    r.yaw_rate = r.rate[2]
    look(robot, r.seen, r)
    measure_force(r)
    for k in range(3):
        r.force[k] = r.last_force[k]
    pull(robot, r.seen, r)
    r.traction[:] = 0.0
    carry(robot, r)
    r.guess = math.sqrt(r.force[0] ** 2 + r.force[1] ** 2)
    for k in range(2):
        total = r.force[k]
        bias = total / (1.0 + (total / (3.0 * robot.accel_bias)) ** 4)  # more than that is a slope
        r.leak[k], r.slope[k] = bias, total - bias
        r.covariance[k, 0, 0] = _START_PLACE**2
        r.covariance[k, VELOCITY, VELOCITY] = robot.start_speed**2
        r.covariance[k, LEAK, LEAK] = robot.start_leak**2
        r.covariance[k, LENS, LENS] = (SCALE if k == 0 else ROTATION) ** 2


@compiled
def _take(sensors: Any, r: Any) -> None:
    """Keep what is a number: ``r.seen``."""
    for k in range(sensors.shape[0]):
        if math.isfinite(sensors[k]):
            r.seen[k] = sensors[k]


@compiled
def _advance(robot: Any, sensors: Any, r: Any, work: Any) -> None:
    """Predict with the IMU, then take in wheels, camera and flow."""
    _take(sensors, r)
    r.tick += 1.0
    r.last_rolling[:] = r.rolling
    turn(robot, r)
    look(robot, r.seen, r)
    sense_force(robot, r)
    move(robot, r)
    spread(robot, r)
    pull(robot, r.seen, r)
    settle(robot, r)
    if r.tick == 1.0:
        guess_velocity(r)
    gather(robot, r, work)
    judge(robot, r, work)
    see_rolling(robot, r)
    see_camera(robot, sensors, r)
    see_flow(robot, sensors, r)
    see_rest(robot, r)


@compiled
def _report(robot: Any, r: Any, out: Any) -> None:
    """Write the estimates."""
    h, n, left, rise = r.heading, r.normal, r.left, _carried(r)[1]
    vx, vy = r.velocity[0], r.velocity[1]
    out[ESTIMATE.position], out[ESTIMATE.position + 1] = r.position[0], r.position[1]
    out[ESTIMATE.yaw], out[ESTIMATE.yaw_sigma] = r.yaw, math.sqrt(max(r.yaw_covariance[0], 0.0))
    out[ESTIMATE.linear_velocity_in_body] = vx * h[0] + vy * left[0] + rise * n[0]
    out[ESTIMATE.linear_velocity_in_body + 1] = vy * left[1] + rise * n[1]
    out[ESTIMATE.yaw_rate] = r.yaw_rate
    gx, gy = r.slope[0] / robot.gravity, r.slope[1] / robot.gravity
    gz = math.sqrt(max(0.0, 1.0 - gx * gx - gy * gy))
    for k in range(3):
        out[ESTIMATE.gravity_in_body + k] = -(gx * h[k] + gy * left[k] + gz * n[k])
    vote = (robot.velocity_count * robot.wheel_radius) ** 2 / 6.0
    for k in range(2):
        variance = max(r.covariance[k, VELOCITY, VELOCITY], 0.0)
        out[ESTIMATE.linear_velocity_sigma + k] = math.sqrt(variance)
        for i in range(4):
            own = vote + (RADIUS * r.rolling[i, 0]) ** 2 if k == 0 else (robot.gyro_noise * r.point[i, 0]) ** 2
            out[ESTIMATE.slip_velocity + 2 * i + k] = r.velocity[k] - r.rolling[i, k]
            out[ESTIMATE.slip_sigma + 2 * i + k] = math.sqrt(variance + own)
    for i in range(4):
        out[ESTIMATE.traction_force + i], out[ESTIMATE.normal_force + i] = r.traction[i], r.load[i]
        out[ESTIMATE.traction_use + i] = abs(r.traction[i]) / max(r.load[i], LEAST_LOAD)
    out[ESTIMATE.friction_demand] = r.demand
    out[ESTIMATE.camera_innovation], out[ESTIMATE.camera_rejected] = r.camera_off, r.camera_rejected
    out[ESTIMATE.flow_innovation], out[ESTIMATE.flow_rejected] = r.flow_off, r.flow_rejected
