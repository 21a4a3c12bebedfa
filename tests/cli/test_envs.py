"""``wlr envs``."""

import matplotlib.image
import pytest
from matplotlib.figure import Figure

from wlr_gym.cli import main
from wlr_gym.envs.registry import ENVIRONMENTS
from wlr_gym.envs.tasks import load_randomization
from wlr_gym.learning.evaluation.floor_plots import draw_floors
from wlr_gym.robot import load_robot


def test_list_has_every_environment(capsys):
    assert main(["envs"]) == 0
    shown = capsys.readouterr().out
    assert all(env_id in shown for env_id in ENVIRONMENTS)


def test_description_has_units_and_terms(capsys):
    assert main(["envs", "WLR-Velocity-v0"]) == 0
    shown = capsys.readouterr().out
    for text in ("command[linear_velocity_x]", "rad/s", "track_yaw_rate", "gyro[z]"):
        assert text in shown


def test_unknown_environment(capsys):
    assert main(["envs", "WLR-Velocty-v0"]) == 2
    assert "did you mean 'WLR-Velocity-v0'?" in capsys.readouterr().err


def test_description_shows_what_a_randomization_draws(capsys):
    assert main(["envs", "WLR-Velocity-v0", "--randomization", "patches"]) == 0
    shown = capsys.readouterr().out
    for text in ("``patches``", "drift 2..6 s", "area x_min -1.2..0.7 m", "tolerance x 1, cut at 2", "sensors.imu.gyro_bias"):
        assert text in shown
    assert main(["envs", "WLR-Velocity-v0"]) == 0
    assert "``slippery``" in capsys.readouterr().out


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
