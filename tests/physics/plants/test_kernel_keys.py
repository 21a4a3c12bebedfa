"""A cached kernel is of the code that is loaded: its key holds every module that takes part in its trace."""

import sys
from pathlib import Path

import pytest

import wlr_gym
from wlr_gym.base import compiled
from wlr_gym.physics.codegen import compilation
from wlr_gym.physics.plants.gibbs_appell import kernel as engine
from wlr_gym.physics.plants.mujoco import kernel as mujoco

PACKAGE = Path(wlr_gym.__file__).parent
FAMILIES = frozenset({"drive", "backlash", "ground", "compliance", "rolling_resistance", "forces"})


def called_files(function):
    """The package's files of which something runs while ``function`` does."""
    seen = set()

    def profile(frame, event, argument):
        seen.add(frame.f_code.co_filename)

    sys.setprofile(profile)
    try:
        function()
    finally:
        sys.setprofile(None)
    return {Path(name).relative_to(PACKAGE) for name in seen if Path(name).is_relative_to(PACKAGE)}


@pytest.mark.parametrize(
    ("kernel", "source"),
    [(engine, lambda: engine.kernel_source(FAMILIES, "float64", 8)), (mujoco, mujoco.kernel_source)],
    ids=["gibbs_appell", "mujoco"],
)
def test_the_key_holds_every_module_of_the_trace(kernel, source):
    held = {Path(module.__file__).relative_to(PACKAGE) for module in kernel.TRACED}
    assert called_files(source) <= held


@pytest.mark.parametrize("changed", [compiled, compilation])
def test_kernels_are_compiled_anew_with_other_intrinsics(monkeypatch, changed):
    def name():
        return compilation.load_module("test_key", "ONE = 1\n").__name__

    before = name()
    monkeypatch.setattr(compilation, "source_of", lambda *modules: "other" if changed in modules else "")
    assert before != name()
