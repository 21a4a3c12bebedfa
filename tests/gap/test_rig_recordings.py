"""Recordings of the test rig: decoding, refusals, what intake notices, what is held out."""

import dataclasses
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from rig_bench import Bench, contents, write

from wlr_gym.base.errors import InputError
from wlr_gym.gap.analysis import Analysis, FoundEffect, ParameterEstimate
from wlr_gym.gap.estimation.model import nominal_model
from wlr_gym.gap.problem import Setting
from wlr_gym.gap.report.result import patch_of
from wlr_gym.gap.rig.pendulum import GOAL_LEAD, JOINT, RIG_EFFECTS, STEP, PendulumProblem, Replay, open_pendulum, pendulum_patch
from wlr_gym.gap.rig.pendulum_recordings import decode_load, findings, read_recording, read_recordings
from wlr_gym.gap.rig.problem import law_candidates, smoothed_state
from wlr_gym.gap.workflow import analyse
from wlr_gym.physics.effects import Patch, save_patch

REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "xl330_pendulum"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return write(tmp_path_factory.mktemp("rig"), Bench(), gains=(100, 400), duration=3.0)


def kinds(recordings, run=None):
    return {f.kind for f in findings(recordings) if run is None or f.run == run}


def test_unsigned_readings_of_a_signed_register_are_decoded():
    np.testing.assert_allclose(decode_load(np.array([0.0, 885.0, 65535.0, 64651.0])), [0.0, 1.0, -1 / 885, -1.0])


def test_decoded_duty_is_what_the_gain_asks_for(made):
    for recording in read_recordings(made):
        wish = recording.gain * 4096 / (2 * np.pi) / (256 * 885) * (recording.goal - recording.angle)
        assert np.abs(recording.duty - np.clip(wish, -1, 1)).max() < 0.01 + 0.5 * np.ptp(wish) / 885


def test_states_come_from_the_rows_around(made):
    recording = read_recordings(made)[0]
    angle, rate = smoothed_state(recording.t, np.sin(3.0 * recording.t))
    np.testing.assert_allclose(angle, np.sin(3.0 * recording.t), atol=1e-6)
    np.testing.assert_allclose(rate[4:-4], 3.0 * np.cos(3.0 * recording.t[4:-4]), atol=1e-4)


def test_goals_hold_from_row_to_row_and_keep_their_area(made):
    recording = read_recordings(made)[0]
    replay = Replay(recording)
    middle = recording.t[0] + STEP * (np.arange(len(replay.goals)) + 0.5)
    row = np.clip(np.searchsorted(recording.t - GOAL_LEAD, middle, side="right") - 1, 0, None)
    inside = np.abs(replay.goals - recording.goal[row]) < 1e-12
    assert inside.mean() > 0.55  # the others hold the change of a goal
    assert replay.goals.sum() == pytest.approx(recording.goal[row].sum(), rel=2e-3)


# --- refusals


def broken(folder, **changes):
    one = contents(Bench(), [100], ["sin_sin"], duration=0.5)[0]
    entries = [dict(entry) for entry in one["entries"]]
    changes.pop("edit", lambda e: None)(entries) if "edit" in changes else None
    path = folder / "broken.json"
    path.write_text(json.dumps(one | {"entries": entries} | changes))
    return path


def put(row, key, value):
    def edit(entries):
        entries[row][key] = value

    return edit


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"edit": put(7, "position", None)}, "entry 7: position is None"),
        ({"edit": put(7, "position", float("nan"))}, "entry 7: position is nan"),
        ({"edit": put(9, "timestamp", 0.0)}, "entry 9: timestamp 0 s is not after"),
        ({"edit": put(3, "input_volts", 0)}, "entry 3: input_volts 0 V"),
        ({"edit": lambda entries: entries[5].pop("goal_position")}, "entry 5 has no 'goal_position'"),
        ({"edit": lambda entries: entries.__delitem__(slice(20, None))}, "20 entries; a run needs 50"),
        ({"mass": -1}, "mass -1: expected a positive number"),
        ({"kp": "high"}, "kp is 'high'"),
        ({"entries": 3}, "a list 'entries'"),
    ],
)
def test_what_is_no_recording_is_refused_with_its_place(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        read_recording(broken(tmp_path, **changes))


def test_missing_header_key_is_named(tmp_path):
    one = contents(Bench(), [100], ["sin_sin"], duration=0.5)[0]
    del one["length"]
    (tmp_path / "a.json").write_text(json.dumps(one | {"lenght": 0.1}))
    with pytest.raises(InputError, match=r"has no 'length' \(did you mean 'lenght'"):
        read_recordings(tmp_path)


def test_folders_without_recordings_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        read_recordings(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"holds no \*\.json"):
        read_recordings(tmp_path)
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(InputError, match="cannot be read as JSON"):
        read_recordings(tmp_path)


# --- intake


def test_a_clean_set_is_told_only_what_is_true(made):
    recordings = read_recordings(made)
    found = kinds(recordings)
    assert "wrap" in found
    assert "missing" in found
    assert not found & {"supply", "gap", "dead", "units", "few_runs", "control_law", "off"}


def test_intake_notices_what_is_odd(made):
    recordings = read_recordings(made)
    one = recordings[0]
    rest = recordings[1:]

    def with_one(**changes):
        return kinds([dataclasses.replace(one, **changes), *rest], one.name)

    supply = one.supply.copy()
    supply[100] = 5.7
    assert "supply" in with_one(supply=supply)
    late = one.t + 0.1 * (np.arange(len(one.t)) > 200)
    assert "gap" in with_one(t=late)
    assert "dead" in with_one(angle=np.zeros_like(one.angle))
    assert "off" in with_one(enabled=one.t < 2.0)
    assert "control_law" in with_one(gain=200.0)
    assert "wrap" not in with_one(raw_load=np.abs(one.duty) * 885)


def test_wrong_units_and_signs_are_fatal(made):
    recordings = read_recordings(made)
    one = recordings[0]
    for changes in (
        {"angle": np.degrees(one.angle), "goal": np.degrees(one.goal)},
        {"speed": -one.speed},
        {"speed": 9.5 * one.speed},
    ):
        fatal = [f for f in findings([dataclasses.replace(one, **changes), *recordings[1:]]) if f.fatal]
        assert [f.kind for f in fatal] == ["units"] * len(fatal)
        assert fatal
        assert {f.run for f in fatal} == {one.name}


def test_what_goes_together_over_the_runs_is_said(made):
    recordings = read_recordings(made)
    warming = [dataclasses.replace(r, temperature=r.temperature + k) for k, r in enumerate(recordings)]
    texts = [f.text for f in findings(warming) if f.kind == "confounded"]
    assert any("temperature and order of recording" in text for text in texts)
    assert not any("temperature" in f.text for f in findings(recordings) if f.kind == "confounded")


# --- opening a folder


def test_held_out_runs_cover_gains_and_trajectories(made):
    recordings = read_recordings(made)
    held_out = PendulumProblem(recordings).held_out
    held = [recording for recording in recordings if recording.name in held_out]
    assert len(held) == len(held_out) == 2
    assert len({recording.gain for recording in held}) == 2
    assert len({recording.trajectory for recording in held}) == 2


def test_opening_leaves_out_what_cannot_be_used(made, tmp_path):
    problem, found = open_pendulum(made)
    assert problem is not None
    assert len(problem.runs) == 6
    assert not any(f.fatal for f in found)
    runs = contents(Bench(), [100] * 4, ["sin_sin"] * 4, duration=1.0)
    for entry in runs[0]["entries"]:
        entry["position"] = 57.3 * entry["position"]
        entry["goal_position"] = 57.3 * entry["goal_position"]
    for k, one in enumerate(runs):
        (tmp_path / f"run_{k}.json").write_text(json.dumps(one))
    problem, found = open_pendulum(tmp_path)
    assert problem is not None
    assert problem.runs == ("run_1", "run_2", "run_3")
    assert {f.run for f in found if f.fatal} == {"run_0"}
    (tmp_path / "run_3.json").unlink()
    problem, found = open_pendulum(tmp_path)
    assert problem is None
    assert found[-1].kind == "few_runs"
    assert found[-1].fatal


def test_the_patch_that_an_analysis_of_the_rig_writes_can_be_given_back(made, tmp_path):
    """Every effect that it may find, through the file; a known effect acts as the same effect in a setting does."""
    found = []
    each = (
        law_candidates(RIG_EFFECTS, JOINT, present)[1] for present in ({"load_dependent_friction", "coulomb_friction"}, set())
    )
    for candidate in itertools.chain(*each):
        values = candidate.parameters(candidate.kept([0.5 * (u.low + u.high) for u in candidate.unknowns]))
        estimates = {name: ParameterEstimate(value, value, value, "-") for name, value in values.items()}
        found.append(FoundEffect(candidate.name, candidate.where, estimates, 0.9, 100.0))
    written = patch_of(Analysis("made", "effect_found", "", effects=tuple(found)))
    patch = pendulum_patch(save_patch(written, tmp_path / "patch.yaml"))
    assert patch.effects == written.effects
    assert patch.provenance == written.provenance
    one = Patch(tuple(effect for effect in patch.effects if effect.name == "torque_saturation")[:1])
    problem, plain = open_pendulum(made, one)[0], open_pendulum(made)[0]
    assert problem is not None
    assert plain is not None
    numbers = nominal_model(plain).quantities
    (known,), (added,), (without,) = (
        own.simulate([setting], [3])
        for own, setting in ((problem, Setting(numbers)), (plain, Setting(numbers, one.effects)), (plain, Setting(numbers)))
    )
    assert (known == added).all()
    assert np.abs(known - without).max() > 1e-3


def test_patches_of_the_rig_are_read_from_anything_that_effects_are():
    entry = {"name": "load_dependent_friction", "where": ["servo"], "parameters": {"ratio": 0.2}}
    formula = {"name": "unknown_effect", "formula": "-b * rate", "parameters": {"b": 0.1}, "units": {"b": "N m s/rad"}}
    both = pendulum_patch([entry, {"effects": [formula]}])
    assert [effect.name for effect in both.effects] == ["load_dependent_friction", "unknown_effect"]
    assert pendulum_patch(both) is both
    assert pendulum_patch(entry).effects == both.effects[:1]
    assert not pendulum_patch(None).effects
    assert not pendulum_patch([]).effects


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"name": "torque_saturaton"}, r"effect 1: unknown effect of the test rig .*did you mean 'torque_saturation'"),
        ({"name": "rolling_resistance", "parameters": {"coefficient": 0.1}}, "unknown effect of the test rig"),
        ({"name": "weak_motor", "where": ["wheel_lf"], "parameters": {"scale": 0.9}}, "the rig has one joint, servo"),
        ({"name": "weak_motor", "parameters": {"skale": 0.9}}, r"unknown parameter 'skale' \(did you mean 'scale'"),
        ({"name": "weak_motor", "parameters": {"scale": "much"}}, r"scale = 'much': expected a number in \["),
        ({"name": "torque_saturation", "parameters": {"coefficient": 11}}, r"coefficient = 11: expected a number in \[0, 10\]"),
        ({"name": "torque_saturation"}, "coefficient = None"),
        ({"name": "unknown_effect", "formula": "-b * (rate"}, "formula"),
        ({"name": "unknown_effect"}, r"effect 1 \(unknown_effect\): formula = None: expected a formula"),
        (
            {"name": "unknown_effect", "formula": "-b * rate", "parameters": {"b": 0.1}, "units": ["b"]},
            r"units = \['b'\]: expected a m",
        ),
        ("weak_motor", "expected a mapping with 'name'"),
    ],
)
def test_patches_that_the_rig_cannot_take_are_refused(entry, words):
    with pytest.raises(InputError, match=words):
        pendulum_patch({"effects": [entry]})
    with pytest.raises(InputError, match="expected a mapping with 'effects'"):
        pendulum_patch({"effect": [entry]})


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ({"effects": [], "provenance": "abc"}, "effects: provenance = 'abc': expected a mapping"),
        ({"effects": [], "provenance": [1]}, r"provenance = \[1\]: expected a mapping"),
        (5, "effects = 5: expected a path, a mapping or a list of effects"),
    ],
)
def test_what_is_no_patch_of_the_rig_is_refused(source, words):
    with pytest.raises(InputError, match=words):
        pendulum_patch(source)


def test_a_run_that_cannot_be_used_cannot_be_held_out(tmp_path):
    for k, one in enumerate(contents(Bench(), [100] * 4, ["sin_sin"] * 4, duration=1.0)):
        for entry in one["entries"] if k == 0 else ():
            entry["position"] = 57.3 * entry["position"]
            entry["goal_position"] = 57.3 * entry["goal_position"]
        (tmp_path / f"run_{k}.json").write_text(json.dumps(one))
    with pytest.raises(InputError, match=r"--heldout run_0: the run cannot be used: "):
        analyse(tmp_path, rig="pendulum", heldout=("run_0",))


@pytest.mark.skipif(not REAL.is_dir(), reason="the real recordings are not beside the repository")
def test_real_recordings_are_read_and_flagged():
    recordings = read_recordings(REAL)
    assert len(recordings) == 12
    found = findings(recordings)
    assert not any(f.fatal for f in found)
    per_kind = {kind: {f.run for f in found if f.kind == kind} for kind in ("wrap", "supply", "off")}
    assert len(per_kind["wrap"]) == 9
    assert len(per_kind["supply"]) == 12
    assert len(per_kind["off"]) == 3
    assert min(r.supply.min() for r in recordings) == 5.7
    assert max(r.supply.max() for r in recordings) == 9.2
    assert any(f.kind == "missing" and f.channel == "arm_mass" for f in found)
    confounded = " ".join(f.text for f in found if f.kind == "confounded")
    for pair in ("P gain and temperature", "P gain and order", "temperature and order"):
        assert pair in confounded
    assert all(np.abs(r.duty).max() <= 1.0 for r in recordings)
