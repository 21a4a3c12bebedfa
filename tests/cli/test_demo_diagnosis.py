"""The hidden fault of the demo's robot, and how a diagnosis is judged."""

import math

import pytest

from wlr_gym.demo.diagnosis import caveats_of, hide, judge
from wlr_gym.gap.analysis import Analysis, ChannelGap, FoundEffect, GapFigures
from wlr_gym.gap.report.result import EffectEntry, ParameterEntry
from wlr_gym.physics.effects import load_patch


def found(name, where, **values):
    parameters = {key: ParameterEntry(value=value, ci95=(0.9 * value, 1.1 * value), unit="") for key, value in values.items()}
    return EffectEntry(name=name, where=list(where), parameters=parameters, confidence=1.0)


HIDDEN = load_patch([{"name": "coulomb_friction", "where": ["leg_lf"], "parameters": {"torque": 0.4}}]).effects[0]


def test_the_seed_decides_what_is_hidden():
    drawn = [hide(seed) for seed in range(40)]
    assert drawn == [hide(seed) for seed in range(40)]
    assert len({one["name"] for one in drawn}) >= 2
    assert len({str(one) for one in drawn}) > 30
    for one in drawn:
        load_patch([one])  # every one is an effect of the library, in its range


def test_a_right_answer():
    answer = judge(HIDDEN, [found("coulomb_friction", ["leg_lf"], torque=0.42)])
    assert answer.right
    assert answer.sizes["torque"] == (0.4, 0.42, 0.9 * 0.42, 1.1 * 0.42)
    assert answer.sentence == "The name and the place were right, the size off by 5 %."


def test_only_what_was_hidden_has_a_size():
    """A gyroscope's bias about z says nothing of x and y, which are 0."""
    bias = load_patch([{"name": "gyro_bias", "where": ["sensor"], "parameters": {"z": 0.05}}]).effects[0]
    answer = judge(bias, [found("gyro_bias", ["sensor"], x=0.001, y=0.001, z=0.049)])
    assert list(answer.sizes) == ["z"]
    assert answer.sentence == "The name and the place were right, the size off by 2 %."
    (size,) = judge(bias, [found("gyro_bias", ["sensor"], x=0.001)]).sizes.values()
    assert size[:2] == (0.05, 0.0)  # another axis alone was found


def test_wrong_answers_are_said_to_be_wrong():
    elsewhere = judge(HIDDEN, [found("coulomb_friction", ["leg_rf"], torque=0.4)])
    assert (elsewhere.named, elsewhere.placed, elsewhere.right) == (True, False, False)
    assert "not the place" in elsewhere.sentence
    other = judge(HIDDEN, [found("backlash", ["leg_lf"], angle=0.03)])
    assert not other.named
    assert other.sentence == "The name was not found."
    assert (
        "alternative" in judge(HIDDEN, [found("backlash", ["leg_lf"], angle=0.03)], [["backlash", "coulomb_friction"]]).sentence
    )
    nothing = judge(HIDDEN, [])
    assert not nothing.named
    assert not nothing.right


def test_what_is_named_besides_is_not_right():
    answer = judge(HIDDEN, [found("payload", ["body"], mass=0.3), found("coulomb_friction", ["leg_lf"], torque=0.4)])
    assert answer.named
    assert answer.placed
    assert not answer.right
    assert answer.extra == ("payload",)
    assert "payload was named, too, but is not there" in answer.sentence


def analysis(interval=(0.9, 0.98), after=1.02, **worse):
    gap = GapFigures("rms", 8.0, 1.0, 8.0, 7.0, after, 1.02, 0.95, interval)
    effect = FoundEffect("gyro_bias", ("sensor",), {}, 1.0, 100.0)
    channels = [ChannelGap(name, "rad", 0.1, 2.0, 1.0, 1.4, worse=flag) for name, flag in worse.items()]
    return Analysis("", "effect_found", "", effects=(effect,), gap=gap, channel_gaps=tuple(channels))


def test_caveats_of_an_analysis_are_said_only_where_there_are_any():
    assert caveats_of(analysis(gyro_z=False)) == []
    assert caveats_of(analysis(after=0.97)) == []  # below the floor, by chance
    assert caveats_of(analysis(after=1.2)) == []  # hardly more than noise
    (left,) = caveats_of(analysis(after=1.6))
    assert left.startswith("not all is explained: an error of 1.60 is left in the held-out runs, above the noise floor of 1.02")
    assert caveats_of(analysis((-0.1, 0.9))) == ["the interval of what the effects remove contains 0"]
    assert "too few runs" in caveats_of(analysis((math.nan, math.nan)))[0]
    (worse,) = caveats_of(analysis(gyro_z=True, gyro_x=False))
    assert worse.startswith("one channel gets significantly worse in the held-out runs: ")
    assert not worse.endswith(".")


@pytest.mark.parametrize(("hidden", "said"), [(0.4, []), (0.5, ["the interval does not hold the hidden torque"])])
def test_an_interval_that_does_not_hold_the_truth_is_said(hidden, said):
    patch = load_patch([{"name": "coulomb_friction", "where": ["leg_lf"], "parameters": {"torque": hidden}}])
    assert judge(patch.effects[0], [found("coulomb_friction", ["leg_lf"], torque=0.42)]).outside == said
