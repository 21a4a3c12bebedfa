"""The acceptance test of a policy, and that the stored tables are of the policies, tasks and floors that ship."""

from pathlib import Path

import gymnasium
import pytest
import yaml

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import data_directory
from wlr_gym.cli import main
from wlr_gym.envs.registry import ENVIRONMENTS, register_task
from wlr_gym.envs.tasks.randomization import RandomizationConfig
from wlr_gym.envs.tasks.task import having
from wlr_gym.learning.evaluation.scoring import (
    ACCEPTANCE_FILE,
    FAMILIES,
    LARGEST_LOSS,
    accept,
    fingerprint,
    read_acceptance,
    references_of,
    write_acceptance,
)
from wlr_gym.policy import shipped_names

STORED = sorted((Path(__file__).parents[3] / "docs" / "data" / "acceptance").glob("*.json"))
TINY = {"floors": ["ice"], "episodes": 8, "blocks": 2}


@pytest.mark.slow
def test_a_policy_loses_nothing_against_itself_and_gains_against_standing_still():
    result = accept("slip_compensating", references=["again=slip_compensating", "do_nothing"], **TINY)
    itself, idle = result.losses
    assert (itself.loss, itself.bound) == (0.0, 0.0)
    assert itself.error == itself.reference_error
    assert idle.bound < -50.0
    assert result.accepted


def test_a_worse_policy_is_refused_whatever_its_mean_says():
    result = accept("do_nothing", "WLR-Velocity-v0", references=["slip_compensating"], **TINY)
    assert not result.accepted
    (loss,) = result.refused
    assert loss.loss > 100.0
    assert loss.bound > loss.loss
    assert loss.loss == pytest.approx(100.0 * (loss.error / loss.reference_error - 1.0))


def test_a_task_of_ones_own_is_played_on_its_own_floors(tmp_path):
    task = yaml.safe_load((data_directory("configs") / "task" / "velocity.yaml").read_text())
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump({**task, "name": "mine", "randomization": "ice"}))
    own = register_task(tmp_path / "mine.yaml")
    try:
        result = accept("pid", own, references=["do_nothing"], episodes=2, blocks=1)
    finally:
        del ENVIRONMENTS[own], gymnasium.registry[own]
    assert [one.floors for one in result.losses] == ["ice"]


def test_floors_may_be_a_path_or_settings(tmp_path):
    (tmp_path / "floor.yaml").write_text("{base: ice}\n")
    for floors, said in ((tmp_path / "floor.yaml", str(tmp_path / "floor.yaml")), (RandomizationConfig(name="mine"), "mine")):
        result = accept("pid", references=["do_nothing"], floors=[floors], episodes=2, blocks=1)
        assert [one.floors for one in result.losses] == [said]


def test_the_file_holds_the_result(tmp_path):
    result = accept("pid", references=["do_nothing"], sensors=(), **TINY)
    write_acceptance(tmp_path / ACCEPTANCE_FILE, result)
    assert read_acceptance(tmp_path / ACCEPTANCE_FILE) == result
    (tmp_path / "broken.json").write_text("{}")
    with pytest.raises(InputError, match=r"broken\.json: expected a result of wlr evaluate --accept"):
        read_acceptance(tmp_path / "broken.json")


def test_the_command_says_so_by_its_exit_code(tmp_path, capsys):
    words = [
        "evaluate",
        "do_nothing",
        "--accept",
        "--baselines",
        "pid",
        "--randomization",
        "ice",
        "--episodes",
        "4",
        "--blocks",
        "2",
    ]
    assert main([*words, "--no-progress", "--out", str(tmp_path / "out")]) == 1
    assert "refused: 1 losses may be above 5 %" in capsys.readouterr().out
    assert not read_acceptance(tmp_path / "out" / ACCEPTANCE_FILE).accepted
    assert main(["evaluate", "pid", "do_nothing", "--accept"]) == 2
    assert "--accept: expected one policy, got 2" in capsys.readouterr().err
    assert main(["evaluate", "pid", "--accept", "--backend", "mujoco"]) == 2
    assert "--backend: it is of the card: leave it out with --accept" in capsys.readouterr().err


def test_references_are_the_controller_underneath_and_the_blind_policy():
    assert references_of("velocity_slip_aware", "WLR-Velocity-v0") == ("slip_compensating", "velocity_blind")
    assert references_of("velocity_blind", "WLR-Velocity-v0") == ("slip_compensating_no_camera",)


def test_sensors_are_a_condition():
    assert having(None) == {}
    assert having(["flow"]) == {"task": {"sensors": {"camera": 0.0, "flow": 1.0}}}
    with pytest.raises(InputError, match=r"unknown sensor 'camra'.*'camera'"):
        having(["camra"])


@pytest.mark.parametrize("path", STORED, ids=lambda path: path.stem)
def test_a_stored_table_is_of_what_ships(path):
    """Policies, task, robot and floors are those that were played: otherwise, run the command that wrote the table again."""
    stored = read_acceptance(path)
    references = dict.fromkeys(loss.reference for loss in stored.losses)
    floors = tuple(dict.fromkeys(loss.floors for loss in stored.losses))
    assert stored.inputs == fingerprint(stored.environment, [stored.policy, *references], floors)
    assert floors == FAMILIES[path.stem.partition("_")[0]]
    assert stored.largest_loss == LARGEST_LOSS


def test_every_slip_aware_policy_has_a_stored_table():
    assert {name for name in shipped_names() if name.endswith("slip_aware")} <= {
        read_acceptance(path).policy for path in STORED
    }


@pytest.mark.slow
@pytest.mark.parametrize("path", STORED, ids=lambda path: path.stem)
def test_a_stored_row_comes_out_again(path):
    stored = read_acceptance(path)
    first = stored.losses[0]
    again = accept(
        stored.policy,
        stored.environment,
        references=[first.reference],
        floors=[first.floors],
        episodes=stored.episodes,
        blocks=stored.blocks,
        sensors=stored.sensors,
    ).losses[0]
    assert again.error == pytest.approx(first.error, rel=0.01)
    assert again.loss == pytest.approx(first.loss, abs=1.0)
