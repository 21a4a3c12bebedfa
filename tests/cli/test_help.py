"""What ``--help`` shows on a terminal of 80 columns, and what completes commands and options in a shell."""

import contextlib
import io
import itertools
import re
import shutil
import subprocess

import pytest

from wlr_gym import cli
from wlr_gym.cli import parsing

WORDS = [[name] for name in cli.COMMANDS] + [list(words) for words in cli.NESTED]
WORDS += [[name, word] for name in ("robot", "calibrate") for word in cli.options_of(name)]


@pytest.fixture(params=WORDS, ids=" ".join, scope="module")
def shown(request):
    out = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
        patch.setenv("COLUMNS", "80")
        with pytest.raises(SystemExit, match="0"):
            cli.main([*request.param, "--help"])
    return out.getvalue()


def test_help_fits_80_columns(shown):
    assert max(map(len, shown.splitlines())) <= 80


def test_help_has_no_padding(shown):
    assert not re.search(r"[ \n]\n\Z| $", shown, re.MULTILINE)
    assert not re.search(r"\n\n  -", shown), "a blank line between two options"


@pytest.mark.parametrize("columns", [60, 120])
@pytest.mark.parametrize("words", [["evaluate", "--help"], ["robot", "--help"], ["help"]], ids=" ".join)
def test_help_is_as_wide_as_the_terminal_and_at_most_80(words, columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(columns))
    with contextlib.suppress(SystemExit):
        cli.main(words)
    usage, *lines = capsys.readouterr().out.splitlines()
    assert max(map(len, [usage, *lines])) <= min(columns, 80)
    options = lines[lines.index(" options") :] if " options" in lines else []
    assert all(line.startswith(" ") for line in options), "a rule or a text is broken"


def test_words_behind_a_command_are_in_its_help(capsys):
    for name, word in cli.NESTED:
        with pytest.raises(SystemExit):
            cli.main([name, "--help"])
        assert f"wlr {name} {word}" in capsys.readouterr().out
        assert word in cli.COMMANDS[name]


@pytest.mark.parametrize("name", ["evaluate", "robot", "calibrate"])
def test_help_begins_with_the_usage(name, capsys):
    with pytest.raises(SystemExit):
        cli.main([name, "--help"])
    assert capsys.readouterr().out.startswith(f"usage: wlr {name}")


def test_help_has_no_markup_and_no_types_of_python(shown):
    assert not re.search(r"`|\*\*|:\w+:|\{None\}|None|\(\)|True|False", shown)


def test_a_default_is_said_once(shown):
    for option in re.split(r"\n(?=  (?:-|\[|[A-Z]))", shown):
        described = " ".join(option.split())
        assert not ("(default:" in described and re.search(r"[^(]default[ :]", described.partition("(default:")[0])), described
        assert described.count("(default:") <= 1, described


def test_a_default_is_written_in_one_way(shown):
    assert not re.search(r"[;,.] default(?! ?:)|\(\d+[:)]", " ".join(shown.split()))


def test_every_option_is_described(shown):
    lines = [*shown.partition("\n options\n")[2].splitlines(), ""]
    for line, following in itertools.pairwise(lines):
        if re.match(r"  --\S", line) and "  " not in line.strip():  # its text is below it
            assert re.match(r" {8,}\S", following), line


@pytest.mark.parametrize(
    ("option", "wording"),
    [
        ("--hardware STR", "ardware file (wiring, mounting, safety limits), or name in configs/hardware/"),
        ("--robot STR", "obot file, or name in configs/robot/"),
        ("--port [STR ...]", "Other ports than the hardware file's, such as legs=/dev/ttyUSB1 imu=/dev/ttyACM0"),
    ],
)
def test_an_option_of_many_commands_has_one_wording(shown, option, wording):
    text = " ".join(shown.split())
    if option in text:
        assert wording in text.rpartition(option)[2][:300]


def test_own_options_come_before_shared_ones():
    names = list(parsing.options_of(cli.options_of("evaluate")))
    assert names[0] == "policy"
    assert names[-2:] == ["effects", "sensors"]


def test_usage_fits_80_columns(capsys):
    cli.main([])
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80


@pytest.mark.parametrize("shell", parsing.SHELLS)
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
