"""Bad data are named with run, channel, time and remedy before anything is fitted; effects, losses and wear are no bad data."""

import re
from pathlib import Path

import numpy as np
import pandas
import pytest
from engine_runs import META, ROBOT, posture_and_turns, record, spaced

from wlr_gym.data import Profile, Run, RunMeta
from wlr_gym.data.runs import write_run
from wlr_gym.gap import analyse
from wlr_gym.gap.analysis import NO_PROFILE
from wlr_gym.gap.robot.intake import CHECKS, ChannelFault, against_profile, findings_of, wrapped
from wlr_gym.gap.robot.problem import open_robot


def lively(t):
    """Posture and turns between two rests."""
    return posture_and_turns(np.clip(t, 0.0, 5.0))


@pytest.fixture(scope="module")
def good():
    run = record(lively, spaced(7.0), noise=3)
    return run.table.drop(columns=[name for name in run.table if name.startswith("cam")])


def findings(tables, path):
    runs = [Run(table, META, path / f"run_{k + 1:02d}.csv") for k, table in enumerate(tables)]
    return findings_of(runs, CHECKS, ROBOT)


def degrees(table):
    return table.assign(**{name: np.rad2deg(table[name]) for name in table if name.startswith("gyro")})


def still(table):
    rest = table.iloc[np.tile(np.arange(10), 35)].reset_index(drop=True)
    return rest.assign(t=0.02 * np.arange(len(rest)))


def frozen(joint, since):
    def spoil(table):
        dead = {}
        for kind, value in (("pos", table[f"pos_{joint}"].iloc[since]), ("vel", 0.0)):
            dead[f"{kind}_{joint}"] = table[f"{kind}_{joint}"].where(table.index < since, value)
        return table.assign(**dead)

    return spoil


def turned(*channels):
    return lambda table: table.assign(**{channel: -table[channel] for channel in channels})


def all_of(joint):
    return [f"{kind}_{joint}" for kind in ("pos", "vel", "eff")]


def late(seconds, since):
    return lambda table: table.assign(t=table["t"] + seconds * (table.index >= since))


def clipped(channel):
    """Half of the range that the motion needs."""

    def spoil(table):
        most = 0.5 * table[channel].abs().max()
        return table.assign(**{channel: table[channel].clip(-most, most)})

    return spoil


def mixed(table):
    """Every second row is of a recording in which the left front leg stands elsewhere."""
    return table.assign(pos_leg_lf=table["pos_leg_lf"] + 0.6 * (table.index % 2))


def silent(channel):
    return lambda table: table.assign(**{channel: 0.0})


#: What is done to one of three runs -> channel, kind, s at which it is seen first (None = of the whole run or anywhere).
FAULTS = {
    "gyroscope in degrees per second": (degrees, "gyro_z", "units", None),
    "robot that stands still": (still, "pos", "still", None),
    "two recordings in one": (mixed, "pos", "jump", (0.01, 0.03)),
    "dead leg": (frozen("leg_rf", 0), "pos_leg_rf", "dead", None),
    "dead wheel": (frozen("wheel_lr", 0), "pos_wheel_lr", "dead", None),
    "wheel that dies": (frozen("wheel_rf", 120), "pos_wheel_rf", "dead", (2.4, 4.5)),
    "leg that dies": (frozen("leg_lr", 120), "pos_leg_lr", "dead", (2.4, 4.5)),
    "wheel of the wrong sign": (turned(*all_of("wheel_lf")), "pos_wheel_lf", "mirrored", None),
    "wheel angle of the wrong sign": (turned("pos_wheel_lf"), "pos_wheel_lf", "mirrored", None),
    "leg of the wrong sign": (turned(*all_of("leg_rf")), "pos_leg_rf", "mirrored", None),
    "wheel effort of the wrong sign": (turned("eff_wheel_rr"), "eff_wheel_rr", "mirrored", None),
    "clock that jumps": (late(5.0, 150), "t", "clock", (2.97, 2.99)),
    "clock that jumps a little": (late(0.1, 150), "t", "clock", (2.97, 2.99)),
    "clock at another rate": (lambda table: table.assign(t=2.0 * table["t"]), "t", "clock", None),
    "saturated gyroscope": (clipped("gyro_z"), "gyro_z", "saturated", (0.4, 5.0)),
    "saturated accelerometer": (clipped("acc_x"), "acc_x", "saturated", (0.4, 5.0)),
    "dead gyroscope": (silent("gyro_y"), "gyro_y", "dead", None),
    "dead effort": (silent("eff_leg_lf"), "eff_leg_lf", "dead", None),
    "gyroscope of the wrong sign": (turned("gyro_z"), "gyro_z", "mirrored", None),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_one_run_is_named(fault, good, tmp_path):
    spoil, channel, kind, time = FAULTS[fault]
    found = findings([good, spoil(good.copy()), good], tmp_path)
    assert {one.run for one in found} == {"run_02"}, [one.said for one in found]
    (named,) = [one for one in found if one.channel == channel]
    assert named.kind == kind
    assert named.fatal
    assert named.text
    assert named.expected
    assert named.remedy
    assert time is None or (named.time is not None and time[0] <= named.time <= time[1])


@pytest.fixture
def straight(good):
    """A run in which the legs stand."""
    run = good.copy()
    for name in run:
        if name.startswith(("pos_leg", "cmd_leg")):
            run[name] = 1.4
        if name.startswith("eff_leg"):
            run[name] = 0.1 + 0.01 * np.sin(np.arange(len(run)))
    return run


def test_a_leg_of_the_wrong_sign_is_not_called_dead_where_it_stands(good, straight, tmp_path):
    wrong = turned(*all_of("leg_rf"))
    found = findings([wrong(good.copy()), wrong(straight)], tmp_path)
    assert {(one.run, one.channel, one.kind) for one in found} == {
        ("run_01", "pos_leg_rf", "mirrored"),
        ("run_02", "pos_leg_rf", "mirrored"),
    }


def test_a_fault_of_all_runs_is_one_also_where_a_run_cannot_show_it(good, straight, tmp_path):
    dead = frozen("leg_rf", 0)
    found = findings([good, straight], tmp_path)
    assert not found
    found = findings([dead(good.copy()), straight], tmp_path)
    assert {(one.run, one.channel) for one in found} == {("run_01", "pos_leg_rf"), ("run_02", "pos_leg_rf")}
    assert "dead in run_01" in next(one.text for one in found if one.run == "run_02")


#: True effects that look a little like bad data.
EFFECTS = [
    {"name": "backlash", "where": ["leg_lf", "leg_rf"], "parameters": {"angle": 0.035}},
    {"name": "weak_motor", "where": ["leg_rf"], "parameters": {"scale": 0.3}},
    {"name": "weak_motor", "where": ["wheel_lf"], "parameters": {"scale": 0.1}},
    {"name": "viscous_friction", "where": ["leg_rr"], "parameters": {"coefficient": 1.6}},
    {"name": "coulomb_friction", "where": ["wheel_lf"], "parameters": {"torque": 0.1}},
    {"name": "gyro_bias", "where": ["sensor"], "parameters": {"x": 0.012, "y": -0.012, "z": 0.012}},
    {"name": "joint_zero_offset", "where": ["leg_lr"], "parameters": {"angle": 0.08}},
    {"name": "wheel_radius_error", "where": ["wheel_lr"], "parameters": {"scale": 1.05}},
    {"name": "command_delay", "where": ["wheel_lf", "wheel_rf", "wheel_lr", "wheel_rr"], "parameters": {"delay": 0.04}},
]


@pytest.mark.slow  # nine runs; the blind simulator's are read in a moment, but take longer to make
@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: f"{effect['name']} {effect['where'][0]}")
def test_an_effect_is_no_fault_of_the_data(effect, tmp_path):
    table = record(lively, spaced(7.0), [effect], noise=5).table
    assert not findings([table], tmp_path)


def test_an_analysis_says_at_once_which_runs_it_leaves_out(good, tmp_path):
    for k in range(3):
        write_run(tmp_path / f"run_{k + 1:02d}.parquet", turned("eff_wheel_rr")(good.copy()), META)
    told = []
    found = analyse(tmp_path, tell=lambda stage, share: told.append(stage))
    assert found.verdict == "bad_data"
    assert not found.seconds, "nothing was fitted"
    left_out = [stage for stage in told if stage.startswith("left out")]
    assert [stage.split()[2] for stage in left_out] == ["run_01", "run_02", "run_03"]
    assert "eff_wheel_rr at " in left_out[0]
    assert "turn the sign of the column" in left_out[0]


@pytest.mark.parametrize("meta", [META, None], ids=["stated", "open"])
def test_a_servo_profile_that_is_not_stated_is_noted(meta, good, tmp_path):
    for number in (1, 2, 3):
        write_run(tmp_path / f"run_{number:02d}.parquet", good, meta)
    problem, found = open_robot(tmp_path)
    told = [one for one in found if one.kind == NO_PROFILE]
    assert problem is not None
    assert [one.fatal for one in told] == ([] if meta else [False])
    assert all("does not state the servo profile (profile): none is assumed" in one.text for one in told)


def stops_and_starts(t):
    setpoints = np.full(8, 1.4)
    setpoints[:4] += 0.0 if t < 0.4 else 0.3 * np.sign(np.sin(2.0 * (t - 0.4)))
    setpoints[4:] = 0.0 if t < 0.4 else 4.0 * np.sign(np.sin(5.0 * (t - 0.4)))
    return setpoints


@pytest.fixture(scope="module")
def quick():
    return record(stops_and_starts, spaced(7.0), noise=3).table


@pytest.mark.parametrize(
    ("profile", "message"),
    [
        (
            {"wheel_acceleration": 5.5, "leg_velocity": 1.5, "leg_acceleration": 15.0},
            r"followed by up to .* wheel_acceleration = 5.5",
        ),
        ({"leg_velocity": 0.75}, r"its setpoints are followed by up to 1.\d+ rad/s; meta.yaml states leg_velocity = 0.75"),
        ({"wheel_acceleration": 11.0, "leg_velocity": 1.5, "leg_acceleration": 15.0}, None),
        ({"wheel_acceleration": 30.0, "leg_velocity": 3.0}, None),
        ({}, None),
    ],
)
def test_a_profile_that_the_motion_contradicts_is_a_fault_of_all_runs(quick, good, tmp_path, profile, message):
    meta = RunMeta(profile=Profile(**profile))
    runs = [Run(table, meta, tmp_path / f"run_{k + 1:02d}.csv") for k, table in enumerate((good, quick))]
    found = findings_of(runs, CHECKS, ROBOT)
    assert [one.kind for one in found] == (["profile"] * 2 if message else [])
    assert message is None or re.search(message, found[1].text)


def test_free_wheels_may_change_speed_faster_than_the_profile(quick, tmp_path):
    rear = ("wheel_lr", "wheel_rr")
    free = quick.assign(**dict.fromkeys((f"cmd_{wheel}" for wheel in rear), np.nan))
    turning = 4.0 * np.sin(5.0 * quick["t"])
    free = free.assign(**{f"vel_{wheel}": turning for wheel in rear})
    meta = RunMeta(profile=Profile(wheel_acceleration=11.0))
    driven = free.assign(**{f"cmd_{wheel}": 4.0 * np.sign(turning) for wheel in rear})
    outcomes = [against_profile(Run(table, meta, tmp_path / "run_01.csv"), "cmd", ROBOT) for table in (free, driven)]
    assert [isinstance(outcome, ChannelFault) for outcome in outcomes] == [False, True]


def test_lost_rows_frames_and_a_noisier_or_scaled_sensor_are_no_fault(good, tmp_path):
    rng = np.random.default_rng(2)
    lost = good[rng.random(len(good)) > 0.1].reset_index(drop=True)
    hole = good[(good["t"] < 2.0) | (good["t"] > 2.4)].reset_index(drop=True)
    scaled = good.assign(gyro_z=1.1 * good["gyro_z"])
    noisy = good.assign(**{n: good[n] + 0.005 * rng.standard_normal(len(good)) for n in good if n.startswith("gyro")})
    coarse = good.assign(**{n: np.round(good[n], 2) for n in good if n.startswith(("gyro", "acc"))})
    assert not findings([lost, hole, scaled, noisy, coarse], tmp_path)


def test_a_simulation_without_noise_is_no_fault(tmp_path):
    assert not findings([record(lively, spaced(7.0)).table], tmp_path)


def test_a_wheel_that_others_drag_keeps_its_sign(good, tmp_path):
    """Its effort brakes in whole runs, as its controller asks for."""
    dragged = record(lively, spaced(7.0), [EFFECTS[7]], noise=5).table
    assert not findings([dragged], tmp_path)


@pytest.mark.parametrize("every", [0.02, 0.1, 0.2])
def test_angles_that_start_anew_show_in_slow_rows_too(every):
    t = np.arange(0.0, 20.0, every)
    for angle, is_wrapped in ((3.0 * t % (2 * np.pi), True), (3.0 * t, False)):
        run = Run(pandas.DataFrame({"t": t, "pos_wheel_lf": angle}), META, Path("run_01.csv"))
        assert isinstance(wrapped(run, "pos_wheel_lf", ROBOT), ChannelFault) == is_wrapped
