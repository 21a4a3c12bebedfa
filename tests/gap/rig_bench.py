"""A test bench that shares no code with the simulation of the rig: a pendulum on a servo, in BAM's files."""

import json
from dataclasses import dataclass

import numpy as np

COUNT = 2 * np.pi / 4096


@dataclass(frozen=True)
class Bench:
    """What the bench is made of, SI; friction is smoothed over ``width`` rad/s."""

    torque_constant: float = 0.45
    resistance: float = 4.2
    inertia: float = 0.0062
    gravity: float = 0.49
    coulomb: float = 0.025
    viscous: float = 0.004
    load_ratio: float = 0.0
    delay: float = 0.002
    width: float = 0.01
    supply: float = 7.4


TRAJECTORIES = {
    "sin_sin": lambda t: 0.9 * np.sin(2.0 * t) + 0.5 * np.sin(5.3 * t),
    "sin_time_square": lambda t: np.sin(0.8 * t * t),
    "up_and_down": lambda t: 1.2 * np.sin(0.5 * np.pi * np.minimum(t / 2.0, 1.0)) - 0.1 * np.maximum(t - 2.0, 0.0),
}


H = 5e-4


def drive(bench, gains, trajectories, duration=4.0, period=0.0053):
    """Return time, angle, rate, duty and goal, each (runs, rows), of runs side by side, by Runge-Kutta steps of 0.5 ms."""
    slope = np.asarray(gains) * 4096 / (2 * np.pi) / (256 * 885)
    rows, runs = int(duration / period), len(slope)
    time = 0.0035 + period * np.arange(rows) + np.random.default_rng(7).uniform(-2e-4, 2e-4, (runs, rows))
    written = np.maximum(time - 0.0035, 0.0)
    goal = np.stack([TRAJECTORIES[name](t) for name, t in zip(trajectories, written, strict=True)])
    grid = H * np.arange(int(duration / H) + 20)
    held = np.stack(
        [
            g[np.clip(np.searchsorted(t + bench.delay, grid, side="right") - 1, 0, rows - 1)]
            for g, t in zip(goal, written, strict=True)
        ]
    )

    def change(angle, rate, goal_now):
        voltage = bench.supply * np.clip(slope * (goal_now - angle), -1.0, 1.0)
        motor = bench.torque_constant / bench.resistance * (voltage - bench.torque_constant * rate)
        dry = (bench.coulomb + bench.load_ratio * np.abs(motor)) * np.tanh(rate / bench.width)
        return rate, (motor - bench.viscous * rate - dry - bench.gravity * np.sin(angle)) / bench.inertia

    angle, rate = np.zeros(runs), np.zeros(runs)
    path = np.empty((2, len(grid), runs))
    for k in range(len(grid)):
        path[:, k] = angle, rate
        a1, r1 = change(angle, rate, held[:, k])
        a2, r2 = change(angle + 0.5 * H * a1, rate + 0.5 * H * r1, held[:, k])
        a3, r3 = change(angle + 0.5 * H * a2, rate + 0.5 * H * r2, held[:, k])
        a4, r4 = change(angle + H * a3, rate + H * r3, held[:, k])
        angle = angle + H / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        rate = rate + H / 6 * (r1 + 2 * r2 + 2 * r3 + r4)
    angle, rate = (np.stack([np.interp(t, grid, state[:, k]) for k, t in enumerate(time)]) for state in path)
    return time, angle, rate, np.clip(slope[:, None] * (goal - angle), -1.0, 1.0), goal


def contents(bench, gains, trajectories, temperature=30.0, **options):
    """Return runs as BAM's JSON holds them: rounded to counts, the load register unsigned."""
    found = []
    for k, (time, angle, rate, duty, goal) in enumerate(zip(*drive(bench, gains, trajectories, **options), strict=True)):
        volts = bench.supply + 0.1 * np.random.default_rng(k).integers(-1, 2, len(time))
        columns = {
            "timestamp": time,
            "position": np.rint(angle / COUNT) * COUNT,
            "speed": np.rint(rate / 0.024) * 0.024,
            "load": np.rint(885 * duty).astype(int) % 65536,
            "input_volts": np.round(volts, 1),
            "temp": np.full(len(time), temperature),
            "goal_position": goal,
            "torque_enable": np.ones(len(time), bool),
        }
        entries = [dict(zip(columns, row, strict=True)) for row in zip(*(c.tolist() for c in columns.values()), strict=True)]
        header = {"mass": 0.49, "length": 0.1, "kp": gains[k], "vin": bench.supply, "motor": "made up"}
        found.append(header | {"trajectory": trajectories[k], "entries": entries})
    return found


def write(folder, bench, gains=(100, 200, 400), **options):
    """Write one file per gain and trajectory."""
    pairs = [(gain, trajectory) for gain in gains for trajectory in TRAJECTORIES]
    made = contents(bench, [gain for gain, _ in pairs], [trajectory for _, trajectory in pairs], **options)
    for k, one in enumerate(made):
        (folder / f"run_{k:02d}.json").write_text(json.dumps(one))
    return folder
