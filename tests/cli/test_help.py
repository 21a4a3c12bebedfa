"""What ``--help`` shows on a terminal of 80 columns, and what completes commands and options in a shell."""

import contextlib
import io
import re
import shutil
import subprocess

import pytest

from wlr_gym import cli
from wlr_gym.cli.options import SHELLS

WORDS = [[name] for name in cli.COMMANDS]
WORDS += [[name, word] for name in ("robot", "calibrate", "vision") for word in cli.options_of(name) if word]


@pytest.fixture(params=WORDS, ids=" ".join, scope="module")
def shown(request):
    out = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
        patch.setenv("COLUMNS", "80")
        assert cli.main([*request.param, "--help"]) == 0
    usage, *lines = out.getvalue().splitlines()
    assert usage.startswith(f"usage: wlr {' '.join(request.param)} ")
    assert max(map(len, lines)) <= 80
    return "\n".join(line.strip("\u2502| ") for line in lines)


@pytest.mark.parametrize("columns", [60, 120])
def test_the_list_of_commands_is_as_wide_as_the_terminal_and_at_most_80(columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(columns))
    assert cli.main([]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= min(columns, 80)


def test_words_behind_a_command_are_in_its_help(capsys):
    assert cli.main(["vision", "--help"]) == 0
    assert "wlr vision check" in capsys.readouterr().out
    assert "check" in cli.COMMANDS["vision"]


def test_help_has_no_markup_and_no_types_of_python(shown):
    assert not re.search(r"`|\*\*|:\w+:|None|\(\)|False", shown)


def test_a_default_is_said_once(shown):
    for option in re.split(r"\n(?=--)", shown.partition(" options ")[2]):
        described = " ".join(option.split())
        assert not ("(default:" in described and re.search(r"[^(]default[ :]", described.partition("(default:")[0])), described
        assert described.count("(default:") <= 1, described


def test_a_default_is_written_in_one_way(shown):
    assert not re.search(r"[;,.] default(?! ?:)|\(\d+[:)]", " ".join(shown.split()))


def test_every_option_is_described(shown):
    for option in re.split(r"\n(?=--)", shown.partition(" options ")[2])[1:]:
        assert re.search(r"[A-Za-z]{2,}.* [a-z]{2,}", option.partition(" ")[2]), option


@pytest.mark.parametrize(
    ("option", "wording"),
    [
        ("--hardware STR", "ardware file (wiring, mounting, safety limits), or name in configs/hardware/"),
        ("--robot STR", "obot file, or name in configs/robot/"),
        ("--port [STR [STR ...]]", "Other ports than the hardware file's, such as legs=/dev/ttyUSB1 imu=/dev/ttyACM0"),
    ],
)
def test_an_option_of_many_commands_has_one_wording(shown, option, wording):
    text = " ".join(shown.split())
    if option in text:
        assert wording in text.rpartition(option)[2][:300]


def test_own_options_come_before_shared_ones(capsys):
    cli.main(["evaluate", "--help"])
    shown = capsys.readouterr().out
    places = [shown.index(option) for option in ("--env ", "--progress", "--json", "--effects", "--sensors")]
    assert places == sorted(places)


@pytest.mark.parametrize("shell", SHELLS)
def test_a_shell_takes_the_completion(shell, capsys, tmp_path):
    assert cli.main(["--completion", shell]) == 0
    script = capsys.readouterr().out
    assert all(word in script for word in ("evaluate", "--episodes", "calibrate", "joints"))
    if program := shutil.which(shell):
        file = tmp_path / "wlr"
        file.write_text(script)
        subprocess.run([program, "-n", str(file)], check=True, timeout=60)


def test_bash_completes_commands_and_options(capsys, tmp_path):
    if shutil.which("bash") is None:
        pytest.skip("no bash here")
    cli.main(["--completion", "bash"])
    (tmp_path / "wlr").write_text(capsys.readouterr().out)
    ask = 'source "$0"; {}; COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); _tyro_wlr; printf "%s\\n" "${{COMPREPLY[@]}}"'
    cases = (
        *(("wlr ev", "evaluate"), ("wlr evaluate --epi", "--episodes"), ("wlr calibrate jo", "joints")),
        *(("wlr vision che", "check"), ("wlr vision --anno", "--annotate"), ("wlr vision check --on", "--only")),
    )
    for words, expected in cases:
        script = ask.format(f"COMP_WORDS=({words})")
        answer = subprocess.run(
            ["bash", "-c", script, str(tmp_path / "wlr")], capture_output=True, text=True, check=True, timeout=60
        )
        assert expected in answer.stdout.split(), (words, answer.stdout)


def test_an_unknown_shell_is_refused(capsys):
    assert cli.main(["--completion", "tcsh"]) == 2
    assert "expected one of bash, zsh, fish" in capsys.readouterr().err
