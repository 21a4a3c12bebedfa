"""Kept machine code: one place, read where it is whole and of this version, made anew otherwise, by one process at a time."""

import importlib.util
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

import wlr_gym
from wlr_gym.base.compiled import cache_directory
from wlr_gym.physics.codegen import load_module

MODULE = """
from typing import NamedTuple
from kept_other import OFFSET, twice
from wlr_gym.base.compiled import compiled

class Pair(NamedTuple):
    first: float
    second: float

@compiled
def total(pair):
    return twice(pair.first + pair.second) + OFFSET
"""
OTHER = """
from wlr_gym.base.compiled import compiled
OFFSET = 1.0

@compiled
def twice(x):
    return 2.0 * x
"""


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Load the modules anew, as another process would; returns the first. What is compiled is kept in ``cache``."""
    monkeypatch.setenv("WLR_GYM_CACHE", str(tmp_path / "cache"))
    for name, text in (("kept_pair", MODULE), ("kept_other", OTHER)):
        (tmp_path / f"{name}.py").write_text(text)

    def load(**changes):
        for name in ("kept_other", "kept_pair"):
            path = tmp_path / f"{name}.py"
            if name in changes:
                path.write_text(path.read_text().replace(*changes[name]))
            spec = importlib.util.spec_from_file_location(name, path)
            assert spec is not None
            assert spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            monkeypatch.setitem(sys.modules, name, module)
            exec(compile(path.read_text(), path, "exec"), module.__dict__)  # two changes within a second: no .pyc
        return module

    return load


def hits(module):
    return sum(module.total.stats.cache_hits.values())


def test_the_second_process_loads_what_the_first_compiled(load):
    for expected in (0, 1):
        module = load()
        assert module.total(module.Pair(1.0, 2.0)) == 7.0
        assert hits(module) == expected


@pytest.mark.parametrize(
    ("change", "expected"),
    [({"kept_other": ("2.0 *", "3.0 *")}, 10.0), ({"kept_other": ("OFFSET = 1.0", "OFFSET = 2.0")}, 8.0)],
)
def test_it_is_compiled_anew_when_what_it_calls_or_names_in_another_file_changes(load, change, expected):
    first = load()
    first.total(first.Pair(1.0, 2.0))
    second = load(**change)
    assert second.total(second.Pair(1.0, 2.0)) == expected
    assert hits(second) == 0


def zeros(text: bytes) -> bytes:
    return text[: len(text) // 2] + bytes(len(text) - len(text) // 2)


DAMAGE = {
    "another version": lambda text: text.replace(b"Pair", b"Gone").replace(b"twice", b"other"),
    "empty": lambda text: b"",
    "cut short": lambda text: text[:-1],
    "cut in the middle": lambda text: text[: len(text) // 2],
    "zeros": zeros,
    "foreign": lambda text: b"# not ours\n",
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
@pytest.mark.parametrize("which", ["*.nbi", "*.nbc", "*"])
def test_what_is_torn_or_foreign_is_compiled_anew_quietly(load, tmp_path, capfd, recwarn, damage, which):
    first = load()
    first.total(first.Pair(1.0, 2.0))
    files = [file for file in (tmp_path / "cache").rglob(which) if file.is_file()]
    assert files
    for file in files:
        file.write_bytes(damage(file.read_bytes()))
    again = load()
    assert again.total(again.Pair(1.0, 2.0)) == 7.0
    module = load()
    assert module.total(module.Pair(1.0, 2.0)) == 7.0
    assert (*capfd.readouterr(), *recwarn) == ("", "")
    assert hits(module) == 1


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
@pytest.mark.parametrize("which", ["kept_text_*.py", "**/kept_text_*.pyc"])
def test_generated_source_that_is_torn_is_written_anew(monkeypatch, tmp_path, damage, which):
    monkeypatch.setenv("WLR_GYM_CACHE", str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    text = "@compiled\ndef run(x):\n    return x + 1.0\n\nvalue = run(1.0)\n"
    for _ in range(2):
        module = load_module("kept_text", text)
        assert module.value == 2.0
        del sys.modules[module.__name__]
        (file,) = tmp_path.glob(which)
        file.write_bytes(damage(file.read_bytes()))


def test_two_processes_that_meet_a_new_kernel_compile_it_once(load, tmp_path):
    load()
    slow = MODULE.replace("twice(pair", "sum((" + "twice(1.0), " * 60 + ")) - 120.0 + twice(pair")
    (tmp_path / "kept_pair.py").write_text(slow)
    code = "import kept_pair as m; assert m.total(m.Pair(1.0, 2.0)) == 7.0; print(sum(m.total.stats.cache_hits.values()))"
    found = {"env": {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}, "stdout": subprocess.PIPE}
    both = [subprocess.Popen([sys.executable, "-c", code], **found) for _ in range(2)]
    assert sorted(process.communicate()[0].strip() for process in both) == [b"0", b"1"]


# ---- the place -------------------------------------------------------------------------------------------------------


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """The folder for temporary files, of a user whose cache cannot be written."""
    (tmp_path / "no_folder").touch()
    monkeypatch.setenv("WLR_GYM_CACHE", str(tmp_path / "no_folder"))
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_a_place_that_cannot_be_written_is_replaced_by_a_private_one_with_one_line(temporary, capfd):
    assert cache_directory() == cache_directory() == temporary / f"wlr_gym-{os.getuid()}"
    assert cache_directory().stat().st_mode & 0o077 == 0
    assert capfd.readouterr().err.count("WLR_GYM_CACHE") == 1


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="users of other systems have no number")
@pytest.mark.parametrize("whose", ["another user's", "open to others", "a link"])
def test_code_is_not_taken_from_a_folder_that_others_can_write(temporary, monkeypatch, whose):
    owner = os.getuid()
    expected = temporary / f"wlr_gym-{owner}"
    if whose == "a link":
        (temporary / "elsewhere").mkdir()
        expected.symlink_to(temporary / "elsewhere")
    else:
        expected.mkdir()
        expected.chmod(0o777 if whose == "open to others" else 0o755)
    if whose == "another user's":
        expected.rename(expected := temporary / f"wlr_gym-{owner + 1}")
        monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    found = cache_directory()
    assert found.parent == temporary
    assert found != expected
    assert found.stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("home", ["no home", "~ in the variable"])
def test_a_user_without_home(tmp_path, monkeypatch, home):
    """What pwd does not know has no home: ``docker run --user 4711`` without ``HOME``."""
    monkeypatch.chdir(tmp_path)
    if home == "no home":
        monkeypatch.delenv("HOME")
        monkeypatch.setattr(os, "getuid", lambda: 4711)
        monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
        monkeypatch.delenv("WLR_GYM_CACHE")
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
        (tmp_path / "tmp").mkdir()
        assert cache_directory().parent == tmp_path / "tmp"
    else:
        monkeypatch.setenv("HOME", str(tmp_path / "home"))
        monkeypatch.setenv("WLR_GYM_CACHE", "~/kernels")
        assert cache_directory() == tmp_path / "home" / "kernels"
    assert not (tmp_path / "~").exists()


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can become a user without home")
def test_kernels_run_for_a_user_without_home_who_cannot_write_the_package():
    """``docker run --user 4711`` of an image whose package is root's."""
    code = (
        "import numpy as np; from wlr_gym.base.random import uniforms; uniforms(np.ones(1, np.uint64), np.ones(1, np.uint64))"
    )
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o777)
        environment = {"PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": folder, "PATH": os.environ["PATH"]}
        run = [sys.executable, "-c", code]
        try:
            ran = subprocess.run(run, user=4711, group=4711, env=environment, cwd=folder, capture_output=True, text=True)
        except PermissionError:
            pytest.skip("this Python is root's alone")
    assert ran.returncode == 0, ran.stderr
    assert ran.stderr.count("WLR_GYM_CACHE") == 1, ran.stderr


def test_no_kernel_of_the_package_is_kept_by_numba_itself():
    sources = Path(str(wlr_gym.__file__)).parent.rglob("*.py")
    assert [str(path) for path in sources if "cache=True" in path.read_text(encoding="utf-8")] == []
