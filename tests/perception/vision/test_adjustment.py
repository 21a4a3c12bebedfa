"""Bundle adjustment on circles that are projected point by point: places, shutter, sigmas; no pictures."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wlr_gym.base.errors import InputError
from wlr_gym.perception.markers.detection import Detection
from wlr_gym.perception.markers.targets import load_target, ring_radii
from wlr_gym.perception.vision.adjustment import TargetView, _circles, adjust, at_frame_time, whitened

FOCAL, HEIGHT = 800.0, 720
NOISE = 0.015 / FOCAL  # of a circle's centre


def ellipse_centre(place, radius, rotation, position, lag=0.0, velocity=None):
    """Centre of the conic through 12 projected points of the circle, each at the circle's own time."""
    angles = np.linspace(0, 2 * math.pi, 12, endpoint=False)
    points = place + radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(12)])
    seen = points @ rotation.T + position
    if velocity is not None:
        seen = seen + lag * (velocity[3:] + np.cross(velocity[:3], place @ rotation.T))
    x, y = (seen[:, :2] / seen[:, 2:]).T
    middle = np.array([x.mean(), y.mean()])
    x, y = (x - middle[0]) / radius, (y - middle[1]) / radius
    a, b, c, d, e = np.linalg.lstsq(np.column_stack([x * x, x * y, y * y, x, y]), np.ones(12), rcond=None)[0]
    return middle + radius * np.linalg.solve([[2 * a, b], [b, 2 * c]], [-d, -e])


def film(target, places, count=40, readout=0.0, seed=0, noise=NOISE):
    """Views of a target at ``places`` that drives and turns under a camera 1.8 m above it."""
    rng, views = np.random.default_rng(seed), []
    for k in range(count):
        yaw, x, y = 0.03 * k, -0.3 + 0.01 * k, 0.15 * math.sin(0.1 * k)
        rotation = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler("zy", [yaw, 0.05 * math.sin(0.3 * k)]).as_matrix()
        position = np.array([x, y, 1.8 + 0.03 * math.sin(0.2 * k)])
        velocity = np.array([0.0, 0.0, -0.9, 0.3, 0.15, 0.0])
        seen = {}
        for m, marker in enumerate(target.markers):
            middle = rotation @ places[m] + position
            row = 0.5 * HEIGHT + FOCAL * middle[1] / middle[2]
            lag = readout * (row / HEIGHT - 0.5)
            shares = ring_radii(int(target.codes[m]))
            centres = [ellipse_centre(places[m], s * marker.radius, rotation, position, lag, velocity) for s in shares]
            ellipse = np.array([0.0, row, 1, 0, 0, 1])
            centres = np.array(centres) + noise * rng.standard_normal((3, 2))
            spread = np.tile(NOISE**2 * np.eye(2), (3, 1, 1))
            seen[m] = Detection(int(target.codes[m]), ellipse, centres, spread, ellipse, 200.0, 0.1, 1.0)
        guess = Rotation.from_rotvec(0.003 * rng.standard_normal(3)).as_matrix() @ rotation
        views.append(TargetView(seen, guess, position + 0.003 * rng.standard_normal(3), velocity))
    return views


@pytest.fixture(scope="module")
def body():
    return load_target("body").model_copy(update={"tolerance": 0.001})


def test_the_model_is_the_projected_circle_and_its_jacobian_is_right(body):
    views = film(body, body.positions, 3, 0.02, noise=0.0)
    circles = _circles(body, views, HEIGHT)
    rotations, positions = np.stack([v.rotation for v in views]), np.stack([v.position for v in views])
    shared = np.append(body.positions.ravel(), 0.02)
    residual, by_pose, by_shared = whitened(circles, rotations, positions, shared)
    step = 1e-6
    for k in range(len(shared)):
        moved = whitened(circles, rotations, positions, shared + step * (np.arange(len(shared)) == k))[0]
        assert (moved - residual) / step == pytest.approx(by_shared[..., k], rel=1e-4, abs=1e-2 * np.abs(by_shared).max() / 1e3)
    for k in range(6):
        turn, shift = step * (np.arange(3) == k), step * (np.arange(3, 6) == k)
        turned = np.stack([Rotation.from_rotvec(turn).as_matrix() @ r for r in rotations])
        moved = whitened(circles, turned, positions + shift, shared)[0]
        assert (moved - residual) / step == pytest.approx(by_pose[..., k], rel=1e-4, abs=1e-5 * np.abs(by_pose).max())


def shape_error(found, places):
    """Largest distance (m) in the plane after the best similarity: what a film can tell."""
    a, b = (p[:, 0] + 1j * p[:, 1] for p in (found - found.mean(axis=0), places - places.mean(axis=0)))
    return np.abs(a * (np.vdot(a, b) / np.vdot(a, a)) - b).max()


def test_places_and_readout_come_out_of_the_film_and_sigmas_hold(body):
    errors, shutters, scales = [], [], []
    for seed in range(6):
        places = body.positions + 0.001 * np.random.default_rng(100 + seed).standard_normal((4, 3)) * (1, 1, 0)
        found = adjust(body, film(body, places, readout=0.02, seed=seed), HEIGHT, None)
        assert shape_error(found.target.positions, places) < 0.05e-3
        shutters.append((found.readout - 0.02) / found.readout_std)
        difference = (found.target.positions - places).ravel()
        errors.append(difference @ np.linalg.solve(found.covariance, difference) / 12)
        scales.append(found.scale_std)
    assert 0.3 < np.sqrt(np.mean(np.square(shutters))) < 1.8
    assert 0.4 < np.sqrt(np.mean(errors)) < 1.6
    assert scales == pytest.approx([0.001 / np.linalg.norm(body.positions[:, :2])] * 6, rel=0.05)  # a film cannot tell it


def test_a_stretched_print_needs_one_caliper_reading(body):
    """The stretch across comes from the film; that along both axes from the reading."""
    printed = body.model_copy(update={"tolerance": 1e-4, "stretch": 0.005})
    places = body.positions * (1.002, 1.005, 1)
    views = film(body, places)
    without = adjust(printed, views, HEIGHT, 0.0)
    first, second = body.long_side
    measured = printed.model_copy(update={"caliper": float(np.linalg.norm(places[first] - places[second]))})
    found = adjust(measured, views, HEIGHT, 0.0)
    spans = np.ptp(found.target.positions, axis=0)[:2] / np.ptp(places, axis=0)[:2]
    assert spans == pytest.approx([1, 1], abs=5e-4)
    assert without.scale_std > 3e-3 > 4 * found.scale_std
    assert shape_error(without.target.positions, places) < 0.05e-3


def test_a_marker_is_put_back_to_the_frames_time(body):
    view = film(body, body.positions, 1, 0.02, noise=0.0)[0]
    still = film(body, body.positions, 1, 0.0, noise=0.0)[0]
    back = at_frame_time(view, body, HEIGHT, 0.02)
    for index, seen in still.seen.items():
        assert np.abs(view.seen[index].centres - seen.centres).max() > 1e-4
        assert np.abs(back[index].centres - seen.centres).max() < 1e-5


def test_a_wrong_caliper_reading_is_refused(tmp_path):
    text = "name: b\ncaliper: 0.2\nmarkers:\n" + "".join(
        f"  - {{name: {n}, position: [{x}, {y}, 0.04], radius: 0.03, code: {c}}}\n"
        for n, x, y, c in (
            ("a", 0.14, 0.1, "body_key"),
            ("b", 0.14, -0.1, "body"),
            ("c", -0.14, 0.1, "body"),
            ("d", -0.14, -0.1, "body"),
        )
    )
    (tmp_path / "b.yaml").write_text(text)
    with pytest.raises(InputError, match=r"caliper 0.2: expected about 0.28 \(m, between a and c\)"):
        load_target(tmp_path / "b.yaml")
