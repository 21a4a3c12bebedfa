"""A hundred malformed logs, maps, runs and robots: one line, exit code 2, and nothing half-written."""

import re

import numpy as np
import pytest
from foreign_logs import made_up, rows_of

from wlr_gym.cli import BAD_INPUT, main
from wlr_gym.data.logs import export_run
from wlr_gym.data.logs.map import map_text
from wlr_gym.data.runs import read_run, write_run
from wlr_gym.robot import JOINTS, load_robot
from wlr_gym.robot.interchange.urdf import urdf_text

MAP = {
    "joints": dict(zip(JOINTS, JOINTS, strict=True)),
    "channels": {kind: {"topic": "table", "field": f"{kind}_{{joint}}"} for kind in ("cmd", "pos", "vel", "eff")}
    | {kind: {"topic": "table", "field": f"{kind}_{{axis}}"} for kind in ("gyro", "acc")}
    | {"volt": {"topic": "table", "field": "volt"}},
}


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """The text of a CSV log, the bytes of an MCAP log, a Parquet log and a map."""
    folder = tmp_path_factory.mktemp("good")
    path = write_run(folder / "run_01.csv", rows_of(made_up(4.0)))
    write_run(folder / "run_01.parquet", rows_of(made_up(4.0)))
    mcap = export_run(read_run(path), folder / "a.mcap")
    return {"csv": path.read_text(), "mcap": mcap.read_bytes(), "parquet": (folder / "run_01.parquet").read_bytes()}


def refused(words, out, capsys, *, may_be_read=False):
    """Run a command; it writes nothing and says one line."""
    before = sorted(path for path in out.parent.rglob("*"))
    code = main([str(word) for word in words])
    shown = capsys.readouterr()
    lines = [line for line in shown.err.splitlines() if line.strip() and "reading" not in line]
    assert "Traceback" not in shown.err
    if may_be_read and code == 0:
        return
    assert code == BAD_INPUT, shown
    assert len(lines) == 1, lines
    assert lines[0].startswith("wlr: ")
    assert sorted(path for path in out.parent.rglob("*")) == before


def cell(text, row, column, value):
    lines = text.splitlines(keepends=True)
    place = lines[0].rstrip("\n").split(",").index(column)
    cells = lines[row].rstrip("\n").split(",")
    cells[place] = value
    return "".join([*lines[:row], ",".join(cells) + "\n", *lines[row + 1 :]])


def scaled(column, by, since=1):
    def change(text):
        lines = text.splitlines()
        place = lines[0].split(",").index(column)
        for row in range(since, len(lines)):
            cells = lines[row].split(",")
            cells[place] = repr(float(cells[place]) * by)
            lines[row] = ",".join(cells)
        return "\n".join(lines) + "\n"

    return change


CSV = {
    "empty": lambda text: "",
    "blank": lambda text: "\n\n \n",
    "names only": lambda text: text.splitlines()[0],
    "one row": lambda text: "\n".join(text.splitlines()[:2]) + "\n",
    "numbers for names": lambda text: "\n".join(text.splitlines()[1:]),
    "a comment only": lambda text: "# nothing\n",
    "bytes of zero": lambda text: "\0" * 400,
    "half in zeros": lambda text: text[:100] + "\0" * 300,
    "a name twice": lambda text: text.replace("pos_leg_rf", "pos_leg_lf", 1),
    "no times": lambda text: text.replace("t,", "x,", 1),
    "no setpoints": lambda text: text.replace("cmd_leg_lf", "x", 1),
    "no angle": lambda text: text.replace("pos_wheel_rr", "x", 1),
    "times backwards": lambda text: "\n".join([(lines := text.splitlines())[0], *lines[:0:-1]]),
    "one time late": lambda text: cell(text, 50, "t", "99.0"),
    "times are words": lambda text: re.sub(r"^[\d.]+,", "soon,", text, flags=re.M),
    "times in hours": scaled("t", 1 / 3600),
    "angles are words": lambda text: re.sub(r"(^(?:[^,]*,){9})[^,]*", r"\1left", text, flags=re.M),
    **{f"infinite {name}": lambda text, name=name: cell(text, 60, name, "inf") for name in
       ("pos_leg_lf", "pos_wheel_rr", "vel_leg_lf", "eff_wheel_lf", "gyro_x", "acc_z", "volt")},
    **{f"minus infinite {name}": lambda text, name=name: cell(text, 60, name, "-inf") for name in ("pos_leg_rr", "gyro_z")},
    **{f"degrees in {name}": scaled(name, 57.3) for name in ("pos_leg_lf", "pos_leg_rr", "cmd_leg_lf", "cmd_leg_rr")},
    **{f"degrees later in {name}": scaled(name, 57.3, 100) for name in ("pos_leg_lf", "cmd_leg_rf")},
    **{f"tons in {name}": scaled(name, 1e6) for name in ("eff_leg_lf", "eff_wheel_rr", "vel_wheel_lf", "gyro_z", "volt")},
    "g for acceleration": lambda text: scaled("acc_z", 0.1)(text),
    "a jump": lambda text: cell(text, 90, "pos_leg_lf", "3.1"),
    "a jump back": lambda text: cell(text, 90, "pos_wheel_lf", "-40"),
    "a cell too far": lambda text: cell(text, 90, "pos_leg_lf", "1e300"),
}  # fmt: skip


@pytest.mark.parametrize("fault", CSV)
def test_a_table(fault, good, tmp_path, capsys):
    (tmp_path / "a.csv").write_text(CSV[fault](good["csv"]))
    (tmp_path / "map.yaml").write_text(map_text(MAP))
    out = tmp_path / "runs"
    refused(["import", tmp_path / "a.csv", "--map", tmp_path / "map.yaml", "--out", out], out, capsys)


MAPS = {
    "no YAML": "channels: [",
    "a list": "[1, 2]",
    "a word": "map",
    "unknown key": "chanels: {}",
    "unknown joint": "joints: {leg_fl: a}",
    "joint of a number": "joints: {leg_lf: 3.5}",
    "joint without a name": "joints: {leg_lf: {sign: 1}}",
    "sign of 2": "joints: {leg_lf: {name: a, sign: 2}}",
    "zero of a word": "joints: {leg_lf: {name: a, zero: much}}",
    "channel of a word": "channels: {pos: here}",
    "channel without a field": "channels: {pos: {topic: table}}",
    "unknown channel": "channels: {poss: {topic: table, field: a}}",
    "unknown take": "channels: {volt: {topic: table, field: volt, take: guess}}",
    "left-handed": "frames: {imu: [x, z, y]}",
    "two axes": "frames: {imu: [x, y]}",
    "unknown frame": "frames: {gps: [x, y, z]}",
    "clock of a word": "clocks: {table: {use: sundial}}",
    "offset of a word": "clocks: {table: {offset: late}}",
    "every of 0": "every: 0",
    "every of a half": "every: 0.5",
    "profile below 0": "meta: {profile: {leg_velocity: -1}}",
    "unknown profile": "meta: {profile: {speed: 1}}",
    "no such robot": "meta: {robot: nobody}",
    "time that is not there": "time: zeit",
    "time of a list": "time: [t]",
    "open": "meta: {profile: open}",
}


@pytest.mark.parametrize("fault", MAPS)
def test_a_map(fault, good, tmp_path, capsys):
    (tmp_path / "a.csv").write_text(good["csv"])
    (tmp_path / "map.yaml").write_text(MAPS[fault])
    out = tmp_path / "runs"
    refused(["import", tmp_path / "a.csv", "--map", tmp_path / "map.yaml", "--out", out], out, capsys)


@pytest.mark.parametrize("kind", ["mcap", "parquet"])
@pytest.mark.parametrize("seed", range(8))
def test_a_file_of_bytes_that_are_cut_or_changed(kind, seed, good, tmp_path, capsys):
    rng, whole = np.random.default_rng(seed), bytearray(good[kind])
    if seed % 2:
        whole = whole[: int(rng.uniform(0.0, 0.5) * len(whole))]
    else:
        for place in rng.integers(0, len(whole), 200):
            whole[place] = rng.integers(256)
    (tmp_path / f"a.{kind}").write_bytes(whole)
    out = tmp_path / "runs"
    refused(["import", tmp_path / f"a.{kind}", "--out", out], out, capsys, may_be_read=True)


ROBOTS = {
    "empty": lambda text: "",
    "no XML": lambda text: text[: len(text) // 2],
    "another root": lambda text: text.replace("<robot", "<model", 1).replace("</robot>", "</model>"),
    "no links": lambda text: re.sub(r"<link.*?</link>", "", text, flags=re.S),
    "no joints": lambda text: re.sub(r"<joint name.*?</joint>", "", text, flags=re.S),
    "a mass of 0": lambda text: re.sub(r'mass value="[^"]*"', 'mass value="0"', text, count=1),
    "a mass below 0": lambda text: re.sub(r'mass value="[^"]*"', 'mass value="-1"', text, count=2),
    "a mass of a word": lambda text: re.sub(r'mass value="[^"]*"', 'mass value="much"', text, count=1),
    "a mass that is infinite": lambda text: re.sub(r'mass value="[^"]*"', 'mass value="inf"', text, count=1),
    "an inertia of 0": lambda text: re.sub(r'izz="[^"]*"', 'izz="0"', text, count=1),
    "an inertia below 0": lambda text: re.sub(r'iyy="[^"]*"', 'iyy="-1"', text, count=1),
    "an inertia too large": lambda text: re.sub(r'ixx="[^"]*"', 'ixx="1e9"', text, count=1),
    "an axis of 0": lambda text: text.replace('axis xyz="0 1 0"', 'axis xyz="0 0 0"', 1),
    "an axis of two": lambda text: text.replace('axis xyz="0 1 0"', 'axis xyz="0 1"', 1),
    "an axis across": lambda text: text.replace('axis xyz="0 1 0"', 'axis xyz="1 0 0"', 1),
    "limits swapped": lambda text: re.sub(r'lower="([^"]*)" upper="([^"]*)"', r'lower="\2" upper="\1"', text, count=1),
    "a joint twice": lambda text: text.replace('joint name="leg_rf"', 'joint name="leg_lf"'),
    "a link twice": lambda text: text.replace('link name="leg_rf_link"', 'link name="leg_lf_link"'),
    "a parent that is not there": lambda text: text.replace('parent link="base_link"', 'parent link="base"', 1),
    "a circle": lambda text: text.replace('parent link="base_link"', 'parent link="wheel_lf_link"', 1),
    "an unknown type": lambda text: text.replace('type="revolute"', 'type="hinge"', 1),
    "a slide": lambda text: text.replace('type="revolute"', 'type="prismatic"', 1),
    "a wheel of no size": lambda text: re.sub(r'radius="[^"]*"', 'radius="0"', text),
    "a wheel below 0": lambda text: re.sub(r'radius="[^"]*"', 'radius="-0.1"', text),
    "a torque below 0": lambda text: re.sub(r'effort="[^"]*"', 'effort="-3"', text),
    "a speed of a word": lambda text: re.sub(r'velocity="[^"]*"', 'velocity="fast"', text, count=1),
}  # fmt: skip


@pytest.mark.parametrize("fault", ROBOTS)
def test_a_robot(fault, tmp_path, capsys):
    (tmp_path / "a.urdf").write_text(ROBOTS[fault](urdf_text(load_robot())))
    out = tmp_path / "a.yaml"
    refused(["robot", "import", tmp_path / "a.urdf", "--out", out], out, capsys)
