"""One run of the robot, in one compiled loop: MuJoCo's C functions give inertia and Coriolis forces, everything else is here.

Servos, friction and contacts are forces. Whatever resists motion is a damper whose coefficient is its bound over the speed, but
never over less than the copy's ``floor_creep`` or ``gear_creep``: dry friction that creeps a little instead of sticking. All
dampers and the floor's springs act implicitly: each step solves (M + h sum c J'J) v = M v_old + h f for the new velocities,
again with new coefficients until they agree. No complementarity, no impulses, half a millisecond per step.
"""

# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numba
import numpy as np
from llvmlite.binding import load_library_permanently
from numba import types

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
def _contact(w, place, turn, hip_x, hip_y, length, radius, flat_tyre, cos, sin, rows, columns, dofs):
    """Find the lowest point of a wheel's disc.

    Writes the rows that give its velocity upwards, and along the heading and the axle that of a point above it: ``flat_tyre``
    is a share and a depth, and a tyre rolls on its radius less that share of what it is deeper. They are over the columns (8)
    of the generalised velocities that move it. Returns how deep the lowest point is under a flat floor, its x and its y.
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
    head_x, head_y = side_y / flat, -side_x / flat
    directions = ((head_x, head_y, 0.0), (-head_y, head_x, 0.0), (0.0, 0.0, 1.0))
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
    return -height, at_x, at_y


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
    cross = corners[11]
    length, full_supply, supply_resistance = general[0], general[1], general[2]
    wheel_acceleration, leg_velocity, leg_acceleration = general[3], general[4], general[5]
    force_x, force_y, tether, anchor_x, anchor_y = general[6], general[7], general[8], general[9], general[10]
    drag, veer, pull, pull_frequency, pull_phase = general[11], general[12], general[13], general[14], general[15]
    patch, mu_ratio, mu_k, weak_speed = general[16:21], general[21], general[22], general[23]
    gravity, stiffness = general[24:27], general[27]
    floor_creep, gear_creep, flat_tyre = general[28], general[29], general[30:32]
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
                flat_tyre, np.cos(angle), np.sin(angle), rows, columns, rate,
            )  # fmt: skip
            for k in range(waves.shape[0]):
                depth[w] += waves[k, 0] * np.sin(waves[k, 1] * at_x + waves[k, 2] * at_y + waves[k, 3])
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
                if creep[w] > 0.0:
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
        _integrate(model, qpos.ctypes.data, qvel.ctypes.data, STEP)
        # --- inertial sensors at the body's origin
        for k in range(3):
            gyro[k] += filter_share * (qvel[3 + k] - gyro[k])
            felt = 0.0
            for i in range(3):
                felt += turn[i, k] * ((qvel[i] - before[i]) / STEP - gravity[i])
            accel[k] += filter_share * (felt - accel[k])
