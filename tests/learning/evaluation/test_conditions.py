"""All subjects play the same episodes, each with its own observation; who would not is refused."""

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.learning.evaluation.conditions import (
    BLOCK,
    LEFT_FRICTION,
    SLOPE_FRICTION,
    SWEEPS,
    Condition,
    play,
    read_sweep,
    sweeps_for,
)
from wlr_gym.learning.evaluation.rollout import Rollout
from wlr_gym.learning.evaluation.subjects import Subject, identity, make_player, read_subjects
from wlr_gym.policy import agents as sources_module
from wlr_gym.robot.parameter_table import ELEMENTS

ID = "WLR-Velocity-v0"
SHORT = {"episode_length": 0.2}
#: What configs of agents say about the environment that they need, by name of the subject.
BLIND = {"task": {"observations": {"leg_effort": None}}}
SUBJECTS = read_subjects(["idle=do_nothing", "constant_command"])


def environments(monkeypatch, **own):
    """Let subjects need environments of their own."""
    monkeypatch.setattr(sources_module, "policy_environment", lambda source: own.get(str(source), {}))


def test_every_subject_plays_every_condition_with_the_same_episodes(monkeypatch):
    environments(monkeypatch, do_nothing=BLIND)
    seen, told = {}, []
    conditions = [Condition("main", SHORT, episodes=3, blocks=2), Condition("icy", SHORT, {"ground.mu_x": 0.1}, episodes=3)]

    def watch(condition, subject, block, rollout):
        seen[condition.label, subject.name, block] = rollout

    results = play(ID, SUBJECTS, conditions, 100, lambda text, cost: told.append((text, cost)), watch)
    assert {label: list(names) for label, names in results.items()} == {
        key: ["idle", "constant_command"] for key in ("main", "icy")
    }
    assert results["main"]["idle"].pairs["reward"].shape == (1, 2, 3, 2)
    for (label, _, block), rollout in seen.items():
        other = seen[label, "idle", block]
        assert rollout.seeds.tolist() == [100 + BLOCK * block + i for i in range(3)]
        assert np.array_equal(rollout.parameters, other.parameters)
        assert np.array_equal(rollout.command, other.command)
    assert sum(share for _, share in told) == pytest.approx(1.0)
    assert ("idle: icy", pytest.approx(1 / (2 * 3 * 10))) in told


def test_an_observation_of_ones_own_changes_nothing_but_the_observation(monkeypatch):
    blocks = []
    for own in ({}, {"constant_command": BLIND}):
        environments(monkeypatch, **own)
        play(ID, SUBJECTS[1:], [Condition("main", SHORT, episodes=2)], watch=lambda *given: blocks.append(given[-1]))
    assert np.array_equal(blocks[0].position, blocks[1].position)


def test_a_condition_on_the_task_holds_for_a_policy_with_a_task_of_its_own(monkeypatch):
    environments(monkeypatch, constant_command=BLIND)
    wide = {**SHORT, "task": {"commands": {"terms": {"yaw_rate": [-0.01, 0.01]}}}}
    turned = []
    play(ID, SUBJECTS, [Condition("main", wide, episodes=4)], watch=lambda *given: turned.append(given[-1].command[:, :, 1]))
    assert all(np.abs(turns).max() <= 0.01 for turns in turned)


def test_what_a_policy_is_not_fed_stays_away_under_a_condition_on_the_task():
    core, _ = make_player(ID, "pid", 1, {**SHORT, "task": {"commands": {"terms": {"yaw_rate": [-0.01, 0.01]}}}})
    contract = core.contract()
    core.close()
    assert contract["observer"] is None
    assert not [column["name"] for column in contract["observation"] if column["source"] == "estimate"]


@pytest.mark.parametrize(
    ("own", "message"),
    [
        (
            {"task": {"commands": {"terms": {"yaw_rate": [-0.5, 0.5]}}}},
            r"seed 10.* gets another command from environment step \d+",
        ),
        ({"randomization": "wide"}, r"seed 100: .* is .* and "),
        ({"randomization": {"base": "slippery", "initial_state": {"yaw": 0.1}}}, "starts in another state"),
        ({"task": {"success": {"velocity_error": {"rms": 9.0}}}}, "other measures or commands"),
    ],
)
def test_other_episodes_are_refused(monkeypatch, own, message):
    environments(monkeypatch, constant_command=own)
    long = {"episode_length": 9.0} if "environment step" in message else SHORT
    with pytest.raises(InputError, match=f"'idle' and 'constant_command' were not given the same episodes: .*{message}"):
        play(ID, SUBJECTS, [Condition("main", long, episodes=2)], 100)


def test_a_policy_that_does_not_fit_is_refused_before_anything_is_played(monkeypatch):
    environments(monkeypatch, constant_command={"task": {"observations": {"command": None}}})
    told = []
    with pytest.raises(InputError, match="command"):
        play(ID, SUBJECTS, [Condition("main", SHORT, episodes=2)], tell=lambda *given: told.append(given))
    assert told == []


def test_all_policies_of_a_subject_play_all_blocks():
    both = Subject("both", ("constant_command", "do_nothing"))
    moved, told = [], []
    condition = Condition("main", {"episode_length": 1.0}, episodes=4, blocks=3)

    def watch(condition, subject, block, rollout):
        moved.append((block, int(rollout.seeds[0]), np.abs(rollout.action).max() > 0.0))

    results = play(ID, [both], [condition], 100, lambda text, cost: told.append(cost), watch)
    assert moved == [(block, 100 + BLOCK * block, moves) for moves in (True, False) for block in range(3)]
    assert sum(told) == pytest.approx(1.0)
    rewards = results["main"]["both"].pairs["reward"][..., 0]
    alone = play(ID, [Subject("second", ("do_nothing",))], [condition], 100)["main"]["second"].pairs["reward"][..., 0]
    assert np.array_equal(rewards[1], alone[0])
    assert not np.array_equal(rewards[0], rewards[1])


def test_subjects_are_read():
    assert read_subjects(["pid", "pid", "mine=out/a"]) == (Subject("pid", ("pid",)), Subject("mine", ("out/a",)))
    for wrong, message in (
        (["a=x", "a=y"], "two policies are called 'a'"),
        (["a="], "expected NAME=POLICY"),
        (["=x"], "expected NAME"),
    ):
        with pytest.raises(InputError, match=message):
            read_subjects(wrong)


def test_a_subject_is_known_by_its_settings_or_its_files(tmp_path):
    (tmp_path / "policy").mkdir()
    (tmp_path / "policy" / "contract.json").write_text("{}")
    before = identity(Subject("a", (str(tmp_path),)))
    (tmp_path / "policy" / "weights").write_text("1")
    after = identity(Subject("a", (str(tmp_path),)))
    assert len(before) == len(after) == 64
    assert before != after
    assert identity(SUBJECTS[0]) != identity(SUBJECTS[1])


def test_a_folder_with_an_equals_sign_is_a_folder(tmp_path):
    folder = tmp_path / "lr=3"
    folder.mkdir()
    assert read_subjects([folder]) == (Subject(str(folder), (str(folder),)),)


def same(rollouts, name):
    return np.array_equal(getattr(rollouts[0], name), getattr(rollouts[1], name))


def test_the_paper_s_leg_sweeps_are_commands():
    first, second = SWEEPS["paper"].points
    assert first.commands["rear_leg_second"] == pytest.approx(np.radians(150))
    assert first.commands["front_leg_first"] == first.commands["front_leg_second"] == pytest.approx(np.radians(30))
    assert second.commands["rear_leg_first"] == second.commands["front_leg_second"] == pytest.approx(np.radians(150))


@pytest.mark.parametrize("name", SWEEPS)
def test_every_point_of_a_sweep_can_be_played(name):
    sweep = SWEEPS[name]
    environment = f"WLR-{(sweep.tasks or ('velocity',))[0].capitalize()}-v0"
    steps = []
    ends = (sweep.conditions({"episode_length": 0.04}, 2)[0], sweep.conditions({"episode_length": 0.04}, 2)[-1])
    play(environment, SUBJECTS[:1], ends, watch=lambda *given: steps.append(given[-1]))
    assert not (same(steps, "parameters") and same(steps, "command"))
    assert len({condition.label for condition in sweep.conditions({}, 2)}) == len(sweep.points)


def test_a_sweep_of_another_task_is_refused():
    assert "slope" not in sweeps_for("velocity")
    with pytest.raises(InputError, match="sweep 'slope' is not for task 'velocity'; for it: friction"):
        read_sweep("slope", "velocity")
    with pytest.raises(InputError, match="did you mean 'friction'"):
        read_sweep("frictoin", "velocity")


@pytest.mark.parametrize(("numbers", "message"), [({"episodes": 0}, "episodes = 0"), ({"blocks": 0}, "blocks = 0")])
def test_impossible_numbers_are_refused(numbers, message):
    with pytest.raises(InputError, match=message):
        Condition("main", **numbers)


# ---- every sweep sets what its axis says, seen in what the robots were given ----

LEFT, RIGHT = [0, 2], [1, 3]


def given(name: str, task: str) -> list[tuple[float, Rollout]]:
    """The first, middle and last point of a sweep: its value, and two episodes of two environment steps."""
    sweep = SWEEPS[name]
    chosen = [sweep.points[k] for k in (0, len(sweep.points) // 2, -1)]
    conditions = {condition.label: condition for condition in sweep.conditions({"episode_length": 0.04}, 2)}
    played: list[Rollout] = []
    play(
        f"WLR-{task}-v0",
        SUBJECTS[:1],
        [conditions[sweep.label(p)] for p in chosen],
        watch=lambda *seen: played.append(seen[-1]),
    )
    return [(point.value, rollout) for point, rollout in zip(chosen, played, strict=True)]


def parameter(rollout: Rollout, name: str) -> np.ndarray:
    """All elements of a parameter (episodes, elements)."""
    return rollout.parameters[:, [name in (element, element.partition("[")[0]) for element in ELEMENTS]]


def test_friction_is_the_same_under_every_wheel():
    for friction, rollout in given("friction", "Velocity"):
        np.testing.assert_allclose(rollout.friction, friction)


def test_split_is_the_ratio_of_right_to_left():
    for ratio, rollout in given("split", "Velocity"):
        np.testing.assert_allclose(rollout.friction[:, LEFT], LEFT_FRICTION)
        np.testing.assert_allclose(rollout.friction[:, RIGHT], ratio * LEFT_FRICTION)


@pytest.mark.parametrize("name", ["slope", "grip"])
def test_slopes_are_so_much_less_steep_than_friction_holds(name):
    for value, rollout in given(name, "Slope"):
        friction, below = (SLOPE_FRICTION, value) if name == "slope" else (value, 2.0)
        np.testing.assert_allclose(rollout.friction, friction)
        steepness = np.degrees(parameter(rollout, "ground.slope[pitch]"))
        np.testing.assert_allclose(steepness, np.degrees(np.arctan(friction)) - below)
        assert (steepness > 0.0).all()  # as the task's own randomisation has it: uphill ahead


@pytest.mark.parametrize(("name", "quantity"), [("latency", "command.delay"), ("payload", "payload.mass")])
def test_delay_and_payload_are_what_the_axis_says(name, quantity):
    for value, rollout in given(name, "Velocity"):
        np.testing.assert_allclose(parameter(rollout, quantity), value)
