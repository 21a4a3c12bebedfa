"""Where a wheel touches a floor that is not flat, against dense searches, MuJoCo's own distances and brute force."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from relief_rig import (
    CORE,
    HALF_WIDTH,
    ROUNDING,
    along_heading,
    bump_height,
    columns,
    drawn_height,
    enter_grid,
    grid_height,
    parameters_of,
    piece_distance,
    reach,
    touches,
    turns,
    wave_height,
    wheel_surface,
)
from rig import RADIUS, ROBOT

from wlr_gym.physics import maps
from wlr_gym.physics.plants import relief

#: Floors at the largest curvature that is allowed, 0.25 over the radius.
LARGEST = relief.LARGEST_CURVATURE / RADIUS
BUMPS = {"bumps.spacing": 0.08, "bumps.height": 0.4 * LARGEST * 0.08**2, "bumps.seed": 1234.0}
STONES = {"bumps.spacing": 0.04, "bumps.height": 0.005, "bumps.share": 0.2, "bumps.seed": 77.0}
CORRUGATED = {"wave.length": [0.3, 0.25], "wave.heading": 0.3, "wave.phase": [0.4, 1.1]}
WAVES = CORRUGATED | {"wave.height": [0.6 * LARGEST / (2 * np.pi / 0.3) ** 2, 0.4 * LARGEST / (2 * np.pi / 0.25) ** 2]}
#: Heights at random, as sharp as they may be: 80 x 60 cells, turned and moved.
RANDOM = enter_grid(np.random.default_rng(8).uniform(0.0, 0.01, (60, 80)))
GRID = {
    "grid.number": RANDOM, "grid.cell": 0.06, "grid.x": 0.3, "grid.y": -0.2, "grid.heading": 0.7,
    "grid.scale": LARGEST * 0.06**2 / maps.sharpest(RANDOM),
}  # fmt: skip
HEIGHTS = {
    "waves": (WAVES, wave_height), "bumps": (BUMPS, bump_height), "stones": (STONES, bump_height), "grid": (GRID, grid_height),
}  # fmt: skip
KERB = {"piece.x[piece_1]": 0.0, "piece.height[piece_1]": 0.03, "piece.edge_radius[piece_1]": 0.003}


@pytest.mark.parametrize("floor", HEIGHTS)
def test_a_wheel_touches_smooth_floors_where_a_dense_search_of_its_surface_does(floor):
    """Half a millimetre deep: within 10 um and 0.3 degrees, of the 60 um and 0.5 degrees that are allowed."""
    values, height_of = HEIGHTS[floor]
    parameters, rng, small = parameters_of(1, values), np.random.default_rng(0), 1e-5
    surface, count = wheel_surface(), 24
    depth, normal, centre = np.zeros(count), np.zeros((count, 3)), np.zeros((count, 3))
    turned = turns(rng, count, np.pi, 0.25)
    for k, turn in enumerate(turned):
        centre[k, :2] = rng.uniform(-2.0, 2.0, 2)
        x, y, z = (surface @ turn.T + centre[k]).T
        above = height_of(parameters, x, y) - z
        near = np.flatnonzero(above > above.max() - 1.5e-3)
        x, y, z, above = x[near], y[near], z[near], above[near]
        slopes = [
            (height_of(parameters, x + dx, y + dy) - height_of(parameters, x - dx, y - dy)) / (2 * small)
            for dx, dy in ((small, 0.0), (0.0, small))
        ]
        upright = 1.0 / np.sqrt(1.0 + slopes[0] ** 2 + slopes[1] ** 2)
        lowered = above - above.max() + 5e-4
        best = (lowered * upright).argmax()
        centre[k, 2] = above.max() - 5e-4
        depth[k] = (lowered * upright)[best]
        normal[k] = np.array([-slopes[0][best], -slopes[1][best], 1.0]) * upright[best]
    found = touches(parameters, centre, turned[:, :, 1])
    assert len(found) == 1
    assert np.abs(found[0].depth - depth).max() < 1e-5
    assert np.degrees(np.arccos(np.clip((columns(found[0].normal, count) * normal).sum(axis=1), -1, 1))).max() < 0.3


def _at_edge(rng, count, yaw, roll):
    """Centres (N, 3) and axles (N, 3) of wheels up to 1 mm into a kerb, on its riser, its edge or its top."""
    axle = turns(rng, count, yaw, roll)[:, :, 1]
    angle = rng.uniform(-0.1, np.pi / 2 + 0.1, count)
    out = np.stack([-np.cos(angle), np.zeros(count), np.sin(angle)], axis=1)
    corner, edge = np.array([0.003, 0.0, 0.027]), 0.003
    away = reach(-out, axle) + edge - rng.uniform(0.0, 1e-3, count)
    return corner + out * away[:, None] + [0.0, 1.0, 0.0] * rng.uniform(-0.2, 0.2, (count, 1)), axle


def _on_piece(parameters, centre, axle):
    """The contacts of wheels with the only piece, whichever of their two contacts that is."""
    lanes = relief.pack(parameters, ROBOT)
    edge = relief._edge_of(lanes, 0, list(centre.T))
    return relief._touch_of_edge(edge, list(axle.T), relief.profile_of(lanes, 0))


def test_an_edge_is_touched_where_the_densest_directions_say():
    """Within 0.1 um where the wheel meets the kerb at up to 0.8 rad."""
    count = 300
    parameters = parameters_of(count, KERB)
    centre, axle = _at_edge(np.random.default_rng(1), count, 0.8, 0.2)
    depth = _on_piece(parameters, centre, axle).depth
    dense = [-piece_distance(parameters, k, 0, centre[k], axle[k]) for k in range(count)]
    assert np.abs(depth - dense).max() < 1e-7


def test_a_wheel_along_a_kerb_does_not_touch_it_from_afar():
    """The normal nears the axle, where the separation has a kink: at most 0.7 mm too deep, never too shallow."""
    rng, count = np.random.default_rng(11), 300
    parameters, axle = parameters_of(count, KERB), turns(rng, count, 0.37, 0.2) @ [1.0, 0.0, 0.0]
    away = rng.uniform(0.0, 0.02, count)
    centre = np.stack([-(HALF_WIDTH + ROUNDING + away), rng.uniform(-0.2, 0.2, count), np.full(count, RADIUS)], axis=1)
    depth = _on_piece(parameters, centre, axle).depth
    dense = np.array([-piece_distance(parameters, k, 0, centre[k], axle[k]) for k in range(count)])
    assert np.abs(depth - dense).max() < 7e-4
    assert (depth > dense - 1e-9).all()


def test_an_edge_is_as_far_away_as_mujoco_says_of_a_cylinder_and_a_box():
    """Within 6 um: the search over directions knows a wheel without a crown only as one with a very small one."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option ccd_iterations="200" ccd_tolerance="1e-12"/><worldbody>
        <geom name="box" type="box" size="1 5 0.5" pos="1.003 0 -0.473"/>
        <body mocap="true"><geom type="cylinder" size="{CORE} {HALF_WIDTH}" quat="0.70710678 0.70710678 0 0"/></body>
        </worldbody></mujoco>""")
    data, count = mujoco.MjData(model), 300
    parameters, rng = parameters_of(count, KERB), np.random.default_rng(2)
    turn = turns(rng, count, 0.8, 0.2)
    centre, axle = _at_edge(np.random.default_rng(2), count, 0.8, 0.2)
    depth = _on_piece(parameters, centre, axle).depth
    for k in range(count):
        data.mocap_pos[0] = centre[k]
        mujoco.mju_mat2Quat(data.mocap_quat[0], turn[k].ravel())
        mujoco.mj_kinematics(model, data)
        apart = mujoco.mj_geomDistance(model, data, 0, 1, 1.0, np.zeros(6)) - ROUNDING - 0.003
        assert piece_distance(parameters, k, 0, centre[k], axle[k], crown=1e-3) - apart == pytest.approx(2.9e-6, abs=3e-6)
        assert -1e-9 < -depth[k] - apart < HALF_WIDTH * relief.CROWN


def _flights(rng, count):
    """Floors of up to eight pieces: stairs with a ramp and a plank ahead of them, all along one heading of their own."""
    heading = rng.uniform(-3.0, 3.0, (count, 1))
    ahead = np.cumsum(np.concatenate([np.zeros((count, 1)), rng.uniform(0.5, 0.8, (count, 2)),
                                      rng.uniform(0.12, 0.3, (count, 5))], axis=1), axis=1)  # fmt: skip
    rise = np.cumsum(rng.uniform(0.01, 0.03, (count, 6)), axis=1)
    height = np.concatenate([rng.uniform(0.02, 0.05, (count, 2)), rise], axis=1)
    upright = np.full((count, 8), np.pi / 2)
    front, rear = upright.copy(), upright.copy()
    front[:, 0], rear[:, 0] = rng.uniform(0.3, 1.2, (2, count))
    length = np.full((count, 8), 1e3)
    length[:, :2] = rng.uniform(0.03, 0.3, (count, 2))
    edge = rng.uniform(0.001, 0.005, (count, 1)) * np.ones(8)
    return parameters_of(count, {
        "piece.x": ahead * np.cos(heading), "piece.y": ahead * np.sin(heading), "piece.heading": heading * np.ones(8),
        "piece.height": height, "piece.length": length, "piece.front_slope": front, "piece.rear_slope": rear,
        "piece.edge_radius": edge,
    }), ahead, heading  # fmt: skip


def _gaps(parameters, centre, axle):
    """Distances (N, 9) of wheels from each piece and from the base, by brute force."""
    on_base = centre[:, 2] - reach(np.array([0.0, 0.0, -1.0]), axle)
    rows = range(len(centre))
    on_pieces = [[piece_distance(parameters, k, piece, centre[k], axle[k]) for piece in range(8)] for k in rows]
    return np.column_stack([on_pieces, on_base])


def test_of_ramps_planks_and_stairs_a_wheel_touches_the_two_that_brute_force_finds_deepest():
    """Half of the wheels stand anywhere; the others are pushed into a corner of two."""
    count, rng = 120, np.random.default_rng(3)
    parameters, ahead, heading = _flights(rng, count)
    level = along_heading(heading[:, 0], np.tile([1.0, 0.0, 0.0], (count, 1)))
    axle = along_heading(heading[:, 0], turns(rng, count, 0.6, 0.15)[:, :, 1])
    pushed, everyone = np.arange(count) % 2 == 0, np.arange(count)
    piece = rng.integers(0, 8, count)
    place = np.where(pushed, ahead[everyone, piece] - 1.1 * RADIUS, rng.uniform(-0.1, ahead[:, -1] + 0.1))
    centre = place[:, None] * level + [0.0, 0.0, 0.1]
    for _ in range(10):
        gaps = _gaps(parameters, centre, axle)
        ahead_of_it = gaps[everyone, piece]
        gaps[:, :8][pushed[:, None] & (np.arange(8) >= piece[:, None])] = np.inf  # those that it stands before
        centre[:, 2] -= gaps.min(axis=1) + 5e-4
        centre += np.where(pushed, ahead_of_it + 3e-4, 0.0)[:, None] * level
    nearest = np.sort(_gaps(parameters, centre, axle), axis=1)
    first, second = touches(parameters, centre, axle)
    assert np.abs(-first.depth - nearest[:, 0]).max() < 1e-7
    touching = nearest[:, 1] < 0.0
    assert touching.sum() > 40
    assert np.abs(-second.depth - nearest[:, 1])[touching].max() < 1e-7
    assert (second.depth[~touching] < 1e-7).all()


def test_a_wheel_far_inside_a_kerb_is_pushed_out_of_its_top():
    """Its centre below the top: not out of the face, which is further away."""
    centre = np.array([[0.5, 0.0, 0.02], [0.02, 0.0, 0.025], [-0.01, 0.0, 0.01]])
    parameters, axle = parameters_of(3, KERB), np.tile([0.0, 1.0, 0.0], (3, 1))
    found = touches(parameters, centre, axle)[0]
    assert found.depth == pytest.approx([RADIUS + 0.01, RADIUS + 0.005, RADIUS - 0.01], abs=1e-9)
    assert columns(found.normal, 3) == pytest.approx(np.array([[0, 0, 1], [0, 0, 1], [-1, 0, 0]]), abs=1e-9)


@pytest.mark.parametrize(
    ("floor", "degrees"), [(WAVES, 0.5), (BUMPS, 0.5), (GRID, 0.5), (KERB, 0.01)], ids=["waves", "bumps", "grid", "kerb"]
)
def test_depth_grows_along_the_normal(floor, degrees):
    """A wheel's contact is a potential's force: the normal is the slope of the depth."""
    count, small, rng = 200, 1e-6, np.random.default_rng(4)
    parameters = parameters_of(count, floor)
    if floor is KERB:
        centre, axle = _at_edge(rng, count, 0.8, 0.2)
    else:
        axle = turns(rng, count, np.pi, 0.25)[:, :, 1]
        centre = rng.uniform(-2.0, 2.0, (count, 3)) * [1.0, 1.0, 0.0] + [0.0, 0.0, RADIUS]
        centre[:, 2] += touches(parameters, centre, axle)[0].depth - 3e-4
    slope = np.stack([
        (touches(parameters, centre + step, axle)[0].depth - touches(parameters, centre - step, axle)[0].depth) / (2 * small)
        for step in small * np.eye(3)
    ], axis=1)  # fmt: skip
    found = touches(parameters, centre, axle)[0]
    touching = np.flatnonzero(found.depth > 0.0)
    assert touching.size > 150
    normal = columns(found.normal, count)
    across = np.linalg.norm(np.cross(slope, normal), axis=1)
    assert np.degrees(across[touching]).max() < degrees
    assert np.abs((slope * normal).sum(axis=1) + 1.0)[touching].max() < 0.01


# ---- bumps -----------------------------------------------------------------------------------------------------------


def _heights(values, x, y, dtype: Any = np.float64):
    parameters = parameters_of(1, values)
    lanes = {name: value.astype(dtype) for name, value in relief.pack(parameters, ROBOT).items()}
    return relief.base_height(lanes, x.astype(dtype), y.astype(dtype), frozenset(relief.families(parameters)))


def test_bumps_are_bells_on_the_points_of_a_lattice():
    rng = np.random.default_rng(5)
    x, y = rng.uniform(-1.0, 1.0, (2, 400))
    for values in (BUMPS, STONES):
        assert np.allclose(_heights(values, x, y)[0], bump_height(parameters_of(1, values), x, y), rtol=0, atol=1e-15)


def test_single_precision_draws_the_same_bumps():
    """A lattice point drawn otherwise would be wrong by millimetres; here by what single precision rounds."""
    rng = np.random.default_rng(6)
    x, y = (0.08 * (rng.integers(-60, 60, (2, 4000)) + rng.uniform(0.05, 0.95, (2, 4000)))).astype(np.float32)
    height, single = _heights(BUMPS, x, y)[0], _heights(BUMPS, x, y, np.float32)[0]
    assert single.dtype == np.float32
    assert np.abs(height - single).max() < 1e-6


@pytest.mark.parametrize("floor", [BUMPS, GRID], ids=["bumps", "grid"])
def test_slopes_are_those_of_the_height(floor):
    rng, small = np.random.default_rng(7), 1e-6
    x, y = rng.uniform(-3.0, 3.0, (2, 500))
    _, slope_x, slope_y = _heights(floor, x, y)
    for slope, dx, dy in ((slope_x, small, 0.0), (slope_y, 0.0, small)):
        rise = (_heights(floor, x + dx, y + dy)[0] - _heights(floor, x - dx, y - dy)[0]) / (2 * small)
        assert np.abs(rise - slope).max() < 1e-7


def test_lattice_points_are_evenly_drawn_and_seeds_have_nothing_in_common():
    size, seeds = range(60), range(0, 4000, 389)
    drawn = {seed: np.array([[drawn_height(c, r, seed, 1.0) for r in size] for c in size]) for seed in seeds}
    for field in drawn.values():
        counts, _ = np.histogram(field, 10, (0.0, 1.0))
        assert abs(counts - 360).max() < 120
        assert abs(field.mean() - 0.5) < 0.02
        for shifted in (field[1:], field[2:]):
            assert abs(np.corrcoef(shifted.ravel(), field[: len(shifted)].ravel())[0, 1]) < 0.06
        assert abs(np.corrcoef(field[:, 1:].ravel(), field[:, :-1].ravel())[0, 1]) < 0.06
    fields = [field.ravel() for field in drawn.values()]
    apart = np.corrcoef(fields) - np.eye(len(fields))
    assert np.abs(apart).max() < 0.1


@pytest.mark.parametrize("other", [6, 5 + 1019, 5 + 1020])
def test_no_seed_is_another_one_shifted(other):
    first, second = (np.array([[drawn_height(c, r, seed, 1.0) for r in range(40)] for c in range(40)]) for seed in (5, other))
    for shift in itertools.product(range(-3, 4), repeat=2):
        shifted = np.roll(second, shift, (0, 1))[4:-4, 4:-4].ravel()
        assert abs(np.corrcoef(first[4:-4, 4:-4].ravel(), shifted)[0, 1]) < 0.2


def test_a_field_does_not_nearly_repeat():
    field = np.array([[drawn_height(c, r, 1234, 1.0) for r in range(60)] for c in range(60)])
    for shift in range(1, 40):
        assert abs(np.corrcoef(field[shift:].ravel(), field[:-shift].ravel())[0, 1]) < 0.12
        assert abs(np.corrcoef(field[:, shift:].ravel(), field[:, :-shift].ravel())[0, 1]) < 0.12


def test_the_share_of_stones_is_what_was_asked_for():
    raised = [drawn_height(c, r, 77, 0.2) > 0 for c in range(100) for r in range(100)]
    assert np.mean(raised) == pytest.approx(0.2, abs=0.01)


# ---- grids -----------------------------------------------------------------------------------------------------------


def test_a_grid_goes_through_its_heights_and_on_level():
    heights = np.random.default_rng(9).uniform(-0.01, 0.02, (5, 7))
    values = {"grid.number": enter_grid(heights), "grid.cell": 0.1}
    x, y = np.meshgrid(0.1 * (np.arange(7) - 3.0), 0.1 * (np.arange(5) - 2.0))
    assert np.abs(_heights(values, x, y)[0] - heights).max() < 1e-6  # to which they are kept
    turned = values | {"grid.heading": np.pi / 2, "grid.x": 1.0, "grid.scale": 2.0}  # a quarter turn: along y
    assert np.abs(_heights(turned, 1.0 - y, x)[0] - 2.0 * heights).max() < 2e-6
    beyond, *slopes = _heights(values, np.array([0.4, 5.0]), np.array([0.3, 4.0]))
    assert np.ptp(beyond) == 0.0
    assert not np.any(slopes)


def test_a_wheel_on_a_level_grid_is_as_deep_everywhere():
    """To the last bit that a height of 0.3 m has."""
    count, rng = 400, np.random.default_rng(10)
    parameters = parameters_of(count, {"grid.number": enter_grid(np.full((40, 40), 0.3)), "grid.cell": 0.05})
    centre = np.append(rng.uniform(-1.2, 1.2, (count, 2)), np.full((count, 1), RADIUS + 0.3 - 1e-3), axis=1)
    found = touches(parameters, centre, np.tile([0.0, 1.0, 0.0], (count, 1)))[0]
    assert np.abs(found.depth - 1e-3).max() < 1e-15
    assert (columns(found.normal, count) == [0.0, 0.0, 1.0]).all()


def test_a_grid_of_a_wave_is_that_wave():
    """0.5 m long, its cells 25 mm wide: height within 8 um of 10 mm, slope within 3e-3 of 0.13; contacts with it."""
    wave = {"wave.height": [0.01, 0.0], "wave.length": 0.5, "wave.heading": 0.3}
    side = 0.025 * (np.arange(120) - 59.5)
    x, y = (np.asarray(grid, np.float64) for grid in np.meshgrid(side, side))
    sampled = {"grid.number": enter_grid(wave_height(parameters_of(1, wave), x, y)), "grid.cell": 0.025}
    count, rng = 300, np.random.default_rng(12)
    centre = np.append(rng.uniform(-1.2, 1.2, (count, 2)), np.full((count, 1), RADIUS), axis=1)
    axle = turns(rng, count, np.pi, 0.2)[:, :, 1]
    of_wave, of_grid = (touches(parameters_of(count, floor), centre, axle)[0] for floor in (wave, sampled))
    assert np.abs(of_wave.depth - of_grid.depth).max() < 8e-6
    assert np.abs(columns(of_wave.normal, count) - columns(of_grid.normal, count)).max() < 3e-3


def test_the_sharpest_place_of_a_grid_is_found():
    """A dense search finds none sharper, and nearly as sharp ones."""
    side, small = np.linspace(-0.35, 0.35, 281), 1e-4
    weights = np.random.default_rng(13).uniform(0.0, 0.01, (6, 6))
    values = {"grid.number": maps.enter_map(weights), "grid.cell": 0.1}
    x, y = (grid.ravel() for grid in np.meshgrid(side, side))

    def bend(dx, dy):
        return [
            (_heights(values, x + dx, y + dy)[k] - _heights(values, x - dx, y - dy)[k]) / (2 * small) for k in (1, 2)
        ]  # fmt: skip

    (xx, xy), (_, yy) = bend(small, 0.0), bend(0.0, small)
    dense = (0.5 * np.abs(xx + yy) + np.hypot(0.5 * (xx - yy), xy)).max()
    sharpest = maps.sharpest(maps.enter_map(weights)) / 0.1**2
    assert 0.97 * sharpest < dense < 1.001 * sharpest
