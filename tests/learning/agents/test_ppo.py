"""PPO training: reproducible, survives interruptions, stops at numbers that are not finite."""

import importlib
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import yaml
from ppo_runs import ENVIRONMENT, SETTINGS, assert_same_weights, curve, train, weights
from waiting import wait_until

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import PACKAGE
from wlr_gym.cli import main
from wlr_gym.envs import Sb3VecEnv
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.learning.ppo.policy import parse_settings
from wlr_gym.learning.ppo.training import TrainingLog, begin_episodes, make_model
from wlr_gym.learning.training import recipe_of, settings_of
from wlr_gym.physics.plants.gibbs_appell.plant import GibbsAppellPlant
from wlr_gym.policy import Training, load_agent, load_policy, make_policy, read_contract

torch = pytest.importorskip("torch")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Folder of one uninterrupted run."""
    folder = tmp_path_factory.mktemp("ppo") / "run"
    train(folder)
    return folder


def test_run_folder_is_complete(run):
    assert yaml.safe_load((run / "config.yaml").read_text())["settings"]["num_envs"] == 8
    origin = yaml.safe_load((run / "provenance.yaml").read_text())
    assert origin["seed"] == 0
    assert {"python", "numpy", "torch", "stable-baselines3"} <= origin["versions"].keys()
    assert list((run / "tensorboard").glob("events.*"))
    assert [row["steps"] for row in curve(run)] == [64.0 * k for k in range(1, 7)]
    assert any(row["episodes"] > 0 for row in curve(run))
    contract = read_contract(run / "policy")
    noise = float(weights(run / "policy")["log_std"].mean())
    assert contract["training"] == {"environment": ENVIRONMENT, "steps": 384, "updates": 12, "seed": 0, "log_std": noise}


def test_same_seed_gives_the_same_run_bit_for_bit_and_another_one_another(run, tmp_path):
    again = train(tmp_path / "again")
    assert curve(tmp_path / "again") == curve(run)
    assert_same_weights(again, run / "policy")
    train(tmp_path / "other", seed=1)
    assert curve(tmp_path / "other") != curve(run)


def test_training_changes_the_policy(run):
    core = make_core(ENVIRONMENT, 4, {})
    readings = np.random.default_rng(0).normal(0, 1, (4, core.observation.shape[1])).astype(np.float32)
    trained = load_policy(run, core.contract()).act(readings)
    untrained = load_agent("ppo").make_policy(core.contract(), SETTINGS).act(readings)
    core.close()
    assert not np.array_equal(trained, untrained)


def test_private_names_of_stable_baselines_are_used_in_one_module():
    names = r"\bmodel\._|_last_obs|_last_episode_starts|_n_updates|_setup_learn|_update_current|_get_samples|_build\b|_on_step"
    texts = {path.name: path.read_text(encoding="utf-8") for path in (PACKAGE / "learning").rglob("*.py")}
    assert [name for name, text in texts.items() if re.search(names, text)] == ["networks.py"]


def test_plain_stable_baselines_loads_the_model(run):
    code = "import sys, warnings; warnings.simplefilter('error'); from stable_baselines3 import PPO; PPO.load(sys.argv[1])"
    subprocess.run([sys.executable, "-c", code, str(run / "policy" / "model.zip")], check=True)


@pytest.mark.slow
def test_killed_run_resumes_exactly(run, tmp_path):
    """kill -9 at an arbitrary moment after the first checkpoint; the resumed run ends as the uninterrupted one."""
    folder = tmp_path / "killed"
    settings = {**SETTINGS, "final_learning_rate": 0.001, "total_steps": 100_000_000}
    changes = [f"{key}={value}" for key, value in settings.items() if key != "environment"]
    changes.append("environment.episode_length=0.2")
    blank = tmp_path / "blank.yaml"
    blank.write_text("{}\n")
    command = [sys.executable, "-c", "import sys; from wlr_gym.cli import main; sys.exit(main())", "train", ENVIRONMENT]
    options = ["--config", str(blank), "--out", str(folder), "--no-progress", "--set", *changes]
    process = subprocess.Popen([*command, *options], stdout=subprocess.DEVNULL)
    try:
        wait_until(lambda: list(folder.glob("checkpoints/step_*")), process)
    finally:
        process.kill()
        process.wait()
    newest = max(folder.glob("checkpoints/step_*"))
    steps = read_contract(newest)["training"]["steps"]
    total = steps + 192
    train(folder, resume=True, total_steps=total, final_learning_rate=1e-3)
    train(tmp_path / "whole", total_steps=total, final_learning_rate=1e-3)
    shared = [row for row in curve(folder) if row["steps"] > steps]
    assert shared == [row for row in curve(tmp_path / "whole") if row["steps"] > steps]
    assert [row["steps"] for row in curve(folder)] == [64.0 * k for k in range(1, total // 64 + 1)]


def test_resuming_from_any_checkpoint_ends_the_same(run, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(run, folder)
    for late in sorted(folder.glob("checkpoints/step_*"))[1:]:
        shutil.rmtree(late)
    (folder / "checkpoints" / ".step_000000000256.part").mkdir()  # what a killed write leaves
    resumed = train(folder, resume=True)
    assert curve(folder) == curve(run)
    assert_same_weights(resumed, run / "policy")


def test_a_run_stopped_anywhere_goes_on_as_if_it_were_not(run, tmp_path):
    """Between two checkpoints, in mid-episode: robots, learner and files go on bit for bit."""

    def stop(progress):
        if progress.steps == 192:
            progress.stop()

    folder = tmp_path / "stopped"
    load_agent("ppo").train(Training(ENVIRONMENT, folder, SETTINGS, progress=False, on_update=stop))
    assert read_contract(folder / "policy")["training"]["steps"] == 192
    resumed = train(folder, resume=True)
    assert curve(folder) == curve(run)
    assert_same_weights(resumed, run / "policy")
    lines = [line.split(",")[0] for line in (folder / "learning_curve.csv").read_text().splitlines()]
    assert lines == ["steps", "64", "128", "192", "256", "320", "384"]  # whole numbers stay whole numbers


def test_a_run_goes_on_without_the_policy_that_it_started_from(run, tmp_path):
    start = tmp_path / "start"
    shutil.copytree(run / "policy", start)
    stopped = Training(ENVIRONMENT, tmp_path / "run", SETTINGS, progress=False, init=start, on_update=lambda p: p.stop())
    load_agent("ppo").train(stopped)
    shutil.rmtree(start)
    resumed = load_agent("ppo").train(replace(stopped, resume=True, on_update=None))
    assert read_contract(resumed)["training"]["steps"] == SETTINGS["total_steps"]


def test_a_plant_whose_state_cannot_be_set_is_trained_on_and_resumed_with_new_episodes(tmp_path, monkeypatch):
    monkeypatch.setattr(GibbsAppellPlant, "capabilities", replace(GibbsAppellPlant.capabilities, can_set_state=False))
    train(tmp_path, total_steps=128)
    resumed = train(tmp_path, resume=True, total_steps=256)
    assert read_contract(resumed)["training"]["steps"] == 256
    assert [row["steps"] for row in curve(tmp_path)] == [64.0, 128.0, 192.0, 256.0]


def test_the_environment_is_told_how_far_training_is(run, tmp_path, monkeypatch):
    """Before the first episodes and every update, after a resume too: curricula follow it."""
    told = []
    monkeypatch.setattr(Sb3VecEnv, "set_progress", lambda env, steps: told.append(steps))
    train(tmp_path / "run")
    assert told == [0, 0, 64, 128, 192, 256, 320]
    shutil.rmtree(tmp_path / "run" / "checkpoints" / "step_000000000384")
    told.clear()
    train(tmp_path / "run", resume=True)
    assert told == [256, 320]


def test_episodes_of_the_robots_end_at_different_times():
    """Each robot starts anew once per length of an episode, a like number of them in every step, from the first episode on."""
    env = Sb3VecEnv(ENVIRONMENT, 20, episode_length=0.2)
    model = make_model(env, parse_settings({"num_envs": 20, "steps_per_env": 8, "batch_size": 32}))
    begin_episodes(model, env, 0)
    ended = []
    for _ in range(30):
        env.step_async(np.zeros((20, 8), np.float32))
        ended.append(env.step_wait()[2].sum())
    env.close()
    assert ended == [2] * 30


def test_exploration_noise_of_legs_and_wheels_can_differ():
    env = Sb3VecEnv(ENVIRONMENT, 2)
    config = parse_settings({"num_envs": 2, "steps_per_env": 8, "batch_size": 16, "initial_log_std": (-4.0, -2.0)})
    noise = make_model(env, config).policy.get_parameter("log_std").tolist()
    env.close()
    assert noise == [-4.0] * 4 + [-2.0] * 4


def test_a_run_with_a_curriculum_resumes_exactly(tmp_path):
    curriculum = {"commands": {"start": 0.1, "steps": 384}, "randomization": {"start": 0.1, "steps": 384}}
    settings = {"environment": SETTINGS["environment"] | {"task": {"curriculum": curriculum}}}
    folder = tmp_path / "run"
    whole = train(folder, **settings)
    shutil.copytree(folder, tmp_path / "copy")
    for late in sorted((tmp_path / "copy").glob("checkpoints/step_*"))[1:]:
        shutil.rmtree(late)
    resumed = train(tmp_path / "copy", resume=True, **settings)
    assert curve(tmp_path / "copy") == curve(folder)
    assert_same_weights(resumed, whole)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_a_checkpoint_and_says_how_to_go_on(run, tmp_path, number):
    folder, handler = tmp_path / "interrupted", signal.getsignal(number)
    request = Training(ENVIRONMENT, folder, SETTINGS, progress=False, on_update=lambda progress: signal.raise_signal(number))
    with pytest.raises(KeyboardInterrupt, match=r"wlr train --resume"):
        load_agent("ppo").train(request)
    (saved,) = folder.glob("checkpoints/step_*")
    assert read_contract(saved)["training"]["steps"] == 64
    assert signal.getsignal(number) is handler
    assert_same_weights(train(folder, resume=True), run / "policy")


def test_a_signal_before_the_first_update_leaves_a_checkpoint_too(run, tmp_path, monkeypatch):
    class Slow(TrainingLog):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            assert (tmp_path / "early" / "learning_curve.csv").is_file()
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(importlib.import_module("wlr_gym.learning.ppo.training"), "TrainingLog", Slow)
    with pytest.raises(KeyboardInterrupt, match=r"wlr train --resume"):
        train(tmp_path / "early")
    monkeypatch.undo()
    assert_same_weights(train(tmp_path / "early", resume=True), run / "policy")


def test_what_a_callback_raises_ends_the_run_with_a_checkpoint(run, tmp_path):
    class PrunedError(Exception):
        pass

    def prune(progress):
        raise PrunedError

    with pytest.raises(PrunedError):
        load_agent("ppo").train(Training(ENVIRONMENT, tmp_path / "a", SETTINGS, progress=False, on_update=prune))
    assert_same_weights(train(tmp_path / "a", resume=True), run / "policy")


def test_weights_that_are_not_finite_stop_the_run(tmp_path):
    with pytest.raises(RuntimeError, match=r"is not finite after \d+ steps"):
        train(tmp_path / "nan", learning_rate=1e30, final_learning_rate=1e30)


def test_time_limit_ends_in_good_order(tmp_path):
    request = Training(ENVIRONMENT, tmp_path / "short", SETTINGS | {"total_steps": 10**9}, max_seconds=0.0, progress=False)
    policy = load_agent("ppo").train(request)
    assert read_contract(policy)["training"]["steps"] == 0
    assert [place.name for place in (tmp_path / "short" / "checkpoints").iterdir()] == ["step_000000000000"]  # to go on from


def test_a_training_that_ran_out_of_time_says_how_to_go_on(tmp_path, capsys):
    settings = [f"{name}={value}" for name, value in SETTINGS.items() if name not in ("total_steps", "environment")]
    words = ["train", ENVIRONMENT, "--out", str(tmp_path / "run"), "--max-minutes", "0.001", "--set", *settings]
    assert main([*words, "total_steps=1000000", "environment.episode_length=0.2"]) == 0
    printed = capsys.readouterr().out
    assert "stopped after 0.001 min at step " in printed
    assert f" of 1,000,000; go on with: wlr train --resume {tmp_path / 'run'}\n" in printed


def test_broken_model_file_is_refused(run, tmp_path):
    shutil.copytree(run / "policy", tmp_path / "policy")
    (tmp_path / "policy" / "model.zip").write_bytes(b"not a zip")
    with pytest.raises(InputError, match=r"model\.zip: not a readable model"):
        load_policy(tmp_path / "policy", read_contract(tmp_path / "policy")["environment"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "WLR-Velocity-v1"], "did you mean 'WLR-Velocity-v0'"),
        (["train", "--agent", "pop"], "unknown agent"),
        (["train", "--agent", "do_nothing"], "has no 'train'; agents that have: pid, ppo"),
        (["train", "--set", "epochs=0"], "epochs = 0"),
        (["train", "--set", "hidden_layers=[64,-3]"], "hidden_layers.1 = -3: expected more than 0"),
        (["train", "--set", "environment.precison=float32"], "did you mean 'precision'"),
        (["train", "--resume", "/nowhere"], "not a run folder"),
        (["train", "--resume", ".", "--seed", "1"], "--seed: --resume uses the settings of the run folder: leave it out"),
    ],
)
def test_bad_input_exits_with_2(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())  # nothing is left that would be in the way of the next try


def test_runs_of_different_settings_have_different_folders():
    from wlr_gym.cli import train as command

    for config, folder in ((None, "WLR-Velocity-v0_ppo_slip_aware_0"), ("ppo_blind", "WLR-Velocity-v0_ppo_blind_0")):
        assert command.default_folder(command.TrainOptions(config=config), ENVIRONMENT, {"seed": 0}).name == folder


def test_a_training_that_names_no_settings_has_those_of_what_ships(tmp_path):
    def chosen(**given):
        return settings_of(ENVIRONMENT, None, given.pop("agent", "ppo"), None, **given)

    assert chosen() == settings_of(ENVIRONMENT, "ppo_slip_aware", "ppo", None)
    assert chosen(robot="kit") == settings_of(ENVIRONMENT, "ppo_slip_aware_no_camera", "ppo", None, robot="kit")
    assert chosen(agent="pid") == settings_of(ENVIRONMENT, "pid", "pid", None)
    assert recipe_of("ppo", "a_task_of_mine") == "ppo"


def test_a_full_folder_is_not_overwritten(run, capsys):
    assert main(["train", ENVIRONMENT, "--out", str(run)]) == 2
    assert f"not empty; give another folder, or resume what is there: wlr train --resume {run}" in capsys.readouterr().err


def test_a_start_from_a_controller_drives_like_it_and_is_reproducible(tmp_path):
    """Before any update of PPO the actor does nearly what its teacher does; resuming does not teach again."""
    changes = {"teacher": "pid", "total_steps": 64, "checkpoint_every": 64, "num_envs": 64}
    changes["environment"] = {"episode_length": 4.0, "randomization": "none"}
    first = load_agent("ppo").train(Training(ENVIRONMENT, tmp_path / "a", SETTINGS | changes, max_seconds=0.0, progress=False))
    again = load_agent("ppo").train(Training(ENVIRONMENT, tmp_path / "b", SETTINGS | changes, max_seconds=0.0, progress=False))
    assert_same_weights(first, again)
    core = make_core(ENVIRONMENT, 8, changes["environment"])
    taught, teacher = load_policy(first, core.contract()), make_policy("pid", core.contract())
    rng = np.random.default_rng(1)
    for row in range(8):
        core.seed(row, 100 + row)
    core.begin_episodes(core.everyone)
    actions = []
    for _ in range(100):
        actions.append((teacher.act(core.observation), taught.act(core.observation)))
        core.step(np.clip(actions[-1][0] + 0.03 * rng.standard_normal((8, 8)), -1, 1), core.everyone)
    core.close()
    wanted, done = np.array(actions).swapaxes(0, 1)
    assert np.abs(done - wanted)[..., 4:].mean() < 0.3 * np.abs(wanted[..., 4:]).mean()


def test_the_learning_rate_falls_as_it_is_told_to():
    training = importlib.import_module("wlr_gym.learning.ppo.training")
    config = importlib.import_module("wlr_gym.learning.ppo.policy").PpoConfig(learning_rate=4e-3, final_learning_rate=1e-3)
    linearly = training.learning_rate(config)
    exponentially = training.learning_rate(config.model_copy(update={"learning_rate_falls": "exponentially"}))
    np.testing.assert_allclose([linearly(share) for share in (1.0, 0.5, 0.0)], [4e-3, 2.5e-3, 1e-3])
    np.testing.assert_allclose([exponentially(share) for share in (1.0, 0.5, 0.0)], [4e-3, 2e-3, 1e-3])
