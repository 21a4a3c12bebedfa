"""Policies of other programs as policy files: they act as their source does, action by action (docs/policy_file.md)."""

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium.wrappers import ClipAction, NormalizeObservation, RescaleAction

import wlr_gym
from wlr_gym.base.errors import InputError
from wlr_gym.cli import main
from wlr_gym.envs.interfaces import PathVectorEnv, PostureEnv, WlrEnv
from wlr_gym.envs.tasks.task import read_task
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.policy import contract_of, make_policy, policy_environment

torch = pytest.importorskip("torch")
pytest.importorskip("onnxscript")

from stable_baselines3 import PPO, SAC, TD3  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecMonitor, VecNormalize  # noqa: E402

ID = "WLR-Velocity-v0"
TASK = {"observer": {"camera": False}, "observations": {"estimated_slip_velocity": None}}


@pytest.fixture(scope="module")
def env():
    return wlr_gym.Sb3VecEnv(ID, 4, seed=3, task=TASK)


def readings(env, count=200):
    """Observations of robots that act at random."""
    rng, seen = np.random.default_rng(1), [env.reset()]
    while len(seen) * env.num_envs < count:
        seen.append(env.step(rng.uniform(-1, 1, (env.num_envs, 8)).astype(np.float32))[0])
    return np.concatenate(seen)


def act(path, env, observations):
    """Actions of a file in a core that its contract chooses."""
    assert policy_environment(path)["task"].keys() == {"observer", "observations"}
    return make_policy(path, env.contract()).act(observations)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["PPO", "PPO squashed", "SAC", "TD3"])
def test_an_archive_acts_as_its_model_predicts(env, tmp_path, algorithm):
    """Through the command, normalisation included; the model's own ``predict`` and ``normalize_obs`` are the reference."""
    normalised = VecNormalize(env, clip_obs=1.5)
    normalised.reset()
    for _ in range(30):
        normalised.step(np.random.default_rng(2).uniform(-1, 1, (4, 8)).astype(np.float32))
    made = {"PPO": PPO, "PPO squashed": PPO, "SAC": SAC, "TD3": TD3}[algorithm]
    options = {"use_sde": True, "policy_kwargs": {"squash_output": True}} if algorithm == "PPO squashed" else {}
    model = made("MlpPolicy", normalised, seed=4, device="cpu", **options)
    with torch.no_grad():
        for name, weights in model.policy.named_parameters():  # actions far from zero, some beyond the limit
            weights.mul_(60.0 if name.startswith("action_net") else 1.5)
    model.save(tmp_path / "model.zip")
    normalised.save(str(tmp_path / "normalise.pkl"))
    (tmp_path / "fed.yaml").write_text(
        "environment: {task: {observer: {camera: false}, observations: {estimated_slip_velocity: null}}}\n"
    )
    out = tmp_path / "policy.onnx"
    words = ["export", str(tmp_path / "model.zip"), "--env", ID, "--config", str(tmp_path / "fed.yaml")]
    assert main([*words, "--normalizer", str(tmp_path / "normalise.pkl"), "--out", str(out)]) == 0
    seen = readings(env)
    expected = model.predict(normalised.normalize_obs(seen), deterministic=True)[0]
    assert np.ptp(expected) > 0.5
    np.testing.assert_allclose(act(out, env, seen), expected, atol=1e-5)
    card = wlr_gym.evaluate(out, baselines=(), episodes=2)
    assert card.scores["main"][str(out)]["tracking_error"].mean > 0.0


def test_a_plain_network(env, tmp_path):
    """CleanRL style: a module with layers of its own names and orders, normaliser as a module."""
    torch.manual_seed(0)
    width = env.observation_space.shape[0]
    network = torch.nn.Sequential(
        torch.nn.LayerNorm(width), torch.nn.Linear(width, 16), torch.nn.SiLU(), torch.nn.Linear(16, 8)
    )
    network[1].eval()  # the rest is in training, and stays
    parity = wlr_gym.import_policy(network, env, tmp_path / "p.onnx", normalizer=torch.nn.Hardtanh(-0.5, 0.5))
    assert [module.training for module in network] == [True, False, True, True]
    assert parity.real <= 1e-5
    seen = readings(env)
    with torch.no_grad():
        expected = network(torch.as_tensor(np.clip(seen, -0.5, 0.5))).clamp(-1, 1).numpy()
    np.testing.assert_allclose(act(tmp_path / "p.onnx", env, seen), expected, atol=1e-5)
    contract = contract_of(tmp_path / "p.onnx")
    assert (contract["agent"], contract["training"]["environment"]) == ("imported", ID)


def test_an_environment_that_was_made_without_an_id(tmp_path):
    own = WlrEnv(definition=read_task("velocity").model_dump(mode="json", exclude_none=True))
    for made in (PostureEnv(), PathVectorEnv(2)):
        network = torch.nn.Linear(len(made.contract()["observation"]), 8)
        wlr_gym.import_policy(network, made, tmp_path / f"{type(made).__name__}.onnx")
    assert contract_of(tmp_path / "PostureEnv.onnx")["training"]["environment"] == "WLR-Posture-v0"
    assert contract_of(tmp_path / "PathVectorEnv.onnx")["training"]["environment"] == "WLR-Path-v0"
    with pytest.raises(InputError, match="has no id: register its task with register_task"):
        wlr_gym.import_policy(torch.nn.Linear(len(own.contract()["observation"]), 8), own, tmp_path / "own.onnx")


def test_the_normaliser_around_the_environment_is_part_of_the_policy(env, tmp_path):
    around = VecNormalize(VecMonitor(env), clip_obs=0.5)
    around.reset()
    network = torch.nn.Linear(env.observation_space.shape[0], 8)
    wlr_gym.import_policy(network, around, tmp_path / "p.onnx")
    seen = readings(env)
    with torch.no_grad():
        expected = network(torch.as_tensor(around.normalize_obs(seen))).clamp(-1, 1).numpy()
    np.testing.assert_allclose(act(tmp_path / "p.onnx", env, seen), expected, atol=1e-5)


def test_a_wrapper_that_no_file_holds_is_refused(env, tmp_path):
    network = torch.nn.Linear(env.observation_space.shape[0], 8)
    half = np.float32(0.5)
    wlr_gym.import_policy(network, ClipAction(gym.make(ID, task=TASK)), tmp_path / "fits.onnx")
    for wrapped in (VecFrameStack(env, 2), RescaleAction(gym.make(ID), -half, half), NormalizeObservation(gym.make(ID))):
        with pytest.raises(InputError, match=rf"the wrapper {type(wrapped).__name__} changes observations or actions"):
            wlr_gym.import_policy(network, wrapped, tmp_path / "p.onnx", normalizer=torch.nn.Identity())
    assert not (tmp_path / "p.onnx").exists()


@pytest.mark.parametrize("behind", ["VecNormalize", "VecNormalize of rewards", "NormalizeObservation", "RescaleAction", ""])
def test_an_archive_that_was_trained_behind_a_wrapper_is_refused_without_what_undoes_it(env, tmp_path, behind):
    half = np.float32(0.5)
    kept = {
        "VecNormalize": lambda: VecNormalize(env),
        "VecNormalize of rewards": lambda: VecNormalize(env, norm_obs=False),
        "NormalizeObservation": lambda: DummyVecEnv([lambda: NormalizeObservation(gym.make(ID, task=TASK))]),
        "RescaleAction": lambda: DummyVecEnv([lambda: RescaleAction(gym.make(ID, task=TASK), -half, half)]),
        "": lambda: env,
    }[behind]()
    model = PPO("MlpPolicy", kept, n_steps=8, batch_size=8, n_epochs=1, device="cpu", seed=4).learn(8)
    model.save(tmp_path / "model.zip")
    out = tmp_path / "p.onnx"
    if not behind:
        wlr_gym.import_policy(tmp_path / "model.zip", env, out)
        return
    said = "trained in actions" if behind == "RescaleAction" else "trained behind"
    with pytest.raises(InputError, match=said):
        wlr_gym.import_policy(tmp_path / "model.zip", env, out)
    assert not out.exists()
    if "VecNormalize" in behind:
        wlr_gym.import_policy(tmp_path / "model.zip", env, out, normalizer=kept)


def test_a_network_for_a_task_file(tmp_path):
    task = read_task("velocity").model_dump(mode="json", exclude_none=True)
    task["observations"].pop("gyro")
    (tmp_path / "narrow.yaml").write_text(yaml.safe_dump(task, sort_keys=False))
    env = gym.make(ID, task=str(tmp_path / "narrow.yaml"))
    wlr_gym.import_policy(torch.nn.Linear(env.reset()[0].size, 8), env, tmp_path / "p.onnx")
    (tmp_path / "narrow.yaml").unlink()
    core = make_core(ID, 1, policy_environment(tmp_path / "p.onnx"))
    make_policy(tmp_path / "p.onnx", core.contract())


class Branch(torch.nn.Linear):
    """What no graph can be: which way it goes depends on its input."""

    def forward(self, input):
        return super().forward(input) if input.sum() > 0.0 else -super().forward(input)


def test_what_does_not_fit_is_refused_and_leaves_nothing(env, tmp_path, capsys):
    out = tmp_path / "p.onnx"
    width = env.observation_space.shape[0]
    for network, message in (
        (torch.nn.Linear(3, 8), f"rows of {width} numbers"),
        (torch.nn.Linear(width, 7), r"expected float32 of shape \(2, 8\)"),
        (torch.nn.LSTM(width, 8), r"returns tuple for 2 observations, expected float32 of shape \(2, 8\)"),
        (Branch(width, 8), "cannot be written as an ONNX graph: "),
    ):
        with pytest.raises(InputError, match=message):
            wlr_gym.import_policy(network, env, out)
    with pytest.raises(InputError, match="expected an environment of wlr_gym"):
        wlr_gym.import_policy(torch.nn.Linear(width, 8), gym.make("CartPole-v1"), out)
    (tmp_path / "broken.zip").write_bytes(b"no zip")
    assert main(["export", str(tmp_path / "broken.zip"), "--env", ID, "--out", str(out)]) == 2
    assert "not a readable archive" in capsys.readouterr().err
    assert main(["export", str(tmp_path / "broken.zip"), "--out", str(out)]) == 2
    assert "give --env" in capsys.readouterr().err
    assert not out.exists()
