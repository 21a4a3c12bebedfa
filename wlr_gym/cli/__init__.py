"""The ``wlr`` command. Each sub-command is a module with its options, a frozen dataclass, and ``run(options) -> exit code``.

The options of ``wlr train`` are ``train.TrainOptions``, and so on.
"""

from __future__ import annotations

import gc
import importlib
import keyword
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from wlr_gym import __version__
from wlr_gym.base.errors import InputError, MissingPackageError, nearest, unknown_name
from wlr_gym.cli.interruption import interruptible

#: Exit codes; an interrupted command ends as a shell reports SIGINT (128 + 2).
OK = 0
FAILED = 1
BAD_INPUT = 2
INTERRUPTED = 130

#: Modules that this command's ``--import`` named: one that starts another process hands them on.
IMPORTED: list[str] = []

#: Command -> what it does, in one line. The module of the same name is imported only when the command is used.
COMMANDS = {
    "demo": "the whole loop in three and a half minutes: learn, drive on ice, find a hidden fault, adapt to it",
    "envs": "list the environments, or describe one",
    "effects": "list what can be added to the robot's model, explain it, or check patch files",
    "robot": "robot files: new, check, show; import from and export to MJCF and URDF",
    "train": "train an agent on an environment",
    "sweep": "train settings x seeds, or search settings, here or on a Ray cluster",
    "evaluate": "score a policy against baselines, with confidence intervals",
    "play": "drive a robot in a window, in a browser, or into a video",
    "export": "write a policy as one file (ONNX), its model card, or runs as MCAP or rosbag2",
    "record": "drive a robot or simulator through a motion and write the measured run",
    "import": "make measured runs of other programs' logs",
    "view": "watch measured runs in a browser beside what a simulator makes of them",
    "replay": "drive a simulator with the commands of measured runs; where do they diverge?",
    "compare": "drive two simulators with the same setpoints; where do they diverge?",
    "gap": "find what the model lacks: name the missing effect, validate it on held-out runs",
    "adapt": "adapt a policy to a robot: drive, find what the model lacks, train on, test",
    "vision": "measure pose and slip from a video of the robot with ring markers; check: look at the sheets",
    "calibrate": "calibrate joints, IMU, flow sensor or camera; write the marker sheets",
    "doctor": "look at a robot before it drives; names the first fault and its remedy",
    "commission": "test a robot on a stand, compare each result with the emulator",
    "deploy": "drive the robot with a policy, through the command limiter",
    "emulate": "emulate the robot's servos and IMU on pseudo-terminals, with faults",
}

#: Words behind a command that name a module of their own (``vision_check``).
NESTED = {("vision", "check")}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``wlr`` and return its exit code: 0 done, 1 failed, 2 bad input, 130 interrupted."""
    return guarded(_dispatch, sys.argv[1:] if arguments is None else arguments)


def guarded(dispatch: Callable[[list[str]], int], arguments: Sequence[str]) -> int:
    """Do what the words of a command line say and return the exit code; mistakes and interruption are told in one line."""
    words = list(arguments)
    os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")  # numba colours messages that nobody reads
    gc.set_threshold(max(50_000, gc.get_threshold()[0]))  # and leaves much to the garbage collector while it compiles
    try:
        try:
            return _answered(dispatch, words)
        finally:
            print(end="", flush=True)  # here, where it can be caught; at its end Python could only complain
    except BrokenPipeError:
        if not _output_is_closed():
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED


def _answered(dispatch: Callable[[list[str]], int], words: list[str]) -> int:
    try:
        with interruptible():
            return dispatch(words)
    except (InputError, MissingPackageError) as error:
        _say(str(error), "red")
        return BAD_INPUT
    except KeyboardInterrupt as interruption:
        _say(str(interruption) or "interrupted", "yellow")
        return INTERRUPTED


def _output_is_closed() -> bool:
    """Whether nobody reads the output any more: ``wlr ... | head``. Only writing tells, where nothing is left to be flushed."""
    try:
        print(flush=True)
    except BrokenPipeError:
        return True
    return False


def _dispatch(words: list[str]) -> int:
    words = _import_modules(words)
    if not words or words[0] in {"-h", "--help", "help"}:
        print(usage())
        return OK
    if words[0] in {"-V", "--version"}:
        print(f"wlr_gym {__version__}")
        return OK
    if words[0] == "--completion":
        print(_completion(words[1:]))
        return OK
    name, *rest = words
    if name not in COMMANDS:
        raise unknown_name("command", name, COMMANDS)
    return run_command(name, rest)


def _completion(words: list[str]) -> str:
    """Return the script that completes commands and options in a shell."""
    from wlr_gym.cli import parsing

    if len(words) != 1 or words[0] not in parsing.SHELLS:
        raise InputError(f"--completion: expected one of {', '.join(parsing.SHELLS)}, such as: wlr --completion bash")
    nested = {(name, word): options_of(f"{name}_{word}") for name, word in NESTED}
    return parsing.completion(words[0], "wlr", {name: options_of(name) for name in COMMANDS}, nested)


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
    _check_word(name, arguments)
    return run_options(parse(name, arguments), _module(name).run)


def run_options(options: Any, run: Callable[[Any], int]) -> int:
    """Run a command with its options; with ``--json`` only results are printed on the standard output."""
    from wlr_gym.cli.results import only_results

    with only_results(getattr(options, "json", False)):
        return run(options)


def run_program(program: str, kind: type, run: Callable[[Any], int], description: str, arguments: Sequence[str] | None) -> int:
    """Be a program of one command, ``python -m PROGRAM``, as ``wlr`` runs its commands; return the exit code."""

    def dispatch(words: list[str]) -> int:
        return run_words(program, kind, run, description, words)

    return guarded(dispatch, sys.argv[1:] if arguments is None else arguments)


def run_words(program: str, kind: type, run: Callable[[Any], int], description: str, words: Sequence[str]) -> int:
    """Parse the words of a program of one command and run it."""
    from wlr_gym.cli import parsing

    return run_options(parsing.parse(kind, program, words, description), run)


def _check_word(name: str, arguments: Sequence[str]) -> None:
    """Refuse a first word that is neither a file nor a command of this command, but nearly one of the latter."""
    word = next(iter(arguments), "")
    hint = nearest(word, [inner for outer, inner in NESTED if outer == name])
    if hint and not Path(word).suffix and not Path(word).exists():
        raise InputError(f"unknown word '{word}'{hint}; see: wlr {name} --help")


def parse(name: str, arguments: Sequence[str]) -> Any:
    """Return the options of one command; SystemExit after ``--help``.

    Raises:
        InputError: arguments that do not parse.
    """
    from wlr_gym.cli import parsing

    module, program = _module(name), f"wlr {name.replace('_', ' ')}"
    kind = options_of(name)
    if isinstance(kind, dict):
        return parsing.chosen(program, kind, arguments, module.__doc__ or "")
    return parsing.parse(kind, program, arguments, module.__doc__ or "")


def options_of(name: str) -> Any:
    """Return the options of one command, a dataclass; of one with commands of its own: name -> options and what it does."""
    module = _module(name)
    return getattr(module, "COMMANDS", None) or getattr(module, f"{''.join(map(str.capitalize, name.split('_')))}Options")


def _module(name: str) -> Any:
    """Import the module of a command; a word of Python cannot be a module's name, and gets an underscore."""
    return importlib.import_module(f"wlr_gym.cli.{name}{'_' if keyword.iskeyword(name) else ''}")


def usage() -> str:
    """Return the help text of ``wlr``."""
    from wlr_gym.cli import parsing

    hints = (
        "wlr COMMAND --help explains one; wlr --version",
        "wlr --import MODULE COMMAND first imports what adds to the library",
        "wlr --completion bash (or zsh, fish) prints what completes commands and options",
    )
    return "\n".join([parsing.usage("wlr", COMMANDS), "", *map(parsing.wrapped, hints)])


def _say(message: str, colour: str) -> None:
    from rich.console import Console
    from rich.text import Text

    Console(stderr=True).print(Text.assemble(("wlr: ", f"bold {colour}"), (message, colour)), soft_wrap=True)
