"""The report: one whole page, every number as analysed, nothing from outside; pictures inside their frames; the folder."""

import json
import re
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import gap_examples as examples
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from wlr_gym.base.errors import InputError
from wlr_gym.base.text import number
from wlr_gym.data.format import CHANNELS, COLUMNS
from wlr_gym.gap.analysis import (
    NO_PROFILE,
    Analysis,
    ChannelGap,
    Equivalent,
    Evidence,
    FoundEffect,
    HeatMap,
    IntakeFinding,
    ParameterEstimate,
    Place,
    Threshold,
)
from wlr_gym.gap.report import page as folder
from wlr_gym.gap.report.page import check_folder, report, save_analysis
from wlr_gym.gap.report.plots import draw, figures
from wlr_gym.gap.report.result import result_of
from wlr_gym.gap.report.text import (
    _GROUPS,
    below_floor,
    channel,
    closure,
    error,
    estimate,
    feature,
    percent,
    places,
    plain,
    sentence,
    title,
)
from wlr_gym.gap.workflow import named_robot

EVERY = pytest.mark.parametrize("analysis", examples.ALL.values(), ids=list(examples.ALL))
PICTURE = {"gap": b"\x89PNG"}


class Page(HTMLParser):
    """Checks that tags close in order, and collects text, attributes and rows of tables."""

    EMPTY = ("meta", "img", "br")

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.attributes, self.texts, self.rows, self.headings = [], [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.attributes += [(tag, *attribute) for attribute in attrs]
        if tag not in self.EMPTY:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" in self.open:
            return
        self.texts.append(data)
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.texts).split())


def page_of(analysis, tmp_path, pictures=None):
    return Page(report(analysis, pictures or {}, tmp_path))


@EVERY
def test_page_is_whole_and_its_own(analysis, tmp_path):
    text = report(analysis, PICTURE, tmp_path)
    page = Page(text)
    assert text.startswith("<!DOCTYPE html>")
    assert not {"script", "link", "iframe"} & {tag for tag, _, _ in page.attributes}
    outside = [value for _, name, value in page.attributes if name in ("src", "href") and not value.startswith("data:")]
    assert not outside
    assert "http" not in text
    assert "url(" not in text
    assert "@import" not in text
    assert "nan" not in page.text.split()


@EVERY
def test_verdict_comes_first_in_one_sentence(analysis, tmp_path):
    page = page_of(analysis, tmp_path)
    line = sentence(analysis)
    assert line.endswith(".")
    assert "\n" not in line
    body = page.text.partition(analysis.data)[2]  # after the title
    assert body.index(line) < body.index("Data:")


def test_an_open_servo_profile_is_said_under_the_verdict(tmp_path):
    assumed = IntakeFinding("", "", NO_PROFILE, "meta.yaml does not state the servo profile")
    page = page_of(replace(examples.EFFECT_FOUND, intake=(assumed,)), tmp_path)
    assert page.text.index(f"{assumed.text}.") < page.text.index("Where")


def test_order_of_the_sections(tmp_path):
    page = page_of(examples.EFFECT_FOUND, tmp_path)
    assert page.headings == [
        "Where", "What", "How much", "How sure", "What to run next", "Calibration", "The data", "How to use the result"
    ]  # fmt: skip
    assert page_of(examples.BAD_DATA, tmp_path).headings == ["The data"]
    assert page_of(examples.NOT_EXCITED, tmp_path).headings == ["How sure", "What to run next", "Calibration", "The data"]


def test_numbers_are_those_of_the_analysis(tmp_path):
    analysis = examples.EFFECT_FOUND
    page = page_of(analysis, tmp_path)
    rows = {tuple(row) for row in page.rows}
    assert ("coefficient", "0.0412 (0.0383 to 0.0447)") in rows
    assert ("eff_wheel_lf", "motor torque, left front wheel", "44 %", "opposes the motion, the same at every speed") in rows
    assert ("ground.mu", "-", "0.6", "0.652", "0.016", "0.09", "+0.6") in rows
    assert ("command.delay", "s", "0.012", "0.0153", "0.00039", "0.003", "+1.1") in rows
    assert ("run_03", "held out", "7.60", "5.20", "1.14", "94 %") in rows
    assert ("run_01", "fitted", "7.00", "5.00", "1.10", "93 %") in rows
    for one in analysis.channel_gaps:
        cells = next(row for row in page.rows if row[:2] == [one.channel, channel(one.channel)] and len(row) == 6)
        assert cells[3:] == [error(one.before), error(one.calibrated), error(one.after)]
    assert ("viscous friction", "coefficient", "0.0081 N m s/rad") in rows
    assert "Selection frequency 97 %." in page.text
    assert (
        "Compared with 19 sets of runs that the final model made itself, more than chance explains is left in the fitted runs: "
        "an error of 1.19 times the sensor noise (1.17 times what is expected) and scatter of the runs' estimates of the "
        "model's numbers (1.40 times what is expected). Most of the error that is not expected is in acc_z and eff_leg_lf. "
        "run_05 pulls ground.mu farthest from the others." in page.text
    )
    assert "they always reject" in page.text
    whole = "integrated autocorrelation time in rows, geometric mean of the channels"
    assert ("whiteness", whole, "7.60", "7.00", "7.60", "1.09", "0.10") in rows
    assert ("level: acc_z", "acceleration along z", "1.31", "1.00", "1.04", "1.31", "0.05") in rows
    assert ("whiteness: acc_z", "acceleration along z", "6.90", "6.80", "7.90", "1.01", "0.25") in rows
    moved = [row[0] for row in page.rows if len(row) == 7 and row[1] in ("s", "-", "kg", "V/rad")]
    assert moved == ["command.delay", "ground.mu", "servo.kp[leg_lf]", "body.mass", "servo.kp[leg_rf]"]
    for value in ("7.91", "5.24", "1.21", "7.42", "1.13", "95 %"):
        assert value in page.text
    assert "95 % interval 91 to 97 %" in page.text


def test_every_candidate_is_shown_with_why_it_lost(tmp_path):
    page = page_of(examples.EFFECT_FOUND, tmp_path)
    for one in examples.EFFECT_FOUND.evidence:
        if one.outcome == "rejected at screening":
            assert one.reason in [row[3] for row in page.rows if len(row) == 4 and row[0] == plain(one.name)]
        else:
            mine = [row for row in page.rows if len(row) == 8 and row[0] == plain(one.name) and row[6] == one.outcome]
            assert all(row[7] == one.reason for row in mine)
            assert [number(one.gain), number(one.screened)] in [row[3:5] for row in mine if row[1] == places(one.where)]
    backlash = next(row for row in page.rows if row[0] == "backlash")
    assert backlash[1] == "left front leg"
    assert [row[6] for row in page.rows if "5312" in row] == ["selected"]
    selected = [value for tag, name, value in page.attributes if (tag, name) == ("tr", "class") and value == "selected"]
    assert len(selected) == 1


def test_candidates_and_none_of_them_have_their_probability(tmp_path):
    first, *others = examples.EFFECT_FOUND.evidence
    likely = (replace(first, probability=0.87), *others)
    page = page_of(replace(examples.EFFECT_FOUND, evidence=likely, thresholds=(Threshold(1, 16.0, 9.0, 0.04),)), tmp_path)
    assert [row[5] for row in page.rows if len(row) == 8 and row[4] == number(first.screened)] == ["87 %"]
    assert "Probability that none of them is missing: 4 %." in page.text


def test_an_error_as_large_as_counts_is_shown_as_at_least_that(tmp_path):
    first = examples.EFFECT_FOUND.channel_gaps[0]
    channels = (replace(first, before=50.0, calibrated=49.9, after=3.0, worse=True),)
    far = replace(examples.EFFECT_FOUND, gap=replace(examples.GAP, cap=50.0, heldout_before=50.0), channel_gaps=channels)
    page = page_of(far, tmp_path)
    assert ["50 or more", "49.9", "3.00"] in [row[3:] for row in page.rows if row and row[0] == first.channel]
    assert "50 or more error of the model as given" in page.text
    assert vars(result_of(far).gap)["cap"] == 50.0
    assert "50 or more" not in page_of(examples.EFFECT_FOUND, tmp_path).text


def test_an_error_below_the_noise_floor_is_explained(tmp_path):
    below = replace(examples.EFFECT_FOUND, gap=replace(examples.GAP, heldout_after=0.97, noise_floor=1.04))
    said = "0.97 is below the expected level of noise (1.04), by chance"
    assert f"{said}: 100 % is the most that is counted." in page_of(below, tmp_path).text
    assert below_floor(replace(examples.NOTHING_MISSING, gap=below.gap)) == f"{said}."
    assert below_floor(examples.NOTHING_MISSING) == ""
    assert below_floor(replace(below, gap=replace(examples.GAP, heldout_after=1.038, noise_floor=1.041))) == ""


def test_without_effects_nothing_is_said_of_effects(tmp_path):
    page = page_of(examples.NOTHING_MISSING, tmp_path)
    assert "with the effects added" not in page.text
    assert "with effects" not in page.text
    assert ["run_03", "held out", "7.60", "5.20"] in page.rows
    assert "the patch is empty" in page.text
    assert ["backlash", "angle", "0.0087 rad"] in page.rows
    assert "What these runs would have shown" in page.text


def test_fatal_findings_come_first(tmp_path):
    page = page_of(examples.BAD_DATA, tmp_path)
    assert [row[0] for row in page.rows] == ["", "fatal", "fatal", "noted"]
    assert "pos_leg_lf reaches 87: degrees, not rad? Convert and try again" in page.text


def test_commands_can_be_typed(tmp_path):
    folder = tmp_path / "my results"
    lines = report(examples.EFFECT_FOUND, {}, folder)
    text = "\n".join(unescape(block) for block in re.findall("<pre>(.*?)</pre>", lines, re.DOTALL))
    assert f"wlr effects check '{folder}/patch.yaml'" in text
    assert f"wlr train WLR-Velocity-v0 --effects '{folder}/patch.yaml'" in text
    assert f"--set environment.randomization='{folder}/result.json'" in text
    assert "wlr record --excitation straight --out new_runs" in text
    known = replace(examples.EFFECT_FOUND, known_effects=({"name": "payload"},))
    assert "--effects FILES-GIVEN-AS-KNOWN " in report(known, {}, folder)
    assert "known from the start: payload" in report(known, {}, folder)
    assert "/result.json' --effects FILES-GIVEN-AS-KNOWN\n" in unescape(report(known, {}, folder)).replace("</pre>", "\n")


@pytest.mark.parametrize(
    ("meta", "option", "named", "shown"),
    [
        ("", None, None, ""),
        ("robot: wlr-nominal", None, "nominal", ""),
        ("robot: wlr-flow", None, "flow", " --robot flow"),
        ("robot: robot.yaml", None, "{}/robot.yaml", " --robot '{}/robot.yaml'"),
        ("robot: wlr-flow", "mine.yaml", "mine.yaml", " --robot mine.yaml"),
    ],
)
def test_commands_name_the_robot_that_was_analysed(tmp_path, meta, option, named, shown):
    folder = tmp_path / "my runs"
    folder.mkdir()
    (folder / "meta.yaml").write_text(meta)
    found = named_robot(folder, None, option)
    assert found == (named and named.format(folder))
    provenance = {} if found is None else {"robot": found}
    page = unescape(report(replace(examples.EFFECT_FOUND, provenance=provenance), {}, Path("out")))
    for line in ("wlr train WLR-Velocity-v0 --effects out/patch.yaml", "wlr record --excitation straight --out new_runs"):
        assert f"{line}{shown.format(folder)}\n" in f"{page}\n".replace("</pre>", "\n")


def test_a_patch_that_cannot_be_loaded_is_not_advertised(tmp_path):
    rig = FoundEffect("torque_saturation", ("servo",), {}, 0.9, 400.0, doc="torque falls behind the current")
    page = page_of(replace(examples.EFFECT_FOUND, effects=(rig,)), tmp_path)
    assert "The robot's simulators cannot load it: " in page.text
    assert "wlr train" not in page.text
    assert "What is missing: torque falls behind the current." in page.text
    assert "No formula" not in page.text


def test_a_law_of_a_rig_is_not_taken_for_the_librarys_of_the_same_name(tmp_path):
    own = FoundEffect("viscous_friction", ("axis",), {}, 0.9, 400.0, doc="friction that grows with speed: -viscous speed")
    text = page_of(replace(examples.EFFECT_FOUND, effects=(own,)), tmp_path).text
    assert "What is missing: friction that grows with speed: -viscous speed." in text
    assert "back-EMF" not in text
    assert "Law:" not in text


def test_an_unknown_effect_has_a_formula_or_says_that_it_has_none(tmp_path):
    assert "Law: -k * (leg_angle - a0)" in page_of(examples.UNKNOWN_EFFECT, tmp_path).text
    assert "Tried where leg angle lr is 0.9 to 2.1 rad" in page_of(examples.UNKNOWN_EFFECT, tmp_path).text
    bare = replace(examples.UNKNOWN_EFFECT, effects=(FoundEffect("unknown_effect", ("leg_lr",), {}, 0.8, 900.0),))
    text = page_of(bare, tmp_path).text
    assert "No formula was found that holds." in text
    assert "no formula describes it either" in text
    assert "the patch is empty" in text


def test_texts_are_escaped(tmp_path):
    evil = '<script>alert("1")</script> & Prüfstand 机器人'
    analysis = replace(
        examples.EFFECT_FOUND,
        data=evil,
        summary=evil,
        intake=(IntakeFinding(evil, evil, evil, evil),),
        evidence=(Evidence(1, evil, (evil,), {evil: 1.0}, 1.0, 1.0, "selected", evil),),
        localisation=(Place(evil, 0.5, evil),),
        effects=(FoundEffect(evil, (evil,), {evil: ParameterEstimate(1.0, 0.0, 2.0, evil)}, 0.5, 1.0, evil),),
        gap=replace(examples.GAP, metric=evil),
        provenance={evil: evil},
        seconds={evil: 3.0},
        adequacy=replace(
            examples.ADEQUACY,
            level=replace(examples.ADEQUACY.level, channels={evil: examples.ADEQUACY.level.channels["acc_z"]}),
            whiteness=replace(examples.ADEQUACY.whiteness, channels={evil: examples.ADEQUACY.whiteness.channels["acc_z"]}),
            constancy=replace(
                examples.ADEQUACY.constancy,
                pulled_most=replace(examples.ADEQUACY.constancy.pulled_most, number=evil, run=evil),
            ),
        ),
    )  # fmt: skip
    text = report(analysis, {}, tmp_path)
    page = Page(text)
    assert "<script" not in text
    assert evil in page.text
    assert [row for row in page.rows if row[0] == evil and row[2:3] == ["50 %"]]


# ---- words -----------------------------------------------------------------------------------------------------------


def test_sentences_say_what_was_found():
    found = sentence(examples.EFFECT_FOUND)
    assert found == (
        "The model lacks rolling resistance (both front wheels); added, it removes 95 % (95 % interval 91 to 97 %) of the "
        "avoidable error of the held-out runs; these data do not distinguish it from coulomb friction."
    )
    assert "to within 1.04 times the sensor noise once its parameters are calibrated" in sentence(examples.NOTHING_MISSING)
    assert "something (left rear leg) that no effect of the library explains; a formula describes it" in sentence(
        examples.UNKNOWN_EFFECT
    )
    assert "degrees, not rad?" in sentence(examples.BAD_DATA)
    assert sentence(examples.NOT_EXCITED).endswith("record turns and posture.")
    assert sentence(replace(examples.BAD_DATA, summary="So.")) == "So."
    two_runs = replace(
        examples.EFFECT_FOUND,
        gap=replace(examples.GAP, reduction_ci95=(float("nan"), float("nan"))),
        run_gaps=tuple(one for one in examples.EFFECT_FOUND.run_gaps if one.run != "run_09"),
    )
    assert "it removes 95 % (run by run 94 % and 96 %; no interval) of the avoidable" in sentence(two_runs)
    little = replace(examples.EFFECT_FOUND, gap=replace(examples.GAP, reduction=0.03, reduction_ci95=(0.01, 0.05)))
    assert "interval 1 to 5 %) of the avoidable error of the held-out runs, which is too little to help: check" in sentence(
        little
    )
    unsure = replace(examples.EFFECT_FOUND, gap=replace(examples.GAP, reduction=0.2, reduction_ci95=(0.05, 0.35)))
    assert "held-out runs, which may be too little to help: check the servo profile in meta.yaml" in sentence(unsure)
    worse = replace(examples.EFFECT_FOUND, gap=replace(examples.GAP, reduction=-0.27, reduction_ci95=(-0.33, -0.21)))
    assert "added, it makes the error of the held-out runs larger: -27 % (95 % interval -33 to -21 %);" in sentence(worse)
    alike = replace(examples.EFFECT_FOUND, gap=replace(examples.GAP, reduction=-0.02, reduction_ci95=(-0.07, 0.02)))
    assert "it does not measurably change the error of the held-out runs: -2 % (95 % interval -7 to 2 %);" in sentence(alike)
    no_room = replace(examples.EFFECT_FOUND, gap=replace(examples.GAP, reduction=float("nan")))
    assert "; the error of the held-out runs is as small without it;" in sentence(no_room)
    unknown = replace(no_room, gap=replace(examples.GAP, reduction=float("nan"), noise_floor=float("nan")))
    assert "; added, it changes the error of the held-out runs from 5.24 to 1.21;" in sentence(unknown)
    two = (*examples.EFFECT_FOUND.effects, FoundEffect("payload", ("body",), {}, 0.9, 300.0))
    assert sentence(replace(examples.EFFECT_FOUND, effects=two, equivalent=())).startswith(
        "The model lacks 2 effects: rolling resistance (both front wheels) and payload (body); added, they remove 95 %"
    )
    doubts = (*examples.EFFECT_FOUND.equivalent, Equivalent(("payload", "com_offset", "floor_slope"), ""))
    assert sentence(replace(examples.EFFECT_FOUND, effects=two, equivalent=doubts)).endswith(
        "; these data do not distinguish rolling resistance from coulomb friction, nor payload from com offset or floor slope."
    )


def test_what_is_left_without_a_name_is_not_called_nothing():
    none = examples.NOTHING_MISSING
    assert none.gap is not None
    rest = replace(none, gap=replace(none.gap, heldout_calibrated=3.2, heldout_after=3.2, noise_floor=1.1))
    assert (title(none), title(rest)) == ("Nothing missing", "Nothing clear enough to be named")
    assert "to within 3.20 times the sensor noise" in sentence(rest)
    assert closure(rest).startswith(
        "Not all is explained: an error of 3.20 is left in the held-out runs, above the noise floor of 1.10; "
    )
    assert "lacks nothing" not in sentence(rest)


@pytest.mark.parametrize("verdict", ["effect_found", "unknown_effect", "nothing_missing", "not_excited"])
def test_what_is_left_is_said_with_every_verdict_and_where(verdict, tmp_path):
    few = {"eff_wheel_lf": 2.0, "eff_wheel_rf": 2.5, "eff_leg_lf": 1.8, "gyro_x": 0.9}
    channels = tuple(ChannelGap(name, "", 1.0, 5.0, 5.0, left, COLUMNS[name].group) for name, left in few.items())
    little = replace(examples.ALL[verdict], gap=replace(examples.GAP, heldout_after=1.49), channel_gaps=channels)
    much = replace(little, gap=replace(examples.GAP, heldout_after=1.6))
    assert closure(little) == result_of(little).closure == ""
    # above the floor: 3 + 5.25 of the wheels, 2.24 of the leg
    told = (
        "Not all is explained: an error of 1.60 is left in the held-out runs, above the noise floor of 1.00; "
        "79 % of it is in the motor torques of the wheels."
    )
    assert closure(much) == result_of(much).closure == told
    assert told in page_of(much, tmp_path).text
    assert "Not all is explained" not in page_of(little, tmp_path).text


def test_groups_of_channels_have_words():
    assert {COLUMNS[name].group for name in CHANNELS} <= set(_GROUPS)


def test_a_column_of_a_system_of_ones_own_keeps_its_name():
    gap = ChannelGap("position: 0.5 s", "m", 1.0, 5.0, 5.0, 3.0, "position")
    far = replace(examples.NOTHING_MISSING, gap=replace(examples.GAP, heldout_after=3.0), channel_gaps=(gap,))
    assert closure(far).endswith("100 % of it is in position.")


@pytest.mark.parametrize(
    ("where", "words"),
    [
        (("wheel_lf", "wheel_rf", "wheel_lr", "wheel_rr"), "all four wheels"),
        (("leg_rr", "leg_lr"), "both rear legs"),
        (("leg_lf",), "left front leg"),
        (("wheel_lf", "wheel_rr"), "left front wheel and right rear wheel"),
        (("leg_lf", "wheel_lf"), "left front leg and left front wheel"),
        (("ground",), "floor"),
        (("body_force_x",), "body force x"),
        ((), ""),
    ],
)
def test_places_in_words(where, words):
    assert places(where) == words


def test_states_come_with_their_unit():
    assert feature("joint_velocity[wheel_lf]") == "joint_velocity[wheel_lf] (rad/s)"
    assert feature("motor_torque[leg_lf]") == "motor_torque[leg_lf] (N m)"
    assert feature("slip_speed[wheel_lf]") == "slip_speed[wheel_lf] (m/s)"
    assert feature("rate [rad/s]") == "rate [rad/s]"


def test_numbers_in_words():
    assert [error(value) for value in (1.0, 12.34, 456.0, float("nan"))] == ["1.00", "12.3", "456", "-"]
    assert [percent(share) for share in (0.951, -0.004, -0.27)] == ["95 %", "0 %", "-27 %"]
    angle = examples.UNKNOWN_EFFECT.effects[0].parameters["a0"]
    assert estimate(angle) == "1.21 (1.17 to 1.25) rad = 69.3°"
    assert estimate(replace(angle, low=float("nan"))) == "1.21 rad = 69.3°"
    assert estimate(ParameterEstimate(1.021709, 1.0173, 1.0261, "-")) == "1.022 (1.017 to 1.026)"
    assert estimate(ParameterEstimate(0.0, -0.1, 0.1, "m")) == "0.00 (-0.10 to 0.10) m"
    assert estimate(ParameterEstimate(-3.73e-5, -0.00181, 0.00174, "rad/s")) == "0.0000 (-0.0018 to 0.0017) rad/s"
    assert estimate(ParameterEstimate(0.01, -0.02, 0.022, "rad")) == "0.010 (-0.020 to 0.022) rad = 0.573°"


# ---- pictures --------------------------------------------------------------------------------------------------------


def small(analysis):
    """Fewer channels and one heat map: drawing takes its time."""
    (heat_map, *_) = analysis.heat_maps or (examples.heat_map(),)
    few = HeatMap(heat_map.channels[:6], heat_map.bins, heat_map.values[:6], heat_map.feature)
    return replace(analysis, heat_maps=(few,), channel_gaps=analysis.channel_gaps[:6], traces=analysis.traces[1:3])


def test_nothing_runs_out_of_a_picture():
    long = "an effect of quite an unreasonable length, at all four wheels and both rear legs, that goes on and on"
    analysis = small(examples.EFFECT_FOUND)
    evidence = (*analysis.evidence[:6], Evidence(1, long, (long,), {}, 7000.0, 1.0, "equivalent", long))
    analysis = replace(analysis, evidence=evidence, localisation=(Place(long[:40], 1.0, long), *analysis.localisation))
    for name, figure in figures(analysis).items():
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        frame = figure.bbox
        for axes in figure.axes:
            box = axes.get_tightbbox()
            assert box is not None
            assert box.x0 >= -2, name
            assert box.y0 >= -2, name
            assert box.x1 <= frame.x1 + 2, name
            assert box.y1 <= frame.y1 + 2, name


def test_interval_of_an_effect_that_harms_stays_in_the_picture():
    worse = replace(examples.GAP, heldout_after=6.4, reduction=-0.27, reduction_ci95=(-1.4, 0.86))
    axes = figures(Analysis("", "effect_found", "", effects=examples.EFFECT_FOUND.effects, gap=worse))["gap"].axes[0]
    (whisker,) = [line for line in axes.lines if line.get_marker() == "|"]
    assert max(np.asarray(whisker.get_xdata())) == pytest.approx(5.24 + 1.4 * 4.24)
    assert axes.get_xlim()[1] > 5.24 + 1.4 * 4.24


def widths(figure):
    return [bar.get_width() for bar in figure.axes[0].patches]


def test_pictures_show_the_numbers():
    found = figures(small(examples.EFFECT_FOUND))
    assert widths(found["gap"]) == [7.91, 5.24, 1.21]
    (whisker,) = [line for line in found["gap"].axes[0].lines if line.get_marker() == "|"]
    assert np.asarray(whisker.get_xdata()) == pytest.approx([5.24 - 0.973 * 4.24, 5.24 - 0.912 * 4.24])
    first = found["evidence"].axes[0]
    assert max(widths(found["evidence"])) == 5312.4
    shown = {text.get_text().split("  ")[1] for text in first.texts}
    assert shown == {"selected", "worse fit", "implausible", "rejected at screening"}
    assert np.max(np.asarray(found["where_1"].axes[0].images[0].get_array())) == pytest.approx(
        examples.heat_map().values[:6].max()
    )
    assert found["where_1"].axes[0].get_xlabel() == "joint_velocity[wheel_lf] (rad/s)"
    left, below = found["overlays_1"].axes[:2]
    assert [line.get_label() for line in left.lines] == ["measured", "model as given", "calibrated", "effects added"]
    trace = small(examples.EFFECT_FOUND).traces[0]
    assert np.array_equal(below.lines[1].get_ydata(), trace.after_error)
    assert left.get_ylabel() == "rad/s"
    bare = figures(replace(small(examples.NOTHING_MISSING), evidence=()))
    assert widths(bare["gap"]) == [2.31, 1.04]
    assert "effects added" not in [line.get_label() for line in bare["overlays_1"].axes[0].lines]


def test_evidence_shows_what_an_effect_must_gain():
    analysis = replace(small(examples.EFFECT_FOUND), thresholds=(Threshold(1, 16.0, 9.0, 0.04),))
    axes = figures(analysis)["evidence"].axes[0]
    (least,) = axes.lines
    assert np.asarray(least.get_xdata()).tolist() == [16.0, 16.0]
    assert axes.get_xscale() == "symlog"  # beside a gain of 5312


def test_a_row_that_no_sensor_has_read_is_not_drawn():
    analysis = small(examples.EFFECT_FOUND)
    trace = analysis.traces[0]
    unread = np.r_[np.nan, trace.after_error[1:]]
    shown = figures(replace(analysis, traces=(replace(trace, calibrated_error=unread, after_error=unread),)))
    above, below = shown["overlays_1"].axes[:2]
    for line in (*above.lines, below.lines[1]):
        assert np.asarray(line.get_xdata())[0] == pytest.approx(trace.t[1] - trace.t[0])


def test_equal_errors_do_not_hide_each_other():
    right = figures(small(examples.EFFECT_FOUND))["gap"].axes[1]
    heights = [np.asarray(markers.get_offsets())[0, 1] for markers in right.collections[1:]]
    assert len(set(heights)) == 3
    (sensors,) = right.lines
    (floor,) = [line for line in figures(small(examples.EFFECT_FOUND))["gap"].axes[0].lines if line.get_linestyle() == "--"]
    assert sensors.get_color() != floor.get_color()


def apart(*colours: list[float]) -> float:
    """Contrast of two colours (WCAG 2)."""
    linear = [[((c + 0.055) / 1.055) ** 2.4 if c > 0.04 else c / 12.92 for c in colour] for colour in colours]
    dark, bright = sorted(0.2126 * red + 0.7152 * green + 0.0722 * blue for red, green, blue in linear)
    return (bright + 0.05) / (dark + 0.05)


def test_numbers_in_cells_stand_out():
    axes = figures(small(examples.EFFECT_FOUND))["where_1"].axes[0]
    (image,) = axes.images
    for text in axes.texts:
        column, row = (round(one) for one in text.get_position())
        colour = np.asarray(image.cmap(image.norm(examples.heat_map().values[row, column])))[:3].tolist()
        ink = {"white": [1.0, 1.0, 1.0], "black": [0.0, 0.0, 0.0]}
        contrasts = {name: apart(colour, other) for name, other in ink.items()}
        assert contrasts[str(text.get_color())] == max(contrasts.values()) >= 4.5


def test_what_has_no_numbers_is_not_drawn():
    assert draw(examples.BAD_DATA) == {}
    empty = HeatMap((), (), np.zeros((0, 0)))
    blank = HeatMap(("volt",), ("all",), np.full((1, 1), np.nan))
    drawn = draw(replace(examples.BAD_DATA, heat_maps=(empty, blank)))
    assert list(drawn) == ["where_2"]
    assert drawn["where_2"].startswith(b"\x89PNG")


# ---- the folder ------------------------------------------------------------------------------------------------------


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(folder, "draw", lambda analysis: dict(PICTURE))


def test_files_are_written(tmp_path, quick):
    out = tmp_path / "deep" / "out"
    assert save_analysis(examples.EFFECT_FOUND, out) == out / "result.json"
    files = sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file())
    assert files == ["patch.yaml", "plots/gap.png", "report.html", "result.json"]
    assert json.loads((out / "result.json").read_text())["patch"] == str((out / "patch.yaml").resolve())
    assert "data:image/png;base64,iVBORw==" in (out / "report.html").read_text()


def test_an_earlier_analysis_is_replaced(tmp_path, quick):
    save_analysis(examples.EFFECT_FOUND, tmp_path)
    (tmp_path / "plots" / "overlays_9.png").write_bytes(b"stale")
    (tmp_path / "config.yaml").write_text("")
    save_analysis(examples.BAD_DATA, tmp_path)
    assert json.loads((tmp_path / "result.json").read_text())["verdict"] == "bad_data"
    assert not (tmp_path / "plots" / "overlays_9.png").exists()
    assert not (tmp_path / "config.yaml").exists()


@pytest.mark.parametrize("name", ["run_01.parquet", "notes.txt", "result.json", "patch.yaml"])
def test_a_foreign_folder_is_refused(tmp_path, name, quick):
    """Files of the names that an analysis writes may be anybody's."""
    (tmp_path / name).write_text("{}  # by hand")
    with pytest.raises(InputError, match=rf"--out .*: '{name}' in it is not of an analysis"):
        save_analysis(examples.EFFECT_FOUND, tmp_path)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "{}  # by hand")]


def test_folders_that_cannot_be_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "file" / "deeper"):
        with pytest.raises(InputError, match="file is a file; expected a folder"):
            check_folder(place)
    with pytest.raises(InputError, match="--out /proc/x: cannot be written to"):
        check_folder(Path("/proc/x"))
    check_folder(tmp_path / "new" / "deep")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_failure_leaves_the_earlier_results_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(folder, "draw", lambda analysis: dict(PICTURE))
    save_analysis(examples.EFFECT_FOUND, tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    monkeypatch.setattr(folder, "draw", lambda analysis: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        save_analysis(examples.NOTHING_MISSING, tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
