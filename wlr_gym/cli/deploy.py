"""Drive the robot with a policy: check, ramp to the start pose, run at 50 Hz through the command limiter, stop, torque off.

Space switches the motors off at once, q stops, and so do Ctrl-C, SIGTERM and SIGHUP. Try it without a robot: --emulated. Wheels
off the ground the first time; see docs/robot.md.
"""

from __future__ import annotations

import contextlib
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.text import Text

from wlr_gym.base.errors import InputError, Interval, check_name
from wlr_gym.base.files import require_ending, require_output_place
from wlr_gym.base.provenance import write_yaml
from wlr_gym.base.text import pairs
from wlr_gym.cli import FAILED, IMPORTED, OK
from wlr_gym.cli.options import (
    PORT,
    CameraOption,
    FloorOption,
    JsonOption,
    PatchOption,
    Seconds,
    Seed,
    environment_of,
    handed,
    note_untrained,
    refuse_given,
)
from wlr_gym.cli.terminal import print_json, print_table, wait_for_enter
from wlr_gym.envs.registry import task_source_of
from wlr_gym.policy import (
    Policy,
    camera_share,
    contract_of,
    environment_for,
    make_policy,
    misses_camera,
    policy_environment,
    untrained,
)
from wlr_gym.robot import JOINTS, load_robot, robot_hash

if TYPE_CHECKING:
    from wlr_gym.data.logs.messages import McapStream
    from wlr_gym.envs.core import Core
    from wlr_gym.hardware.deployment import Deployment
    from wlr_gym.hardware.loop import ControlLoop
    from wlr_gym.hardware.operator import DrivingPad, Keys
    from wlr_gym.hardware.safety.status import RobotStatus
    from wlr_gym.physics.floor import Floor
    from wlr_gym.physics.plants.base import RobotOptions

#: Part of the control steps in which answers may be missing before it is said at the end.
MANY_MISSED = 0.05
#: How a stop begins that an emulated robot in real time owes to a busy computer.
_LATE = ("deadlines:", "silence:", "idle:", "watchdog:", "imu: no reading", "no answer from", "NoAnswerError:")
#: s for which the dead-man button of a gamepad may be let go.
_PAD_DEADMAN = 0.2


@dataclass(frozen=True)
class DeployOptions(JsonOption, PatchOption, FloorOption, CameraOption):
    policy: tyro.conf.Positional[str]
    """Policy file or folder, run folder, or name of an agent or shipped policy."""
    env: str | None = None
    """Environment id, see: wlr envs; default: the one the policy was trained in, else WLR-Velocity-v0."""
    robot: str | None = field(default=None, kw_only=True)
    """Robot file, or name in configs/robot/; default: that of the hardware file, else the policy's."""
    emulated: bool = field(default=False, kw_only=True)
    """Drive an emulated robot, which is started for the purpose."""
    stepped: bool = False
    """With --emulated: in emulated time, without ports: faster, and the same bits each time."""
    dry_run: bool = False
    """Do everything but write to the servos: nothing moves."""
    fault: tuple[str, ...] = ()
    """With --emulated: what goes wrong, as in wlr emulate: "drop legs after=3"."""
    seconds: Seconds = 10.0
    """How long to drive."""
    command: tuple[str, ...] = ()
    """What to follow: linear_velocity_x=0.1 yaw_rate=0; default: drawn anew every few seconds, as in training."""
    seed: Seed = 0
    """Seed of the drawn commands, and of an emulated robot's noise."""
    deadman: Annotated[float, Interval("s", above=0.0, most=10.0)] | None = None
    """Stop the wheels when no key was pressed for so many seconds (10 at most); with --gamepad: its dead-man button (0.2)."""
    gamepad: str | None = None
    """Steer with a gamepad, such as /dev/input/js0, while its dead-man button is held; buttons: the hardware file's gamepad."""
    realtime: int | None = None
    """Run at this real-time priority (1 to 99, SCHED_FIFO) with all memory locked; Linux."""
    out: Path = Path("robot_runs")
    """Folder for the logs."""
    mcap: Path | None = None
    """Write the run into this new MCAP file, too, while it goes on, for Foxglove and PlotJuggler."""
    yes: bool = False
    """Do not ask before the robot moves."""
    status: bool = True
    """Show a live status."""


def run(options: DeployOptions) -> int:
    """Deploy; 0 = ended as it was asked to, 1 = something stopped the robot."""
    from wlr_gym.hardware.deployment import deploy, loop_of
    from wlr_gym.hardware.operator import HELP, Keys, stop_on_signals
    from wlr_gym.hardware.safety.preflight import require_ports
    from wlr_gym.hardware.timing import real_time
    from wlr_gym.learning.evaluation.rollout import make_core

    command = checked_command(options)
    environment = environment_of(options.env, options.policy)
    note_untrained([options.policy])
    robot = driven_robot(options)
    hardware = robot_options(options, robot)
    keywords = {"backend": "dynamixel", "hardware": hardware, "robot": robot, "episode_length": options.seconds}
    policy = _make_policy(options.policy, environment, keywords, command)
    console = Console()
    with contextlib.ExitStack() as last, contextlib.ExitStack() as stack:  # the stream ends when the motors are off
        if options.emulated and not options.stepped:
            ports, poses = stack.enter_context(_emulator(options, console, robot, hardware.floor))
            keywords["hardware"] = replace(hardware, ports=ports, poses=poses)
        core = make_core(environment, 1, environment_for(options.policy, keywords))
        stack.callback(core.close)
        _say_what_is_not_known(core, options.policy, console)
        loop = loop_of(core)
        pads = [stack.enter_context(pad) for pad in _gamepads(options, core, loop, console)]
        if options.realtime is not None:
            stack.enter_context(real_time(options.realtime))
        if not (options.yes or options.emulated or options.dry_run):
            require_ports(loop.hardware)
            wait_for_enter(console, "The robot will move. Wheels off the ground? Hand on the switch?")
        if options.stepped:
            from wlr_gym.hardware.emulator.machine import Machine

            assert isinstance(loop.clock, Machine)
            for fault in options.fault:
                loop.clock.inject(fault)
        recorder = loop.recorder
        if options.mcap is not None:
            from wlr_gym.data.logs.messages import McapStream

            recorder.stream = last.enter_context(McapStream(options.mcap, recorder.columns[1:], recorder.meta, loop.robot))
        keys = stack.enter_context(Keys())
        if keys.is_terminal:
            console.print(HELP, style="dim")
        stack.enter_context(stop_on_signals(loop.operator))
        stack.enter_context(_serving(loop, core, [keys, *pads], options.status and console.is_terminal, console))
        result = deploy(core, policy, options.seed, command, pads[0].command if pads else None)
    if options.json:
        print_json(_results(result, loop))
    else:
        _report(result, loop, console)
    if recorder.stream is not None:
        _report_stream(recorder.stream, console)
    console.print(busy_note(options, result.reason), style="yellow", end="")
    return OK if result.well else FAILED


def checked_command(options: DeployOptions) -> dict[str, float]:
    """Return the held command, from options that make sense: before an operator is asked or a robot started."""
    from wlr_gym.hardware.config import load_hardware
    from wlr_gym.hardware.timing import require_priority

    if options.realtime is not None:
        require_priority("--realtime", options.realtime)
    if not options.emulated:
        refuse_given(options, ("stepped", "fault", "effects"), "it is for the emulated robot: add --emulated")
    if options.stepped:
        refuse_given(options, ("realtime",), "emulated time is not real time; leave out --stepped")
    if options.emulated:
        refuse_given(options, ("port",), "the emulated robot brings its own ports")
    elif not options.dry_run and (words := untrained(options.policy)):
        raise InputError(f"{words}; a real robot moves with one of these, or with your own")
    options.camera_file()
    options.patch()
    if options.fault:
        from wlr_gym.hardware.emulator import parse_fault

        places = (*JOINTS, *load_hardware(options.hardware).buses, "imu", "flow", "camera")
        try:
            for fault in options.fault:
                parse_fault(fault, places)
        except InputError as error:
            raise InputError(f"--fault: {error}") from None
    require_output_place(options.out)
    if options.mcap is not None:
        if options.mcap.exists():
            raise InputError(f"--mcap {options.mcap}: is there already; a stream goes into a new file")
        require_ending(options.mcap, (".mcap",), "--mcap")
    command = pairs("--command", options.command, "yaw_rate=0.1")
    try:
        return {name: float(text) for name, text in command.items()}
    except ValueError:
        raise InputError(f"--command {' '.join(options.command)}: expected name=number") from None


def _results(result: Deployment, loop: ControlLoop) -> dict[str, Any]:
    """Return what ``--json`` prints; ``statistics`` count the steps of the ramp to the start pose too."""
    statistics = {f"{name}_ms" if _is_time(value) else name: value for name, value in result.statistics.items()}
    return {
        "reason": result.reason,
        "well": result.well,
        "run": result.run,
        "files": loop.recorder.files,
        "steps": result.ticks,
        "steps_with_ramp": statistics.pop("ticks"),
        "statistics": statistics,
        "limited": dict(loop.interventions),
    }


def _is_time(value: object) -> bool:
    """Whether a statistic is of a time, in percentiles."""
    return isinstance(value, Mapping) and "p50" in value


def busy_note(options: DeployOptions, reason: str) -> str:
    """Return what to do about a busy computer, where that is why a run ended; an emulated robot is never late by itself."""
    from wlr_gym.hardware.safety.preflight import STEPPED

    if not options.emulated or options.stepped or options.fault or not reason.startswith(_LATE):
        return ""
    return f"This computer is too busy, or too slow, for an emulated robot in real time: {STEPPED}.\n"


def driven_robot(options: DeployOptions) -> Any:
    """Return the robot that is driven: the one asked for, else that of the hardware file, else the policy's; None = any.

    The hardware file knows more of a robot than its policy does, such as currents. Where nobody named one, and the policy was
    made for another robot than that of the nominal wiring, it is the policy's.
    """
    from wlr_gym.hardware.config import load_hardware

    made_for = policy_environment(options.policy).get("robot")
    if options.robot is not None or made_for is None:
        return options.robot
    wired = load_hardware(options.hardware).robot
    if wired is None:
        return made_for
    is_same = robot_hash(load_robot(wired)) == robot_hash(load_robot(made_for))
    return made_for if options.hardware == DeployOptions.hardware and not is_same else wired


def robot_options(options: DeployOptions, robot: Any) -> RobotOptions:
    """Return how the robot is connected and on what it drives; an emulated one in real time gets its ports once it runs."""
    from wlr_gym.physics.plants.base import RobotOptions

    floor = options.load_floor(None if robot is None else load_robot(robot))
    if floor is not None and options.emulated:
        floor = floor.drawn(options.seed)
    own = {
        "ports": pairs("--port", options.port, PORT),
        "emulated": options.stepped,
        "log": options.out,
        "deadman": _PAD_DEADMAN if options.deadman is None and options.gamepad is not None else options.deadman,
        "effects": options.patch() if options.stepped else None,
        "floor": floor,
    }
    return RobotOptions(**handed(options, RobotOptions, **own))


def _make_policy(source: str, environment: str, keywords: Mapping[str, Any], command: Mapping[str, float]) -> Policy:
    """Return the policy; it needs no robot, so names and what does not fit are told before one is started."""
    from wlr_gym.envs.core import make_task
    from wlr_gym.envs.settings import read_settings
    from wlr_gym.envs.tasks import contract
    from wlr_gym.envs.tasks.terms import COMMANDS

    task = make_task(task_source_of(environment), read_settings(environment_for(source, keywords)))
    for name, value in command.items():
        check_name("command", name, task.commands, "--command")
        low, high = task.config.commands.terms[name]
        if not low <= value <= high:
            raise InputError(f"--command: {name} = {value:g}: expected {COMMANDS[name].words(low, high)}")
    return make_policy(source, contract(task, {}))


def _gamepads(options: DeployOptions, core: Core, loop: ControlLoop, console: Console) -> list[DrivingPad]:
    """Return the gamepad that steers, or none; refuse one whose sticks steer none of the task's commands."""
    if options.gamepad is None:
        return []
    from wlr_gym.hardware.operator import DrivingPad

    terms, buttons = core.task.config.commands.terms, loop.hardware.gamepad
    ranges = {name: (float(terms[name][0]), float(terms[name][1])) for name in core.task.commands}
    text = f"gamepad: hold button {buttons.deadman} to drive; {buttons.stop}: stop; {buttons.motors_off}: motors off at once"
    console.print(text, style="dim")
    return [DrivingPad(options.gamepad, buttons, ranges)]


def _report_stream(stream: McapStream, console: Console) -> None:
    if not (stream.path.is_file() or stream.trouble):
        return
    left_out = f"{stream.left_out} rows came too quickly and are left out" if stream.left_out else ""
    problem = stream.trouble or left_out
    console.print(f"written: {stream.path}{problem and '; '}{problem}", style="yellow" if problem else "", soft_wrap=True)


@contextlib.contextmanager
def _emulator(
    options: DeployOptions, console: Console, robot: Any = None, floor: Floor | None = None
) -> Iterator[tuple[dict[str, str], Path | None]]:
    """Start ``wlr emulate`` as a process of its own; yield its ports, and the file of its poses where a camera needs it."""
    import subprocess
    import tempfile

    from wlr_gym.data.runs import write_robot
    from wlr_gym.hardware.config import load_hardware

    hardware = load_hardware(options.hardware)
    with tempfile.TemporaryDirectory(prefix="wlr-robot-") as folder:
        links, poses = Path(folder) / "ports", None if options.camera is None else Path(folder) / "poses"
        words = ["--links", str(links), "--hardware", options.hardware, "--seed", str(options.seed)]
        if robot is not None:
            write_robot(Path(folder) / "robot.yaml", load_robot(robot))
            words += ["--robot", str(Path(folder) / "robot.yaml")]
        if floor is not None:
            write_yaml(Path(folder) / "floor.yaml", floor.content())
            words += ["--floor", str(Path(folder) / "floor.yaml")]
        words += ["--poses", str(poses)] if poses is not None else []
        words += ["--fault", *options.fault] if options.fault else []
        words += ["--effects", *options.effects] if options.effects else []
        modules = [word for module in IMPORTED for word in ("--import", module)]
        main = "import sys; from wlr_gym.cli import main; sys.exit(main())"
        command, pipe = [sys.executable, "-c", main, *modules, "emulate", *words], subprocess.PIPE
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, start_new_session=True)
        assert process.stdout is not None
        assert process.stderr is not None
        try:
            console.print("starting the emulated robot ...", style="dim")
            if not process.stdout.readline():
                raise InputError(f"the emulated robot does not start: {process.stderr.read().strip()}")
            ports = {name: str(links / name) for name in hardware.port_names}
            if missing := [name for name in ports if not (links / name).exists()]:  # a port of the file may be a real robot's
                raise InputError(f"the emulated robot has no port '{missing[0]}', which {options.hardware} has")
            yield ports, poses
        finally:
            process.terminate()
            process.communicate()


def _say_what_is_not_known(core: Core, policy: str, console: Console) -> None:
    """Say what is not measured, and what to expect of a policy without a camera that had one in most of its training."""
    console.print(f"not measured on a robot, and left out: {', '.join(core.unmeasured)}", style="dim")
    try:
        trained = contract_of(policy)["environment"]
    except InputError:  # an agent that was not trained
        trained = core.contract()
    if not core.settings.has_camera and misses_camera(trained):
        share = camera_share(trained)
        had = "the slip observer is meant to have" if share >= 1.0 else f"in {share:.0%} of its training the policy had"
        console.print(f"note: {had} a camera, and none is named (--camera): expect worse tracking", style="yellow")


@contextlib.contextmanager
def _serving(
    loop: ControlLoop, core: Core, helpers: Sequence[Keys | DrivingPad], show: bool, console: Console
) -> Iterator[None]:
    """Serve keys and gamepad, and show the status, in the time that is left in each step."""
    from rich.live import Live

    live = Live(console=console, auto_refresh=False, transient=True) if show else None
    view, count = RobotView(loop, core), 0

    def spare() -> None:
        nonlocal count
        for helper in helpers:
            helper.serve(loop.operator)
        count += 1
        if live is not None and count % 10 == 0:
            live.update(view.table(), refresh=True)

    loop.operator.spare = spare
    with live or contextlib.nullcontext():
        try:
            yield
        finally:
            loop.operator.spare = None


def _report(result: Deployment, loop: ControlLoop, console: Console) -> None:
    colour = "green" if result.well else "red"
    console.print(Text.assemble(("ended: ", "bold"), (result.reason, colour)))
    statistics = result.statistics
    times = {name: values for name, values in statistics.items() if _is_time(values)}
    steps = f"{result.ticks} steps, {statistics['ticks']} with the ramp"
    if any(values["max"] for name, values in times.items() if name not in ("period", "slack")):
        rows = [(name, *(f"{value:.2f}" for value in values.values())) for name, values in times.items()]
        print_table(console, ("", "p50", "p95", "p99", "max"), rows, f"{steps}, {statistics['missed']} missed; ms")
    else:  # in emulated time nothing takes any
        console.print(steps)
    console.print(f"command limiter, steps: {_counted(loop.interventions)}")
    if (missed := loop.interventions["silence"]) > MANY_MISSED * statistics["ticks"]:
        share = f"{missed / statistics['ticks']:.0%} of the steps ({missed} of {statistics['ticks']})"
        console.print(f"answers were missing in {share}: check cables and latency timers: wlr doctor", style="yellow")
    if camera := statistics.get("camera"):
        console.print(camera_line(camera))
    if written := [result.run] if result.run is not None else loop.recorder.files:
        console.print(f"written: {', '.join(map(str, written))}", soft_wrap=True)


# ---- the live status -------------------------------------------------------------------------------------------------


class RobotView:
    """What a driver wants to see now: of the loop that drives the robot, and the core that says what it is asked to follow."""

    def __init__(self, loop: ControlLoop, core: Core) -> None:
        self._loop, self._core = loop, core
        self._seen: Counter[str] = Counter()

    def table(self) -> Any:
        """Return a table of the joints, and below it the command and what supervision sees."""
        from rich.table import Table

        loop, core = self._loop, self._core
        phase = loop.phase.name.lower().replace("_", " ")
        table = Table(box=None, title=f"{phase}  {core.time[0]:.1f} s", title_justify="left", caption_justify="left")
        for name in ("joint", "angle rad", "setpoint", "speed rad/s", "effort N m", "degC", "V"):
            table.add_column(name, justify="left" if name == "joint" else "right")
        status = loop.status
        if status is None:
            return table
        columns = (status.position, loop.setpoints, status.velocity, status.effort, status.temperature, status.voltage)
        for k, joint in enumerate(JOINTS):
            numbers = (f"{column[k]:.2f}" for column in columns)
            table.add_row(joint, *numbers, style="red" if status.silence[k] > 0 else "")
        command = "  ".join(f"{name} {value:+.2f}" for name, value in zip(core.task.commands, core.command[0], strict=True))
        camera = [] if status.camera is None else [camera_state(status)]
        acts = ", ".join(sorted(loop.interventions - self._seen)) or "nothing"
        limiter = f"command limiter acts on: {acts}; steps in all: {_counted(loop.interventions)}"
        self._seen = loop.interventions.copy()  # what it changed or stopped since the last look
        table.caption = "\n".join([command, supervised(loop, status), *camera, limiter])
        return table


def supervised(loop: ControlLoop, status: RobotStatus) -> str:
    """Return what the safety rules look at, each with its limit."""
    from wlr_gym.hardware.safety.rules import tilt_of
    from wlr_gym.hardware.safety.status import ratings_of

    limits = loop.limits
    load = np.abs(status.effort) / ratings_of(loop.robot, loop.pacer.period).stall_torque
    strained, hottest, lowest = int(load.argmax()), int(status.temperature.argmax()), int(status.voltage.argmin())
    seen = [
        f"load {load[strained]:.0%} ({JOINTS[strained]}, limit {limits.load:.0%})",
        f"{status.temperature[hottest]:.0f} degC ({JOINTS[hottest]}, limit {limits.hot:g})",
        f"{status.voltage[lowest]:.1f} V ({JOINTS[lowest]}, limit {limits.low_voltage:g})",
        f"tilt {tilt_of(status.up):.2f} rad (limit {limits.tilt:g})",
        f"servos silent {status.silence.max():.2f} s (limit {limits.silence:g})",
        f"IMU {status.imu_silence:.2f} s (limit {limits.imu_silence:g})",
        f"late {loop.pacer.late_ticks} in a row (limit {limits.late}), {loop.pacer.late_share:.0%} "
        f"(limit {limits.late_share:.0%}), missed {loop.pacer.missed}",
    ]
    if limits.deadman is not None:
        seen.append(f"operator silent {loop.operator.silence:.1f} s (limit {limits.deadman:g})")
    return "  ".join(seen)


def camera_state(status: RobotStatus) -> str:
    """Return what the camera says now."""
    camera = status.camera
    assert camera is not None
    x, y, yaw = camera.pose
    found = f"camera: x {x:+.3f} m  y {y:+.3f} m  yaw {yaw:+.3f} rad, {1e3 * (status.time - camera.time):.0f} ms old"
    if camera.doubt:
        found += f"; {camera.doubt}"
    if not camera.reason:
        return found
    return f"{found}; {'wrong: ' if camera.is_wrong else 'no pose: '}{camera.reason}"


def camera_line(found: dict[str, Any]) -> str:
    """Return what came of a camera in a run, from the control loop's statistics."""
    line = f"camera: {found['frames']} frames, {found['rate']:.1f} per second, {found['poses']} poses"
    if latency := found.get("latency"):
        tail = f"(99 %: {latency['p99']:.0f}, max {latency['max']:.0f})"
        line += f"; from exposure to the control step {latency['p50']:.0f} ms {tail}"
    if lag := found.get("lag"):
        line += f"; pictures older than their stamps by {lag['ms']:.0f} +- {lag['std']:.0f} ms, by the gyroscope"
    doubt = f"; {found['doubt']}" if "doubt" in found else ""
    return f"{line}; frames without a believed pose: {_counted(Counter(found['without_pose']))}{doubt}"


def _counted(counts: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.most_common()) or "none"
