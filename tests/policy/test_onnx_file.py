"""A policy as one file: it answers as the trained one, carries its contract, and is refused when it is not whole."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")
pytest.importorskip("onnxscript")
pytest.importorskip("onnxruntime")
pytest.importorskip("stable_baselines3")

import onnx

from wlr_gym.base.errors import InputError, MissingPackageError
from wlr_gym.cli import main
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.policy import contract_of, export_policy, load_agent, load_policy, make_policy, read_contract, write_contract
from wlr_gym.policy.export import compare
from wlr_gym.policy.onnx_file import CONTRACT_KEY, FINGERPRINT_KEY, open_policy, seal

ID = "WLR-Velocity-v0"


@pytest.fixture(scope="module")
def environment(trained):
    return read_contract(trained / "policy")["environment"]


def rows(environment, count, seed=0):
    return np.random.default_rng(seed).normal(0.0, 1.0, (count, len(environment["observation"]))).astype(np.float32)


# ---- it is the same policy -------------------------------------------------------------------------------------------


def test_it_answers_as_stable_baselines_does(trained, exported, environment):
    from stable_baselines3 import PPO

    seen = rows(environment, 500)
    expected, _ = PPO.load(trained / "policy" / "model.zip", device="cpu").policy.predict(seen, deterministic=True)
    answered = make_policy(exported, environment).act(seen)
    assert answered.dtype == np.float32
    assert (np.abs(expected) == 1.0).mean() > 0.1  # clipping is part of the graph
    assert np.abs(expected).mean() > 0.2
    np.testing.assert_allclose(answered, expected, atol=2e-6)


def test_same_bits_alone_in_any_batch_and_when_loaded_again(exported, environment):
    seen = rows(environment, 96)
    policy = make_policy(exported, environment)
    together = policy.act(seen)
    for size in (1, 3, 8, 32):
        parts = [policy.act(seen[start : start + size]) for start in range(0, len(seen), size)]
        np.testing.assert_array_equal(np.concatenate(parts), together)
    np.testing.assert_array_equal(make_policy(exported, environment).act(seen), together)
    np.testing.assert_array_equal(policy.act(seen.astype(np.float64)[:, ::-1][:, ::-1]), together)


def test_it_needs_neither_torch_nor_onnx(exported, environment):
    code = """
import json, sys
sys.modules |= {name: None for name in ("torch", "stable_baselines3", "onnx", "onnxscript")}
import numpy as np
from wlr_gym.policy import contract_of, make_policy
environment = contract_of(sys.argv[1])["environment"]
seen = np.full((1, len(environment["observation"])), 0.1, np.float32)
print(json.dumps(make_policy(sys.argv[1], environment).act(seen)[0].tolist()))
"""
    said = subprocess.run([sys.executable, "-c", code, str(exported)], check=True, capture_output=True, text=True).stdout
    mine = make_policy(exported, environment).act(np.full((1, len(environment["observation"])), 0.1, np.float32))[0]
    assert json.loads(said) == mine.tolist()


def test_it_carries_its_contract(trained, exported):
    folder, content = read_contract(trained / "policy"), contract_of(exported)
    for key in ("format", "agent", "environment", "config", "versions"):
        assert content[key] == folder[key]
    assert content["training"] == {**folder["training"], "seconds": 1.5}
    parity = content["exported"]["parity"]
    assert parity["observations"] == 1016
    assert 0.0 < parity["random"] < 2e-6
    assert 0.0 < parity["real"] < 2e-6
    assert {"onnx", "onnxruntime", "torch"} <= content["exported"]["versions"].keys()


def test_it_names_no_place_of_the_machine_it_was_made_on(trained, exported):
    data = exported.read_bytes()
    import torch

    for place in (Path.cwd(), trained.parent, Path(torch.__file__).parent, Path.home()):
        assert str(place).encode() not in data
    assert b"stack_trace" not in data


def test_the_same_policy_gives_the_same_file(trained, exported, environment, tmp_path):
    export_policy(trained, tmp_path / "again.onnx", rows(environment, 16, seed=7), {"seconds": 1.5})
    assert (tmp_path / "again.onnx").read_bytes() == exported.read_bytes()


# ---- files that are not what they should be --------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9, 0.999])
def test_a_file_cut_short_is_refused(exported, tmp_path, share):
    data = exported.read_bytes()
    (tmp_path / "cut.onnx").write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match=r"cut\.onnx: (not a policy file of wlr_gym, or cut short|damaged)"):
        open_policy(tmp_path / "cut.onnx")


def test_a_changed_weight_is_noticed(exported, tmp_path):
    model = onnx.load(exported)
    weights = max(model.graph.initializer, key=lambda tensor: len(tensor.raw_data))
    weights.raw_data = bytes([weights.raw_data[0] ^ 1]) + weights.raw_data[1:]
    onnx.save(model, tmp_path / "changed.onnx")
    with pytest.raises(InputError, match="damaged or changed"):
        open_policy(tmp_path / "changed.onnx")


def test_other_onnx_files_are_refused(exported, tmp_path):
    model = onnx.load(exported)
    del model.metadata_props[:]
    onnx.save(model, tmp_path / "other.onnx")
    with pytest.raises(InputError, match=r"other\.onnx: not a policy file of wlr_gym, or cut short"):
        open_policy(tmp_path / "other.onnx")


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04" * 50])
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "p.onnx").write_bytes(content)
    with pytest.raises(InputError, match=r"p\.onnx: not a policy file of wlr_gym"):
        open_policy(tmp_path / "p.onnx")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(format=2), "not a policy contract of format 1"),
        (lambda c: c.pop("config"), "'config' is missing"),
        (lambda c: c["environment"]["observation"].pop(), "its contract needs observation: N rows of"),
        (lambda c: c["environment"]["action"].pop(), "its contract needs action: N rows of 7"),
    ],
)
def test_a_contract_that_does_not_fit_the_graph_is_refused(exported, tmp_path, change, message):
    content = contract_of(exported)
    change(content)
    (tmp_path / "p.onnx").write_bytes(seal(exported.read_bytes(), content))
    with pytest.raises(InputError, match=rf"p\.onnx: .*{message}"):
        open_policy(tmp_path / "p.onnx")


def test_any_changed_bit_is_noticed(exported, tmp_path):
    data = exported.read_bytes()
    for place in np.random.default_rng(0).integers(0, len(data), 60):
        changed = bytearray(data)
        changed[place] ^= 128
        (tmp_path / "p.onnx").write_bytes(changed)
        with pytest.raises(InputError, match=r"damaged or changed|not a policy file"):
            open_policy(tmp_path / "p.onnx")


def test_a_graph_too_new_for_onnxruntime_is_refused(exported, tmp_path):
    model = onnx.load(exported)
    model.opset_import[0].version = 999
    (tmp_path / "p.onnx").write_bytes(seal(model.SerializeToString(), contract_of(exported)))
    with pytest.raises(InputError, match=r"p\.onnx: this onnxruntime \(.*\) cannot compute it"):
        open_policy(tmp_path / "p.onnx")


def test_it_is_refused_for_another_environment(exported):
    core = make_core(ID, 1, {"task": {"action": {"wheel_scale": 3.0}}})
    with pytest.raises(InputError, match=r"policy\.onnx: .*action\[4\]\.scale is 6\.0 in the policy, 3\.0 in the environment"):
        load_policy(exported, core.contract())
    core.close()


def test_without_onnxruntime_it_says_what_to_install(exported, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingPackageError, match=r"onnxruntime.*wlr-gym\[export\]"):
        open_policy(exported)


# ---- exporting -------------------------------------------------------------------------------------------------------


def test_a_graph_that_answers_differently_is_not_written(trained, environment, tmp_path, monkeypatch):
    import torch

    load_agent("ppo")
    module = importlib.import_module("wlr_gym.learning.ppo.policy")
    to_onnx = module.to_onnx
    monkeypatch.setattr(module, "to_onnx", lambda actor, width: to_onnx(torch.nn.Sequential(actor, torch.nn.Tanh()), width))
    (tmp_path / "p.onnx").write_bytes(b"old")
    with pytest.raises(InputError, match="the exported graph answers differently: by up to"):
        export_policy(trained, tmp_path / "p.onnx", rows(environment, 4))
    assert (tmp_path / "p.onnx").read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("where", ["random", "real"])
def test_answers_that_are_no_numbers_are_not_alike(environment, where):
    class Policy:
        def __init__(self, bad):
            self.bad = bad

        def act(self, observations):
            is_bad = self.bad == ("real" if len(observations) == 4 else "random")
            return np.full((len(observations), 8), np.nan if is_bad else 0.0, np.float32)

        def reset(self, mask):
            pass

    with pytest.raises(InputError, match="by up to nan"):
        compare(Policy(""), Policy(where), environment, rows(environment, 4))


def test_what_cannot_be_exported(trained, exported, environment, tmp_path):
    seen, out = rows(environment, 1), tmp_path / "p.onnx"
    with pytest.raises(InputError, match=r"policy\.onnx: is a policy file already"):
        export_policy(exported, out, seen)
    with pytest.raises(InputError, match=r"expected a file that ends in \.onnx"):
        export_policy(trained, tmp_path / "p.pt", seen)
    with pytest.raises(InputError, match=r"p\.onnx: cannot be written"):
        export_policy(trained, tmp_path / "nowhere" / "p.onnx", seen)
    write_contract(tmp_path, "do_nothing", {}, environment, {})
    with pytest.raises(InputError, match=r"agent 'do_nothing' has no 'export_network'; agents that have: ppo"):
        export_policy(tmp_path, out, seen)
    assert not out.exists()


def test_command_line(trained, exported, tmp_path, capsys):
    out = tmp_path / "new" / "p.onnx"
    assert main(["export", str(trained), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "written:" in said
    assert "answers as the policy does" in said
    content = contract_of(out)
    assert content["exported"]["parity"]["observations"] == 1000 + 16 * 200
    assert content["training"]["seconds"] > 0
    metadata = {entry.key: entry.value for entry in onnx.load(out).metadata_props}
    assert metadata.keys() == {CONTRACT_KEY, FINGERPRINT_KEY}
    assert main(["export", str(trained), "--out", str(out)]) == 2
    assert "--force" in capsys.readouterr().err
    assert main(["export", str(tmp_path), "--out", str(tmp_path / "other.onnx")]) == 2
    assert "no policy there" in capsys.readouterr().err
    assert main(["export", "pid", "--out", str(out)]) == 2
    assert main(["export", str(trained), "--out", str(tmp_path / "p.pt")]) == 2


@pytest.mark.parametrize(("clock", "seconds"), [([1.0, 2.0, 4.0], 4.0), ([1.0, 2.0, 0.5, 3.0], 5.0), ([7.0], 7.0)])
def test_wall_time_of_resumed_runs(clock, seconds):
    from wlr_gym.learning.curves import wall_time

    assert wall_time({"seconds": now} for now in clock) == seconds


def test_training_commands_are_told_without_the_machine():
    from wlr_gym.cli.export import portable

    command = "wlr train WLR-Velocity-v0 --config ppo --seed 3 --out '/a b/run' --no-progress --max-minutes=5 --set x=1"
    assert portable(command) == "wlr train WLR-Velocity-v0 --config ppo --seed 3 --set x=1"


def test_a_recorded_command_is_one_that_a_shell_takes(monkeypatch):
    from wlr_gym.base.provenance import provenance
    from wlr_gym.cli.export import portable

    words = ["train", "WLR-Velocity-v0", "--set", "environment.task.commands.terms.yaw_rate=[-0.2, 0.2]"]
    monkeypatch.setattr(sys, "argv", ["/usr/bin/wlr", *words, "--out", "runs/o'brien"])
    assert portable(provenance()["command"]) == f"wlr {' '.join(words[:3])} '{words[3]}'"
