"""Kept machine code: read where it is of this version, made anew where another version left it."""

import importlib.util
import sys

import pytest
from numba.core import config

MODULE = """
from typing import NamedTuple
from wlr_gym.base.compiled import compiled

class Pair(NamedTuple):
    first: float
    second: float

@compiled
def total(pair):
    return pair.first + pair.second
"""


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Load the module anew, as another process would; returns it. What is compiled is kept beside it."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    config.reload_config()
    path = tmp_path / "kept_pair.py"
    path.write_text(MODULE)

    def load():
        spec = importlib.util.spec_from_file_location("kept_pair", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "kept_pair", module)
        spec.loader.exec_module(module)
        return module

    return load


def hits(module):
    return sum(module.total.stats.cache_hits.values())


def test_the_second_process_loads_what_the_first_compiled(load):
    for expected in (0, 1):
        module = load()
        assert module.total(module.Pair(1.0, 2.0)) == 3.0
        assert hits(module) == expected


@pytest.mark.parametrize(
    "old", [lambda text: text.replace(b"Pair", b"Gone"), lambda text: text[: len(text) // 2], lambda _: b""]
)
def test_what_another_version_kept_is_compiled_anew_quietly(load, tmp_path, capfd, recwarn, old):
    first = load()
    first.total(first.Pair(1.0, 2.0))
    (index,) = tmp_path.rglob("*.nbi")
    index.write_bytes(old(index.read_bytes()))
    second = load()
    assert second.total(second.Pair(1.0, 2.0)) == 3.0
    assert hits(second) == 0
    assert (*capfd.readouterr(), *recwarn) == ("", "")
    third = load()
    assert third.total(third.Pair(1.0, 2.0)) == 3.0
    assert hits(third) == 1
