"""``wlr robot``: files are written whole or not at all, and say what they are."""

import json
import re

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.cli import BAD_INPUT, FAILED, OK, main
from wlr_gym.cli.robot import NewOptions, new_robot
from wlr_gym.robot import load_robot
from wlr_gym.robot.outline import QUESTIONS, question_of
from wlr_gym.robot.parameters import Parameters

BIG = ["body.mass=12", "leg.length=300 mm", "wheel.radius=8 cm", "body.size=0.6 0.4 0.15", "wheel.mass=800 g", "leg.mass=0.7",
       "servo.leg.stall_torque=30", "servo.wheel.stall_torque=9000 mN m", "servo.wheel.no_load_speed=77 rpm"]  # fmt: skip


@pytest.fixture
def big(tmp_path):
    path = tmp_path / "big.yaml"
    assert main(["robot", "new", "--out", str(path), "--yes", "--set", *BIG]) == OK
    return path


def test_new_without_questions(big):
    robot = load_robot(big)
    assert robot.name == "big"
    assert (robot.leg.length, robot.wheel.radius, robot.wheel.mass) == (0.3, 0.08, 0.8)
    assert robot.servo.wheel.no_load_speed == pytest.approx(8.063, rel=1e-3)
    assert robot.servo.wheel.stall_torque == 9.0
    assert robot.body.inertia == pytest.approx(tuple(np.array([0.4**2 + 0.15**2, 0.6**2 + 0.15**2, 0.6**2 + 0.4**2])), rel=1e-4)
    assert robot.hip_position.x == 0.3  # half the body
    assert robot.sensors == load_robot().sensors
    text = big.read_text()
    assert "base: nominal" in text
    assert "# [given] kg; mass of the body" in text
    assert "# [derived] uniform box" in text


def test_new_prints_what_a_check_finds_as_json(tmp_path, capsys):
    path = tmp_path / "weak.yaml"
    words = ["--yes", "--json", "--set", "servo.wheel.stall_torque=0.05", "body.mass=40"]
    assert main(["robot", "new", "--out", str(path), *words]) == FAILED
    shown = capsys.readouterr()
    found = json.loads(shown.out)
    assert (found["robot"], found["out"]) == ("weak", str(path))
    assert "fault" in [finding["level"] for finding in found["findings"]]
    assert shown.err == f"written: {path}\n"


def test_new_asks_with_defaults_and_asks_again(tmp_path, capsys):
    """Enter takes the default; what cannot be read is said and asked again."""
    asked = []
    answers = iter(["", "twelve", "0.7 0.5 0.1", *[""] * len(QUESTIONS)])

    def ask(text):
        asked.append(text)
        return next(answers)

    path = tmp_path / "asked.yaml"
    new_robot(NewOptions(out=path, set=("leg.length=0.2",)), ask)
    assert asked[0] == "mass of the body, without legs and wheels [2.8 kg]:"
    assert asked[1] == asked[2] == "length, width and height of the body [0.35 0.32 0.07 m]:"
    assert "body.size = 'twelve': " in capsys.readouterr().out
    assert asked[3] == "hips ahead of and behind the body's middle [0.35 m]:"  # follows the answer before
    assert len(asked) == len(QUESTIONS)  # one was given, one was asked twice
    assert load_robot(path).leg.length == 0.2


def test_nothing_is_replaced_without_being_told(big, capsys):
    before = big.read_text()
    for command in (["new", "--yes"], ["import", str(big)], ["export", "nominal"]):
        assert (
            main(["robot", *command, "--out", str(big), *(["--format", "urdf"] if command[0] == "export" else [])]) == BAD_INPUT
        )
        assert "exists; choose another name, or replace it with --force" in capsys.readouterr().err.replace("\n", " ")
    assert big.read_text() == before
    assert main(["robot", "new", "--yes", "--force", "--out", str(big)]) == OK
    assert load_robot(big).leg.length == load_robot().leg.length


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("body.mas=3", "unknown number of a new robot 'body.mas' (did you mean 'body.mass'?)"),
        ("body.mass=3 lb", "body.mass = '3 lb': unknown unit 'lb'"),
        ("body.mass=3 mm", "body.mass = '3 mm': expected a number in kg, g"),
        ("body.mass=0", "body.mass = '0': expected more than 0 kg"),
        ("body.size=3 m", "body.size = '3 m': expected 3 numbers in m, cm, mm"),
        ("leg.length=nan", "leg.length = 'nan': expected a number in m"),
        ("leg_limits=2 1", "leg_limits = [2.0, 1.0]"),
        ("leg.length=300 m", "wlr: leg.length = 300 m: is unusual, expected 0.02 to 1 m; in mm? 300 mm = 0.3 m"),
    ],
)
def test_bad_answers_are_refused_and_nothing_is_written(tmp_path, word, message, capsys):
    path = tmp_path / "bad.yaml"
    assert main(["robot", "new", "--yes", "--out", str(path), "--set", word]) == BAD_INPUT
    said = " ".join(capsys.readouterr().err.split())
    assert message in said
    assert list(tmp_path.iterdir()) == []


def test_a_refusal_of_all_answers_loses_none(tmp_path):
    with pytest.raises(
        InputError, match=r"your answers: --set body.mass=2.8 body.size='0.35 0.32 0.07' .*leg_limits='2.0 1.0'"
    ):
        new_robot(NewOptions(out=tmp_path / "x.yaml", set=("leg_limits=2 1",)), lambda text: "")


def test_a_new_robot_that_cannot_stand_is_written_and_fails(tmp_path, capsys):
    path = tmp_path / "weak.yaml"
    assert (
        main(["robot", "new", "--yes", "--out", str(path), "--set", "servo.wheel.stall_torque=0.05", "body.mass=40"]) == FAILED
    )
    assert path.is_file()
    assert "cannot turn on its floor" in capsys.readouterr().out


def test_show_as_text_and_json(big, capsys):
    assert main(["robot", "show", str(big)]) == OK
    printed = capsys.readouterr().out
    assert "top_speed" in printed
    assert max(map(len, printed.splitlines())) <= 80
    assert not re.search(r"e-1\d", printed), "rounding, which is 0"
    assert main(["robot", "show", str(big), "--json"]) == OK
    shown = json.loads(capsys.readouterr().out)
    assert shown["numbers"]["total_mass"] == {"value": 18.0, "unit": "kg", "meaning": "body, legs and wheels"}


def test_picture(big, tmp_path, graphics):
    from PIL import Image

    path = tmp_path / "big.png"
    assert main(["robot", "show", str(big), "--picture", str(path)]) == OK
    picture = np.asarray(Image.open(path))
    assert picture.shape == (960, 1280, 3)
    blue = (picture[:, :, 2].astype(int) - picture[:, :, 0] > 40) & (picture[:, :, 2] < 160)  # the body, in each view
    assert all(blue[y : y + 480, x : x + 640].sum() > 2000 for y in (0, 480) for x in (0, 640))
    edges = np.concatenate([blue[:, [0, 639, 640, 1279]].ravel(), blue[[0, 479, 480, 959]].ravel()])
    assert not edges.any()  # the whole robot is in the picture


def test_a_picture_of_unknown_kind_is_refused(capsys):
    assert main(["robot", "show", "--picture", "robot.gif2"]) == BAD_INPUT
    assert "expected a file that ends in .png" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", ["xml", "urdf"])
def test_out_and_back(big, suffix, tmp_path, capsys):
    file, back = tmp_path / f"big.{suffix}", tmp_path / "folder" / "back.yaml"
    back.parent.mkdir()
    assert main(["robot", "export", str(big), "--out", str(file)]) == OK
    assert "does not hold: " in capsys.readouterr().out
    assert main(["robot", "import", str(file), "--out", str(back), "--base", str(big)]) == OK
    assert "base: ../big.yaml" in back.read_text()
    before, after = load_robot(big), load_robot(back)
    np.testing.assert_allclose(Parameters.nominal(after).values, Parameters.nominal(before).values, rtol=1e-12)
    assert (after.leg_limits, after.sensors, after.wheel.width) == (before.leg_limits, before.sensors, before.wheel.width)


@pytest.mark.parametrize("command", ["import", "new"])
def test_what_is_stated_of_all_legs_is_of_all_whatever_the_base_says_of_one(command, big, tmp_path):
    single, out, file = tmp_path / "single.yaml", tmp_path / "out.yaml", tmp_path / "big.urdf"
    single.write_text('{base: big.yaml, name: single, individual: {"leg.length[leg_rf]": 0.4, "servo.kp[leg_lr]": 50.0}}')
    assert main(["robot", "export", str(big), "--out", str(file)]) == OK
    given = [str(file)] if command == "import" else ["--yes"]
    assert main(["robot", command, *given, "--out", str(out), "--base", str(single)]) == OK
    expected = {"servo.kp[leg_lr]": 50.0} if command == "import" else {}  # no file of another program holds a gain
    assert load_robot(out).individual == expected


def test_import_as_json(big, tmp_path, capsys):
    file, back = tmp_path / "big.urdf", tmp_path / "back.yaml"
    assert main(["robot", "export", str(big), "--out", str(file), "--json"]) == OK
    assert "ground" in json.loads(capsys.readouterr().out)["not_held"]
    assert main(["robot", "import", str(file), "--out", str(back), "--json"]) == OK
    report = json.loads(capsys.readouterr().out)
    assert report["joints"][0] == {"joint": "leg_lf", "name": "leg_lf", "sign": 1.0, "offset": 0.0}
    assert report["numbers"]["leg"]["length"] == 0.3


def test_what_comes_from_the_base_is_listed_and_checked(big, tmp_path, capsys):
    file, back = tmp_path / "big.xml", tmp_path / "back.yaml"
    assert main(["robot", "export", str(big), "--out", str(file)]) == OK
    assert main(["robot", "import", str(file), "--out", str(back)]) == OK
    said = " ".join(capsys.readouterr().out.split())
    assert "Taken from 'nominal': " in said
    assert "servo.wheel.no_load_speed = 6.388, " in said
    assert "servo.wheel.no_load_speed = 6.388" in back.read_text()
    assert main(["robot", "check", str(back)]) == OK
    said = capsys.readouterr().out
    assert "servo.wheel.no_load_speed = 6.388 rad/s: taken from 'nominal'; it decides the top speed" in said
    assert "servo.wheel.stall_torque = " not in said  # the file has it
    for robot in (str(big), "nominal", "emanual"):
        assert main(["robot", "check", robot]) == OK
        assert "taken from" not in capsys.readouterr().out


def test_a_number_is_given_in_place_of_the_files(big, tmp_path, capsys):
    file, back = tmp_path / "big.urdf", tmp_path / "back.yaml"
    assert main(["robot", "export", str(big), "--out", str(file)]) == OK
    assert main(["robot", "import", str(file), "--out", str(back), "--set", "wheel.radius=90 mm"]) == OK
    assert load_robot(back).wheel.radius == 0.09
    assert main(["robot", "import", str(file), "--out", str(tmp_path / "b.yaml"), "--set", "wheel.radios=1"]) == BAD_INPUT
    assert "(did you mean 'wheel.radius'?)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.urdf", "<robot name='a'><link name='b'/></robot>", "0 joints on body 'b' (none), 0 in all: expected four legs"),
        ("a.xml", "<mujoco><worldbody><geom type='box'/></worldbody></mujoco>", "MuJoCo cannot load it"),
        ("a.xml", "<mujoco><worldbody/></mujoco>", "expected one robot in the world, found 0: none"),
        ("a.xml", "no file at all", "broken XML"),
        ("b.xml", None, "cannot be read: No such file"),
    ],
)
def test_files_that_are_no_such_robot_are_refused(tmp_path, name, text, message, capsys):
    file, out = tmp_path / name, tmp_path / "out.yaml"
    if text is not None:
        file.write_text(text)
    assert main(["robot", "import", str(file), "--out", str(out)]) == BAD_INPUT
    assert message in " ".join(capsys.readouterr().err.split())
    assert not out.exists()


def test_export_to_an_unknown_format_is_refused(tmp_path, capsys):
    assert main(["robot", "export", "nominal", "--out", str(tmp_path / "robot.sdf")]) == BAD_INPUT
    assert "expected a file that ends in .xml, .mjcf, .urdf" in capsys.readouterr().err


def test_units_of_answers():
    assert question_of("servo.leg.no_load_speed").read("53 rpm") == pytest.approx(5.550, rel=1e-3)
    assert question_of("leg_limits").read("20 160 deg") == pytest.approx([0.349, 2.793], abs=1e-3)
    assert question_of("hip_position.z").read("-10 mm") == -0.01
