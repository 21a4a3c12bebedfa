"""``wlr deploy`` and what is under it: a policy on the emulated robot, its log, and the same actions again from the log."""

import io
import json
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import yaml
from gymnasium.error import ResetNeeded
from rich.console import Console

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")

from policy_log import act_again, read_policy_log
from robot_rig import HARDWARE, PERIOD, Phase, hardware_file, machine_of

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import data_directory
from wlr_gym.cli import FAILED, OK, run_command
from wlr_gym.cli.deploy import DeployOptions, RobotView, _emulator, busy_note
from wlr_gym.cli.terminal import wait_for_enter
from wlr_gym.data.replay import replay
from wlr_gym.data.runs import read_run
from wlr_gym.hardware.config import load_hardware, with_ports
from wlr_gym.hardware.deployment import REHEARSALS, loop_of
from wlr_gym.hardware.deployment import deploy as drive
from wlr_gym.hardware.emulator.link import emulated_robot
from wlr_gym.hardware.log import CsvTable, read_events
from wlr_gym.hardware.loop import StoppedError
from wlr_gym.hardware.timing import MonotonicClock
from wlr_gym.learning.evaluation.rollout import make_core, roll_out
from wlr_gym.policy import make_policy

ID = "WLR-Velocity-v0"
COMMAND = {"linear_velocity_x": 0.08, "yaw_rate": 0.15}


@pytest.fixture
def robot_core(tmp_path):
    """Makes an emulated robot's core, and closes it when the test is over."""
    made = []

    def make(seconds=4.0, log=tmp_path, **hardware):
        options = {"emulated": True, "log": log, **hardware}
        made.append(make_core(ID, 1, {"backend": "dynamixel", "hardware": options, "episode_length": seconds}))
        return made[-1]

    yield make
    for core in made:
        core.close()


class Wobble:
    """A policy that uses its whole observation and its own past, in float32."""

    def __init__(self, width):
        self.weights = np.random.default_rng(0).normal(0.0, 0.05, (width, 8)).astype(np.float32)
        self.state = np.zeros(8, np.float32)

    def act(self, observations):
        self.state = np.float32(0.9) * self.state + np.float32(0.1) * np.tanh(observations @ self.weights)[0]
        return np.clip(self.state, -1, 1)[None]

    def reset(self, mask):
        self.state = np.zeros(8, np.float32)


def run_of(core):
    """Drive with the PID controller, close, and return the log."""
    result = drive(core, make_policy("pid", core.contract()), seed=1, command=COMMAND)
    core.close()
    assert result.run is not None
    return read_run(result.run)


# ---- deploying ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "make", [lambda core: Wobble(core.observation.shape[1]), lambda core: make_policy("pid", core.contract())]
)
def test_the_log_shown_to_the_policy_again_gives_the_same_actions(robot_core, make):
    core = robot_core()
    result = drive(core, make(core), seed=2)
    assert result.run is not None
    assert result.well
    assert result.ticks == 200
    log = read_policy_log(result.run)
    assert len(np.unique(log["command_yaw_rate"])) >= 1
    given, answered = act_again(core, make(core), result.run)
    assert given.shape == (200, 8)
    assert np.abs(np.diff(given, axis=0)).max() > 0.001
    np.testing.assert_array_equal(answered, given)


@pytest.mark.slow
def test_commands_that_change_on_the_way_are_seen_again(robot_core):
    core = robot_core(9.0)
    policy = make_policy("pid", core.contract())
    result = drive(core, policy, seed=5)
    assert result.run is not None
    commands = read_policy_log(result.run)["command_yaw_rate"]
    assert len(np.unique(commands)) >= 2
    given, answered = act_again(core, policy, result.run)
    np.testing.assert_array_equal(answered, given)


def test_a_policy_tracks_on_the_robot_as_in_simulation(robot_core):
    """Errors on the emulated robot lie where those of randomised simulated robots lie, with the same command."""
    core = robot_core(8.0)
    machine, seen = machine_of(core), []
    loop_of(core).operator.spare = lambda: seen.append(machine.plant.truth().values[0].copy())
    result = drive(core, make_policy("pid", core.contract()), command=COMMAND)
    assert result.reason == "time is over"
    columns = machine.plant.truth().layout.slices
    truth = np.array(seen)[-100 - 30 :][:100]  # the last 2 s before the wheels stop
    speed = truth[:, columns["linear_velocity_in_body"].start].mean()
    turn = truth[:, columns["angular_velocity_in_body"].stop - 1].mean()
    simulated = make_core(
        ID, 32, {"episode_length": 8.0, "task": {"commands": {"terms": held(COMMAND), "zero_probability": 0.0}}}
    )
    rollout = roll_out(simulated, make_policy("pid", simulated.contract()))
    assert not rollout.fell.any()
    for value, series in ((speed, rollout.forward_velocity), (turn, rollout.yaw_rate)):
        low, high = np.percentile(series[-100:].mean(axis=0), [2.5, 97.5])
        assert low <= value <= high


def held(command):
    return {name: [value, value + 1e-9] for name, value in command.items()}


def test_a_stop_by_the_gate_is_reported_and_logged(robot_core):
    core = robot_core()
    loop = loop_of(core)
    machine_of(core).inject("drop wheels after=1.5")
    result = drive(core, make_policy("pid", core.contract()))
    assert result.run is not None
    assert not result.well
    assert result.reason.startswith("silence: no answer from wheel_lf")
    assert loop.phase is Phase.FAULT
    assert len(read_run(result.run).table) == result.ticks
    rules = [event["rule"] for event in read_events(result.run) if event["event"] == "intervention"]
    assert "silence" in rules


def test_a_full_disk_under_the_policys_log_is_a_stop_in_good_order(robot_core, monkeypatch):
    def full(table, values):
        if "policy" in table.path.name:
            raise OSError(28, "No space left on device")
        add(table, values)

    add = CsvTable.add
    monkeypatch.setattr(CsvTable, "add", full)
    core = robot_core()
    result = drive(core, make_policy("pid", core.contract()))
    assert not result.well
    assert result.reason.startswith("computer: the log cannot be written: [Errno 28]")
    assert result.ticks <= 2


def test_a_failing_policy_leaves_no_torque(robot_core):
    core = robot_core()

    class Broken(Wobble):
        def act(self, observations):
            if np.abs(observations).max() > 0.5 and self.state.any():
                raise ZeroDivisionError
            return super().act(observations)

    with pytest.raises(ZeroDivisionError):
        drive(core, Broken(core.observation.shape[1]))
    assert not any(servo["torque_enable"] for servo in machine_of(core).servos.values())


def test_actions_that_are_no_numbers_are_refused_and_torque_goes_off(robot_core):
    core = robot_core()

    class Nan(Wobble):
        def act(self, observations):
            return np.full((1, 8), np.nan, np.float32)

    with pytest.raises(InputError, match="expected a finite number"):
        drive(core, Nan(core.observation.shape[1]))
    assert not any(servo["torque_enable"] for servo in machine_of(core).servos.values())


def test_simulators_are_no_robots():
    core = make_core(ID, 1, {})
    with pytest.raises(InputError, match="'gibbs_appell' is no robot"):
        drive(core, make_policy("do_nothing", core.contract()))
    core.close()


@pytest.mark.slow
def test_a_policys_run_is_replayed_from_its_first_tick(robot_core):
    """The robot drives off at once: the effort of that is no tension that it stood under before."""
    core = robot_core()
    errors = replay(run_of(core)).errors
    assert max(error.segment_rms / error.noise for error in errors.values()) < 8.0  # else 140
    assert errors["gyro_z"].segment_rms < 2.0 * errors["gyro_z"].noise


@pytest.mark.slow
def test_an_emulated_robot_may_hide_something(robot_core, tmp_path):
    """Effects act on what is emulated; environment and policy are not told."""
    runs = {}
    for name, core in (
        ("sound", robot_core(2.0, tmp_path / "sound")),
        ("tired", robot_core(2.0, tmp_path / "tired", effects="tired_battery")),
    ):
        runs[name] = run_of(core)
        assert not core.patch.effects
    assert runs["tired"]["volt"].mean() < runs["sound"]["volt"].mean() - 0.2
    with pytest.raises(InputError, match="a real robot has its own"):
        make_core(ID, 1, {"backend": "dynamixel", "hardware": {"effects": "tired_battery"}})


# ---- command line ------------------------------------------------------------------------------------------------------


def words(folder, *more):
    seconds = [] if "--seconds" in more else ["--seconds", "1"]
    out = [] if "--out" in more else ["--out", str(folder)]
    return ["pid", "--emulated", "--stepped", *seconds, *out, *more]


def test_command_line_in_emulated_time(tmp_path, capsys):
    assert run_command("deploy", words(tmp_path, "--command", "linear_velocity_x=0.05", "yaw_rate=0")) == OK
    said = capsys.readouterr().out
    assert "p95" not in said  # of times that are all zero
    assert "space: motors off at once" not in said  # there is no terminal
    assert "ended: time is over" in said
    assert "track_linear_velocity" in said
    log = read_policy_log(tmp_path / "run_01.csv")
    assert (log["command_linear_velocity_x"] == 0.05).all()


def test_a_policy_trained_mostly_with_a_camera_is_said_to_lack_one(tmp_path, capsys):
    pytest.importorskip("onnxruntime")
    for policy, said in (("path_slip_aware", True), ("velocity_slip_aware", False)):
        assert run_command("deploy", [policy, *words(tmp_path, "--seconds", "0.1")[1:]]) == OK
        assert ("in 70% of its training the policy had a camera" in " ".join(capsys.readouterr().out.split())) is said


def test_an_agent_before_any_training_is_noted_and_moves_no_real_robot(tmp_path, capsys):
    assert run_command("deploy", ["ppo", *words(tmp_path, "--seconds", "0.1")[1:]]) == OK
    assert "note: 'ppo' is the agent before any training; trained ones: path_blind" in capsys.readouterr().err
    with pytest.raises(InputError, match="'ppo' is the agent before any training"):
        run_command("deploy", ["ppo", "--yes"])


def test_a_run_that_ends_on_the_way_to_the_start_pose_names_its_log(tmp_path, capsys):
    stopped = words(tmp_path, "--fault", "drop wheels after=0.2")
    assert run_command("deploy", stopped) == FAILED
    names = [tmp_path / "ramp_01.csv", tmp_path / "run_01.events.jsonl"]
    assert f"written: {', '.join(map(str, names))}" in capsys.readouterr().out
    assert run_command("deploy", [*stopped, "--json"]) == FAILED
    assert json.loads(capsys.readouterr().out)["files"] == [str(path).replace("_01", "_02") for path in names]


def test_the_results_say_which_steps_they_count_and_their_units(tmp_path, capsys):
    assert run_command("deploy", words(tmp_path, "--json")) == OK
    found = json.loads(capsys.readouterr().out)
    assert found["steps"] == 50
    assert found["steps_with_ramp"] > 50
    assert found["statistics"]["missed"] == 0
    assert set(found["statistics"]["read_ms"]) == {"p50", "p95", "p99", "max"}
    assert "ticks" not in json.dumps(found)


def test_the_live_status_shows_what_supervision_sees(robot_core):
    core = robot_core(2.0, deadman=5.0)
    loop = loop_of(core)
    view, seen = RobotView(loop, core), []

    def look():
        if loop.phase is Phase.RUNNING:
            loop.operator.note_sign()
            file = io.StringIO()
            Console(file=file, width=400).print(view.table())
            seen.append(file.getvalue())

    loop.operator.spare = look
    machine_of(core).inject("drop wheel_rf after=1.2 duration=0.1")
    drive(core, make_policy("pid", core.contract()), command=COMMAND)
    status = loop.status
    assert status is not None
    for words in ("running  1.0 s", "linear_velocity_x +0.08", "wheel_rr", "limit 70%", "limit 68", "limit 10.2", "limit 0.7"):
        assert any(words in text for text in seen), words
    assert "operator silent 0.0 s (limit 5)" in seen[-1]
    silent = [text for text in seen if "servos silent 0.00 s" not in text]
    assert 1 <= len(silent) <= 5  # of 20 ms each
    assert "acts on: silence" in silent[-1]
    assert "acts on: nothing" in seen[-1]


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ("overload wheel_rr after=0.8", "alert: wheel_rr has a hardware error"),
        ("encoder_jump leg_lf value=2", "leg_lf     position: 3.57 rad"),  # out of its range: it is not driven
        ("overheat leg_lf value=500", "temperature: leg_lf has"),
    ],
)
def test_command_line_says_why_it_stopped(tmp_path, capsys, fault, reason):
    assert run_command("deploy", words(tmp_path, "--fault", fault)) == FAILED
    assert reason in capsys.readouterr().out


def test_command_line_dry_run(tmp_path):
    assert run_command("deploy", words(tmp_path, "--dry-run")) == OK
    assert read_run(tmp_path / "run_01.csv").meta.notes == "dry run"


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--seconds", "0"], "--seconds 0"),
        (["--seed", "-1"], "--seed -1"),
        (["--deadman", "0"], "--deadman 0"),
        (["--deadman", "nan"], "--deadman nan"),
        (["--deadman", "300"], "--deadman 300: expected more than 0 and at most 10 s"),
        (["--command", "yaw_rate=nan"], "--command: yaw_rate = nan: expected -"),
        (["--command", "speed"], "--command speed: expected name=value, such as yaw_rate=0.1"),
        (["--command", "yaw_rate=fast"], "expected name=number"),
        (["--command", "yaw=1"], "unknown command 'yaw'"),
        (["--port", "legs=/dev/x"], "brings its own ports"),
        (["--fault", "dorp"], r"--fault: unknown fault 'dorp' \(did you mean 'drop'\?\)"),
        (["--fault", "drop lges"], r"--fault: fault 'drop lges': unknown place 'lges' \(did you mean 'legs'\?\)"),
        (["--realtime", "200"], "--realtime 200: expected 1 to 99"),
        (["--out", __file__], "--out .*test_deploy.py: cannot be a folder: it is a file"),
        (["--mcap", __file__], "--mcap .*test_deploy.py: is there already"),
        (["--hardware", "nominl"], "nominal"),
        (["--effects", "tired_batery"], "did you mean 'tired_battery'"),
    ],
)
def test_command_line_bad_options(tmp_path, monkeypatch, more, message):
    monkeypatch.setattr("wlr_gym.cli.deploy.driven_robot", lambda options: None)  # the first that is done after the checks
    with pytest.raises(InputError, match=message):
        run_command("deploy", words(tmp_path, *more))


@pytest.mark.parametrize("reason", ["deadlines: 5 ticks in a row late", "silence: no answer from leg_lf for 0.5 s"])
def test_a_busy_computer_is_named_where_nothing_else_can_be_late(reason):
    emulated = DeployOptions("pid", emulated=True)
    assert "--stepped" in busy_note(emulated, reason)
    assert busy_note(emulated, "tilt: 0.8 rad") == ""
    for other in ({"emulated": False}, {"stepped": True}, {"fault": ("drop legs",)}):
        assert busy_note(replace(emulated, **other), reason) == ""


def test_faults_are_for_the_emulated_robot(tmp_path):
    with pytest.raises(InputError, match="add --emulated"):
        run_command("deploy", ["pid", "--fault", "drop"])
    with pytest.raises(InputError, match="add --emulated"):
        run_command("deploy", ["pid", "--effects", "tired_battery"])
    with pytest.raises(InputError, match="cannot be opened"):
        run_command("deploy", ["pid", "--yes", "--port", f"legs={tmp_path}/none", "--out", str(tmp_path)])


def test_nobody_there_to_start_the_robot(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    there = ["--port", "legs=/dev/null", "wheels=/dev/null", "imu=/dev/null"]
    with pytest.raises(InputError, match="nobody there to start the robot"):
        run_command("deploy", ["pid", "--out", str(tmp_path), *there])
    with pytest.raises(InputError, match="legs port /dev/ttyUSB0: not there"):  # nobody is asked
        run_command("deploy", ["pid", "--out", str(tmp_path)])


@pytest.mark.slow
@pytest.mark.parametrize("stop", ["signal", "key"])
def test_command_line_on_real_terminals(tmp_path, stop):
    """The whole way in real time: emulator process, ports, watchdog process, a stop from outside. No claim about time."""
    pytest.importorskip("termios")
    hardware = hardware_file(tmp_path, {})
    arguments = ["deploy", "pid", "--emulated", "--seconds", "120", "--out", str(tmp_path / "log")]
    code = "import sys; from wlr_gym.cli import run_command; sys.exit(run_command(sys.argv[1], sys.argv[2:]))"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments, "--hardware", str(hardware)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    end = time.monotonic() + 120
    run = tmp_path / "log" / "partial_run_01.csv"
    while time.monotonic() < end and not (run.is_file() and len(run.read_bytes()) > 5000) and process.poll() is None:
        time.sleep(0.05)
    if stop == "signal":
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=60)
    else:
        output, _ = process.communicate(input="q", timeout=60)
    assert process.returncode == OK, output
    assert ("SIGINT" if stop == "signal" else "stop key") in output
    assert len(read_run(tmp_path / "log" / "run_01.csv").table) > 5
    assert json.loads((tmp_path / "log" / "run_01.events.jsonl").read_text().splitlines()[-1])["event"] == "end"


# ---- real time ---------------------------------------------------------------------------------------------------------


class Sleepy:
    """A PID controller that takes two and a half ticks to think, at the ticks of ``sleeps``."""

    def __init__(self, core, sleeps):
        self.pid, self.sleeps, self.tick = make_policy("pid", core.contract()), sleeps, -REHEARSALS

    def act(self, observations):
        self.tick += 1
        if self.tick in self.sleeps:
            time.sleep(2.5 * PERIOD)
        return self.pid.act(observations)

    def reset(self, mask):
        self.pid.reset(mask)


class WallClock:
    """The real clock, on which an emulated robot moves on by a tick in every wait.

    Attributes:
        waits: what was waited for, and when that was over.
    """

    def __init__(self, machine):
        self.machine, self.waits = machine, []

    def now(self):
        return time.monotonic()

    def wait_until(self, moment):
        MonotonicClock().wait_until(moment)
        self.waits.append((moment, self.now()))
        self.machine.advance(PERIOD)


def sleepy_drive(folder, monkeypatch, late, sleeps):
    """Drive 100 ticks in real time; return core, result and the (deadline, time) of the ticks' waits."""
    clocks = []

    def in_real_time(*arguments, **keywords):
        link = emulated_robot(*arguments, **keywords)
        clocks.append(WallClock(link.clock))
        return replace(link, clock=clocks[0])

    monkeypatch.setattr("wlr_gym.hardware.emulator.link.emulated_robot", in_real_time)
    hardware = {"hardware": hardware_file(folder, {}, late=late), "emulated": True, "log": folder / "log"}
    core = make_core(ID, 1, {"backend": "dynamixel", "hardware": hardware, "episode_length": 2.0})
    result = drive(core, Sleepy(core, sleeps), command=COMMAND)
    return core, result, np.array(clocks[0].waits[-int(result.statistics["ticks"]) :])


def times_of(path):
    """Times (s) of the rows of a log; none where a drive did not get so far."""
    return read_run(path)["t"] if path.is_file() else np.zeros(0)


STOP_TICKS = round(HARDWARE.safety.stop_time / PERIOD)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("late", "sleeps", "reason"),
    [(10000, (10, 30, 31, 60), "time is over"), (20, range(20, 100), "deadlines: 20 ticks in a row late")],
    ids=["to its end", "stopped"],
)
def test_every_tick_of_the_wall_clock_is_accounted_for(tmp_path, monkeypatch, late, sleeps, reason):
    """True on any computer, however busy; how well it keeps up is measured by ``python -m studies.bench bus``."""
    core, result, waits = sleepy_drive(tmp_path, monkeypatch, late, sleeps)
    log = tmp_path / "log"
    events, on_the_way, driven = read_events(log / "run_01.csv"), times_of(log / "ramp_01.csv"), times_of(log / "run_01.csv")
    times, (deadlines, woken) = np.concatenate([on_the_way, driven]), waits.T
    statistics = events[-1]["statistics"]
    assert result.reason.startswith(reason)
    assert statistics == result.statistics

    # the log has a row for each tick, between that tick's deadline and the next tick's start
    assert statistics["ticks"] == len(times) == len(deadlines)
    assert (times[1:] >= deadlines[:-1]).all()
    assert (times <= woken).all()
    assert woken[-1] <= events[-1]["t"] + 1e-6
    if result.run is not None:  # else stopped on the way to the start pose, by a computer that sleeps more than the policy
        assert len(driven) == result.ticks + STOP_TICKS
        assert len(read_policy_log(result.run)["action_leg_lf"]) == result.ticks
    assert (result.ticks == 100) == result.well

    # deadlines lie on one grid, and what was left out of it was counted
    steps = np.diff(deadlines) / PERIOD
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert steps.min() > 0.5
    origin = deadlines[0] - PERIOD * (1 + statistics["missed"] - np.sum(np.round(steps) - 1))
    checked = next(event["t"] for event in events if event["event"] == "checks")
    assert checked - 1e-6 <= origin <= times[0]
    assert statistics["missed"] >= len([tick for tick in sleeps if tick < result.ticks])

    # the statistics are of that time: a tick starts when its wait is over, and before what is read in it has its time
    started = np.array([statistics["jitter"][name] for name in ("p50", "p95", "p99", "max")])
    looked = np.append(times[1:], events[-1]["t"])
    for bound, sign in ((woken, 1.0), (looked, -1.0)):
        seen = np.percentile(1e3 * (bound - deadlines), [50, 95, 99, 100])
        assert (sign * (started - seen) >= -2e-3).all()  # they are rounded to 1 us
    assert (statistics["period"]["max"] >= 1e3 * 2.5 * PERIOD) or not result.well

    nothing_is_written_any_more(core, log)
    core.close()


def nothing_is_written_any_more(core, folder):
    """Torque is off; more actions are refused, and change neither what the servos hold nor a file."""

    def seen():
        registers = [servo.read(0, 200)[1] for servo in machine_of(core).servos.values()]
        return registers, {path.name: path.read_bytes() for path in folder.iterdir()}

    assert not any(servo["torque_enable"] for servo in machine_of(core).servos.values())
    before = seen()
    for _ in range(3):
        with pytest.raises((StoppedError, ResetNeeded)):  # the latter where it was stopped before its episode began
            core.step(np.ones((1, 8), np.float32), core.everyone)
    assert seen() == before


def test_an_emulated_robot_has_every_port_of_the_file(tmp_path):
    """A port that stayed the file's own would be the real robot's."""
    content = yaml.safe_load((data_directory("configs") / "hardware/nominal.yaml").read_text())
    legs = content["buses"].pop("legs")
    for name, joints in (("front", legs["joints"][:2]), ("rear", legs["joints"][2:])):
        content["buses"][name] = {**legs, "port": f"/dev/real_{name}", "joints": joints}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(content))
    options = DeployOptions("pid", hardware=str(tmp_path / "mine.yaml"), emulated=True)
    with _emulator(options, Console(stderr=True)) as (ports, _):
        wired = with_ports(load_hardware(options.hardware), ports)
        assert set(ports) == {"wheels", "front", "rear", "imu"}
        assert all("wlr-robot-" in bus.port for bus in (*wired.buses.values(), wired.imu))


@pytest.mark.parametrize(("answer", "starts"), [("", True), ("y", True), ("n", False), ("q", False)])
def test_only_enter_starts_the_robot(answer, starts):
    console = Console(stderr=True)
    console.input = lambda prompt: answer  # pyright: ignore[reportAttributeAccessIssue]
    if starts:
        wait_for_enter(console, "Free floor?")
    else:
        with pytest.raises(KeyboardInterrupt, match="asked not to start the robot"):
            wait_for_enter(console, "Free floor?")
