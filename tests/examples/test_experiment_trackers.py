"""``examples/experiment_trackers.py`` against stand-ins for W&B and MLflow that have the parameters of the real ones."""

import importlib.util
import inspect
import sys
import types
from pathlib import Path
from typing import Any

import pytest

import wlr_gym

SCRIPT = Path(__file__).resolve().parents[2] / "examples" / "experiment_trackers.py"
#: What is called of each, and the parameters used, in the order of wandb 0.31 and MLflow 3.17.
WANDB = {
    "init": ("project", "dir", "name", "config", "mode"),
    "Run.log": ("self", "data", "step"),
    "Run.log_artifact": ("self", "artifact_or_path"),
    "Run.finish": ("self",),
    "Artifact.__init__": ("self", "name", "type"),
    "Artifact.add_dir": ("self", "local_path"),
}
MLFLOW = {
    "set_tracking_uri": ("uri",),
    "get_experiment_by_name": ("name",),
    "create_experiment": ("name", "artifact_location"),
    "set_experiment": ("experiment_name",),
    "start_run": ("run_id", "experiment_id", "run_name"),
    "log_params": ("params",),
    "log_metrics": ("metrics", "step"),
    "log_artifacts": ("local_dir", "artifact_path"),
    "end_run": ("status",),
}
Calls = list[tuple[str, dict[str, Any]]]


def stand_in(name: str, functions: dict[str, tuple[str, ...]], calls: Calls, answers: dict[str, Any]) -> types.ModuleType:
    """A module whose functions write down what they are called with, and refuse parameters that they do not have."""
    module: Any = types.ModuleType(name)

    def record(function: str) -> Any:
        names = [one for one in functions[function] if one != "self"]
        signature = inspect.Signature(
            [inspect.Parameter(one, inspect.Parameter.POSITIONAL_OR_KEYWORD, default=None) for one in names]
        )

        def called(*args: Any, **keywords: Any) -> Any:
            given = args[1:] if functions[function][:1] == ("self",) else args
            calls.append((f"{name}.{function}", dict(signature.bind(*given, **keywords).arguments)))
            return answers.get(function)

        return called

    for function in functions:
        owner, _, method = function.rpartition(".")
        if owner and not hasattr(module, owner):
            setattr(module, owner, type(owner, (), {}))
        setattr(getattr(module, owner) if owner else module, method, record(function))
    return module


@pytest.fixture
def script():
    spec = importlib.util.spec_from_file_location("experiment_trackers", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def calls(monkeypatch):
    for name in ("WANDB_MODE", "MLFLOW_TRACKING_URI"):
        monkeypatch.delenv(name, raising=False)
    found: Calls = []
    wandb: Any = stand_in("wandb", WANDB, found, {})
    original = wandb.init
    wandb.init = lambda **keywords: (original(**keywords), wandb.Run())[1]
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    monkeypatch.setitem(sys.modules, "mlflow", stand_in("mlflow", MLFLOW, found, {}))
    return found


def updates(settings, folder):
    """What a training of three updates tells, scored at the second."""
    for steps in (10, 20, 30):
        held_out = {"steps": 20, "tracking_error": 0.5} if steps > 10 else {}
        yield wlr_gym.TrainingProgress(folder, steps, 30, {"steps": steps, "reward_per_second": 0.1 * steps}, held_out)


def test_both_trackers_are_told_every_update(script, calls, tmp_path, monkeypatch, capsys):
    def train(env_id, out, config, *, settings, on_update):
        for progress in updates(settings, out):
            on_update(progress)
        return out / "policy"

    monkeypatch.setattr(wlr_gym, "train", train)
    script.train(tmp_path, {"total_steps": 30})
    names = [name for name, _ in calls]
    logged = [
        {"training/reward_per_second": 1.0},
        {"training/reward_per_second": 2.0, "held_out/tracking_error": 0.5},
        {"training/reward_per_second": 3.0},
    ]
    told = [(given["data"], given["step"]) for name, given in calls if name == "wandb.Run.log"]
    assert told == [(given["metrics"], given["step"]) for name, given in calls if name == "mlflow.log_metrics"]
    assert told == list(zip(logged, (10, 20, 30), strict=True))
    by_name = dict(calls)
    assert by_name["wandb.init"] == {
        "project": "wlr_gym", "dir": str(tmp_path), "name": tmp_path.name, "config": {"total_steps": 30}, "mode": "offline",
    }  # fmt: skip
    assert by_name["mlflow.log_params"] == {"params": {"total_steps": 30}}
    assert by_name["mlflow.set_tracking_uri"]["uri"].startswith(f"sqlite:///{tmp_path}")
    best = str(tmp_path / "run" / "best")
    assert by_name["wandb.Artifact.add_dir"] == {"local_path": best}
    assert by_name["mlflow.log_artifacts"] == {"local_dir": best, "artifact_path": "policy"}
    assert names.index("wandb.Run.finish") > names.index("wandb.Run.log_artifact")
    assert names[-1] == "mlflow.end_run"
    assert "2 of 2 trackers" in capsys.readouterr().out


def test_a_server_is_used_where_one_is_set(script, calls, tmp_path, monkeypatch):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://localhost:5000")
    monkeypatch.setenv("WANDB_MODE", "online")
    script.with_mlflow(tmp_path, {})
    script.with_wandb(tmp_path, {})
    names = [name for name, _ in calls]
    assert "mlflow.set_tracking_uri" not in names
    assert "mlflow.create_experiment" not in names
    assert dict(calls)["wandb.init"]["mode"] == "online"


def test_what_is_not_installed_is_left_out(script, tmp_path, monkeypatch, capsys):
    for name in ("wandb", "mlflow"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setattr(
        wlr_gym, "train", lambda *given, settings, on_update: [on_update(p) for p in updates(settings, tmp_path)] and tmp_path
    )
    script.train(tmp_path, {})
    printed = capsys.readouterr().out
    assert printed.count("left out") == 2
    assert "0 of 2 trackers" in printed


@pytest.mark.parametrize(("name", "functions"), [("wandb", WANDB), ("mlflow", MLFLOW)])
def test_the_stand_ins_are_like_the_real_ones(name, functions):
    """Where they are installed."""
    real = pytest.importorskip(name)
    for function, names in functions.items():
        found: Any = real
        for part in function.split("."):
            found = getattr(found, part)
        assert [one for one in inspect.signature(found).parameters if one in names] == sorted(
            names, key=list(inspect.signature(found).parameters).index
        )
