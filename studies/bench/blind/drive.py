"""One run of the robot, in one compiled loop: MuJoCo's C functions give inertia and Coriolis forces, everything else is here.

Servos, friction and contacts are forces. Whatever resists motion is a damper whose coefficient is its bound over the speed, but
never over less than the copy's ``floor_creep`` or ``gear_creep``: dry friction that creeps a little instead of sticking. All
dampers and the floor's springs act implicitly: each step solves (M + h sum c J'J) v = M v_old + h f for the new velocities,
again with new coefficients until they agree. No complementarity, no impulses, half a millisecond per step.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numba
import numpy as np
import pandas as pd
from llvmlite.binding import load_library_permanently
from numba import types
from numpy.typing import NDArray

from studies.bench.blind.cases import Hidden
from studies.bench.blind.copies import CORNERS, JOINTS, LEGS, WHEELS, Copy

#: s.
STEP = 5e-4
#: Records are this far apart, s.
SAMPLE = 1e-3
#: Standing still before the first row, s.
SETTLE = 1.5
#: Corner frequency of the IMU, Hz.
BANDWIDTH = 44.0
#: Of the tyres, N s/m.
NORMAL_DAMPING = 60.0
#: Of bristles on the floor, N s/m.
BRISTLE_DAMPING = 4.0
#: Solutions of the velocity equation per step, at most.
SOLUTIONS = 12
#: Agreement of two solutions that is enough, m/s and rad/s.
AGREED = 1e-7
#: Columns of a record: position 0:3, quaternion 3:7, joint angles 7:15, rates 15:23, currents 23:31, gyroscope 31:34,
#: accelerometer 34:37, supply 37, normal forces 38:42, slip speeds 42:46.
WIDTH = 46


def _load_mujoco() -> None:
    """Let compiled code see MuJoCo's C functions by their names (so that it can be kept on disk, too)."""
    folder = Path(mujoco.__file__).parent
    names = ("*mujoco*.so*", "*mujoco*.dylib", "*mujoco*.dll")
    library = next(path for name in names for path in sorted(folder.glob(name)) if "cpython" not in path.name)
    load_library_permanently(str(library))


def _function(name: str, *extra: Any) -> Any:
    """A C function of a model and its data, given as addresses."""
    return types.ExternalFunction(name, types.void(types.intp, types.intp, *extra))


_load_mujoco()
_kinematics = _function("mj_kinematics")
_com_position = _function("mj_comPos")
_mass_matrix = _function("mj_makeM")
_full_mass_matrix = _function("mj_fullM", types.intp)
_com_velocity = _function("mj_comVel")
_bias_force = _function("mj_rne", types.int32, types.intp)
_integrate = types.ExternalFunction("mj_integratePos", types.void(types.intp, types.intp, types.intp, types.float64))


_jit = numba.njit(nogil=True, cache=True, error_model="numpy")


@_jit
def _leg_reference(reference, rate, goal, limit, acceleration):
    """Advance a position profile by one step; returns reference and its rate."""
    left = goal - reference
    if limit == 0.0:
        return goal, 0.0
    if acceleration == 0.0:
        move = min(max(left, -limit * STEP), limit * STEP)
        return reference + move, move / STEP
    room = acceleration * STEP
    wish = min(limit, np.sqrt(2.0 * acceleration * abs(left)))
    if left < 0.0:
        wish = -wish
    rate = min(max(wish, rate - room), rate + room)
    if abs(left) <= abs(rate) * STEP and abs(rate) <= 2.0 * room:
        return goal, 0.0
    return reference + rate * STEP, rate


@_jit
def _rotation(q, matrix):
    w, x, y, z = q[0], q[1], q[2], q[3]
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@_jit
def _solve(matrix, vector):
    """Solve a symmetric positive definite system in place by Cholesky's method; the answer is left in ``vector``."""
    size = vector.shape[0]
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = np.sqrt(total) if i == j else total / matrix[j, j]
    for i in range(size):
        total = vector[i]
        for k in range(i):
            total -= matrix[i, k] * vector[k]
        vector[i] = total / matrix[i, i]
    for i in range(size - 1, -1, -1):
        total = vector[i]
        for k in range(i + 1, size):
            total -= matrix[k, i] * vector[k]
        vector[i] = total / matrix[i, i]


@_jit
def _contact(w, place, turn, hip_x, hip_y, length, radius, flat_tyre, waves, steep, cos, sin, rows, columns, dofs):
    """Find the lowest point of a wheel's disc.

    Writes the rows that give its velocity upwards, and along the heading and the axle that of a point above it: ``flat_tyre``
    is a share and a depth, and a tyre rolls on its radius less that share of what it is deeper. They are over the columns (8)
    of the generalised velocities that move it. Directions follow the share ``steep`` of the floor's own slope there. Returns
    how deep the lowest point is in the floor, its x and its y.
    """
    side_x, side_y, side_z = turn[0, 1], turn[1, 1], turn[2, 1]
    flat = np.sqrt(side_x * side_x + side_y * side_y)
    # from the hub down, in the plane of the disc
    down_x, down_y, down_z = side_z * side_x / flat, side_z * side_y / flat, -flat
    hub_x, hub_z = hip_x + length * cos, -length * sin
    arm_x = radius * (turn[0, 0] * down_x + turn[1, 0] * down_y + turn[2, 0] * down_z)
    arm_y = radius * (turn[0, 1] * down_x + turn[1, 1] * down_y + turn[2, 1] * down_z)
    arm_z = radius * (turn[0, 2] * down_x + turn[1, 2] * down_y + turn[2, 2] * down_z)
    x, y, z = hub_x + arm_x, hip_y + arm_y, hub_z + arm_z
    height = place[2] + turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z
    at_x = place[0] + turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
    at_y = place[1] + turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
    share = flat_tyre[0] * (max(-height, 0.0) - flat_tyre[1]) / radius
    depth, slope_x, slope_y = -height, 0.0, 0.0
    for k in range(waves.shape[0]):
        angle = waves[k, 1] * at_x + waves[k, 2] * at_y + waves[k, 3]
        depth += waves[k, 0] * np.sin(angle)
        slope_x += steep * waves[k, 0] * waves[k, 1] * np.cos(angle)
        slope_y += steep * waves[k, 0] * waves[k, 2] * np.cos(angle)
    head_x, head_y = side_y / flat, -side_x / flat
    ahead, aside = head_x * slope_x + head_y * slope_y, head_x * slope_y - head_y * slope_x
    directions = ((head_x, head_y, ahead), (-head_y, head_x, aside), (-slope_x, -slope_y, 1.0))
    for d in range(3):
        e = directions[d]
        arm = 1.0 if d == 2 else 1.0 - share
        x, y, z = hub_x + arm * arm_x, hip_y + arm * arm_y, hub_z + arm * arm_z
        bx = turn[0, 0] * e[0] + turn[1, 0] * e[1] + turn[2, 0] * e[2]
        by = turn[0, 1] * e[0] + turn[1, 1] * e[1] + turn[2, 1] * e[2]
        bz = turn[0, 2] * e[0] + turn[1, 2] * e[1] + turn[2, 2] * e[2]
        row = rows[3 * w + d]
        row[0], row[1], row[2] = e[0], e[1], e[2]
        row[3], row[4], row[5] = y * bz - z * by, z * bx - x * bz, x * by - y * bx
        row[6] = (z * bx) - (x - hip_x) * bz
        row[7] = arm * (arm_z * bx - arm_x * bz)
    for k in range(6):
        columns[w, k] = k
    columns[w, 6], columns[w, 7] = dofs[w], dofs[4 + w]
    return depth, at_x, at_y


@_jit
def _along(row, columns, velocity):
    total = 0.0
    for k in range(8):
        total += row[k] * velocity[columns[k]]
    return total


@_jit
def _add_damper(matrix, row, columns, coefficient):
    for i in range(8):
        scaled = coefficient * row[i]
        for k in range(8):
            matrix[columns[i], columns[k]] += scaled * row[k]


@_jit
def drive(model, data, qpos, qvel, addresses, tables, times, setpoints, records):
    position, rate, motor_rate, motor_position = addresses
    joints, corners, general, waves = tables
    kp, kd, constant, resistance, coulomb, viscous = joints[0], joints[1], joints[2], joints[3], joints[4], joints[5]
    stick_extra, stick_speed, load_ratio, motor_scale = joints[6], joints[7], joints[8], joints[9]
    amplitude, order, phase, delay, zero, play = joints[10], joints[11], joints[12], joints[13], joints[14], joints[15]
    tooth_stiffness, tooth_damping = joints[16], joints[17]
    hip_x, hip_y, radius, wheel_mu, creep, rolling = corners[0], corners[1], corners[2], corners[3], corners[4], corners[5]
    out_of_round, spring, rest, dahl_torque, dahl_stiffness = corners[6], corners[7], corners[8], corners[9], corners[10]
    cross, give, bristle_length = corners[11], corners[12], corners[13]
    length, full_supply, supply_resistance = general[0], general[1], general[2]
    wheel_acceleration, leg_velocity, leg_acceleration = general[3], general[4], general[5]
    force_x, force_y, tether, anchor_x, anchor_y = general[6], general[7], general[8], general[9], general[10]
    drag, veer, pull, pull_frequency, pull_phase = general[11], general[12], general[13], general[14], general[15]
    patch, mu_ratio, mu_k, weak_speed = general[16:21], general[21], general[22], general[23]
    gravity, stiffness = general[24:27], general[27]
    floor_creep, gear_creep, flat_tyre = general[28], general[29], general[30:32]
    rest_load, steep = general[32], general[33]
    filter_share = 1.0 - np.exp(-2.0 * np.pi * BANDWIDTH * STEP)

    size = qvel.shape[0]
    reference, reference_rate = np.zeros(8), np.zeros(8)
    current, torque, dahl, dry = np.zeros(8), np.zeros(8), np.zeros(4), np.zeros(8)
    goal, next_row = setpoints[0].copy(), np.zeros(8, dtype=np.int64)
    gyro, accel, turn = np.zeros(3), np.zeros(3), np.zeros((3, 3))
    normal, slip, before = np.zeros(4), np.zeros(4), np.zeros(size)
    mass, fixed, matrix = np.zeros((size, size)), np.zeros((size, size)), np.zeros((size, size))
    bias, force, right, base = np.zeros(size), np.zeros(size), np.zeros(size), np.zeros(size)
    rows, columns, depth = np.zeros((12, 8)), np.zeros((4, 8), dtype=np.int64), np.zeros(4)
    mu_x, pressed = np.zeros(4), np.zeros(4, dtype=np.bool_)
    bent, stays, bend, hold = np.zeros((4, 2)), np.zeros(4), np.zeros(4), np.zeros(4)
    slow = np.full(4, floor_creep)
    slow_gear, slow_roll = np.full(8, gear_creep), np.full(4, gear_creep)
    for j in range(4):
        reference[j] = qpos[position[j]] + zero[j]
    drawn, supply = 0.0, full_supply
    accel[2] = -gravity[2]
    per_sample = round(SAMPLE / STEP)
    for n in range(-round(SETTLE / STEP), (records.shape[0] - 1) * per_sample + 1):
        now = n * STEP
        if n >= 0 and n % per_sample == 0:
            row = records[n // per_sample]
            row[0:7] = qpos[0:7]
            for j in range(8):
                row[7 + j], row[15 + j], row[23 + j] = qpos[position[j]], qvel[rate[j]], current[j]
            row[31:34], row[34:37], row[37] = gyro, accel, supply
            row[38:42], row[42:46] = normal, slip
        _kinematics(model, data)
        _com_position(model, data)
        _mass_matrix(model, data)
        _full_mass_matrix(model, data, mass.ctypes.data)
        _com_velocity(model, data)
        _bias_force(model, data, 0, bias.ctypes.data)
        fixed[:, :] = mass
        force[:] = 0.0
        # --- servos and gears
        supply = full_supply - supply_resistance * drawn
        for j in range(8):
            while next_row[j] < times.shape[0] and times[next_row[j]] + delay[j] <= now:
                goal[j] = setpoints[next_row[j], j]
                next_row[j] += 1
            joint, motor = rate[j], motor_rate[j]
            angle, speed, motor_speed = qpos[position[j]], qvel[joint], qvel[motor]
            gain = motor_scale[j] * constant[j] / resistance[j]
            reading = angle + zero[j]
            if np.isnan(goal[j]):
                current[j], torque[j] = 0.0, 0.0
                reference[j], reference_rate[j] = reading, speed
                fixed[motor, motor] += STEP * viscous[j]
            else:
                if j < 4:
                    reference[j], reference_rate[j] = _leg_reference(
                        reference[j], reference_rate[j], goal[j], leg_velocity, leg_acceleration
                    )
                else:
                    change = goal[j] - reference_rate[j]
                    if wheel_acceleration > 0.0:
                        change = min(max(change, -wheel_acceleration * STEP), wheel_acceleration * STEP)
                    reference_rate[j] += change
                    reach = supply / kp[j]
                    reference[j] = min(max(reference[j], reading - reach), reading + reach)
                    reference[j] += STEP * (reference_rate[j] - 0.5 * change)
                wish = kp[j] * (reference[j] - reading) + kd[j] * (reference_rate[j] - speed)
                volts = min(max(wish, -supply), supply)
                back = constant[j]
                if volts == wish and play[j] == 0.0:
                    back += kd[j]
                fixed[motor, motor] += STEP * (gain * back + viscous[j])
                force[motor] += gain * (volts + (back - constant[j]) * motor_speed)
                current[j] = (volts - constant[j] * motor_speed) / resistance[j]
                torque[j] = motor_scale[j] * constant[j] * current[j]
            force[motor] += amplitude[j] * np.sin(order[j] * angle + phase[j])
            dry[j] = coulomb[j] + load_ratio[j] * abs(torque[j])
            if stick_extra[j] != 0.0:
                dry[j] += stick_extra[j] * np.exp(-((motor_speed / stick_speed[j]) ** 2))
            if play[j] > 0.0:
                lead = qpos[motor_position[j]] - angle
                overlap = lead - 0.5 * play[j] if lead > 0.0 else lead + 0.5 * play[j]
                if abs(lead) > 0.5 * play[j] and (
                    tooth_stiffness[j] * abs(overlap) + tooth_damping[j] * (motor_speed - speed) * np.sign(lead) > 0.0
                ):
                    grip = tooth_damping[j] + STEP * tooth_stiffness[j]
                    force[motor] -= tooth_stiffness[j] * overlap
                    force[joint] += tooth_stiffness[j] * overlap
                    fixed[motor, motor] += STEP * grip
                    fixed[joint, joint] += STEP * grip
                    fixed[motor, joint] -= STEP * grip
                    fixed[joint, motor] -= STEP * grip
            if j < 4:
                force[joint] -= spring[j] * (angle - rest[j])
                if dahl_torque[j] > 0.0:
                    move = speed * STEP
                    dahl[j] += dahl_stiffness[j] * (move - abs(move) * dahl[j] / dahl_torque[j])
                    force[joint] -= dahl[j]
        total = 0.0
        for j in range(8):
            total += abs(current[j])
            if j >= 4:
                dry[j] += cross[j - 4] * abs(torque[4 + ((j - 4) ^ 1)])
        drawn += 0.3 * (total - drawn)
        # --- forces on the body
        _rotation(qpos[3:7], turn)
        ahead = turn[0, 0] * qvel[0] + turn[1, 0] * qvel[1] + turn[2, 0] * qvel[2]
        force[0] += force_x - tether * (qpos[0] - anchor_x) + pull * np.sin(2 * np.pi * pull_frequency * now + pull_phase)
        force[1] += force_y - tether * (qpos[1] - anchor_y)
        for k in range(3):
            force[k] += -turn[k, 0] * drag * ahead * abs(ahead) + turn[k, 1] * veer * ahead
        # --- contacts
        for w in range(4):
            angle, spin_angle = qpos[position[w]], qpos[position[4 + w]]
            depth[w], at_x, at_y = _contact(
                w, qpos, turn, hip_x[w], hip_y[w], length, radius[w] * (1.0 + out_of_round[w] * np.sin(spin_angle)),
                flat_tyre, waves, steep, np.cos(angle), np.sin(angle), rows, columns, rate,
            )  # fmt: skip
            pressed[w] = depth[w] > 0.0
            mu_x[w] = wheel_mu[w]
            inside = patch[1] < at_x and at_x < patch[2] and patch[3] < at_y and at_y < patch[4]
            if inside and not np.isnan(patch[0]):
                mu_x[w] = patch[0]
            slip[w] = np.hypot(_along(rows[3 * w], columns[w], qvel), _along(rows[3 * w + 1], columns[w], qvel))
            if mu_x[w] > mu_k:
                mu_x[w] = mu_k + (mu_x[w] - mu_k) * np.exp(-slip[w] / weak_speed)
        # --- new velocities
        for i in range(size):
            base[i] = STEP * (force[i] - bias[i])
            for k in range(size):
                base[i] += mass[i, k] * qvel[k]
        before[:] = qvel
        for _ in range(SOLUTIONS):
            matrix[:, :] = fixed
            right[:] = base
            for j in range(8):
                matrix[motor_rate[j], motor_rate[j]] += STEP * dry[j] / slow_gear[j]
            for w in range(4):
                if not pressed[w]:
                    continue
                lift, wheel = rows[3 * w + 2], rate[4 + w]
                grip = NORMAL_DAMPING + STEP * stiffness
                _add_damper(matrix, lift, columns[w], STEP * grip)
                for k in range(8):
                    right[columns[w, k]] += STEP * stiffness * depth[w] * lift[k]
                mu_y = mu_x[w] * mu_ratio
                if give[w] > 0.0:
                    # bristles relax over their way and are bent by the slip, exactly within the step
                    own = bristle_length[w] * np.sqrt(max(normal[w], 0.01 * rest_load) / rest_load)
                    bristles = normal[w] / (give[w] * own)
                    gone = STEP * abs(radius[w] * (qvel[wheel] + qvel[rate[w]] + qvel[4])) / own
                    stays[w] = np.exp(-gone)
                    bend[w] = STEP * (-np.expm1(-gone) / gone if gone > 1e-9 else 1.0)
                    total = 0.0
                    for axis, mu in ((0, mu_x[w]), (1, mu_y)):
                        speed = _along(rows[3 * w + axis], columns[w], qvel)
                        pull_back = bristles * (stays[w] * bent[w, axis] + bend[w] * speed) + BRISTLE_DAMPING * speed
                        total += (pull_back / max(mu * normal[w], 1e-9)) ** 2
                    hold[w] = 1.0 / max(np.sqrt(total), 1.0)
                    for axis in range(2):
                        row = rows[3 * w + axis]
                        _add_damper(matrix, row, columns[w], STEP * hold[w] * (bristles * bend[w] + BRISTLE_DAMPING))
                        for k in range(8):
                            right[columns[w, k]] -= STEP * hold[w] * bristles * stays[w] * bent[w, axis] * row[k]
                elif creep[w] > 0.0:
                    share = max(slip[w], 1e-9)
                    factor = np.tanh(share / creep[w]) / share
                    _add_damper(matrix, rows[3 * w], columns[w], STEP * normal[w] * mu_x[w] * factor)
                    _add_damper(matrix, rows[3 * w + 1], columns[w], STEP * normal[w] * mu_y * factor)
                else:
                    _add_damper(matrix, rows[3 * w], columns[w], STEP * normal[w] * mu_x[w] * mu_x[w] / slow[w])
                    _add_damper(matrix, rows[3 * w + 1], columns[w], STEP * normal[w] * mu_y * mu_y / slow[w])
                if rolling[w] > 0.0:
                    resist = STEP * rolling[w] * normal[w] * radius[w] / slow_roll[w]
                    leg = rate[w]
                    for one in (4, leg, wheel):
                        for other in (4, leg, wheel):
                            matrix[one, other] += resist
            _solve(matrix, right)
            change = 0.0
            for i in range(size):
                change = max(change, abs(right[i] - qvel[i]))
                qvel[i] = right[i]
            for j in range(8):
                slow_gear[j] = max(abs(qvel[motor_rate[j]]), gear_creep)
            for w in range(4):
                ahead, aside = _along(rows[3 * w], columns[w], qvel), _along(rows[3 * w + 1], columns[w], qvel)
                up = _along(rows[3 * w + 2], columns[w], qvel)
                slow[w] = max(np.hypot(mu_x[w] * ahead, mu_x[w] * mu_ratio * aside), mu_x[w] * floor_creep)
                slip[w] = np.hypot(ahead, aside)
                slow_roll[w] = max(abs(qvel[rate[4 + w]] + qvel[rate[w]] + qvel[4]), gear_creep)
                normal[w] = 0.0
                if depth[w] > 0.0:
                    normal[w] = max(stiffness * depth[w] - (NORMAL_DAMPING + STEP * stiffness) * up, 0.0)
                pressed[w] = normal[w] > 0.0
            if change < AGREED:
                break
        for w in range(4):
            for axis in range(2):
                speed = _along(rows[3 * w + axis], columns[w], qvel)
                bent[w, axis] = hold[w] * (stays[w] * bent[w, axis] + bend[w] * speed) if pressed[w] else 0.0
        _integrate(model, qpos.ctypes.data, qvel.ctypes.data, STEP)
        # --- inertial sensors at the body's origin
        for k in range(3):
            gyro[k] += filter_share * (qvel[3 + k] - gyro[k])
            felt = 0.0
            for i in range(3):
                felt += turn[i, k] * ((qvel[i] - before[i]) / STEP - gravity[i])
            accel[k] += filter_share * (felt - accel[k])


# ---- what the logger would have written ------------------------------------------------------------------------------


Array = NDArray[np.float64]
JITTER = 1e-3  # s, of a tick and of a camera frame's age
LOST = 1 / 300  # share of ticks
#: One count of the current register, A.
CURRENT_COUNT = 2.69e-3
#: One count of the load register, share of the stall torque.
LOAD_COUNT = 1e-3
#: One count of the voltage register, V.
VOLT_COUNT = 0.1


def ticks(duration: float, rate: float, rng: np.random.Generator) -> Array:
    """Return the host clock at every tick that is not lost, s."""
    nominal = np.arange(1, int(duration * rate)) / rate
    kept = nominal[rng.random(len(nominal)) >= LOST]
    times = kept - 1 / rate + 0.005 + JITTER * np.clip(rng.standard_normal(len(kept)), -4, 4)
    return np.maximum(times, 1e-4)


def log(
    records: Array, times: Array, setpoints: Array, copy: Copy, hidden: Hidden, robot: dict[str, Any], rng: np.random.Generator
) -> pd.DataFrame:
    """Turn the records of a simulated run into the table of a measured one.

    Args:
        records: as of ``simulation.simulate``.
        times: (n,) host clock of the rows, s.
        setpoints: (n, 8) written in these rows.
    """
    sensors = robot["sensors"]
    now = _at(records, times)
    table: dict[str, Array] = {"t": times}
    table |= {f"cmd_{joint}": setpoints[:, j] for j, joint in enumerate(JOINTS)}
    table |= _encoders(now, records[0], copy, hidden, sensors)
    table |= _efforts(now, copy, robot, rng)
    table |= _inertial(now, copy, hidden, sensors["imu"], rng)
    table |= _camera(records, times, copy, hidden, sensors["camera"], rng)
    volts = now[:, 37] + sensors["volt_noise"] * rng.standard_normal(len(times))
    table["volt"] = _count(volts, VOLT_COUNT)
    return pd.DataFrame(table)


def _at(records: Array, times: Array) -> Array:
    """Interpolate the records at times, holding the ends."""
    place = np.clip(times / SAMPLE, 0, len(records) - 1.000001)
    low = place.astype(int)
    share = (place - low)[:, None]
    return (1 - share) * records[low] + share * records[low + 1]


def _count(values: Array, size: float) -> Array:
    return np.rint(values / size) * size


def _encoders(now: Array, first: Array, copy: Copy, hidden: Hidden, sensors: dict[str, Any]) -> dict[str, Array]:
    count = sensors["encoder"]
    table = {}
    for j, joint in enumerate(JOINTS):
        zero = copy.joint_zero[j] + hidden.zero[j] if j < 4 else -first[7 + j]
        table[f"pos_{joint}"] = _count(now[:, 7 + j] + zero, count["position"])
    return table | {f"vel_{joint}": _count(now[:, 15 + j], count["velocity"]) for j, joint in enumerate(JOINTS)}


def _efforts(now: Array, copy: Copy, robot: dict[str, Any], rng: np.random.Generator) -> dict[str, Array]:
    noise, table = robot["sensors"]["effort"], {}
    for j, joint in enumerate(JOINTS):
        constant = copy.nominal_torque_constant[j]
        sigma = noise["leg_noise"] if j < 4 else noise["wheel_noise"]
        size = CURRENT_COUNT * constant if j < 4 else LOAD_COUNT * robot["servo"]["wheel"]["stall_torque"]
        effort = now[:, 23 + j] * constant + sigma * rng.standard_normal(len(now))
        table[f"eff_{joint}"] = _count(effort, size)
    return table


def _inertial(now: Array, copy: Copy, hidden: Hidden, imu: dict[str, float], rng: np.random.Generator) -> dict[str, Array]:
    turn = _mounting(*hidden.imu)
    gyro = now[:, 31:34] @ turn + copy.gyro_bias + hidden.gyro_bias
    accel = now[:, 34:37] @ turn + copy.accel_bias
    gyro += imu["gyro_noise"] * rng.standard_normal(gyro.shape)
    accel += imu["accel_noise"] * rng.standard_normal(accel.shape)
    return {f"gyro_{axis}": gyro[:, k] for k, axis in enumerate("xyz")} | {
        f"acc_{axis}": accel[:, k] for k, axis in enumerate("xyz")
    }


def _mounting(roll: float, pitch: float, yaw: float) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll): from sensor to body. A row vector times it is its transpose times a column."""
    (cr, sr), (cp, sp), (cy, sy) = [(np.cos(angle), np.sin(angle)) for angle in (roll, pitch, yaw)]
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def _heading(records: Array) -> Array:
    w, x, y, z = records[:, 3:7].T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _nose_down(records: Array) -> Array:
    w, x, y, z = records[:, 3:7].T
    return np.arcsin(np.clip(2 * (w * y - x * z), -1, 1))


def _camera(
    records: Array, times: Array, copy: Copy, hidden: Hidden, camera: dict[str, float], rng: np.random.Generator
) -> dict[str, Array]:
    """A frame every 1/30 s belongs to the first tick after it; its pose is as old as the set's age, with a little jitter."""
    frames = np.floor(times * camera["rate"] + rng.random())
    fresh = np.diff(frames, prepend=-1) > 0
    age = copy.camera_age + hidden.camera_delay + JITTER * rng.standard_normal(len(times))
    seen = times - np.maximum(age, 0)
    unrolled = records[:, :7].copy()
    pose = np.column_stack([unrolled[:, :3], np.unwrap(_heading(records)), _nose_down(records)])
    pose = np.stack([np.interp(seen, SAMPLE * np.arange(len(pose)), column) for column in pose.T], axis=1)
    start = np.array([*records[0, :2], _heading(records[:1])[0]])
    east, north = (pose[:, :2] - start[:2]).T
    # zeroed at the start, where the floor frame's x is the robot's heading; the camera sees that frame turned by its mounting
    angle = start[2] + copy.camera_yaw + hidden.camera_yaw
    x, y = np.cos(angle) * east + np.sin(angle) * north, -np.sin(angle) * east + np.cos(angle) * north
    clean = {"cam_x": x * hidden.camera_scale, "cam_y": y * hidden.camera_scale, "cam_yaw": pose[:, 3] - start[2]}
    clean |= {"cam_z": pose[:, 2], "cam_pitch": pose[:, 4]}
    table = {}
    for name, values in clean.items():
        sigma = camera["yaw_noise"] if name in ("cam_yaw", "cam_pitch") else camera["position_noise"]
        table[name] = np.where(fresh, values + sigma * rng.standard_normal(len(times)), np.nan)
    return table


# ---- the model; a gear with play gets a rotor on a joint of its own --------------------------------------------------


@dataclass(frozen=True)
class BlindWorld:
    """A compiled model and where things are in it.

    Attributes:
        model: MuJoCo model.
        position, rate: indices (8,) of the joints in qpos and qvel.
        motor_position, motor_rate: the same of the motors; those of the joint unless its gear has play.
    """

    model: mujoco.MjModel
    position: NDArray[np.intp]
    rate: NDArray[np.intp]
    motor_position: NDArray[np.intp]
    motor_rate: NDArray[np.intp]


def build(copy: Copy, hidden: Hidden) -> BlindWorld:
    """Compile the robot copy with what is hidden in it."""
    model = mujoco.MjModel.from_xml_string(_xml(copy, hidden))

    def addresses(names: list[str]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in names]
        return model.jnt_qposadr[ids].astype(np.intp), model.jnt_dofadr[ids].astype(np.intp)

    position, rate = addresses(list(JOINTS))
    motors = [f"{name}_rotor" if hidden.play[k] > 0 else name for k, name in enumerate(JOINTS)]
    motor_position, motor_rate = addresses(motors)
    return BlindWorld(model, position, rate, motor_position, motor_rate)


def floor_gravity(copy: Copy, hidden: Hidden) -> Array:
    """Gravity (3,) in the frame of the inclined floor, m/s2."""
    pitch, roll = copy.slope + hidden.slope
    down = np.array([-np.sin(pitch), -np.sin(roll), 0.0])
    down[2] = -np.sqrt(1.0 - down @ down)
    return copy.gravity * down


def _numbers(*values: float) -> str:
    return " ".join(f"{value:.12g}" for value in values)


def _rotor(joint: str, armature: float, play: float) -> tuple[str, str]:
    """Return the rotor's body and the joint's own armature: play puts the motor's inertia on a joint beside it."""
    if play == 0:
        return "", _numbers(armature)
    body = (
        f'<body name="{joint}_rotor"><inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>'
        f'<joint name="{joint}_rotor" type="hinge" axis="0 1 0" armature="{_numbers(armature)}"/></body>'
    )
    return body, "0"


def _corner(index: int, copy: Copy, hidden: Hidden) -> str:
    leg, wheel = LEGS[index], WHEELS[index]
    x, y = CORNERS[index] * copy.hip
    leg_rotor, leg_armature = _rotor(leg, copy.armature[index], hidden.play[index])
    wheel_rotor, wheel_armature = _rotor(wheel, copy.armature[4 + index], hidden.play[4 + index])
    across, along, own = copy.leg_inertia[index][1], copy.leg_inertia[index][0], copy.leg_inertia[index][2]
    return f"""
    <body name="{leg}" pos="{_numbers(x, y, 0)}">
      <inertial pos="{_numbers(copy.leg_com, 0, 0)}" mass="{_numbers(copy.leg_mass[index])}"
        diaginertia="{_numbers(own, across, along)}"/>
      <joint name="{leg}" type="hinge" axis="0 1 0" armature="{leg_armature}"/>
      <body name="{wheel}" pos="{_numbers(copy.leg_length, 0, 0)}">
        <inertial pos="0 0 0" mass="{_numbers(copy.wheel_mass)}"
          diaginertia="{_numbers(copy.transverse_inertia, copy.spin_inertia, copy.transverse_inertia)}"/>
        <joint name="{wheel}" type="hinge" axis="0 1 0" armature="{wheel_armature}"/>
      </body>{wheel_rotor}
    </body>{leg_rotor}"""


def _xml(copy: Copy, hidden: Hidden) -> str:
    corners = "".join(_corner(index, copy, hidden) for index in range(4))
    mass, *place = hidden.payload
    payload = ""
    if mass > 0:
        inertial = f'<inertial pos="0 0 0" mass="{_numbers(mass)}" diaginertia="1e-9 1e-9 1e-9"/>'
        payload = f'<body pos="{_numbers(*place)}">{inertial}</body>'
    return f"""
<mujoco>
  <compiler angle="radian" balanceinertia="false"/>
  <option gravity="{_numbers(*floor_gravity(copy, hidden))}"/>
  <worldbody>
    <body name="body" pos="0 0 0.17">
      <freejoint/>
      <inertial pos="{_numbers(*(copy.com + hidden.com))}" mass="{_numbers(copy.mass)}"
        diaginertia="{_numbers(*copy.inertia)}"/>
      {payload}{corners}
    </body>
  </worldbody>
</mujoco>"""


# ---- one run of a robot copy -----------------------------------------------------------------------------------------


#: Of meeting teeth, N m/rad: legs, wheels.
TOOTH_STIFFNESS = (3000.0, 600.0)
#: N m s/rad per rotor inertia.
TOOTH_DAMPING = 700.0


@dataclass(frozen=True)
class BlindProfile:
    """Profile registers of a data set, rad/s2, rad/s, rad/s2; 0 = off."""

    wheel_acceleration: float
    leg_velocity: float
    leg_acceleration: float


def simulate(
    world: BlindWorld,
    copy: Copy,
    hidden: Hidden,
    profile: BlindProfile,
    times: Array,
    setpoints: Array,
    start: Array,
    duration: float,
) -> Array:
    """Drive the robot through one run.

    Args:
        world: compiled model.
        times: (n,) s, when the setpoints are written.
        setpoints: (n, 8) rad, rad/s, NaN = torque off.
        start: (4,) leg angles at which the robot is set down, rad, true.
        duration: s.

    Returns:
        (samples, WIDTH) records every ``SAMPLE`` seconds from time 0.

    Raises:
        FloatingPointError: the simulated robot blew up.
    """
    model, data = world.model, mujoco.MjData(world.model)
    data.qpos[world.position[:4]] = start
    has_rotor = world.motor_position != world.position
    data.qpos[world.motor_position[has_rotor]] = data.qpos[world.position[has_rotor]]
    data.qpos[2] = (copy.leg_length * np.sin(start) + copy.radius * hidden.radius_scale).max()
    records = np.zeros((round(duration / SAMPLE) + 1, WIDTH))
    addresses = (world.position, world.rate, world.motor_rate, world.motor_position)
    tables = (_joint_table(copy, hidden), _corner_table(copy, hidden), _general_table(copy, hidden, profile), copy.floor_waves)
    drive(model._address, data._address, data.qpos, data.qvel, addresses, tables, times, setpoints, records)
    if not np.isfinite(records).all():
        raise FloatingPointError("the simulated robot blew up")
    return records


def _joint_table(copy: Copy, hidden: Hidden) -> Array:
    constant = copy.data_sheet_voltage / copy.no_load_speed
    resistance = constant * copy.data_sheet_voltage / copy.stall_torque
    return np.array(
        [
            copy.kp,
            copy.kd,
            constant,
            resistance,
            copy.coulomb + hidden.coulomb,
            copy.viscous + hidden.viscous,
            hidden.stick_extra,
            hidden.stick_speed,
            hidden.load_ratio,
            hidden.motor_scale,
            *hidden.ripple,
            copy.command_delay + hidden.delay,
            np.concatenate([copy.joint_zero + hidden.zero, np.zeros(4)]),
            hidden.play,
            np.repeat(TOOTH_STIFFNESS, 4),
            TOOTH_DAMPING * copy.armature,
        ]
    )


def _corner_table(copy: Copy, hidden: Hidden) -> Array:
    hips = CORNERS * copy.hip
    return np.array(
        [
            hips[:, 0],
            hips[:, 1],
            copy.radius * hidden.radius_scale,
            np.where(np.isnan(hidden.wheel_mu), copy.mu, hidden.wheel_mu),
            hidden.creep_speed,
            hidden.rolling,
            hidden.out_of_round,
            *hidden.leg_spring,
            *hidden.elastic,
            np.repeat(hidden.cross_ratio, 2),
            *hidden.bristles,
        ]
    )


def _general_table(copy: Copy, hidden: Hidden, profile: BlindProfile) -> Array:
    return np.array(
        [
            copy.leg_length,
            copy.supply,
            hidden.supply_resistance,
            profile.wheel_acceleration,
            profile.leg_velocity,
            profile.leg_acceleration,
            *hidden.force,
            *hidden.tether,
            hidden.drag,
            hidden.veer,
            *hidden.pull,
            *hidden.patch,
            hidden.mu_ratio,
            *hidden.weak_slip,
            *floor_gravity(copy, hidden),
            copy.normal_stiffness,
            copy.floor_creep,
            copy.gear_creep,
            copy.flattening,
            copy.weight / 4 / copy.normal_stiffness,
            copy.weight / 4,
            copy.steepness,
        ]
    )
