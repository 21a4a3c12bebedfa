"""The ``wlr`` command: exit codes and messages."""

import importlib
import os
import signal
import subprocess
import sys
import time
import types
from dataclasses import dataclass

import pytest
from rich.console import Console

import wlr_gym
from wlr_gym import cli
from wlr_gym.base.errors import InputError, MissingPackageError
from wlr_gym.cli import deploy


@dataclass(frozen=True)
class NoOptions:
    pass


@pytest.fixture
def command(monkeypatch):
    """Return a function that makes ``wlr probe`` raise, return or call what it is given."""

    def make(outcome):
        def run(options):
            if isinstance(outcome, BaseException):
                raise outcome
            return outcome() if callable(outcome) else outcome

        module = types.ModuleType("wlr_gym.cli.probe")
        module.__dict__.update(ProbeOptions=NoOptions, run=run)
        monkeypatch.setitem(sys.modules, "wlr_gym.cli.probe", module)
        monkeypatch.setitem(cli.COMMANDS, "probe", "for tests")

    return make


@pytest.mark.parametrize(
    ("words", "said"),
    [(["--help"], list(cli.COMMANDS)), ([], ["usage: wlr"]), (["--version"], [wlr_gym.__version__])],
    ids=["help", "nothing", "version"],
)
def test_what_the_program_says_of_itself(words, said, capsys):
    assert cli.main(words) == 0
    shown = capsys.readouterr().out
    assert all(text in shown for text in said)


def test_unknown_command_names_the_nearest(capsys):
    assert cli.main(["trian"]) == 2
    shown = capsys.readouterr()
    assert "did you mean 'train'?" in shown.err
    assert shown.out == ""


@pytest.mark.parametrize(
    ("outcome", "code"),
    [(0, 0), (1, 1), (InputError("bad"), 2), (MissingPackageError("absent"), 2), (KeyboardInterrupt(), 130)],
)
def test_exit_codes(command, outcome, code):
    command(outcome)
    assert cli.main(["probe"]) == code


LOSES_IT = {
    "package": "try:\n    signal.raise_signal(signal.SIGINT)\nexcept BaseException:\n    pass\n",
    "callback": "class Lost:\n    def __del__(self):\n        signal.raise_signal(signal.SIGINT)\n",
}


@pytest.fixture
def foreground():
    """Ctrl-C as on a terminal: a background shell has switched it off."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("foreground")
@pytest.mark.parametrize("how", LOSES_IT)
def test_an_interruption_that_a_package_or_a_callback_loses_comes_again(how, command, tmp_path, monkeypatch, capsys):
    (tmp_path / f"loses_it_{how}.py").write_text(f"import signal\n{LOSES_IT[how]}")
    monkeypatch.syspath_prepend(tmp_path)

    def work():
        module = importlib.import_module(f"loses_it_{how}")
        getattr(module, "Lost", object)()
        for _ in range(500):
            time.sleep(0.01)

    command(work)
    assert cli.main(["probe"]) == cli.INTERRUPTED
    assert capsys.readouterr().err == "wlr: interrupted\n"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_input_error_is_one_line_without_traceback(command, capsys):
    command(InputError("file x, line 3: expected [a], got 'b'"))
    cli.main(["probe"])
    assert capsys.readouterr().err == "wlr: file x, line 3: expected [a], got 'b'\n"


def test_other_errors_are_not_swallowed(command):
    command(RuntimeError("a fault of ours"))
    with pytest.raises(RuntimeError, match="a fault of ours"):
        cli.main(["probe"])


def test_bad_option_exits_with_2(command, capsys):
    command(0)
    assert cli.main(["probe", "--nonsense"]) == 2
    shown = capsys.readouterr().err
    assert "Unrecognized options: --nonsense" in shown
    assert "wlr probe --help" in shown


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("words", [["help"], ["train", "--help"], ["effects", "--json"]], ids=" ".join)
def test_ends_silently_when_nobody_reads(words, unbuffered):
    ours, theirs = os.pipe()
    os.close(ours)
    program = "import sys; from wlr_gym.cli import main; sys.exit(main())"
    with os.fdopen(theirs, "wb") as pipe:
        ended = subprocess.run(
            [sys.executable, "-c", program, *words],
            stdout=pipe, stderr=subprocess.PIPE, env=os.environ | {"PYTHONUNBUFFERED": unbuffered}, timeout=60, check=False,
        )  # fmt: skip
    assert (ended.returncode, ended.stderr) == (cli.FAILED, b"")


def test_modules_are_imported_first(tmp_path, monkeypatch, capsys):
    (tmp_path / "adds_a_command.py").write_text("from wlr_gym import cli\ncli.COMMANDS['probe'] = 'from a module of my own'\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(cli, "COMMANDS", dict(cli.COMMANDS))
    assert cli.main(["--import", "adds_a_command", "--help"]) == 0
    assert "from a module of my own" in capsys.readouterr().out
    assert cli.IMPORTED == ["adds_a_command"]
    assert cli.main(["--import=adds_a_command", "--version"]) == 0
    assert cli.IMPORTED == ["adds_a_command"]
    assert cli.main(["--version"]) == 0
    assert cli.IMPORTED == []


@pytest.mark.parametrize("words", [["--import"], ["--import", "no_such_module_here", "envs"], ["--import", ".foo", "envs"]])
def test_a_module_that_is_not_there_is_named(words, capsys, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert cli.main(words) == 2
    assert "expected a module of Python" in capsys.readouterr().err


def test_an_emulator_of_its_own_process_imports_the_same(monkeypatch):
    asked = []

    def start(command, **_):
        asked.extend(command)
        raise OSError("no process today")

    monkeypatch.setattr("subprocess.Popen", start)
    monkeypatch.setattr(deploy, "IMPORTED", ["mine"])
    with pytest.raises(OSError, match="today"), deploy._emulator(deploy.DeployOptions("pid", emulated=True), Console()):
        pass
    assert asked[3:6] == ["--import", "mine", "emulate"]


def test_an_option_given_twice_is_refused(capsys):
    """The parser would take the last one and drop the others without a word."""
    assert cli.main(["train", "WLR-Velocity-v0", "--set", "total_steps=1000", "--set", "seed=1"]) == 2
    assert "--set is given twice; all its values go behind one: --set FIRST SECOND" in capsys.readouterr().err


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
@pytest.mark.parametrize("words", ["envs", "--help", "effects"])
def test_output_onto_a_full_disk_ends_in_one_line(words):
    code = "import sys; from wlr_gym.cli import main; sys.exit(main(sys.argv[1:]))"
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-c", code, words], stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "wlr: output: cannot be written: No space left on device\n")
