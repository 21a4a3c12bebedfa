"""The ``wlr`` command. Each sub-command is a module with its options, a frozen dataclass, and ``run(options) -> exit code``.

The options of ``wlr train`` are ``train.TrainOptions``, and so on.
"""

from __future__ import annotations

import importlib
import keyword
import os
import sys
from collections.abc import Sequence
from typing import Any

from wlr_gym import __version__
from wlr_gym.base.errors import InputError, MissingPackageError, unknown_name

#: Exit codes; an interrupted command ends as a shell reports SIGINT (128 + 2).
OK = 0
FAILED = 1
BAD_INPUT = 2
INTERRUPTED = 130

#: Modules that this command's ``--import`` named: one that starts another process hands them on.
IMPORTED: list[str] = []

#: Command -> what it does, in one line. The module of the same name is imported only when the command is used.
COMMANDS = {
    "envs": "list the environments, or describe one: its actions, observations and rewards",
    "effects": "list the effects that can be added to the robot, explain one, or check patch files",
    "robot": "robot files of your own: new, check, show, import from and export to MJCF and URDF",
    "train": "train an agent on an environment; resumes after an interruption",
    "sweep": "train settings x seeds, or search settings, on this machine or a Ray cluster; resumes trial by trial",
    "evaluate": "score a policy or agent over many episodes, against baselines, with confidence intervals",
    "export": "write a policy as one file (ONNX) that runs without torch, or its model card; runs as MCAP or rosbag2",
    "play": "drive a robot in a window or a browser with keys or a gamepad, or into a video",
    "view": "watch measured runs in a browser beside what a simulator makes of them; works over ssh, without internet",
    "replay": "drive a simulator with the commands of measured runs and report where they diverge",
    "compare": "drive two plants with the same setpoints and report where they diverge, in noise units",
    "gap": "find what the model lacks: compare with measured runs, name the missing effect, validate it on held-out runs",
    "import": "make measured runs of other programs' logs: MCAP, rosbags, CSV, Parquet, LeRobot; proposes what is what",
    "record": "drive a robot or simulator through an excitation and write the measured run",
    "paper": "run the paper's experiments in several models and check its claims",
    "vision": "measure pose and slip from a video of the robot with ring markers",
    "calibrate": "calibrate the robot's joints, its IMU or a camera, or write the marker sheets to print",
    "deploy": "drive the robot with a policy, through the command limiter",
    "doctor": "look at a robot before it drives: ports, servos, IMU, policy; names the first fault and its remedy",
    "commission": "test a robot on a stand, compare each result with the emulator, write what was measured",
    "emulate": "emulate the robot's servos and IMU on pseudo-terminals, with faults on command",
    "adapt": "adapt a policy to a robot: drive, find what the model lacks, train on with it, test, drive again; one page",
    "bench": "measure the speed of the engine, the environments and training on this machine",
    "demo": "the whole loop in about three minutes: learn, drive on ice, find the hidden fault of a robot; one page",
}

#: Words behind a command that name a module of their own (``vision_check``).
NESTED = {("vision", "check")}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``wlr`` and return its exit code: 0 done, 1 failed, 2 bad input, 130 interrupted."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        return _dispatch(words)
    except (InputError, MissingPackageError) as error:
        _say(str(error), "red")
        return BAD_INPUT
    except KeyboardInterrupt as interruption:
        _say(str(interruption) or "interrupted", "yellow")
        return INTERRUPTED


def _dispatch(words: list[str]) -> int:
    words = _import_modules(words)
    if not words or words[0] in {"-h", "--help", "help"}:
        print(usage())
        return OK
    if words[0] in {"-V", "--version"}:
        print(f"wlr_gym {__version__}")
        return OK
    name, *rest = words
    if name not in COMMANDS:
        raise unknown_name("command", name, COMMANDS)
    return run_command(name, rest)


def _import_modules(words: list[str]) -> list[str]:
    """Import what ``--import MODULE`` names, so that a command knows what it registers; return the words after it."""
    IMPORTED.clear()
    while words and words[0].partition("=")[0] == "--import":
        module, words = (words[0].partition("=")[2], words[1:]) if "=" in words[0] else ("".join(words[1:2]), words[2:])
        if os.getcwd() not in sys.path:
            sys.path.insert(0, os.getcwd())  # as for python -m: modules lie where one works
        try:
            importlib.import_module(module)
        except (ModuleNotFoundError, TypeError, ValueError) as error:
            raise InputError(f"--import {module}: expected a module of Python: {error}") from None
        IMPORTED.append(module)
    return words


def run_command(name: str, arguments: Sequence[str]) -> int:
    """Parse the arguments of one command and run it."""
    if (name, *arguments[:1]) in NESTED:
        name, arguments = f"{name}_{arguments[0]}", arguments[1:]
    return _module(name).run(parse(name, arguments))


def parse(name: str, arguments: Sequence[str]) -> Any:
    """Return the options of one command; SystemExit after ``--help`` and arguments that do not parse.

    Raises:
        InputError: an option given twice, of which the parser would drop all but the last.
    """
    import tyro

    given = [word.partition("=")[0] for word in arguments if word.startswith("--")]
    for option in given:
        if given.count(option) > 1:
            raise InputError(f"wlr {name}: {option} is given twice; all its values go behind one: {option} FIRST SECOND")
    module = _module(name)
    kind = getattr(module, "".join(part.capitalize() for part in name.split("_")) + "Options")
    return tyro.cli(kind, prog=f"wlr {name.replace('_', ' ')}", description=module.__doc__, args=list(arguments))


def _module(name: str) -> Any:
    """Import the module of a command; a word of Python cannot be a module's name, and gets an underscore."""
    return importlib.import_module(f"wlr_gym.cli.{name}{'_' if keyword.iskeyword(name) else ''}")


def usage() -> str:
    """Return the help text of ``wlr``."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {summary}" for name, summary in COMMANDS.items()]
    hint = "wlr COMMAND --help explains one; wlr --version\nwlr --import MODULE COMMAND first imports what adds to the library"
    return "\n".join(["usage: wlr COMMAND [OPTIONS]", "", *lines, "", hint])


def _say(message: str, colour: str) -> None:
    from rich.console import Console
    from rich.text import Text

    Console(stderr=True).print(Text.assemble(("wlr: ", f"bold {colour}"), (message, colour)), soft_wrap=True)
