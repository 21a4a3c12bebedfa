"""The ``wlr`` command. Each sub-command is a module with its options, a frozen dataclass, and ``run(options) -> exit code``.

The options of ``wlr train`` are ``train.TrainOptions``, and so on.
"""

from __future__ import annotations

import _thread
import contextlib
import errno
import gc
import importlib
import keyword
import os
import shutil
import signal
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from wlr_gym import __version__
from wlr_gym.base.errors import InputError, MissingPackageError, nearest, unknown_name

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


#: Commands whose ``--out`` is a folder that nobody else may write to meanwhile; train, sweep and adapt see to it themselves.
WRITE_A_FOLDER = {"demo", "evaluate", "record", "replay", "compare", "gap", "vision", "commission", "deploy"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``wlr`` and return its exit code: 0 done, 1 failed, 2 bad input, 130 interrupted."""
    return guarded(_dispatch, sys.argv[1:] if arguments is None else arguments)


def guarded(dispatch: Callable[[list[str]], int], words: Sequence[str]) -> int:
    """Do what the words of a command line say and return the exit code; mistakes and interruption are told in one line."""
    os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")  # numba colours messages that nobody reads
    gc.set_threshold(max(50_000, gc.get_threshold()[0]))  # and leaves much to the garbage collector while it compiles
    try:
        try:
            return _answered(dispatch, list(words))
        finally:
            print(end="", flush=True)  # here, where it can be caught; at its end Python could only complain
    except BrokenPipeError:  # nobody reads the output any more: wlr ... | head; or it is another pipe, and our error
        if _output_is_open():
            raise
        return FAILED
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        _say(f"{error.filename or 'output'}: cannot be written: {error.strerror}", "red")
        _output_is_open()
        return FAILED


def _output_is_open() -> bool:
    """Whether what is printed is still written; where it is not, nothing of it is, and Python does not complain at its end."""
    try:
        print(flush=True)  # only writing tells, where nothing is left to be flushed
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return False
    return True


def _answered(dispatch: Callable[[list[str]], int], words: list[str]) -> int:
    try:
        with interruptible():
            return dispatch(words)
    except SystemExit as end:  # of the parser: after help, or a mistake that it has told
        if isinstance(end.code, str):
            raise
        return end.code or OK
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
    if words[0] == "--completion":
        return _completion(words[1:])
    name, *rest = words
    if name not in COMMANDS:
        raise unknown_name("command", name, COMMANDS)
    return run_command(name, rest)


def _completion(words: list[str]) -> int:
    """Print the script that completes commands and options in a shell."""
    from wlr_gym.cli.options import SHELLS, one_of, parse

    if len(words) != 1 or words[0] not in SHELLS:
        raise InputError(f"--completion: expected one of {', '.join(SHELLS)}, such as: wlr --completion bash")
    return parse(one_of({name: options_of(name) for name in COMMANDS}), "wlr", ["--tyro-print-completion", words[0]])


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
    options, module = parse_command(name, arguments), _module(name)
    own = (run for kind, run in getattr(module, "COMMANDS", {}).values() if type(options) is kind)
    run = next(own, None) or module.run
    return run_options(options, partial(_alone, run) if name in WRITE_A_FOLDER and run is module.run else run)


def _alone(run: Callable[[Any], int], options: Any) -> int:
    """Run a command that holds the folder for its results."""
    from wlr_gym.base.files import alone_in

    with alone_in(options.out):
        return run(options)


def run_options(options: Any, run: Callable[[Any], int]) -> int:
    """Run a command with its options; with ``--json`` only results are printed on the standard output."""
    from wlr_gym.cli.terminal import only_results

    with only_results(getattr(options, "json", False)):
        return run(options)


def run_program(program: str, kind: type, run: Callable[[Any], int], description: str, arguments: Sequence[str] | None) -> int:
    """Be a program of one command, ``python -m PROGRAM``, as ``wlr`` runs its commands; return the exit code."""
    from wlr_gym.cli.options import parse

    words = sys.argv[1:] if arguments is None else arguments
    return guarded(lambda words: run_options(parse(kind, program, words, description), run), words)


def parse_command(name: str, arguments: Sequence[str]) -> Any:
    """Return the options of one command; see :func:`wlr_gym.cli.options.parse`."""
    from wlr_gym.cli.options import one_of, parse

    program, kind, description = f"wlr {name}", options_of(name), _module(name).__doc__ or ""
    if not isinstance(kind, Mapping):
        return parse(kind, program, arguments, description)
    word, names = next(iter(arguments), ""), [one for one in kind if one]
    if word in names:
        return parse(kind[word], f"{program} {word}", arguments[1:])
    if "" not in kind:
        if word and not word.startswith("-"):
            raise unknown_name(f"command of {program}", word, names)
        if not word:
            raise InputError(f"expected one of {', '.join(names)}; see: {program} --help")
        return parse(one_of(kind), program, arguments, description)
    hint = nearest(word, names)
    if hint and not Path(word).suffix and not Path(word).exists():  # neither a file nor a command, but nearly the latter
        raise InputError(f"unknown word '{word}'{hint}; see: {program} --help")
    return parse(kind[""], program, arguments, description)


def options_of(name: str) -> Any:
    """Return a command's options, a dataclass; of one with commands of its own: name -> options, "" = those beside them."""
    module = _module(name)
    own, commands = getattr(module, f"{name.capitalize()}Options", None), getattr(module, "COMMANDS", None)
    if commands is None:
        return own
    return ({} if own is None else {"": own}) | {word: kind for word, (kind, _) in commands.items()}


def _module(name: str) -> Any:
    """Import the module of a command; a word of Python cannot be a module's name, and gets an underscore."""
    return importlib.import_module(f"wlr_gym.cli.{name}{'_' if keyword.iskeyword(name) else ''}")


def usage() -> str:
    """Return the help text of ``wlr``, as wide as the terminal but 80 columns at most."""
    width = min(80, shutil.get_terminal_size().columns)
    listed = [textwrap.fill(f"  {name:<12}{text}", width, subsequent_indent=" " * 14) for name, text in COMMANDS.items()]
    more = [
        "wlr COMMAND --help explains one; wlr --version",
        "wlr --import MODULE COMMAND first imports what adds to the library",
        "wlr --completion bash (or zsh, fish) prints what completes commands and options",
    ]
    return "\n".join(["usage: wlr COMMAND [OPTIONS]", "", *listed, "", *(textwrap.fill(line, width) for line in more)])


def _say(message: str, colour: str) -> None:
    from rich.console import Console
    from rich.text import Text

    Console(stderr=True).print(Text.assemble(("wlr: ", f"bold {colour}"), (message, colour)), soft_wrap=True)


# ---- interruption -----------------------------------------------------------------------------------------------------

#: s after which an interruption that could not end the command comes again.
_AGAIN = 0.05
#: s for which an import may hold one up.
_PATIENCE = 10.0


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt for Ctrl-C in here, but after an import: some packages catch it there, and callbacks lose it."""
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    waiting: list[threading.Timer] = []
    before, since = sys.unraisablehook, 0.0

    def come_again() -> None:
        waiting[:] = [threading.Timer(_AGAIN, _interrupt_main)]
        waiting[0].daemon = True
        waiting[0].start()

    def interrupt(_: int, frame: FrameType | None) -> None:
        nonlocal since
        since = since or time.monotonic()
        if not _imports(frame) or time.monotonic() > since + _PATIENCE:
            raise KeyboardInterrupt
        come_again()

    def note(lost: Any) -> None:
        if lost.exc_type is KeyboardInterrupt:  # in a callback, where Python can only complain
            come_again()
        else:
            before(lost)

    sys.unraisablehook = note
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.unraisablehook = before
        for timer in waiting:
            timer.cancel()


def _interrupt_main() -> None:
    """Interrupt the main thread, also where it waits in a system call."""
    if hasattr(signal, "pthread_kill") and (main := threading.main_thread().ident) is not None:
        signal.pthread_kill(main, signal.SIGINT)
    else:
        _thread.interrupt_main()


def _imports(frame: FrameType | None) -> bool:
    """Whether a module is being imported in this command."""
    while frame is not None and frame.f_globals.get("__name__") != "wlr_gym.cli":
        if frame.f_globals.get("__name__") == "importlib._bootstrap":
            return True
        frame = frame.f_back
    return False
