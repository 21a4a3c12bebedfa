"""Snapshots: robots that are set back go on bit for bit, in any row of any batch."""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from fake_plant import FakePlant

import wlr_gym  # noqa: F401
from wlr_gym.base.errors import InputError
from wlr_gym.base.snapshot import Snapshot
from wlr_gym.envs import Sb3VecEnv

#: s; episodes end within the roll-outs.
LENGTH = 0.5
BACKLASH = {"name": "backlash", "where": ["leg_lf", "wheel_rr"], "parameters": {"angle": 0.02}}
SPRING = {
    "name": "unknown_effect",
    "where": ["leg_lr"],
    "formula": "-k * (leg_angle - a0) * time",
    "parameters": {"k": 0.8, "a0": 1.2},
    "units": {"k": "N m/rad/s", "a0": "rad"},
}
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "engine": ("WLR-Velocity-v0", {"randomization": "wide", "effects": [BACKLASH, SPRING]}),
    "engine float32": ("WLR-Path-v0", {"randomization": "patches", "precision": "float32", "observation": "dict"}),
    "engine, free wheel": ("WLR-Slope-v0", {"free_wheels": ["wheel_lf"]}),
    "mujoco": ("WLR-Posture-v0", {"randomization": "wide", "backend": "mujoco", "effects": [BACKLASH, SPRING]}),
}


def make(case: str, count: int, **more: Any) -> Any:
    env_id, keywords = CASES[case]
    return gym.make_vec(env_id, num_envs=count, episode_length=LENGTH, **keywords, **more)


def actions(steps: int, count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, count, 8)).astype(np.float32)


def rows_of(found: Any, rows: list[int], place: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """These robots' rows of every array that a step returned, in dicts and infos too."""
    if isinstance(found, Mapping):
        for key, value in found.items():
            yield from rows_of(value, rows, f"{place}/{key}")
    elif isinstance(found, tuple):
        for number, value in enumerate(found):
            yield from rows_of(value, rows, f"{place}/{number}")
    else:
        yield place, np.asarray(found)[rows]


def assert_same(first: Any, rows: list[int], second: Any, others: list[int]) -> None:
    """What both steps returned of these robots is the same to the bit; what an info lacks holds for none of them."""
    ours, theirs = dict(rows_of(first, rows)), dict(rows_of(second, others))
    for place in ours.keys() | theirs.keys():
        if place in ours and place in theirs:
            np.testing.assert_array_equal(ours[place], theirs[place], err_msg=place)
        else:
            mask = (ours if place in ours else theirs).get("/".join([*place.split("/")[:-1], f"_{place.split('/')[-1]}"]))
            assert place.split("/")[-1].startswith("_") or mask is not None, place
            assert mask is None or not mask.any(), place


@pytest.mark.parametrize("case", CASES)
def test_robots_go_on_in_other_rows_of_another_batch(case: str) -> None:
    env, other = make(case, 4), make(case, 11)
    env.reset(seed=3)
    other.reset(seed=100)
    given = actions(60, 4)
    for action in given[:20]:
        env.step(action)
    for action in actions(7, 11, seed=1):
        other.step(action)
    snapshot = pickle.loads(pickle.dumps(env.get_state()))
    later = [env.step(action) for action in given[20:]]
    bystander = other.get_state([0])
    other.set_state(snapshot[[2, 0]], [9, 1])
    np.testing.assert_equal(other.get_state([0]).arrays, bystander.arrays)
    for action, expected in zip(given[20:], later, strict=True):
        wide = np.zeros((11, 8), np.float32)
        wide[9], wide[1] = action[2], action[0]
        assert_same(other.step(wide), [9, 1], expected, [2, 0])
    assert any(expected[3][[0, 2]].any() for expected in later)  # an episode ended, and the next began


@pytest.mark.slow
def test_one_robot_alone_and_in_a_batch() -> None:
    env_id, keywords = CASES["engine"]
    single: Any = gym.make(env_id, **keywords)
    batch: Any = gym.make_vec(env_id, num_envs=3, **keywords)
    single.reset(seed=5)
    batch.reset(seed=6)
    for action in actions(15, 1):
        single.step(action[0])
    snapshot = single.unwrapped.get_state()
    observations = batch.set_state(snapshot, [False, True, True])
    fresh: Any = gym.make(env_id, **keywords).unwrapped  # never reset
    np.testing.assert_array_equal(fresh.set_state(snapshot), observations[1])
    for action in actions(20, 1, seed=2):
        observation, reward, *_ = single.step(action[0])
        together = batch.step(np.repeat(action, 3, axis=0))
        np.testing.assert_array_equal(together[0][1], observation)
        np.testing.assert_array_equal(together[0][2], observation)
        assert together[1][1] == together[1][2] == reward
        np.testing.assert_array_equal(fresh.step(action[0])[0], observation)


def test_the_interface_of_stable_baselines3_has_them_too() -> None:
    env_id, keywords = CASES["engine"]
    env = Sb3VecEnv(env_id, 2, seed=1, **keywords)
    env.reset()
    for action in actions(5, 2):
        env.step(action)
    snapshot, given = env.get_state(), actions(10, 2, seed=4)
    first = [env.step(action)[0] for action in given]
    env.set_state(snapshot)
    np.testing.assert_array_equal([env.step(action)[0] for action in given], first)


def walk(found: Any, place: str, seen: set[int]) -> Iterator[tuple[str, Any]]:
    """Every array, number and object array below an object, as (path, value)."""
    if isinstance(found, (np.ndarray, np.void, bool, int, float, str)):
        yield place, found
    elif isinstance(found, Mapping):
        for key, value in found.items():
            yield from walk(value, f"{place}[{key}]", seen)
    elif isinstance(found, (list, tuple)):
        for number, value in enumerate(found):
            yield from walk(value, f"{place}[{number}]", seen)
    elif type(found).__module__.startswith("wlr_gym") and id(found) not in seen:
        seen.add(id(found))
        names = [*getattr(found, "__dict__", ()), *(n for k in type(found).__mro__ for n in getattr(k, "__slots__", ()))]
        for name in names:
            yield from walk(getattr(found, name), f"{place}.{name}", seen)


#: What a step writes before it reads it, or an address.
SCRATCH = (
    ".plant._table", ".plant._generalised", ".plant._force_inputs", ".plant._batch.contact", ".plant._batch.constraint",
    ".plant._batch.per_contact", ".plant._batch._size", ".plant._batch._pos", ".plant._batch._quat", ".observer._work",
)  # fmt: skip


@pytest.mark.parametrize("case", ["engine", "mujoco", "engine float32"])
def test_nothing_that_an_environment_remembers_is_missing(case: str) -> None:
    """Two environments with other pasts are alike in every number below them after one got the other's state."""
    env, other = make(case, 16), make(case, 16)
    for seed, one in enumerate((env, other)):
        one.reset(seed=100 * seed, options={"parameters": {"ground.mu_x": 0.3 + 0.2 * seed}})
        for action in actions(22, 16, seed):
            one.step(action)
    before = dict(walk(env.core, "", set()))
    remembered = [place for place, value in walk(other.core, "", set()) if not np.array_equal(value, before[place])]
    assert len(remembered) > 30  # the walk finds what differs
    other.set_state(env.get_state())
    found = dict(walk(other.core, "", set()))
    different = [place for place in before if not _equal(found[place], before[place]) and not place.startswith(SCRATCH)]
    assert different == []


def _equal(first: Any, second: Any) -> bool:
    if isinstance(first, np.ndarray) and first.dtype.kind in "fc":
        return np.array_equal(first, second, equal_nan=True)
    return np.array_equal(first, second)


def test_a_snapshot_is_a_sequence_of_robots() -> None:
    env = gym.make_vec("WLR-Velocity-v0", num_envs=3)
    env.reset(seed=0)
    snapshot = env.get_state()  # type: ignore[attr-defined]
    assert [len(one) for one in snapshot] == [1, 1, 1]
    for rows, same in ((-1, 2), (slice(1, None), [1, 2])):
        for name, values in snapshot[rows].arrays.items():
            np.testing.assert_array_equal(values, snapshot[same].arrays[name])
    assert len(repr(snapshot)) < 40


def test_what_a_caller_does_with_his_arrays_later_does_not_reach_the_robots() -> None:
    friction = np.full((4,), 0.5)
    env = gym.make_vec("WLR-Velocity-v0", num_envs=1, randomization="patches")
    env.reset(seed=0, options={"parameters": {"ground.mu_x": friction}})
    friction[:] = 0.2
    for _ in range(150):
        env.step(np.zeros((1, 8), np.float32))
    assert (env.core.parameters["ground.mu_x"] == 0.5).all()  # type: ignore[attr-defined]


def test_a_snapshot_of_something_else_is_refused_and_nothing_changes() -> None:
    env = make("engine", 2)
    env.reset(seed=0)
    snapshot, kept = env.get_state(), env.get_state()
    env_id, keywords = CASES["engine"]
    for difference, more in {
        "precision is 'float32'": {"precision": "float32"},
        "physics_step": {"physics_step": 0.002},
        "randomization": {"randomization": "ice"},
        "effects": {"effects": [SPRING]},
        "free_wheels": {"free_wheels": ["wheel_lf"]},
        "robot.servo.leg.stall_current is 4.4, here None": {"robot": "emanual"},
    }.items():
        other: Any = gym.make_vec(env_id, num_envs=2, **{**keywords, "episode_length": LENGTH, **more})
        other.reset(seed=0)
        with pytest.raises(InputError, match=difference):
            env.set_state(other.get_state())
    for bad, message in (
        (["x"], "rows"),
        ([2], "from 0 to 1"),
        ([-1], "from 0 to 1"),
        ([True], "2 booleans"),
        ([], "rows"),
        ([1, 1], "twice"),
    ):
        with pytest.raises(InputError, match=message):
            env.get_state(bad)
    with pytest.raises(InputError, match="2 robots for 1"):
        env.set_state(snapshot, [0])
    part = Snapshot(snapshot.fits, {name: values for name, values in snapshot.arrays.items() if name != "plant/lanes"})
    with pytest.raises(InputError, match="no 'lanes': it was not taken of such a thing"):
        env.set_state(part)
    assert len(snapshot[1]) == 1
    assert snapshot[1].nbytes * 2 == snapshot.nbytes
    with pytest.raises(InputError, match="dict"):
        env.set_state({"position": 0.0})
    np.testing.assert_equal(env.get_state().arrays, kept.arrays)
    with pytest.raises(gym.error.ResetNeeded):
        make("engine", 2).get_state()


def test_a_plant_whose_state_cannot_be_set_says_so(fake: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """As that of docs/extending.md, which has no such methods at all."""
    monkeypatch.setattr(FakePlant, "capabilities", replace(FakePlant.capabilities, can_set_state=False))
    env: Any = gym.make("WLR-Velocity-v0").unwrapped
    env.reset(seed=0)
    for call in (env.get_state, lambda: env.set_state(None)):
        with pytest.raises(InputError, match="backend 'gibbs_appell': its robots cannot be saved and set back"):
            call()
