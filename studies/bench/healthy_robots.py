"""How often the supervision stops a healthy robot: shipped policies on rough floors, on robots that are not like their file.

``python -m studies.bench.healthy_robots POLICY ROBOTS SECONDS OUT.json``: each robot's parameters are drawn from three times
the tolerances of its file (cut at 2 sigma), its floor's friction from 0.1 to 0.9, its battery is weak; 1 % of answers are lost,
5 % come too late.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from wlr_gym.cli.options import environment_of
from wlr_gym.hardware.config import load_hardware
from wlr_gym.hardware.deployment import deploy
from wlr_gym.hardware.emulator import Machine, MachineOptions
from wlr_gym.hardware.emulator import link as emulated
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.policy import environment_for, make_policy
from wlr_gym.robot import Robot, load_robot
from wlr_gym.robot.parameter_table import ELEMENTS, TABLE
from wlr_gym.robot.parameters import Parameters

ROBOT, HARDWARE = load_robot("emanual"), load_hardware()
#: Times the file's tolerances that robots differ, sigma that they are cut at, and V of the weakest battery.
WIDER, CUT, WEAK = 3.0, 2.0, 11.0
LINE = ("drop legs wheels probability=0.01 after=5", "late legs wheels probability=0.05 after=5")  # the start refuses it


def drawn(robot: Robot, rng: np.random.Generator) -> Parameters:
    """Return a robot's parameters."""
    parameters = Parameters.nominal(robot)
    keys = {spec.name: spec.tolerance for spec in TABLE if spec.tolerance in robot.tolerances}
    for k, element in enumerate(ELEMENTS):
        key = keys.get(element.partition("[")[0])
        if key is None or key.startswith(("ground", "camera", "command")):
            continue
        nominal = parameters.values[0, k]
        sigma = WIDER * robot.tolerances[key].sigma(element, nominal)
        change = sigma * float(np.clip(rng.standard_normal(), -CUT, CUT))
        least = 0.1 * nominal if nominal > 0.0 else -np.inf if key in ("joint_zero", "body.com_offset") else 0.0
        parameters.values[0, k] = max(nominal + change, least)
    mu = rng.uniform(0.1, 0.9)
    parameters["ground.mu_x"] = parameters["ground.mu_y"] = mu
    parameters["servo.supply_voltage"] = rng.uniform(WEAK, 12.0)
    return parameters


def drive(policy: str, seed: int, seconds: float, floor: str = "rough") -> tuple[str, float]:
    """Return why a robot stopped (empty = it did not), and for how long (s) it drove."""
    rng = np.random.default_rng(seed)

    def make(robot: Robot, hardware: Any, effects: Any = None, **options: Any) -> Any:
        machine_options = MachineOptions(timing=NO_TIME, tick=0.002, seed=seed)
        machine = Machine(robot, hardware, machine_options, parameters=drawn(robot, rng), floor=options["floor"])
        for fault in LINE:
            machine.inject(fault)
        return emulated.emulated_link(machine)

    whole, emulated.emulated_robot = emulated.emulated_robot, make
    try:
        hardware = {"emulated": True, "floor": floor, "seed": seed}
        keywords = {"backend": "dynamixel", "hardware": hardware, "robot": "emanual", "episode_length": seconds}
        core = make_core(environment_of(None, policy), 1, environment_for(policy, keywords))
    finally:
        emulated.emulated_robot = whole
    result = deploy(core, make_policy(policy, core.contract()), seed=seed)
    core.close()
    return ("" if result.well else result.reason), result.ticks * 0.02


def main(policy: str, robots: str, seconds: str, path: str) -> None:
    """Drive, and write what stopped how many."""
    stops: Counter[str] = Counter()
    driven, reasons = 0.0, []
    for seed in range(int(robots)):
        reason, time = drive(policy, seed, float(seconds))
        driven += time
        if reason:
            stops[reason.partition(":")[0]] += 1
            reasons.append(f"seed {seed}, {time:.1f} s: {reason}")
            print(reasons[-1], flush=True)
    found = {"policy": Path(policy).stem, "robots": int(robots), "minutes": round(driven / 60.0, 1), "stops": dict(stops)}
    print(found)
    Path(path).write_text(json.dumps({**found, "reasons": reasons}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
