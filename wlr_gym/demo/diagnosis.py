"""The stages of the second worker: a robot with a hidden fault is driven, the gap workflow names it, and is judged."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.base.html import heading, picture, table
from wlr_gym.base.plots import COLOURS, new_figure, tidy
from wlr_gym.base.text import counted, number
from wlr_gym.demo.page import ENVIRONMENT, NOT_SHOWN, SHOWN, Demo, Section, Tell, drawn, link, paragraph
from wlr_gym.gap.report.text import error, listed, percent, places, plain, unit_of
from wlr_gym.robot import JOINTS, LEGS, WHEELS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from wlr_gym.data import Run
    from wlr_gym.gap.analysis import Analysis
    from wlr_gym.gap.report.result import EffectEntry, GapEntry
    from wlr_gym.physics.effects import PatchEffect

DRIVE_TITLE = "3. A robot with a hidden fault"
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
    from wlr_gym.data.excitations import EXCITATIONS
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
    motions = [f"'{name}' ({EXCITATIONS[name].doc})" for name in drivers if name in EXCITATIONS]
    html = paragraph(
        "An emulated robot, servo by servo and register by register, is driven like a real one: preflight, command limiter, "
        f"50 Hz, a log of what was sent and read. {counted(drivers.count(POLICY), 'run')} by the shipped policy {POLICY}, and "
        f"{len(motions)} by motions: {', '.join(motions)}. Something about this robot is not in its file: drawn from the seed "
        "of this demo, and told to nobody until the end of this page."
    )
    html += drawn(
        _picture(runs[drivers.index(POLICY)]),
        demo.out / "measured_run.png",
        "A run of the policy as the robot logged it. The robot has no camera: joints, motor currents and IMU are all there is.",
    )
    headline = f"A robot with a hidden fault was driven and logged: {len(runs)} runs, {seconds:.0f} s in all."
    return Section(DRIVE_TITLE, headline, html)


def _deploy(demo: Demo, patch: Any, seed: int) -> None:
    from wlr_gym.hardware.deployment import deploy
    from wlr_gym.learning.evaluation.rollout import make_core
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


# ---- what does the simulator lack? -----------------------------------------------------------------------------------


NAME_TITLE = "4. What does the simulator lack?"
CHECK_TITLE = "5. Does it hold?"


def name(demo: Demo, tell: Tell) -> Section:
    """Run the gap workflow on the measured runs, and nothing else."""
    from wlr_gym.gap import analyse
    from wlr_gym.gap.analysis import EFFECT_FOUND
    from wlr_gym.gap.report.page import REPORT_FILE
    from wlr_gym.gap.report.text import sentence

    if not demo.measured.is_dir():
        raise InputError("no measured runs: the robot was not driven")
    found = analyse(demo.measured, demo.gap, tell=lambda text, share: tell(f"gap workflow: {text}", share))
    html = paragraph(
        "The gap workflow gets the folder of measured runs. It calibrates the simulator within its tolerances, tests every "
        "effect of its library at every place, and holds out one run or two that no fit has seen."
    )
    if found.gap is not None:
        html += paragraph(f"Error of replayed runs: {found.gap.metric}.")
    html += f"<p><b>{escape(sentence(found))}</b></p>"
    plots = demo.gap / "plots"
    for kind, caption in (
        ("evidence", "By how much each candidate improves the fit; the selected one is dark."),
        ("overlays_1", "Measured channels, and the same runs replayed by the simulator as given, calibrated, and with what was "
         "found; below each the error that is left. Green: two standard deviations of sensor noise."),
    ):  # fmt: skip
        if (plots / f"{kind}.png").is_file():
            html += picture(kind, (plots / f"{kind}.png").read_bytes(), caption)
    files = ((REPORT_FILE, "the whole report"), ("patch.yaml", "the patch"))
    links = [link(demo, demo.gap / name, text) for name, text in files if (demo.gap / name).is_file()]
    html += f"<p>Files: {', '.join(links)}.</p>"
    verdict = SHOWN if found.verdict == EFFECT_FOUND else NOT_SHOWN
    return Section(NAME_TITLE, sentence(found), html, verdict, caveats_of(found))


def caveats_of(found: Analysis) -> list[str]:
    """Return what is left, what is not sure, and what got worse."""
    from wlr_gym.gap.report.text import closure, made_worse

    if found.gap is None:
        return ["no run could be held out to validate it"]
    low, high = found.gap.reduction_ci95
    said = [text.rstrip(".") for text in (closure(found), made_worse(found)) if text]
    if found.added and not np.isfinite([low, high]).all():
        said.append("too few runs are held out for an interval of what the effects remove")
    elif found.added and low <= 0.0 <= high:
        said.append("the interval of what the effects remove contains 0")
    return [f"{text[0].lower()}{text[1:]}" for text in said]


# ---- does it hold? ---------------------------------------------------------------------------------------------------


def check(demo: Demo, tell: Tell) -> Section:
    """Show the report's numbers of the held-out runs, then the hidden fault."""
    from wlr_gym.gap.report.result import RESULT_FILE, read_result
    from wlr_gym.physics.effects import load_patch

    if not (demo.gap / RESULT_FILE).is_file():
        raise InputError("no result of the gap workflow to check")
    result = read_result(demo.gap / RESULT_FILE)
    hidden = load_patch(demo.hidden).effects[0]
    answer = judge(hidden, result.effects, result.equivalent)
    heldout = [one for one in result.run_gaps if one.heldout]
    html = paragraph(
        "The runs that no fit has seen: error of the gap report (1 = sensor noise), and what the effects remove of what is "
        "above the noise floor."
    )
    rows = []
    for one in heldout:
        errors = [error(value) for value in (one.before, one.calibrated, one.after)]
        rows.append((one.run, *errors, percent(one.reduction)))
    html += table(("held-out run", "as given", "calibrated", "with effects", "removed"), rows, range(1, 5))
    html += heading("The hidden fault") + _revealed(hidden, result.effects, answer)
    said = "No run was held out."
    if (gap := result.gap) is not None:
        steps = (error(_number(value)) for value in (gap.heldout_calibrated, gap.heldout_after, gap.noise_floor))
        said = "Error of the held-out runs: {} calibrated, {} with what was found; noise floor {}.".format(*steps)
    worse = [one.run for one in heldout if one.after > one.calibrated]
    caveats = [*answer.outside, *([f"the effects make the error of {listed(worse)} larger"] if worse else [])]
    verdict = SHOWN if answer.right and fell(result.gap) else NOT_SHOWN
    return Section(CHECK_TITLE, f"{answer.sentence} {said}", html, verdict, caveats)


def fell(gap: GapEntry | None) -> bool:
    """Whether the effects make the error of the held-out runs smaller."""
    return gap is not None and _number(gap.heldout_after) < _number(gap.heldout_calibrated)


def _number(value: float | None) -> float:
    return np.nan if value is None else value


# ---- the hidden fault ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Diagnosis:
    """How good a diagnosis is.

    Attributes:
        named, placed: the hidden effect is among those found; at its place.
        near: another name was selected, and the report says that these data do not distinguish it from the hidden one.
        sizes: parameter -> (hidden, found, low, high); the interval is NaN where there is none.
        extra: names found that were not hidden.
    """

    named: bool
    placed: bool
    near: bool
    sizes: Mapping[str, tuple[float, float, float, float]]
    extra: tuple[str, ...]

    @property
    def right(self) -> bool:
        """Named, at its place, and nothing besides."""
        return self.named and self.placed and not self.extra

    @property
    def outside(self) -> list[str]:
        """Return in words which sizes lie outside their interval."""
        out = [name for name, (hidden, _, low, high) in self.sizes.items() if hidden < low or hidden > high]
        return [f"the interval does not hold the hidden {listed(out)}"] if out else []

    @property
    def sentence(self) -> str:
        """Return the verdict in words."""
        if not self.named:
            return f"The name was not found{', but the report gave it as an alternative' if self.near else ''}."
        place = "the place were right" if self.placed else "but not the place was right"
        text = f"The name {'and ' if self.placed else ''}{place}"
        if self.sizes:
            off = max(abs(found / hidden - 1.0) for hidden, found, _, _ in self.sizes.values())
            text += f", the size off by {100.0 * off:.0f} %"
        extra = f"; {listed([plain(name) for name in self.extra])} was named, too, but is not there" if self.extra else ""
        return f"{text}{extra}."


def judge(hidden: PatchEffect, found: Sequence[EffectEntry], equivalent: Sequence[Sequence[str]] = ()) -> Diagnosis:
    """Compare what was found with what was hidden.

    Args:
        hidden: the effect.
        found: entries of the result file.
        equivalent: groups of names that the data do not distinguish.
    """
    same = [one for one in found if one.name == hidden.name]
    best = next((one for one in same if set(one.where) == set(hidden.where)), same[0] if same else None)
    sizes = {}
    if best is not None:
        for parameter, value in hidden.parameters.items():
            if value != 0.0:  # the other axes of a bias have no size to be off by
                entry = best.parameters.get(parameter)  # a component of a vector may be missing
                found_value, interval = (0.0, None) if entry is None else (entry.value, entry.ci95)
                sizes[parameter] = (value, found_value, *(interval or (np.nan, np.nan)))
    return Diagnosis(
        named=best is not None,
        placed=best is not None and set(best.where) == set(hidden.where),
        near=best is None and any(hidden.name in group for group in equivalent),
        sizes=sizes,
        extra=tuple(one.name for one in found if one is not best),
    )


def _revealed(hidden: PatchEffect, found: Sequence[EffectEntry], answer: Diagnosis) -> str:
    from wlr_gym.physics.effects import EFFECTS

    named = [plain(one.name) for one in found] or ["nothing"]
    at = [places(one.where) for one in found if one.name == hidden.name] or [places(one.where) for one in found] or ["-"]
    rows = [
        ("effect", plain(hidden.name), ", ".join(named), "yes" if answer.named else "no"),
        ("place", places(hidden.where), ", ".join(at), "yes" if answer.placed else "no"),
    ]
    for parameter, (truth, value, low, high) in answer.sizes.items():
        unit = unit_of(EFFECTS[hidden.name].parameters[parameter].unit)
        interval = f" (95 % interval {number(low)} to {number(high)})" if np.isfinite(low) else ""
        inside = "the interval holds it" if low <= truth <= high else "outside the interval"
        off = f"{round(100.0 * (value / truth - 1.0)):+d} %; {inside}"
        rows.append((parameter, f"{number(truth)}{unit}", f"{number(value)}{unit}{interval}", off))
    return table(("", "hidden in the robot", "found by the gap workflow", "right?"), rows)
