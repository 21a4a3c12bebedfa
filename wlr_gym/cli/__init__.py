"""The ``wlr`` command. Each sub-command is a module with a frozen dataclass ``Options`` and ``run(options) -> exit code``."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from wlr_gym import __version__
from wlr_gym.errors import InputError, MissingPackageError, unknown_name

OK, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130

#: Command -> what it does, in one line. The module of the same name is imported only when the command is used.
COMMANDS = {
    "envs": "list the environments, or describe one: its actions, observations and rewards",
    "effects": "list the effects that can be added to the robot, explain one, or check patch files",
    "train": "train an agent on an environment; resumes after an interruption",
    "evaluate": "score a policy or agent over many episodes, against baselines, with confidence intervals",
    "export": "write a trained policy as one file (ONNX with its contract) that runs without torch, or its model card",
    "play": "drive a robot in a window with keys or a gamepad, or into a video",
    "replay": "drive a simulator with the commands of measured runs and report where they part",
    "compare": "drive two plants with the same goals and report where they part, in noise units",
    "gap": "find what the model lacks: compare with measured runs, name the missing effect, prove it on runs kept aside",
    "record": "drive a robot or simulator through an excitation and write the measured run",
    "paper": "run the paper's experiments in several models and check its claims",
    "vision": "measure pose and slip from a video of the robot with ring markers",
    "calibrate": "calibrate the robot's joints, its IMU or a camera, or write the marker sheets to print",
    "deploy": "drive the robot with a policy, behind the safety gate",
    "doctor": "look at a robot before it drives: ports, servos, IMU, policy; names the first fault and its remedy",
    "emulate": "emulate the robot's servos and IMU on pseudo-terminals, with faults on command",
    "bench": "measure the speed of the engine, the environments and training on this machine",
    "demo": "train, evaluate and plot in about three minutes",
}


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


def run_command(name: str, arguments: Sequence[str]) -> int:
    """Parse the arguments of one command and run it."""
    import tyro

    module = importlib.import_module(f"wlr_gym.cli.{name}")
    options = tyro.cli(module.Options, prog=f"wlr {name}", description=module.__doc__, args=list(arguments))
    return module.run(options)


def usage() -> str:
    """Return the help text of ``wlr``."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {summary}" for name, summary in COMMANDS.items()]
    return "\n".join(["usage: wlr COMMAND [OPTIONS]", "", *lines, "", "wlr COMMAND --help explains one; wlr --version"])


def _say(message: str, colour: str) -> None:
    from rich.console import Console
    from rich.text import Text

    Console(stderr=True).print(Text.assemble(("wlr: ", f"bold {colour}"), (message, colour)), soft_wrap=True)
