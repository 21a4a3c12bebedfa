"""``wlr envs``."""

import re

import matplotlib.image
import pytest
from matplotlib.figure import Figure

from wlr_gym.cli import main
from wlr_gym.envs.registry import ENVIRONMENTS
from wlr_gym.envs.tasks import load_randomization, load_task
from wlr_gym.learning.evaluation.plots import draw_floors
from wlr_gym.robot import load_robot


def test_list_has_every_environment(capsys):
    assert main(["envs"]) == 0
    shown = capsys.readouterr().out
    assert all(env_id in shown for env_id in ENVIRONMENTS)


@pytest.mark.parametrize("width", [60, 80, 130])
@pytest.mark.parametrize("env_id", ["WLR-Velocity-v0", "WLR-Path-v0"])
def test_description_fits_the_terminal_and_has_every_index_once(env_id, width, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    assert main(["envs", env_id, "--randomization", "wide", "--robot", "nominal"]) == 0
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= width
    assert not re.search(r"\*\*|`|==", shown)
    task = load_task(ENVIRONMENTS[env_id], load_robot())
    told = [_indices(block) for block in shown.split("\n\n") if "index" in block.partition("\n")[0].split()]
    assert told == [list(range(len(columns))) for columns in (task.actions, task.policy, task.privileged)]
    assert {column.term for column in (*task.policy, *task.privileged)} <= set(shown.split())


def _indices(block: str) -> list[int]:
    """Numbers of a block's index column, found by the place of its heading: ``6-9`` is four."""
    head, *lines = block.splitlines()
    cells = (line[head.index("index") :].partition(" ")[0] for line in lines)
    spans = [[int(end) for end in cell.split("-")] for cell in cells if re.fullmatch(r"\d+(-\d+)?", cell)]
    return [index for span in spans for index in range(span[0], span[-1] + 1)]


def test_unknown_environment(capsys):
    assert main(["envs", "WLR-Velocty-v0"]) == 2
    assert "did you mean 'WLR-Velocity-v0'?" in capsys.readouterr().err


def test_description_shows_what_a_randomization_draws(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["envs", "WLR-Velocity-v0", "--randomization", "patches"]) == 0
    shown = capsys.readouterr().out
    for text in (
        "Randomization: patches; ",
        "drift 2..6 s: ",
        "area x_min -1.2..0.7 m",
        "tolerance x 1, cut at 2",
        "sensors.imu.gyro_bias",
    ):
        assert text in shown
    assert main(["envs", "WLR-Velocity-v0"]) == 0
    assert "Randomization: slippery; " in capsys.readouterr().out


def test_description_has_meanings_and_units(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["envs", "WLR-Slope-v0"]) == 0
    shown = capsys.readouterr().out
    for text in (
        "rms at most 0.006 m/s",
        "below_friction_limit uniform 0.0262..0.21 rad",
        "add normal +- sensors.imu.gyro_bias rad/s, cut at 3",
        "leg_angle +-0.05 rad",
        "contact_force             on the wheel, in all: along its heading",
        "env.unwrapped.contract()",
    ):
        assert text in shown


def test_bad_randomization(capsys):
    assert main(["envs", "WLR-Velocity-v0", "--randomization", "wid"]) == 2
    assert "did you mean 'wide'?" in capsys.readouterr().err
    assert main(["envs", "--randomization", "wide"]) == 2
    assert "name the environment too" in capsys.readouterr().err


def test_picture_of_the_floors(tmp_path, capsys):
    path = tmp_path / "new" / "floors.png"
    assert main(["envs", "WLR-Velocity-v0", "--randomization", "patches", "--picture", str(path)]) == 0
    picture = matplotlib.image.imread(path)
    assert picture.shape[1] > 900
    assert picture.reshape(-1, picture.shape[2]).std(axis=0)[:3].min() > 0.05
    assert main(["envs", "WLR-Velocity-v0", "--picture", str(tmp_path / "floors.jpg.txt")]) == 2
    assert "ends in .png" in capsys.readouterr().err


@pytest.mark.parametrize("blocks", [1, 4])
def test_the_label_of_the_colours_is_not_cut_off(tmp_path, monkeypatch, blocks):
    drawn = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *args, **keywords: drawn.append(self) or save(self, *args, **keywords))
    draw_floors(tmp_path / "floors.png", [load_randomization("nominal", load_robot())] * blocks, count=2)
    figure = drawn[0]
    label = figure.axes[-1].xaxis.label.get_window_extent()
    assert label.width > 20
    assert figure.bbox.x0 <= label.x0 < label.x1 <= figure.bbox.x1
    assert figure.bbox.y0 <= label.y0
