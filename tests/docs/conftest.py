import os
import sys
from typing import Any

import gymnasium
import pytest


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """An empty folder to run a page in; what the page imports from it, registers and sets is undone afterwards."""
    from wlr_gym.envs.registry import ENVIRONMENTS
    from wlr_gym.envs.tasks.terms import COMPUTED, MEASURES, POLICY_TERMS, PRIVILEGED_TERMS, REWARDS, TERMINATIONS
    from wlr_gym.physics.effects import EFFECTS
    from wlr_gym.physics.plants import BACKENDS

    registries: tuple[Any, ...] = (
        EFFECTS, ENVIRONMENTS, gymnasium.registry, BACKENDS, COMPUTED, POLICY_TERMS, PRIVILEGED_TERMS, REWARDS, TERMINATIONS,
        MEASURES,
    )  # fmt: skip
    before, modules = [dict(registry) for registry in registries], set(sys.modules)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    yield tmp_path
    for registry, contents in zip(registries, before, strict=True):
        registry.clear()
        registry.update(contents)
    for name in set(sys.modules) - modules:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(os.fspath(tmp_path)):
            del sys.modules[name]
