"""How far each wheel's rolling is to be trusted as the body's velocity: a small recurrent network, the same for all wheels.

Every wheel has a memory of its own. It sees what the physics of contact says about its slip (by how much it rolls off the
estimate, its traction over its load, their signs against each other and against the acceleration, jumps) and what its side's
other wheel and all wheels remember. All of it stays the same when the robot is mirrored or turned round. It says with which
precision (1/variance, along heading and left) the wheel's rolling counts as a measurement of the velocity, and by how much a
wheel that pulls rolls ahead. Trained on simulated runs of the nominal robot with the filter's own likelihood, by
``studies/observer/training.py``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.compiled import compiled

Array = NDArray[np.float64]

#: Numbers that a wheel's network sees of its own, and that all wheels' see alike; numbers that a wheel remembers.
CLUES, CLUES_ALIKE, MEMORY = 10, 8, 8
#: Inputs of a wheel's own (clues, its memory, its partner's), and inputs alike (clues, mean memory).
OWN, ALIKE = CLUES + 2 * MEMORY, CLUES_ALIKE + MEMORY
OUTPUTS = 5  # precision along heading and left, lead, noise of velocity and of leak
_PERIOD = 0.02  # s, control period of the training: precisions are per reading of so long
#: N. Less than this counts as a wheel in the air when something is divided by its load.
LEAST_LOAD = 0.5


#: What the network needs room for while it judges one robot.
WORK = np.dtype(
    [
        ("seen_by", np.float64, (4, OWN)),
        ("alike", np.float64, (ALIKE,)),
        ("common", np.float64, (2 * MEMORY,)),
        ("sum", np.float64, (4, 2 * MEMORY)),
    ]
)


@compiled
def _squash(x: float) -> float:
    """A rational tanh."""
    x = min(max(x, -3.0), 3.0)
    return x * (27.0 + x * x) / (27.0 + 9.0 * x * x)


@compiled
def _log(x: float, least: float) -> float:
    return math.log(abs(x) + least)


@compiled
def gather(robot: Any, r: Any, work: Any) -> None:
    """Put what each wheel's network sees into ``work.seen_by`` (4, OWN), and what all see alike into ``work.alike``."""
    fz = max(r.force[2], 2.0)
    mean_load, mean_x, mean_y = 0.1, 0.0, 0.0
    for i in range(4):
        mean_load += 0.25 * r.load[i]
        mean_x += 0.25 * (r.rolling[i, 0] - r.velocity[0])
        mean_y += 0.25 * (r.rolling[i, 1] - r.velocity[1])
    pull_x, pull_y = r.force[0] - r.leak[0], r.force[1] - r.leak[1]
    sigma_x = 0.5 * (0.5 * math.log(r.covariance[0, 1, 1]) + 5.0)
    sigma_y = 0.5 * (0.5 * math.log(r.covariance[1, 1, 1]) + 5.0)
    demand = 3.0 * math.sqrt(math.sqrt(pull_x * pull_x + pull_y * pull_y + 1e-9) / fz)
    turning, legs, shaken = min(abs(r.yaw_rate), 2.0), min(r.legs, 3.0), 0.5 * min(r.shaken, 5.0)
    off = 0.5 * (0.5 * _log(mean_x * mean_x + mean_y * mean_y, 1e-6) + 5.0)
    change_x, change_y = r.velocity[0] - r.last_velocity[0], r.velocity[1] - r.last_velocity[1]
    a = work.alike
    a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7] = sigma_x, sigma_y, demand, turning, legs, shaken, off, r.inclined
    for i in range(4):
        c = work.seen_by[i]
        dx, dy = r.rolling[i, 0] - r.velocity[0], r.rolling[i, 1] - r.velocity[1]
        use = r.traction[i] / max(r.load[i], LEAST_LOAD)
        c[0] = 0.5 * (_log(dx, 1e-3) + 5.0)
        c[1] = 0.5 * (_log(dy, 1e-3) + 5.0)
        c[2] = 2.0 * abs(use)
        c[3] = 3.0 * use * dx / (abs(dx) + 0.01)
        c[4] = 10.0 * use * pull_x / fz
        c[5] = r.load[i] / mean_load - 1.0
        c[6] = 0.5 * (_log(r.rolling[i, 0] - r.last_rolling[i, 0] - change_x, 1e-3) + 6.0)
        c[7] = 0.5 * (_log(r.rolling[i, 1] - r.last_rolling[i, 1] - change_y, 1e-3) + 6.0)
        c[8] = 5.0 * min(abs(r.rolling[i, 0]), 0.6)
        c[9] = 0.5 * (_log(dx - mean_x, 1e-3) + 5.0)


@compiled
def judge(robot: Any, r: Any, work: Any) -> None:
    """Advance the wheels' memories by what they see.

    Finds ``r.trust`` (4, 2), precision of their rolling, s2/m2; ``r.lead`` (4,), by how much each rolls ahead, m/s; and
    ``r.wander`` (2,), what the filter's noises of velocity and leak are multiplied with in the next step.
    """
    _share(robot, r, work)
    weights, seen, total, common = robot.gate, work.seen_by, work.sum, work.common
    for k in range(0, 2 * MEMORY, 2):  # two rows for four wheels at a time: eight sums that need not wait for each other
        a0 = a1 = a2 = a3 = common[k]
        b0 = b1 = b2 = b3 = common[k + 1]
        for j in range(OWN):
            a, b = weights[k, j], weights[k + 1, j]
            x0, x1, x2, x3 = seen[0, j], seen[1, j], seen[2, j], seen[3, j]
            a0 += a * x0
            a1 += a * x1
            a2 += a * x2
            a3 += a * x3
            b0 += b * x0
            b1 += b * x1
            b2 += b * x2
            b3 += b * x3
        total[0, k], total[1, k], total[2, k], total[3, k] = a0, a1, a2, a3
        total[0, k + 1], total[1, k + 1], total[2, k + 1], total[3, k + 1] = b0, b1, b2, b3
    for i in range(4):
        for k in range(MEMORY):
            gate = 0.5 + 0.5 * _squash(0.5 * work.sum[i, k])
            r.memory[i, k] += gate * (_squash(work.sum[i, MEMORY + k]) - r.memory[i, k])
    _say(robot, r, work)


@compiled
def _share(robot: Any, r: Any, work: Any) -> None:
    """Lay out what each wheel's network sees, and add up what all four see alike."""
    for i in range(4):
        for k in range(MEMORY):
            work.seen_by[i, CLUES + k] = r.memory[i, k]
            work.seen_by[(i + 2) % 4, CLUES + MEMORY + k] = r.memory[i, k]
    for k in range(MEMORY):
        work.alike[CLUES_ALIKE + k] = 0.25 * (r.memory[0, k] + r.memory[1, k] + r.memory[2, k] + r.memory[3, k])
    weights, bias, alike, common = robot.gate_alike, robot.gate_bias, work.alike, work.common
    for k in range(2 * MEMORY):
        total = bias[k]
        for j in range(ALIKE):
            total += weights[k, j] * alike[j]
        common[k] = total


@compiled
def _say(robot: Any, r: Any, work: Any) -> None:
    """Read precision, lead and wander from the memories."""
    weights, alike_weights, bias = robot.output, robot.output_alike, robot.output_bias
    seen, alike, memory = work.seen_by, work.alike, r.memory
    for k in range(OUTPUTS):
        common = bias[k]
        for j in range(CLUES_ALIKE):
            common += alike_weights[k, j] * alike[j]
        for i in range(4):
            total = common
            for j in range(CLUES):
                total += weights[k, j] * seen[i, j]
            for j in range(MEMORY):
                total += weights[k, CLUES + j] * memory[i, j]
            work.sum[i, k] = total
    for i in range(4):
        for k in range(2):
            r.trust[i, k] = math.exp(min(max(work.sum[i, k], 0.0), 14.5)) * robot.period / _PERIOD
        use = r.traction[i] / max(r.load[i], LEAST_LOAD)
        r.lead[i] = math.exp(min(max(work.sum[i, 2], -8.0), 0.0)) * min(max(use, -1.0), 1.0)
    for k in range(2):
        mean = 0.25 * (work.sum[0, 3 + k] + work.sum[1, 3 + k] + work.sum[2, 3 + k] + work.sum[3, 3 + k])
        r.wander[k] = math.exp(min(max(mean, -4.0), 4.0))
