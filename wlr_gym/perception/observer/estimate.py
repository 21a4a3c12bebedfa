"""One control step of the observer: a small Kalman filter per robot, compiled; every robot on its own.

Frames: *start* (the floor frame as the body stood at the reset: x along its heading), *heading* (turns with the body about the
floor's normal; x along the wheels, y to the left in the floor), *body*. Velocities are estimated in the heading frame, each
direction by a filter of its own (:mod:`wlr_gym.perception.observer.axis`), heading and gyroscope bias by a third.
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from wlr_gym.perception.observer import axis
from wlr_gym.perception.observer.contacts import LEAST_LOAD, carry, look, pull
from wlr_gym.perception.observer.layout import ESTIMATE_LAYOUT
from wlr_gym.physics.plants.base import SENSOR_LAYOUT

# What the filter takes for granted; 1 sigma where it is an uncertainty. Chosen on simulated runs: docs/slip_observer.md.
_START_SPEED = 0.05  # m/s of a robot that has just been put down
_START_LEAK = 0.02  # m/s2 beyond the accelerometer's noise
_START_SLIP = 0.1  # m/s
_ACCEL_WANDER = 0.03  # m/s2 per root second: gravity leaking in as the estimated tilt errs
_ALIAS = 0.25  # share of the change of an IMU reading from tick to tick that one sample per tick misses
_GYRO_WANDER = 1e-5  # rad/s per root second
_QUIET = 0.0005  # m/s: noise of a wheel's rolling speed from tick to tick
_ROLLING = 0.0015  # m/s: its slow error while it does not slip
_RADIUS = 0.005  # relative error of the wheels' radius
_SHARE = 1.0  # how far a slip may change while it lasts, over its size
_LIMIT_SLIP = 0.02  # m/s: slip to be expected when the floor must hold much
_FAST, _SLOW = 10.0, 1.0  # 1/s: how fast slip fades when it is small and the floor holds easily, and when not
_EASY, _HARD = 0.03, 0.10  # friction demand between which slip becomes likely
_AGREE = 0.01  # m/s: slip that certainly is one
_HOLDS = 0.8  # how much more than its load a wheel that grips may hold; twice that, it certainly does not
_SOFT = 0.003  # m/s: slip below which a wheel counts as gripping
_UNEVEN = 0.7  # error of the balance of friction over the spread of the slips
_MEMORY = 0.3  # s over which that error lasts
_GATE = 4.0  # squared normalised innovation beyond which a wheel has slipped
_CAMERA_GATE = 25.0  # squared normalised innovation beyond which a camera frame may be wrong
_PATIENCE = 3  # such frames in a row, then it is the estimate that is
_FRAMES = 8.0  # camera frames over which a lasting disagreement shows
_DOUBT = 1.5  # twice its mean normalised innovation from which on the wheels are doubted
_SETTLE = 1.5  # s: how fast the tilt follows the legs
_SMOOTH = 0.06  # s: low-pass of the friction demand

_VELOCITY, _GYRO, _ACCEL, _CAMERA, _CAMERA_AGE, _CAMERA_IS_NEW = (
    SENSOR_LAYOUT.slices[name].start
    for name in (
        "joint_velocity",
        "gyro",
        "accelerometer",
        "camera_pose",
        "camera_age",
        "camera_is_new",
    )
)
_OUT = {name: columns.start for name, columns in ESTIMATE_LAYOUT.slices.items()}
_O_POSITION, _O_YAW, _O_YAW_SIGMA, _O_VELOCITY, _O_SIGMA = (
    _OUT[name] for name in ("position", "yaw", "yaw_sigma", "linear_velocity_in_body", "linear_velocity_sigma")
)
_O_RATE, _O_GRAVITY, _O_SLIP, _O_SLIP_SIGMA = (
    _OUT[name] for name in ("yaw_rate", "gravity_in_body", "slip_velocity", "slip_sigma")
)
_O_TRACTION, _O_LOAD, _O_USE, _O_DEMAND = (
    _OUT[name] for name in ("traction_force", "normal_force", "traction_use", "friction_demand")
)


@njit(cache=True, nogil=True)
def reset(robot: Any, records: Any, mask: Any, sensors: Any, values: Any) -> None:
    """Start masked robots anew; see :class:`wlr_gym.perception.observer.observer.SlipObserver`."""
    for i in range(mask.shape[0]):
        if mask[i]:
            _start(robot, sensors[i], records[i])
            _report(robot, records[i], values[i])


@njit(cache=True, nogil=True)
def update(robot: Any, records: Any, mask: Any, sensors: Any, values: Any) -> None:
    """Advance masked robots by one control step."""
    for i in range(mask.shape[0]):
        if mask[i]:
            _advance(robot, sensors[i], records[i])
            _report(robot, records[i], values[i])


@njit(cache=True, nogil=True)
def _take(sensors: Any, r: Any) -> None:
    """Keep what is a number: ``r.seen``."""
    for k in range(sensors.shape[0]):
        if math.isfinite(sensors[k]):
            r.seen[k] = sensors[k]


@njit(cache=True, nogil=True)
def _start(robot: Any, sensors: Any, r: Any) -> None:
    """Begin level and at rest; what the accelerometer reads along the floor is bias or, where it is much, a slope."""
    r.seen[:] = 0.0
    r.seen[_ACCEL + 2] = robot.gravity
    _take(sensors, r)
    r.tick = r.yaw = r.gyro_bias = r.demand = r.doubt = r.strange = 0.0
    r.normal[0], r.normal[1], r.normal[2] = 0.0, 0.0, 1.0
    r.raw[:] = 0.0
    r.yaw_covariance[0], r.yaw_covariance[1], r.yaw_covariance[2] = 0.0, 0.0, robot.gyro_bias**2
    for k in range(3):
        r.rate[k] = r.seen[_GYRO + k]
    r.yaw_rate = r.rate[2]
    look(robot, r.seen, r)
    _measure_force(r)
    for k in range(3):
        r.force[k] = r.last_force[k]
    pull(robot, r.seen, r)
    r.traction[:] = 0.0
    carry(robot, r.seen, r)
    r.covariance[:] = 0.0
    for k in range(2):
        total = r.force[k]
        bias = total / (1.0 + (total / (3.0 * robot.accel_bias)) ** 4)  # more than that is a slope
        r.leak[k], r.slope[k] = bias, total - bias
        r.position[k] = r.velocity[k] = r.raw_velocity[k] = r.surprise[k] = 0.0
        r.covariance[k, axis.VELOCITY, axis.VELOCITY] = _START_SPEED**2
        r.covariance[k, axis.LEAK, axis.LEAK] = robot.accel_noise**2 + _START_LEAK**2
        for i in range(4):
            r.slip[k, i] = 0.0
            r.covariance[k, axis.SLIP + i, axis.SLIP + i] = _START_SLIP**2


@njit(cache=True, nogil=True)
def _measure_force(r: Any) -> None:
    """Turn the accelerometer's reading into the heading frame: ``r.last_force``."""
    x, y, z = r.seen[_ACCEL], r.seen[_ACCEL + 1], r.seen[_ACCEL + 2]
    r.last_force[0] = r.heading[0] * x + r.heading[2] * z
    r.last_force[1] = r.left[0] * x + r.left[1] * y + r.left[2] * z
    r.last_force[2] = r.normal[0] * x + r.normal[1] * y + r.normal[2] * z


@njit(cache=True, nogil=True)
def _advance(robot: Any, sensors: Any, r: Any) -> None:
    """Predict with the IMU, then take in wheels and camera."""
    _take(sensors, r)
    r.tick += 1.0
    turned = _turn(robot, r)
    look(robot, r.seen, r)
    change = _sense_force(robot, r)
    _move(robot, turned, r)
    _spread(robot, turned, change, r)
    pull(robot, r.seen, r)
    _settle(robot, r)
    if r.tick == 1.0:
        _guess(r)
    _roll(robot, r)
    _balance(robot, r)
    pose_sum = sensors[_CAMERA] + sensors[_CAMERA + 1] + sensors[_CAMERA + 2]
    if robot.camera > 0.0 and r.seen[_CAMERA_IS_NEW] > 0.5 and math.isfinite(pose_sum):
        _see(robot, r)
    _rest(robot, r)


@njit(cache=True, nogil=True)
def _turn(robot: Any, r: Any) -> float:
    """Turn floor normal and heading with the gyroscope; return the angle turned about the normal."""
    before, dt = r.yaw_rate, robot.period
    wx, wy, wz = r.rate[0], r.rate[1], r.rate[2]
    for k in range(3):
        r.rate[k] = r.seen[_GYRO + k]
    mx, my, mz = (0.5 * dt * (r.rate[0] + wx), 0.5 * dt * (r.rate[1] + wy), 0.5 * dt * (r.rate[2] + wz))
    nx, ny, nz = r.normal[0], r.normal[1], r.normal[2]
    x, y, z = nx - (my * nz - mz * ny), ny - (mz * nx - mx * nz), nz - (mx * ny - my * nx)
    _set_normal(r, x, y, z)
    r.yaw_rate = r.normal[0] * r.rate[0] + r.normal[1] * r.rate[1] + r.normal[2] * r.rate[2] - r.gyro_bias
    turned = dt * ((0.5 - robot.lag) * before + (0.5 + robot.lag) * r.yaw_rate)
    r.yaw += turned
    c = r.yaw_covariance
    missed = _ALIAS * (r.yaw_rate - before)
    c[0] += dt * (dt * c[2] - 2.0 * c[1]) + dt * dt * (robot.gyro_noise**2 + missed * missed)
    c[1] -= dt * c[2]
    c[2] += _GYRO_WANDER**2 * dt
    return turned


@njit(cache=True, nogil=True)
def _set_normal(r: Any, x: float, y: float, z: float) -> None:
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    r.normal[0], r.normal[1], r.normal[2] = x * scale, y * scale, z * scale


@njit(cache=True, nogil=True)
def _sense_force(robot: Any, r: Any) -> float:
    """Mean specific force over the tick; friction demand, and how far all wheels may slip alike, ``r.limit`` 0 to 1.

    Returns:
        How much the specific force changed along the floor, m/s2.
    """
    x, y, z = r.last_force[0], r.last_force[1], r.last_force[2]
    _measure_force(r)
    old, new = 0.5 - robot.lag, 0.5 + robot.lag
    r.force[0] = old * x + new * r.last_force[0]
    r.force[1] = old * y + new * r.last_force[1]
    r.force[2] = old * z + new * r.last_force[2]
    along = math.sqrt((r.force[0] - r.leak[0]) ** 2 + (r.force[1] - r.leak[1]) ** 2)
    demand = along / max(r.force[2], 0.2 * robot.gravity)
    r.demand += (1.0 - math.exp(-robot.period / _SMOOTH)) * (demand - r.demand)
    share = min(1.0, max(0.0, (max(r.demand, demand) - _EASY) / (_HARD - _EASY)))
    r.limit = max(share * share * (3.0 - 2.0 * share), r.doubt)
    return math.sqrt((r.last_force[0] - x) ** 2 + (r.last_force[1] - y) ** 2)


@njit(cache=True, nogil=True)
def _move(robot: Any, turned: float, r: Any) -> None:
    """Carry pose and velocity over the tick."""
    dt = robot.period
    c, s = math.cos(turned), math.sin(turned)
    gx, gy = r.slope[0], r.slope[1]
    r.slope[0], r.slope[1] = c * gx + s * gy, c * gy - s * gx
    ax = r.force[0] - r.leak[0] - 0.5 * (gx + r.slope[0])
    ay = r.force[1] - r.leak[1] - 0.5 * (gy + r.slope[1])
    middle = r.yaw - 0.5 * turned
    cm, sm = math.cos(middle), math.sin(middle)
    vx, vy = r.velocity[0], r.velocity[1]
    # in the frame of the tick's middle: turned by half, kicked, turned by half
    ch, sh = math.cos(0.5 * turned), math.sin(0.5 * turned)
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


@njit(cache=True, nogil=True)
def _spread(robot: Any, turned: float, change: float, r: Any) -> None:
    """Carry the uncertainty over the tick, and let slip fade."""
    dt = robot.period
    split = min(1.0, (r.slope[0] ** 2 + r.slope[1] ** 2) / robot.accel_bias**2)
    common = _LIMIT_SLIP * r.limit
    r.noise[0] = 0.0
    r.noise[1] = dt * dt * (robot.accel_noise**2 + (_ALIAS * change) ** 2)
    # how bias and slope share what the accelerometer read at first is a guess, which shows as the robot turns
    r.noise[2] = _ACCEL_WANDER**2 * dt + (1.4 * robot.accel_bias * turned) ** 2 * (0.3 + 0.7 * split)
    _grip(r)
    for i in range(4):
        size = r.slip[0, i] ** 2 + r.slip[1, i] ** 2 + r.loose * r.mean_square
        r.decay[i] = math.exp(-dt * (_FAST + max(r.limit, r.loose, 1.0 - r.grips[i]) * (_SLOW - _FAST)))
        r.noise[axis.SLIP + i] = (1.0 - r.decay[i] ** 2) * (_ROLLING**2 + common * common + _SHARE**2 * size)
    for k in range(2):
        for i in range(4):
            r.slip[k, i] *= r.decay[i]
        axis.predict(r.covariance[k], dt, r.decay, r.noise)


@njit(cache=True, nogil=True)
def _grip(r: Any) -> None:
    """Judge which wheels grip, ``r.grips`` (4,) 0 to 1, and whether they can: ``r.loose`` 0 to 1, else.

    Wheels that grip must hold against those that slip: |sum of N_j s_j/|s_j|| over these, at most sum N_i over those where all
    are on one floor. Where they would have to hold much more, the robot is on skids with all four.
    """
    held_x, held_y, holds, r.mean_square = 0.0, 0.0, 1e-12, 0.0
    for i in range(4):
        cx, cy = r.slip[0, i], r.slip[1, i]
        square = cx * cx + cy * cy
        r.mean_square += 0.25 * square
        size = math.sqrt(square) + 1e-12
        x = min(1.0, size / _AGREE)
        r.grips[i] = 1.0 - x * x * (3.0 - 2.0 * x)
        holds += r.grips[i] * r.load[i]
        held_x += (1.0 - r.grips[i]) * r.load[i] * cx / size
        held_y += (1.0 - r.grips[i]) * r.load[i] * cy / size
    ratio = math.sqrt(held_x * held_x + held_y * held_y) / holds
    r.loose = min(1.0, max(0.0, (ratio - _HOLDS) / _HOLDS))


@njit(cache=True, nogil=True)
def _settle(robot: Any, r: Any) -> None:
    """Loads of the wheels; let the tilt follow the legs."""
    b, c = carry(robot, r.seen, r)
    share = robot.period / _SETTLE
    b, c = share * b, share * c
    _set_normal(
        r,
        r.normal[0] - b * r.heading[0] - c * r.left[0],
        r.normal[1] - c * r.left[1],
        r.normal[2] - b * r.heading[2] - c * r.left[2],
    )


@njit(cache=True, nogil=True)
def _guess(r: Any) -> None:
    """Begin with the geometric median of the wheels' rolling velocities: some spin while a robot is put down."""
    for _ in range(8):
        total, x, y = 1e-12, 0.0, 0.0
        for i in range(4):
            dx, dy = r.rolling[i, 0] - r.velocity[0], r.rolling[i, 1] - r.velocity[1]
            weight = 1.0 / math.sqrt(dx * dx + dy * dy + _SOFT**2)
            total += weight
            x += weight * r.rolling[i, 0]
            y += weight * r.rolling[i, 1]
        r.velocity[0], r.velocity[1] = x / total, y / total


@njit(cache=True, nogil=True)
def _roll(robot: Any, r: Any) -> None:
    """Take in how the wheels roll: wheel ``i`` rolls at v + c_i."""
    for k in range(2):
        p = r.covariance[k]
        for i in range(4):  # one that jumps away from what the IMU tells has slipped
            innovation = r.rolling[i, k] - r.velocity[k] - r.slip[k, i]
            noise = _QUIET**2 + (_RADIUS * r.rolling[i, k]) ** 2
            excess = innovation * innovation - _GATE * (axis.see_wheel(p, i, r.column) + noise)
            if excess > 0.0:
                p[axis.SLIP + i, axis.SLIP + i] += excess
        for i in range(4):
            total = axis.see_wheel(p, i, r.column) + _QUIET**2 + (_RADIUS * r.rolling[i, k]) ** 2
            _correct(r, k, r.rolling[i, k] - r.velocity[k] - r.slip[k, i], total)


@njit(cache=True, nogil=True)
def _balance(robot: Any, r: Any) -> None:
    """Take in that the floor's friction on the wheels nearly cancels out where it must hold little.

    Coulomb friction of wheels under loads N_i that slip by s_i on an even floor balances where sum N_i s_i/|s_i| = 0: at the
    weighted geometric median of the wheels' rolling velocities. One step of Weiszfeld's iteration for it is the measurement
    sum w_i c_i = 0, w_i ~ N_i/|s_i|: wheels that grip decide, and wheels that slip must slip against each other. How uneven the
    floor is, is not known: the more the wheels differ, the less this says.
    """
    common = _LIMIT_SLIP * r.limit
    total = 1e-12
    for i in range(4):
        r.weight[i] = r.load[i] / math.sqrt(r.slip[0, i] ** 2 + r.slip[1, i] ** 2 + _SOFT**2 + 0.1 * r.loose * r.mean_square)
        total += r.weight[i]
    for k in range(2):
        mean, spread = 0.0, 0.0
        for i in range(4):
            mean += r.weight[i] / total * r.slip[k, i]
        for i in range(4):
            spread += r.weight[i] / total * (r.slip[k, i] - mean) ** 2
        for i in range(4):
            r.share[i] = r.weight[i] / total
        together = r.limit * r.limit * mean
        variance = (_ROLLING**2 + common**2 + together**2 + _UNEVEN**2 * spread) * _MEMORY / robot.period
        _correct(r, k, -mean, axis.see_balance(r.covariance[k], r.share, r.column) + variance)


@njit(cache=True, nogil=True)
def _correct(r: Any, k: int, innovation: float, total: float) -> None:
    """Correct direction ``k`` by the measurement whose P h' is in ``r.column``."""
    r.change[:] = 0.0
    axis.correct(r.covariance[k], r.column, innovation, total, r.change)
    c, s = math.cos(r.yaw), math.sin(r.yaw)
    r.position[0] += (c if k == 0 else -s) * r.change[0]
    r.position[1] += (s if k == 0 else c) * r.change[0]
    r.velocity[k] += r.change[axis.VELOCITY]
    r.leak[k] += r.change[axis.LEAK]
    for i in range(4):
        r.slip[k, i] += r.change[axis.SLIP + i]


@njit(cache=True, nogil=True)
def _see(robot: Any, r: Any) -> None:
    """Take in a camera pose: it shows where the robot was ``camera_age`` ago."""
    age = min(max(r.seen[_CAMERA_AGE], 0.0), r.tick * robot.period, (r.raw.shape[0] - 2) * robot.period)
    length = r.raw.shape[0]
    back = r.tick - age / robot.period
    whole = math.floor(back)
    part = back - whole
    now, a = int(r.tick) % length, int(whole) % length
    b = (a + 1) % length if part > 0.0 else a
    c, s = math.cos(r.yaw), math.sin(r.yaw)
    # what the corrections since then have added to the velocity
    ex = c * r.velocity[0] - s * r.velocity[1] - r.raw_velocity[0]
    ey = s * r.velocity[0] + c * r.velocity[1] - r.raw_velocity[1]
    x = r.position[0] - (r.raw[now, 0] - r.raw[a, 0] - part * (r.raw[b, 0] - r.raw[a, 0])) - ex * age
    y = r.position[1] - (r.raw[now, 1] - r.raw[a, 1] - part * (r.raw[b, 1] - r.raw[a, 1])) - ey * age
    yaw = r.yaw - (r.raw[now, 2] - r.raw[a, 2] - part * (r.raw[b, 2] - r.raw[a, 2]))
    dx, dy = r.seen[_CAMERA] - x, r.seen[_CAMERA + 1] - y
    strange = False
    for k in range(2):
        innovation = c * dx + s * dy if k == 0 else c * dy - s * dx
        total = axis.see_position(r.covariance[k], age, r.column) + robot.camera_noise**2
        least = innovation * innovation / _CAMERA_GATE
        strange = strange or least > total
        r.surprise[k] += (innovation / math.sqrt(max(total, least)) - r.surprise[k]) / _FRAMES
        _correct(r, k, innovation, total if r.strange >= _PATIENCE else max(total, least))
    yaw_error = r.seen[_CAMERA + 2] - yaw
    p = r.yaw_covariance
    total = p[0] + 2.0 * age * p[1] + age * age * p[2] + robot.camera_yaw_noise**2
    least = yaw_error * yaw_error / _CAMERA_GATE
    _correct_yaw(r, 1.0, age, yaw_error, total if r.strange >= _PATIENCE else max(total, least))
    r.doubt = min(1.0, max(0.0, 2.0 * max(abs(r.surprise[0]), abs(r.surprise[1])) - _DOUBT))
    r.strange = r.strange + 1.0 if strange or least > total else 0.0


@njit(cache=True, nogil=True)
def _correct_yaw(r: Any, of_yaw: float, of_bias: float, innovation: float, total: float) -> None:
    """Correct yaw and gyroscope bias by a measurement of of_yaw yaw + of_bias bias; ``total``: the innovation's variance."""
    p = r.yaw_covariance
    yaw, bias = of_yaw * p[0] + of_bias * p[1], of_yaw * p[1] + of_bias * p[2]
    r.yaw += yaw / total * innovation
    r.gyro_bias += bias / total * innovation
    p[0] -= yaw * yaw / total
    p[1] -= yaw * bias / total
    p[2] -= bias * bias / total


@njit(cache=True, nogil=True)
def _rest(robot: Any, r: Any) -> None:
    """While every joint rests, the gyroscope reads its bias."""
    for k in range(8):
        if abs(r.seen[_VELOCITY + k]) > 0.5 * robot.velocity_count:
            return
    total = r.yaw_covariance[2] + robot.gyro_noise**2
    if r.yaw_rate * r.yaw_rate < 16.0 * total:
        _correct_yaw(r, 0.0, 1.0, r.yaw_rate, total)


@njit(cache=True, nogil=True)
def _report(robot: Any, r: Any, out: Any) -> None:
    """Write the estimates."""
    h, n, left = r.heading, r.normal, r.left
    rise, carried = 0.0, 1e-12
    for i in range(4):
        rise += r.load[i] * r.lift[i]
        carried += r.load[i]
    rise /= carried
    vx, vy = r.velocity[0], r.velocity[1]
    out[_O_POSITION], out[_O_POSITION + 1] = r.position[0], r.position[1]
    out[_O_YAW], out[_O_YAW_SIGMA] = r.yaw, math.sqrt(max(r.yaw_covariance[0], 0.0))
    out[_O_VELOCITY] = vx * h[0] + vy * left[0] + rise * n[0]
    out[_O_VELOCITY + 1] = vy * left[1] + rise * n[1]
    out[_O_RATE] = r.yaw_rate
    gx, gy = r.slope[0] / robot.gravity, r.slope[1] / robot.gravity
    gz = math.sqrt(max(0.0, 1.0 - gx * gx - gy * gy))
    for k in range(3):
        out[_O_GRAVITY + k] = -(gx * h[k] + gy * left[k] + gz * n[k])
    vote = (robot.velocity_count * robot.wheel_radius) ** 2 / 6.0
    for k in range(2):
        variance = max(r.covariance[k, axis.VELOCITY, axis.VELOCITY], 0.0)
        out[_O_SIGMA + k] = math.sqrt(variance)
        for i in range(4):
            own = vote + (_RADIUS * r.rolling[i, 0]) ** 2 if k == 0 else (robot.gyro_noise * r.point[i, 0]) ** 2
            out[_O_SLIP + 2 * i + k] = r.velocity[k] - r.rolling[i, k]
            out[_O_SLIP_SIGMA + 2 * i + k] = math.sqrt(variance + own)
    for i in range(4):
        out[_O_TRACTION + i], out[_O_LOAD + i] = r.traction[i], r.load[i]
        out[_O_USE + i] = abs(r.traction[i]) / max(r.load[i], LEAST_LOAD)
    out[_O_DEMAND] = r.demand
