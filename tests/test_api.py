"""The library's front door: public names, their types and documentation, and what they do as the commands do."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import wlr_gym
from wlr_gym.base.errors import InputError

NAMES = [name for name in wlr_gym.__all__ if name != "hardware"]


def test_the_stub_has_the_same_names_from_the_same_places() -> None:
    tree = ast.parse(Path(str(wlr_gym.__file__)).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = {alias.name: node.module for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert imports.pop("hardware") == "wlr_gym"
    assert imports == wlr_gym.HOMES
    listed = next(node.value for node in tree.body if isinstance(node, ast.Assign) and "__all__" in ast.unparse(node))
    assert sorted(ast.literal_eval(listed)) == sorted(wlr_gym.__all__)


def test_one_sees_the_names() -> None:
    code = "import sys, wlr_gym; print(set(wlr_gym.__all__) <= set(dir(wlr_gym)), 'numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "False"]
    with pytest.raises(AttributeError, match="did you mean 'evaluate'"):
        wlr_gym.evalute  # type: ignore[attr-defined]  # noqa: B018
    assert wlr_gym.hardware.__all__


@pytest.mark.parametrize("name", NAMES)
def test_public_names_say_what_they_are(name: str) -> None:
    value = getattr(wlr_gym, name)
    document = inspect.getdoc(value) or ""
    assert document.split(".")[0], name
    if inspect.isfunction(value):
        parameters = inspect.signature(value).parameters
        sections = ["Raises:"] + ["Args:"] * (len(parameters) > 1)
        for section in sections:
            assert section in document, f"{name} lacks {section}"
        assert all(p.annotation is not inspect.Parameter.empty for p in parameters.values())


@pytest.mark.parametrize("name", wlr_gym.hardware.__all__)
def test_names_of_the_hardware_load(name: str) -> None:
    assert inspect.getdoc(getattr(wlr_gym.hardware, name))


def test_a_training_does_not_write_into_a_used_folder(tmp_path: Path) -> None:
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(InputError, match=r"not empty; give another folder$"):
        wlr_gym.train("WLR-Velocity-v0", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["note.txt"]
    with pytest.raises(InputError, match=r"did you mean 'WLR-Velocity-v0'"):
        wlr_gym.train("WLR-Velocty-v0", tmp_path / "new")
    with pytest.raises(InputError, match="max_seconds = 0: expected more than 0 s"):
        wlr_gym.train("WLR-Velocity-v0", tmp_path / "new", max_seconds=0)
    with pytest.raises(InputError, match="not a run folder"):
        wlr_gym.resume_training(tmp_path)
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_a_policy_is_trained_scored_and_loaded_from_python(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    size = {"total_steps": 512, "num_envs": 8, "steps_per_env": 32, "batch_size": 128, "epochs": 1}
    policy = wlr_gym.train("WLR-Velocity-v0", tmp_path / "run", "ppo_blind", settings=size, seed=3)
    told: list[float] = []
    card = wlr_gym.evaluate(policy, episodes=3, baselines=["do_nothing"], tell=lambda text, share: told.append(share))
    assert list(card.names)[1:] == ["do_nothing"]
    assert card.scores["main"][card.names[0]]["tracking_error"].mean > 0.0
    assert sum(told) == pytest.approx(1.0)


def test_baselines_fit_the_task() -> None:
    from wlr_gym.learning.evaluation.scoring import default_baselines, fitting_baselines

    assert fitting_baselines("WLR-Velocity-v0") == ("do_nothing", "pid")
    assert default_baselines("pid", "WLR-Velocity-v0") == ("do_nothing", "pid")
    assert default_baselines("velocity_blind", "WLR-Velocity-v0") == ("do_nothing", "pid", "slip_compensating_no_camera")
    with pytest.raises(InputError, match="unknown backend 'mujco' \\(did you mean 'mujoco'"):
        wlr_gym.evaluate("pid", backend="mujco")
