"""Adaptation step by step: folders, resuming, what the result states, and bad input; nothing here drives or learns."""

import importlib
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("dynamixel_sdk")
pytest.importorskip("onnxruntime")

import wlr_gym
from wlr_gym.base.errors import InputError
from wlr_gym.cli import main
from wlr_gym.data.excitations import excite
from wlr_gym.data.record import record_simulation
from wlr_gym.envs.tasks import load_randomization
from wlr_gym.gap.decision import HISTORY_FILE, Decided, History, Recorded
from wlr_gym.gap.report.result import Result
from wlr_gym.learning.adaptation import driving, retraining, uncertainty
from wlr_gym.learning.adaptation.adapt import state_uncertainty
from wlr_gym.learning.adaptation.driving import EmulatedRobot
from wlr_gym.learning.adaptation.retraining import may_stop_more, stopped_episodes
from wlr_gym.learning.adaptation.state import STEPS, AdaptStep, Asked, Progress, open_folder
from wlr_gym.learning.evaluation.scoring import Acceptance, Loss
from wlr_gym.physics.effects import Patch, load_patch
from wlr_gym.robot import load_robot

ROBOT = load_robot()
SEEDS = np.arange(4000, dtype=np.uint64)
steps = importlib.import_module("wlr_gym.learning.adaptation.adapt")


def quiet(text, share):
    """Progress that nobody sees."""


def asked(**changes):
    fields = {"policy": "velocity_slip_aware", "identity": "x", "environment": "WLR-Velocity-v0", "robot": "y"}
    return Asked.model_validate(fields | {"driven": "emulated"} | changes)


def result(effects=(), reduction=0.5, calibration=None, **content):
    gap = {
        "metric": "rms", "fit_before": 2.0, "fit_after": 1.0, "heldout_before": 2.0, "heldout_calibrated": 1.5,
        "heldout_after": 1.0, "noise_floor": 1.0, "reduction": max(reduction, 0.0), "reduction_signed": reduction,
        "reduction_ci95": None,
    }  # fmt: skip
    filled = {"verdict": "effect_found" if effects else "nothing_missing", "effects": list(effects), "equivalent": []}
    filled |= {"localisation": {}, "gap": gap, "runs": {"fit": [], "heldout": []}, "patch": "patch.yaml"}
    mu = {"ground.mu": {"nominal": 0.6, "fitted": 0.5, "unit": "-", "ci95": [0.48, 0.52]}}
    return Result.model_validate(filled | {"calibration": mu if calibration is None else calibration} | content)


def delay(value, half):
    parameters = {"delay": {"value": value, "ci95": [value - half, value + half], "unit": "s"}}
    return {"name": "command_delay", "where": ["leg_lf"], "parameters": parameters, "confidence": 1.0}


def drawn(family, name):
    return load_randomization(dict(family.randomization), ROBOT).parameters(SEEDS, SEEDS)[name]


# ---- what the result states ----


def test_effects_and_calibration_are_drawn_within_their_intervals_and_trained_in_half_of_them(tmp_path):
    found = uncertainty.uncertainty_of(result([delay(0.03, 0.002)]), Patch(), "slippery", ROBOT, tmp_path)
    floors = next(one for one in found.families if one.name == "other floors")
    for family, share in ((found.training, 0.5), (found.families[0], 1.0), (floors, 1.0)):
        late, mu = drawn(family, "command.delay[leg_lf]"), drawn(family, "ground.mu_x")
        tolerance = drawn(family, "command.delay[leg_rf]")
        assert (late - tolerance).mean() == pytest.approx(0.03, abs=2e-4)
        assert (late - tolerance).std() == pytest.approx(share * 0.004 / 3.92, rel=0.1)
        assert mu.mean() == pytest.approx(0.5, abs=2e-3)
        assert mu.std() == pytest.approx(share * 0.04 / 3.92, rel=0.1)
    kept = load_randomization(str(tmp_path / "randomization.yaml"), ROBOT)
    assert (kept.parameters(SEEDS, SEEDS).values == drawn_all(floors)).all()
    assert "patch.mu[patch_1]" in kept.elements  # of the task's own floors


def drawn_all(family):
    return load_randomization(dict(family.randomization), ROBOT).parameters(SEEDS, SEEDS).values


def test_the_acceptance_test_goes_to_both_ends_of_the_intervals(tmp_path):
    found = uncertainty.uncertainty_of(result([delay(0.03, 0.002)]), Patch(), "slippery", ROBOT, tmp_path)
    stated, low, high, floors = found.families
    assert [one.name for one in found.families] == ["as stated", "lower ends", "upper ends", "other floors"]
    late = [drawn(one, "command.delay[leg_lf]").mean() for one in (low, stated, high)]
    assert np.diff(late) == pytest.approx([0.002, 0.002], abs=2e-4)
    assert "patch.mu[patch_1]" in load_randomization(dict(floors.randomization), ROBOT).elements


def test_names_that_the_held_out_runs_refute_are_not_taken(tmp_path):
    found = uncertainty.uncertainty_of(result([delay(0.03, 0.002)], -0.1), Patch(), "slippery", ROBOT, tmp_path)
    nothing = uncertainty.uncertainty_of(result(), Patch(), "slippery", ROBOT, tmp_path)
    assert (drawn_all(found.training) == drawn_all(nothing.training)).all()
    assert "makes the error of the held-out runs larger" in found.said[0]


def test_a_formula_acts_as_an_effect_and_a_name_still_in_play_is_a_family(tmp_path):
    formula = {"name": "unknown_effect", "where": ["leg_lr"], "formula": "-k * leg_angle", "parameters": {"k": 0.8}}
    patch = load_patch([{**formula, "units": {"k": "N m/rad"}}])
    other = {"round": 1, "name": "coulomb_friction", "where": ["leg_lf"], "values": {"torque": 0.1}}
    other |= {"gain": 0.0, "screened": 0.0, "reason": ""}
    evidence = [
        {**other, "outcome": "selected", "probability": 0.5},
        {**other, "name": "command_delay", "outcome": "equivalent"},
    ]
    evidence[1] |= {"values": {"delay": 0.04}, "probability": 0.45}
    unknown = {"name": "unknown_effect", "where": ["leg_lr"], "parameters": {}, "confidence": 1.0, "formula": "-k * leg_angle"}
    content = {"evidence": evidence, "thresholds": [{"round": 1, "none": 0.05}]}
    found = uncertainty.uncertainty_of(result([unknown], 0.5, None, **content), patch, "slippery", ROBOT, tmp_path)
    assert [one["formula"] for one in found.training.effects] == ["-k * leg_angle"]
    assert load_patch(tmp_path / "patch.yaml").content()["effects"] == patch.content()["effects"]
    other = next(one for one in found.families if one.name == "or command delay")
    assert drawn(other, "command.delay[leg_lf]").mean() > 0.035
    assert not other.effects


def test_without_numbers_the_old_policy_is_kept(tmp_path):
    history = History(data="", robot=None, backend="", known=[])
    decided = Decided(history, result(calibration={}, verdict="bad_data"), tmp_path)
    record, found = state_uncertainty(Progress(tmp_path, asked()), decided, ROBOT)
    assert (record.outcome, found) == ("left out", None)


# ---- training and acceptance ----


def test_training_goes_on_with_the_policy_s_recipe_on_the_stated_robots(tmp_path):
    found = uncertainty.uncertainty_of(result([delay(0.03, 0.002)]), Patch(), "slippery", ROBOT, tmp_path)
    settings = retraining.training_settings(asked(steps=10**6, learning_rate=5e-4, seed=3), found.training)
    environment = settings["environment"]
    assert environment["randomization"] == found.training.randomization
    assert environment["task"]["sensors"] == {"camera": 0.0, "flow": 0.0}
    assert environment["task"]["controller"]  # what the policy acts on
    assert (settings["total_steps"], settings["seed"], settings["learning_rate"]) == (10**6, 3, 5e-4)


@pytest.mark.parametrize(
    ("stated", "elsewhere", "stops", "kept"),
    [
        (-3.0, 2.0, 22, "new"),
        (1.0, 2.0, 22, "velocity_slip_aware"),
        (-3.0, 6.0, 22, "velocity_slip_aware"),
        (-3.0, 2.0, 120, "velocity_slip_aware"),
    ],
)
def test_the_new_policy_is_kept_where_it_is_better_and_nowhere_worse_or_stopped(
    tmp_path, monkeypatch, stated, elsewhere, stops, kept
):
    bounds = {"as stated": stated, "other floors": elsewhere}
    played, told = [], []

    def accept(new, environment, *, references, floors, **given):
        played.append(name := floors[0]["name"])
        loss = Loss(name, references[0], 0.2, 0.2, bounds[name] - 1.0, bounds[name])
        return Acceptance(new, environment, 8, 1, (), 5.0, "", (loss,))

    monkeypatch.setattr(retraining, "accept", accept)
    monkeypatch.setattr(retraining, "trained_policy", lambda progress: "new")
    monkeypatch.setattr(retraining, "export_trained", lambda progress: "new")
    monkeypatch.setattr(retraining, "watched", lambda progress, found, own, policy: episodes(stops if policy == "new" else 20))
    families = [uncertainty.Family(name, {}) for name in bounds]
    found = uncertainty.Uncertainty(Patch(), families[0], tuple(families), ())
    for _ in range(2):  # the second time its files answer
        progress = Progress(tmp_path, asked(), lambda *said: told.append(said))
        record = retraining.accept_policy(progress, found, ROBOT)
        assert record.numbers["policy"] == kept
        assert (stops == 120) == ("may stop the new one more often (in 23% of episodes, not 4%)" in record.said[0])
    assert played == list(bounds)
    assert told == [("acceptance: as stated", 0.0), ("acceptance: other floors", 0.5)]


def episodes(stopped):
    """In which of 512 episodes a robot is stopped."""
    return np.arange(512) < stopped


@pytest.mark.parametrize(("stops", "trainings"), [(22, ["training"]), (120, ["training", "training_again"])])
def test_a_policy_that_the_supervision_stops_more_often_is_trained_again(tmp_path, monkeypatch, stops, trainings):
    done = {}

    def train(progress, name, family, rewards=None):
        (progress.out / name / "policy").mkdir(parents=True, exist_ok=True)
        done[name] = rewards
        return f"wlr train --out {progress.out / name}"

    def watched(progress, found, own, policy):
        return episodes(stops if policy.endswith("training/policy") else 20)

    monkeypatch.setattr(retraining, "train_in", train)
    monkeypatch.setattr(retraining, "watched", watched)
    progress = Progress(tmp_path, asked())
    found = uncertainty.Uncertainty(Patch(), uncertainty.Family("training", {}), (uncertainty.Family("as stated", {}),), ())
    record = retraining.train_supervised(progress, found, ROBOT)
    assert list(done) == trainings
    assert done["training"] is None
    assert retraining.trained_policy(progress) == str(tmp_path / trainings[-1] / "policy")
    if len(trainings) == 2:
        assert done["training_again"] == retraining.STUCK_WHEELS
        assert "would stop it in 23% of episodes, and the old policy in 4%" in record.said[-1]
        assert record.command.endswith(str(tmp_path / "training_again"))
        monkeypatch.setattr(retraining, "_takes_rewards", lambda policy: False)
        assert "nothing was changed" in retraining.train_supervised(progress, found, ROBOT).said[-1]


def test_rewards_come_beside_those_of_the_recipe():
    settings = retraining.training_settings(asked(), uncertainty.Family("training", {}), retraining.STUCK_WHEELS)
    rewards = settings["environment"]["task"]["rewards"]
    assert rewards["stuck_wheels"] == {"weight": -6.0}
    assert rewards["squared_velocity_error"]


def test_the_supervision_stops_a_robot_whose_wheel_sticks_and_no_healthy_one():
    found = {torque: stopped_episodes("pid", "WLR-Velocity-v0", having_friction(torque), 8, 100_000) for torque in (0.0, 1.2)}
    assert not found[0.0].any()
    assert found[1.2].all()


@pytest.mark.parametrize(
    ("both", "only_new", "only_old", "may"),
    [
        (0, 0, 0, False),
        (300, 0, 0, False),
        (0, 3, 0, False),
        (0, 10, 0, True),
        (0, 10, 10, False),
        (5, 44, 32, True),  # no significant rise, but one of 6 % is not excluded either
        (5, 32, 44, False),
    ],
)
def test_a_policy_must_be_shown_not_to_be_stopped_more_often(both, only_new, only_old, may):
    numbers = np.arange(512)
    new = (numbers < both) | ((numbers >= 400) & (numbers < 400 + only_new))
    old = (numbers < both) | ((numbers >= 450) & (numbers < 450 + only_old))
    assert may_stop_more(new, old) == may


def test_what_the_supervision_would_stop_is_asked_once(tmp_path, monkeypatch):
    played = []
    monkeypatch.setattr(retraining, "stopped_episodes", lambda policy, *_: played.append(policy) or episodes(7))
    family = uncertainty.Family("as stated", {})
    progress, found = Progress(tmp_path, asked()), uncertainty.Uncertainty(Patch(), family, (family,), ())
    policies = ["velocity_slip_aware", str(tmp_path / "training" / "policy"), str(tmp_path / "training_again" / "policy")]
    for policy in policies * 2:
        assert np.array_equal(retraining.watched(progress, found, ROBOT, policy), episodes(7))
    assert played == policies


def having_friction(torque):
    effects = [{"name": "coulomb_friction", "where": ["wheel_lf"], "parameters": {"torque": torque}}] if torque else None
    return {"randomization": "nominal", "effects": effects, "episode_length": 8.0}


# ---- the robot ----


def test_runs_of_another_robot_are_refused(tmp_path):
    other = ROBOT.model_copy(update={"name": "taller", "leg": ROBOT.leg.model_copy(update={"length": 0.12})})
    record_simulation(tmp_path / "run_01.parquet", excite("straight", seconds=4.0), other, "gibbs_appell")
    with pytest.raises(InputError, match=r"of robot 'taller' .* made for .*; expected runs of the policy's robot"):
        driving.record_runs(Progress(tmp_path / "out", asked(robot_runs=str(tmp_path))), None, ROBOT)


def test_a_stopped_drive_is_said_and_an_interrupted_one_is_driven_again(tmp_path, monkeypatch):
    calls = []

    def drive(robot, motion, folder, seed):
        calls.append(motion.name)
        if len(calls) == 2:
            (folder / "run_02.parquet").write_text("half of a run")
            raise KeyboardInterrupt("SIGINT")
        path = folder / f"run_{len(calls):02d}.parquet"
        record_simulation(path, motion.cut(1.0 if motion.name == "turns" else 4.0), ROBOT, "gibbs_appell")
        return Recorded(path, "tilt: 40 degrees" if motion.name == "turns" else "")

    monkeypatch.setattr(driving, "excite_robot", drive)
    progress = Progress(tmp_path, asked(excitations=("straight", "turns")))
    with pytest.raises(KeyboardInterrupt):
        driving.record_runs(progress, EmulatedRobot(ROBOT), ROBOT)
    record = driving.record_runs(progress, EmulatedRobot(ROBOT), ROBOT)
    assert calls == ["straight", "turns", "turns"]
    assert record.said[0] == "1 of 2 excitations left a run: straight."
    assert record.said[1] == "The supervision stopped 'turns': tilt: 40 degrees"
    assert [path.name for path in sorted((tmp_path / "runs").glob("run_*.parquet"))] == ["run_01.parquet"]


# ---- resuming ----


@pytest.mark.parametrize("interrupted", STEPS)
def test_it_resumes_at_every_step_and_repeats_none(tmp_path, monkeypatch, interrupted):
    done, stop = [], [interrupted]
    decided = SimpleNamespace(result=None, folder=tmp_path, history=SimpleNamespace())

    def step(name, answer=lambda record: record):
        def work(*_):
            if name in stop:
                stop.clear()
                raise KeyboardInterrupt
            done.append(name)
            return answer(AdaptStep(said=(name,)))

        return work

    monkeypatch.setattr(steps, "drive_before", step("before"))
    monkeypatch.setattr(steps, "record_runs", step("runs"))
    monkeypatch.setattr(steps, "find_gap", step("gap"))
    monkeypatch.setattr(steps, "_decided", lambda progress: decided)
    monkeypatch.setattr(steps, "state_uncertainty", step("model", lambda record: (record, "found")))
    monkeypatch.setattr(steps, "train_supervised", step("training"))
    monkeypatch.setattr(
        steps, "accept_policy", step("acceptance", lambda record: record.model_copy(update={"numbers": {"policy": "new"}}))
    )
    monkeypatch.setattr(steps, "drive_after", step("after", lambda record: record.model_copy(update={"outcome": "left out"})))
    with pytest.raises(KeyboardInterrupt):
        steps.run_steps(open_folder(tmp_path / "out", asked(), quiet, 1), None, ROBOT)
    found = steps.run_steps(open_folder(tmp_path / "out", asked(), quiet, 1), None, ROBOT)
    assert list(dict.fromkeys(done)) == list(STEPS)
    assert all(done.count(name) == 1 for name in STEPS if name != "model")  # it is made again in a moment
    assert found.is_new
    content = json.loads((tmp_path / "out" / "adapt.json").read_text())
    assert list(content["steps"]) == list(STEPS)
    assert "the new policy was not driven" in found.page.read_text()


def test_a_folder_of_another_command_is_refused(tmp_path):
    open_folder(tmp_path / "out", asked(), quiet, 1).save()
    with pytest.raises(InputError, match=r"state.json: seed: 0, requested 7; expected the same command, or another --out"):
        open_folder(tmp_path / "out", asked(seed=7), quiet, 1)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").write_text("")
    with pytest.raises(InputError, match="expected a new folder"):
        open_folder(tmp_path / "mine", asked(), quiet, 1)


# ---- bad input of the command ----


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "nothing to adapt to: give measured runs"),
        (("--emulated", "--robot-runs", "x"), "--emulated: an emulated robot, a real one"),
        (("--robot-runs", "nowhere"), "--robot-runs nowhere: no such folder"),
        (("--robot-runs", str(Path(__file__).parent)), "no run_*.csv or run_*.parquet"),
        (("--emulated", "--env", "WLR-Path-v0"), "was made for another environment, WLR-Velocity-v0"),
        (("--emulated", "--drives", "0"), "drives"),
        (("--emulated", "--sensors", "camera"), "driven without a camera"),
        (("--emulated", "--backend", "mujco"), "did you mean 'mujoco'"),
        (("--emulated", "--excitation", "strait"), "did you mean 'straight'"),
    ],
)
def test_bad_input_is_refused_before_anything_is_made(tmp_path, capsys, words, said):
    assert main(["adapt", "velocity_slip_aware", "--out", str(tmp_path / "out"), *words]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_unknown_effects_and_agents_are_refused(tmp_path, capsys):
    path = tmp_path / "hidden.yaml"
    path.write_text("effects: [{name: weak_moter, where: [leg_lf], parameters: {scale: 0.8}}]")
    assert main(["adapt", "velocity_slip_aware", "--emulated", "--effects", str(path), "--out", str(tmp_path / "out")]) == 2
    assert "weak_motor" in capsys.readouterr().err
    assert main(["adapt", "pid", "--emulated", "--out", str(tmp_path / "out")]) == 2
    assert "expected a policy that PPO trained" in capsys.readouterr().err


def test_measured_runs_alone_drive_nothing(tmp_path, monkeypatch):
    record_simulation(tmp_path / "data" / "run_01.parquet", excite("straight", seconds=4.0), ROBOT, "gibbs_appell")
    budgets = []

    def decide(data, out, record, budget, **_):
        budgets.append(budget.runs)
        out.mkdir()
        history = History(data=str(data), robot=None, backend="gibbs_appell", known=[], ended="budget")
        (out / HISTORY_FILE).write_text(history.model_dump_json())
        return Decided(history, None, out)

    monkeypatch.setattr(steps, "decide", decide)
    first, found = (wlr_gym.adapt("velocity_slip_aware", tmp_path / "out", robot_runs=tmp_path / "data") for _ in range(2))
    assert (first.policy, first.is_new) == ("velocity_slip_aware", False)
    assert found == first  # from its files
    outcomes = {name: step.outcome for name, step in found.steps.items()}
    assert outcomes == dict.fromkeys(STEPS, "left out") | {"runs": "done", "gap": "done"}
    assert budgets == [0]
    assert "There are too few usable runs" in found.page.read_text()
    assert [path.name for path in (tmp_path / "data").glob("*.parquet")] == ["run_01.parquet"]
