"""Third stage: an emulated robot with a hidden fault, driven by a shipped policy and logged as a real one would be."""

from __future__ import annotations

import shutil
from contextlib import closing
from typing import TYPE_CHECKING, Any

from wlr_gym.base.errors import InputError
from wlr_gym.base.plots import COLOURS, new_figure, tidy
from wlr_gym.base.text import counted
from wlr_gym.demo.settings import ENVIRONMENT, Demo
from wlr_gym.demo.stage import Section, Tell, drawn, paragraph
from wlr_gym.robot import JOINTS, LEGS, WHEELS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from wlr_gym.data import Run

TITLE = "3. A robot with a hidden fault"
POLICY = "velocity_slip_aware"
#: What each run is driven by: the policy, or a motion that brings out what a robot is made of.
DRIVERS = ("posture", POLICY, "turns", "stop_and_go")


def hide(seed: int) -> dict[str, Any]:
    """Return the hidden fault: an effect, its place and its size, all drawn from the seed."""
    from wlr_gym.base.random import generator

    draw = generator(seed, "demo", "secret")  # the name of the stream decides what a seed draws
    if draw.integers(2) == 0:  # it reads a turn where there is none: the robot turns when it is to go straight ahead
        bias = round(float(draw.uniform(0.04, 0.06) * draw.choice((-1.0, 1.0))), 4)
        return {"name": "gyro_bias", "where": ["sensor"], "parameters": {"z": bias}}
    delay = round(float(draw.uniform(0.05, 0.07)), 3)
    return {"name": "command_delay", "where": list(JOINTS), "parameters": {"delay": delay}}


def drive(demo: Demo, tell: Tell) -> Section:
    """Drive the robot and log its runs; the hidden fault is written to a file that is read at the end only."""
    from wlr_gym.data import read_dataset
    from wlr_gym.physics.effects import load_patch, save_patch

    shutil.rmtree(demo.measured, ignore_errors=True)
    patch = load_patch([hide(demo.seed)])
    save_patch(patch, demo.hidden)
    drivers = DRIVERS[: demo.runs]
    for index, driver in enumerate(drivers):
        tell(f"emulated robot: run {index + 1} of {len(drivers)}", index / len(drivers))
        if driver == POLICY:
            _deploy(demo, patch, demo.seed + index)
        else:
            _excite(demo, patch, driver)
    runs = read_dataset(demo.measured).runs
    seconds = sum(float(run["t"][-1] - run["t"][0]) for run in runs)
    html = paragraph(
        "An emulated robot, servo by servo and register by register, is driven like a real one: preflight, command limiter, "
        f"50 Hz, a log of what was sent and read. {_told(drivers)} Something about this robot is not in its file: drawn from "
        "the seed of this demo, and told to nobody until the end of this page."
    )
    html += drawn(
        _picture(runs[drivers.index(POLICY)]),
        demo.out / "measured_run.png",
        "A run of the policy as the robot logged it. The robot has no camera: joints, motor currents and IMU are all there is.",
    )
    headline = f"A robot with a hidden fault was driven and logged: {len(runs)} runs, {seconds:.0f} s in all."
    return Section(TITLE, headline, html)


def _told(drivers: tuple[str, ...]) -> str:
    from wlr_gym.data.excitations import EXCITATIONS

    motions = [f"'{name}' ({EXCITATIONS[name].doc})" for name in drivers if name in EXCITATIONS]
    runs = counted(drivers.count(POLICY), "run")
    return f"{runs} by the shipped policy {POLICY}, and {len(motions)} by motions: {', '.join(motions)}."


def _deploy(demo: Demo, patch: Any, seed: int) -> None:
    from wlr_gym.hardware.deployment import deploy
    from wlr_gym.learning.evaluation import make_core
    from wlr_gym.policy import environment_for, make_policy

    hardware = {"emulated": True, "log": demo.measured, "effects": patch}
    keywords = {"backend": "dynamixel", "robot": "nominal", "hardware": hardware, "episode_length": demo.run_seconds}
    with closing(make_core(ENVIRONMENT, 1, environment_for(POLICY, keywords))) as core:
        ended = deploy(core, make_policy(POLICY, core.contract()), seed)
    if not ended.well:
        raise InputError(f"the robot was stopped: {ended.reason}")


def _excite(demo: Demo, patch: Any, name: str) -> None:
    """Drive a motion with the servos as policies drive them, without a profile: the runs of a folder share it."""
    from dataclasses import replace

    from wlr_gym.data.excitations import excite
    from wlr_gym.data.format import Profile
    from wlr_gym.hardware.deployment import drive_robot
    from wlr_gym.hardware.plant import RobotPlant
    from wlr_gym.physics.plants.base import RobotOptions
    from wlr_gym.robot import load_robot

    robot = load_robot()
    motion = replace(excite(name, demo.seed, robot, seconds=demo.run_seconds), profile=Profile())
    with closing(RobotPlant(robot, 1, hardware=RobotOptions(emulated=True, log=demo.measured, effects=patch))) as plant:
        ended = drive_robot(plant, motion)
    if not ended.well:
        raise InputError(f"the robot was stopped: {ended.reason}")


def _picture(run: Run) -> Figure:
    """Return wheel speeds, leg angles and turning rate of a run over time."""
    figure = new_figure(10.0, 6.0)
    rows = figure.subplots(3, 1, sharex=True)
    t = run["t"] - run["t"][0]
    for axes, kind, joints, label in (
        (rows[0], "vel", WHEELS, "wheel speed (rad/s)"),
        (rows[1], "pos", LEGS, "leg angle (rad)"),
    ):
        for joint, colour in zip(joints, COLOURS, strict=False):
            axes.plot(t, run[f"{kind}_{joint}"], color=colour, linewidth=1.0, label=joint)
            axes.plot(t, run[f"cmd_{joint}"], color=colour, linewidth=0.7, linestyle=":")
        axes.set_ylabel(label)
        axes.legend(
            loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, frameon=False, title="dotted: setpoint", title_fontsize=8
        )
    rows[2].plot(t, run["gyro_z"], color="black", linewidth=1.0)
    rows[2].set(ylabel="yaw rate, gyro (rad/s)", xlabel="time (s)")
    for axes in rows:
        tidy(axes)
        axes.margins(x=0.01)
    return figure
