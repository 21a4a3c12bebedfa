"""The floor as data: what its files may say, what is refused, what a seed draws, which parameters it writes."""

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from matplotlib.image import imsave

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import config_names
from wlr_gym.physics import maps
from wlr_gym.physics.floor import SEEDS, Floor, Grid, floor_noted, lay_floor, load_floor
from wlr_gym.physics.plants import relief
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameter_table import ELEMENTS
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()
FLOORS = ("flat", "gravel", "kerbs", "ramps", "rough", "stairs")
#: The paper's robot lacks numbers, and is none that can be simulated.
ROBOTS = [name for name in config_names("robot") if name != "paper"]
NOMINAL = Parameters.nominal(ROBOT)
KERB = {"kind": "kerb", "at": [0.5, 0.0], "height": 0.02}


def laid(floor: Floor, *seeds: int) -> Parameters:
    parameters = Parameters.nominal(ROBOT, len(seeds))
    floor.write(parameters, np.array(seeds, np.uint64))
    return parameters


def changed(parameters: Parameters) -> dict[str, float]:
    """Elements of the first robot that are not the nominal robot's."""
    different = np.flatnonzero(parameters.values[0] != NOMINAL.values[0])
    return {ELEMENTS[k]: float(parameters.values[0, k]) for k in different}


# ---- files -----------------------------------------------------------------------------------------------------------


def test_floors_that_ship():
    assert tuple(config_names("floor")) == FLOORS


@pytest.mark.parametrize("name", FLOORS)
@pytest.mark.parametrize("robot", ROBOTS)
def test_every_robot_can_drive_on_every_floor(name, robot):
    floor = load_floor(name, load_robot(robot))
    assert floor.name == name
    assert floor.summary


def test_a_floor_is_read_from_file_and_mapping_alike(tmp_path):
    content = {"name": "mine", "pieces": [KERB, {**KERB, "kind": "plank", "at": [1.0, 0.0], "height": 0.03, "depth": 0.2}]}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(content))
    floor = load_floor(tmp_path / "mine.yaml", ROBOT)
    assert floor == load_floor(content) == load_floor(floor)
    assert floor.content() == content


def test_flat_changes_no_parameter():
    assert load_floor(None) == load_floor("flat")
    assert changed(laid(load_floor(None), 3)) == {}
    assert floor_noted(load_floor(None)) is None


# ---- parameters ------------------------------------------------------------------------------------------------------


def test_a_base_is_written():
    waves = {"kind": "waves", "waves": [{"height": 0.01, "length": 1.5, "heading": 0.3, "phase": 1.0}]}
    assert changed(laid(load_floor({"base": waves}, ROBOT), 0)) == {
        "wave.height[wave_1]": 0.01, "wave.length[wave_1]": 1.5, "wave.heading[wave_1]": 0.3, "wave.phase[wave_1]": 1.0,
    }  # fmt: skip
    bumps = {"kind": "bumps", "height": 0.02, "spacing": 0.2, "share": 0.5, "seed": 7}
    assert changed(laid(load_floor({"base": bumps}, ROBOT), 0)) == {
        "bumps.height": 0.02, "bumps.spacing": 0.2, "bumps.share": 0.5, "bumps.seed": 7.0,
    }  # fmt: skip


def test_pieces_are_written():
    ramp = {"kind": "ramp", "at": [1.0, 0.5], "heading": 0.2, "slope": 0.3, "height": 0.05, "depth": 0.4, "down_slope": 0.2}
    parameters = laid(load_floor({"pieces": [KERB, ramp | {"edge_radius": 0.01}]}, ROBOT), 0)
    rows = {name: parameters[f"piece.{name}"][0, :3].tolist() for name in ("x", "y", "heading", "height", "length")}
    assert rows == {
        "x": [0.5, 1.0, 0.0], "y": [0.0, 0.5, 0.0], "heading": [0.0, 0.2, 0.0], "height": [0.02, 0.05, 0.0],
        "length": [1e3, 0.4, 1e3],
    }  # fmt: skip
    upright = math.pi / 2
    assert parameters["piece.front_slope"][0, :2].tolist() == [upright, 0.3]
    assert parameters["piece.rear_slope"][0, :2].tolist() == [upright, 0.2]
    assert parameters["piece.edge_radius"][0, :2].tolist() == [0.003, 0.01]


def test_stairs_are_steps_on_each_other():
    stairs = {"kind": "stairs", "at": [0.0, 1.0], "heading": math.pi / 2, "rise": 0.02, "run": 0.3, "count": 3}
    parameters = laid(load_floor({"pieces": [stairs], "randomise": {"pieces.0.rise": [0.01, 0.03]}}, ROBOT), 5, 6)
    rise = parameters["piece.height"][:, :1]
    assert (rise[0] != rise[1]).all()
    np.testing.assert_allclose(parameters["piece.height"][:, :4], rise * [1, 2, 3, 0], rtol=1e-15)
    np.testing.assert_allclose(parameters["piece.y"][0, :3], [1.0, 1.3, 1.6], rtol=1e-15)
    np.testing.assert_allclose(parameters["piece.x"][0, :3], 0.0, atol=1e-15)


def test_friction_is_written():
    floor = load_floor({"friction": {"mu": 0.5, "patches": [{"mu": 0.1, "x": [1.0, 2.0]}, {"mu": 0.9}]}}, ROBOT)
    parameters = laid(floor, 0)
    assert (parameters["ground.mu_x"] == 0.5).all()
    assert (parameters["ground.mu_y"] == 0.5).all()
    area = [parameters[f"patch.{name}"][0, :2].tolist() for name in ("mu", "x_min", "x_max", "y_min", "y_max")]
    assert area == [[0.1, 0.9], [1.0, -1e3], [2.0, 1e3], [-1e3, -1e3], [1e3, 1e3]]
    assert set(floor.elements().values()) == {"friction.mu", "friction.patches"}
    assert {name for name in floor.elements() if name.startswith("ground")} == {
        f"ground.mu_{axis}[wheel_{corner}]" for axis in "xy" for corner in ("lf", "rf", "lr", "rr")
    }


# ---- maps ------------------------------------------------------------------------------------------------------------

HILLS = np.round(np.random.default_rng(0).uniform(-0.005, 0.005, (12, 9)), 6)


def _save(folder: Path, kind: str) -> Path:
    """Save heights, a picture of them as shares of 10 mm, black for the lowest."""
    path = folder / f"hills.{kind}"
    if kind == "npy":
        np.save(path, HILLS)
    elif kind == "csv":
        np.savetxt(path, HILLS, delimiter=",")
    else:
        imsave(path, (HILLS + 0.005) / 0.01, cmap="gray", vmin=0.0, vmax=1.0)
    return path


@pytest.mark.parametrize("kind", ["npy", "csv", "png"])
def test_a_grid_is_read_from_a_file_beside_the_floors_own_and_kept(tmp_path, kind):
    _save(tmp_path, kind)
    content = {"base": {"kind": "grid", "file": f"hills.{kind}", "cell": 0.1, "scale": 0.01 if kind == "png" else 1.0}}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(content))
    floor = load_floor(tmp_path / "mine.yaml", ROBOT)
    (tmp_path / f"hills.{kind}").unlink()
    again = load_floor(yaml.safe_load(yaml.safe_dump(floor.content())), ROBOT)
    assert again == floor
    parameters = laid(again, 0)
    x, y = np.meshgrid(0.1 * (np.arange(9) - 4.0), 0.1 * (5.5 - np.arange(12)))  # the first row has the largest y
    height, *_ = relief.base_height(relief.pack(parameters, ROBOT), x, y, frozenset({"grid"}))
    expected = HILLS + 0.005 if kind == "png" else HILLS
    assert np.abs(height - expected).max() < (6e-5 if kind == "png" else 2e-6)


def test_random_heights_follow_from_their_seed():
    def base(seed: int) -> dict[str, Any]:
        return {"kind": "grid", "cell": 0.05, "random": {"seed": seed, "height": 0.004, "length": 0.4, "size": [4.0, 3.0]}}

    floors = [load_floor({"base": base(seed)}, ROBOT) for seed in (0, 0, 1)]
    first, same, other = (relief.map_of(laid(floor, 0)["grid.number"][0]) for floor in floors)
    assert np.array_equal(first, same)
    assert not np.array_equal(first, other)
    assert first.shape == (60, 80)
    grid = floors[0].base
    assert isinstance(grid, Grid)
    assert float(maps.map_values(grid.text()).std()) == pytest.approx(0.004, rel=1e-3)
    assert "data" not in floors[0].content()["base"]


def test_the_place_of_a_grid_is_drawn():
    base = {"kind": "grid", "cell": 0.05, "random": {"height": 0.004, "length": 0.4}}
    floor = load_floor({"base": base, "randomise": {"base.at.0": [-2.0, 2.0], "base.scale": [0.5, 1.0]}}, ROBOT)
    parameters = laid(floor, 1, 2)
    assert np.ptp(parameters["grid.number"]) == 0.0
    assert np.ptp(parameters["grid.x"]) > 0.0
    np.testing.assert_array_equal(parameters.values[1], lay_floor(floor.drawn(2), NOMINAL).values[0])


def test_a_map_of_friction_is_written(tmp_path):
    np.savetxt(tmp_path / "mu.csv", [[0.2, 0.4], [0.6, 0.8]], delimiter=",")
    content = {"file": str(tmp_path / "mu.csv"), "cell": 0.5, "at": [1.0, 0.5], "heading": 0.1}
    floor = load_floor({"friction": {"map": content}}, ROBOT)
    parameters = laid(floor, 0)
    assert np.allclose(relief.map_of(parameters["friction_map.number"][0]), [[0.6, 0.8], [0.2, 0.4]])
    assert [parameters[f"friction_map.{name}"][0] for name in ("cell", "x", "y", "heading", "scale")] == [0.5, 1.0, 0.5, 0.1, 1]
    assert set(floor.elements().values()) == {"friction.map"}
    assert not floor.is_flat


def test_a_map_that_no_floor_brought_is_told():
    with pytest.raises(InputError, match="map 12345: is not known here: expected a floor that holds it"):
        relief.map_of(12345.0)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.zeros(3), r"has shape \(3,\): expected rows and columns"),
        (np.zeros((300, 300)), "has 300 x 300 cells: expected at most 65536"),
        ([[0.0, np.nan]], "holds nan: expected finite numbers"),
        (np.full((2, 2), 1 + 2j), "map.npy: holds values of type complex128: expected real numbers"),
        (np.zeros((2, 2), "datetime64[s]"), r"holds values of type datetime64\[s\]: expected real numbers"),
        (np.zeros((2, 2), [("z", float)]), r"holds values of type \[\('z', '<f8'\)\]: expected real numbers"),
        (np.eye(9), "its curvature reaches .*: expected at most 0.25 over 0.034 m"),
    ],
)
def test_grids_that_cannot_be(tmp_path, values, words):
    np.save(tmp_path / "map.npy", values)
    with pytest.raises(InputError, match=words):
        load_floor({"base": {"kind": "grid", "file": str(tmp_path / "map.npy"), "cell": 0.05}}, ROBOT)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"file": "nowhere.npy"}, "nowhere.npy: there is no such file"),
        ({"file": "map.nyp"}, r"'.nyp' is no kind of map \(did you mean '.npy'\?\)"),
        ({}, "has neither 'file' nor 'data': expected the file of a map"),
        ({"data": "3x3_nonsense"}, "data = '3x3_nonsense'...: is no map"),
        ({"data": "5x0_eJwDAAAAAAE="}, "data = '5x0_eJwDAAAAAAE='...: is no map"),
        ({"data": maps.map_text(np.eye(2)).replace("2x2", "-1x2")}, "data = '-1x2_.*: is no map"),
        (
            {"data": maps.map_text(np.eye(2)), "random": {"height": 0.01, "length": 0.5}},
            "base = .*: has both 'data' and 'random': expected one of them",
        ),
        ({"random": {"height": 0.01, "length": 0.5, "size": [90.0, 90.0]}}, "1800 x 1800 cells of 0.05 m: expected at most"),
    ],
)
def test_grids_that_say_nothing_sensible(content, words):
    with pytest.raises(InputError, match=words):
        load_floor({"base": {"kind": "grid", "cell": 0.05, **content}})


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("map.npy", b"", "map.npy: cannot be read as NPY: .*; expected a table of numbers"),
        ("map.npy", b"PK\3\4 an archive", "map.npy: cannot be read as NPY: .*; expected a table of numbers"),
        ("map.png", b"no picture", "map.png: cannot be read as PNG: .*; expected a table of numbers"),
        ("map.csv", b"1,two", "map.csv: cannot be read as CSV: .*'two'.*; expected a table of numbers"),
        ("map.csv", b"", r"map.csv: has shape \(0, 1\): expected rows and columns"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_broken_files_of_maps_are_told(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=words):
        maps.read_map(tmp_path / name)


def test_a_spreadsheets_byte_order_mark_is_skipped(tmp_path):
    (tmp_path / "map.csv").write_bytes(b"\xef\xbb\xbf0,1\r\n2,3\r\n")
    assert maps.map_values(maps.read_map(tmp_path / "map.csv")).tolist() == [[2.0, 3.0], [0.0, 1.0]]


def test_a_grid_has_one_source(tmp_path):
    base = {"kind": "grid", "cell": 0.1, "file": str(_save(tmp_path, "csv")), "random": {"height": 0.01, "length": 0.5}}
    with pytest.raises(InputError, match=r"base = .*: has both 'file' and 'random': expected one of them"):
        load_floor({"base": base})


def test_friction_that_cannot_be(tmp_path):
    np.save(tmp_path / "mu.npy", [[0.2, 6.0]])
    with pytest.raises(InputError, match=r"friction.map: its friction is 0.2 to 6: expected \[0, 5\]"):
        load_floor({"friction": {"map": {"file": str(tmp_path / "mu.npy"), "cell": 0.5}}}, ROBOT)


# ---- draws -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FLOORS)
def test_a_draw_is_a_function_of_the_seed(name):
    floor = load_floor(name)
    batch = laid(floor, 7, 8, 9).values
    np.testing.assert_array_equal(batch[1], laid(floor, 8).values[0])
    np.testing.assert_array_equal(batch[1], lay_floor(floor.drawn(8), NOMINAL).values[0])
    assert bool(floor.randomise) == bool((batch[0] != batch[1]).any())
    assert load_floor(floor.drawn(8).content()) == floor.drawn(8) == floor.drawn(8).drawn(3)


def test_draws_fill_their_range():
    drawn = laid(load_floor("kerbs"), *range(400))["piece.height"][:, :3]
    assert (drawn.min(axis=0) >= [0.005, 0.005, 0.03]).all()
    assert (drawn.max(axis=0) <= [0.02, 0.02, 0.04]).all()
    np.testing.assert_allclose(drawn.mean(axis=0), [0.0125, 0.0125, 0.035], rtol=0.05)
    assert np.abs(np.asarray(np.corrcoef(drawn.T)) - np.eye(3)).max() < 0.15
    seeds = laid(load_floor("rough"), *range(400))["bumps.seed"]
    assert (seeds == np.floor(seeds)).all()
    assert 0 <= seeds.min() < 0.05 * SEEDS < 0.95 * SEEDS < seeds.max() < SEEDS


def test_a_draw_does_not_depend_on_the_other_draws():
    alone = load_floor({"pieces": [KERB], "randomise": {"pieces.0.height": [0.01, 0.03]}})
    both = load_floor({"pieces": [KERB], "randomise": {"pieces.0.at.0": [0.5, 0.6], "pieces.0.height": [0.01, 0.03]}})
    np.testing.assert_array_equal(laid(alone, 1, 2)["piece.height"], laid(both, 1, 2)["piece.height"])


def test_what_the_file_leaves_out_can_be_drawn():
    floor = load_floor({
        "pieces": [KERB], "friction": {"patches": [{"mu": 0.2}]},
        "randomise": {"pieces.0.edge_radius": [0.002, 0.004], "friction.patches.0.x.0": [1.0, 2.0]},
    })  # fmt: skip
    content = floor.drawn(4).content()
    assert 0.002 <= content["pieces"][0]["edge_radius"] <= 0.004
    low, high = content["friction"]["patches"][0]["x"]
    assert 1.0 <= low <= 2.0 < high == 1e3


# ---- refusals --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (
            {"pieces": [{**KERB, "kind": "curb"}]},
            "pieces.0 = .*expected 'kind' one of 'kerb', 'step', 'plank', 'ramp', 'stairs'",
        ),
        ({"pieces": [{**KERB, "hight": 1}]}, r"unknown key 'pieces.0.hight' \(did you mean 'height'\?\)"),
        ({"peices": [KERB]}, r"unknown key 'peices' \(did you mean 'pieces'\?\)"),
        ({"pieces": [{**KERB, "height": -0.1}]}, "pieces.0.height = -0.1: expected more than 0"),
        ({"base": {"kind": "bumps", "height": 0.01}}, "'base.spacing' is missing"),
        ({"base": {"kind": "bumps", "height": 0.01, "spacing": 0.2, "seed": SEEDS}}, f"expected less than {SEEDS}"),
        ({"pieces": [KERB] * 9}, "pieces: 9 pieces and steps, expected at most 8"),
        ({"friction": {"patches": [{"mu": 0.5}] * 5}}, "friction.patches"),
        ({"randomise": {"pieces.0.height": [0.1, 0.2]}}, "randomise: 'pieces.0.height': no number of this floor"),
        (
            {"pieces": [KERB], "randomise": {"pieces.0.hight": [0.1, 0.2]}},
            r"randomise: 'pieces.0.hight': no number of this floor \(did you mean 'pieces.0.height'\?\)",
        ),
        ({"pieces": [KERB], "randomise": {"pieces.0.height": [0.2, 0.1]}}, r"expected \[low, high\] with low <= high"),
        (
            {"pieces": [KERB], "randomise": {"pieces.0.height": "each_episode"}},
            r"randomise: pieces.0.height = 'each_episode': expected \[low, high\]",
        ),
        (
            {"base": {"kind": "bumps", "height": 0.01, "spacing": 0.2}, "randomise": {"base.seed": [1, 2]}},
            r"randomise: base.seed = \(1.0, 2.0\): expected 'each_episode'",
        ),
        (
            {
                "pieces": [{"kind": "stairs", "at": [1, 0], "rise": 0.1, "run": 0.3, "count": 2}],
                "randomise": {"pieces.0.count": [1, 3]},
            },
            "randomise: 'pieces.0.count': how many steps there are cannot be drawn",
        ),
        (
            {
                "base": {"kind": "grid", "cell": 0.1, "random": {"height": 0.01, "length": 0.5}},
                "randomise": {"base.random.seed": "each_episode"},
            },
            "randomise: 'base.random.seed': heights cannot be drawn; expected base.at.0",
        ),
        (
            {
                "base": {"kind": "grid", "cell": 0.1, "random": {"height": 0.01, "length": 0.5}},
                "randomise": {"base.cell": [0.1, 0.2]},
            },
            "randomise: 'base.cell': would also stretch base.random.length = 0.5 m; expected base.at.0",
        ),
        ({"friction": "x"}, "friction = 'x'"),
        ({"friction": [0.5]}, r"friction = \[0.5\]"),
    ],
)
def test_files_that_say_nothing_sensible(content, words):
    with pytest.raises(InputError, match=words):
        load_floor(content)


def test_names_of_floors_are_told():
    with pytest.raises(InputError, match=r"unknown floor config 'kerb' \(did you mean 'kerbs'\?\)"):
        load_floor("kerb")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (
            {"base": {"kind": "bumps", "height": 0.05, "spacing": 0.08}},
            "its curvature reaches 19.5 1/m, 0.66 over the wheels' radius: expected at most 0.25 over 0.034 m",
        ),
        ({"base": {"kind": "waves", "waves": [{"height": 0.1, "length": 0.5}]}}, "its curvature reaches 15.8 1/m"),
        (
            {"pieces": [KERB, {**KERB, "at": [0.6, 0.0]}]},
            "pieces 1 and 2 overlap, from 0.6 to .*: expected the later one higher and on top",
        ),
        (
            {"pieces": [{**KERB, "at": [0.1, 0.0]}]},
            r"piece 1: it lies from 0.1 to .* m ahead of the robot's start, \(0, 0\): expected 0.\d+ m between",
        ),
        ({"pieces": [KERB], "randomise": {"pieces.0.at.0": [0.1, 0.5]}}, "piece 1: it lies from 0.1 to"),
        ({"pieces": [KERB], "randomise": {"pieces.0.at.0": [0.5, 2e3]}}, r"piece.x\[piece_1\]"),
        ({"friction": {"mu": 7.0}}, r"ground.mu_x\[wheel_lf\]"),
    ],
)
def test_floors_on_which_the_robot_cannot_be_simulated(content, words):
    with pytest.raises(InputError, match=words):
        load_floor(content, ROBOT)


@pytest.mark.parametrize(
    "pieces",
    [
        [{**KERB, "kind": "plank", "depth": 0.3}, {**KERB, "at": [1.0, 0.0]}],  # one after the other
        [KERB, {**KERB, "at": [0.7, 0.0], "height": 0.04}],  # on top
        [KERB, {**KERB, "at": [0.9, 0.0], "heading": 1.2}],  # across
        [{**KERB, "at": [-2.0, 0.0]}],  # the start is on its top
        [{**KERB, "at": [0.0, 0.5], "heading": math.pi / 2}],  # beside the start
    ],
)
def test_pieces_that_may_be(pieces: list[dict[str, Any]]):
    assert load_floor({"pieces": pieces}, ROBOT).pieces


def test_a_larger_wheel_takes_less_curvature():
    heights = []
    for robot in sorted(map(load_robot, ROBOTS), key=lambda robot: robot.wheel.radius):
        most = 0.25 * 0.1**2 / (2.5 * robot.wheel.radius)
        load_floor({"base": {"kind": "bumps", "height": 0.999 * most, "spacing": 0.1}}, robot)
        with pytest.raises(InputError, match="curvature"):
            load_floor({"base": {"kind": "bumps", "height": 1.001 * most, "spacing": 0.1}}, robot)
        heights.append(most)
    assert all(first >= second for first, second in pairwise(heights))
