"""The robot's parts: what they weigh against the robot file, their files, and whether they fit into each other."""

import itertools
import json

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.cli import main
from wlr_gym.robot import load_robot
from wlr_gym.robot.parts import Mass, Part, compare, make_kit, posed, together

pytest.importorskip("manifold3d")
ezdxf = pytest.importorskip("ezdxf")


@pytest.fixture(scope="module")
def kit():
    return make_kit(load_robot("nominal"))


def test_masses_of_known_shapes():
    from manifold3d import Manifold

    box = Part("box", "", Manifold.cube((100.0, 200.0, 300.0), True), 1000.0, ((0.0, 0.0, 50.0), (0.0, 0.0, -50.0)))
    found = box.properties()
    assert found.mass == pytest.approx(12.0)
    np.testing.assert_allclose(found.centre, 0.0, atol=1e-9)
    side = 12.0 / 12.0 * (0.2**2 + 0.3**2) + 12.0 * 0.05**2
    assert found.inertia[0, 0] == pytest.approx(side, rel=1e-6)
    np.testing.assert_allclose(found.spread, [12 * 0.01 / 12, 12 * 0.04 / 12, 12 * (0.09 / 12 + 0.0025)], rtol=1e-6)
    pair = together([Mass(1.0, np.array([1.0, 0, 0]), np.zeros((3, 3))), Mass(3.0, np.array([-1.0, 0, 0]), np.zeros((3, 3)))])
    np.testing.assert_allclose(pair.centre, [-0.5, 0, 0])
    np.testing.assert_allclose(np.diag(pair.inertia), [0.0, 3.0, 3.0])


def test_what_is_built_is_the_robot_that_is_simulated(kit):
    """Robot file ``kit`` has the parts' numbers, all of them; ``nominal`` has all but those of the legs, as the docs say."""
    assert [line.name for line in compare(load_robot("kit"), kit) if not line.fits] == []
    off = {line.name for line in compare(load_robot("nominal"), kit) if not line.fits}
    assert off == {"leg.mass", "leg.com_along_leg", "leg.inertia.x", "leg.inertia.z"}


def test_nothing_is_in_the_way_of_anything(kit):
    """No two pieces share room, over the legs' whole range: servos in their blocks, legs past the body, wheels past all."""
    robot = load_robot("nominal")
    for angle in np.linspace(*robot.leg_limits, 7):
        pieces = [piece for piece in posed(kit, robot, [angle] * 4) if piece[0] not in ("cables", "leg_screws")]
        moving = {part.name for part in (*kit.leg, *kit.wheel)}
        for (one, a), (other, b) in itertools.combinations(pieces, 2):
            if {one, other} & moving or angle == robot.leg_limits[0]:
                shared = 0.0 if apart(a, b) else (a ^ b).volume()
                assert shared < 60.0, f"{one} and {other} at {angle:.2f} rad share {shared:.0f} mm3"


def apart(a, b):
    """Return whether the boxes around two solids are apart."""
    first, second = np.reshape(a.bounding_box(), (2, 3)), np.reshape(b.bounding_box(), (2, 3))
    return (first[1] < second[0]).any() or (second[1] < first[0]).any()


def test_files(kit, tmp_path, capsys):
    code = main(["robot", "export", "kit", "--format", "parts", "--out", str(tmp_path), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert code == 0
    names = {path.name for path in tmp_path.iterdir()}
    assert {"body_plate.dxf", "body_plate.stl", "hip_block.stl", "leg_arm.dxf", "wheel.stl", "parts.csv"} <= names
    assert len(found["files"]) == len(names)
    raw = (tmp_path / "wheel.stl").read_bytes()
    corners = np.frombuffer(raw[84:], [("n", "<3f4"), ("c", "<(3,3)f4"), ("e", "<u2")])["c"].astype(float)
    wheel = next(part for part in kit.wheel if part.name == "wheel")
    assert np.linalg.det(corners).sum() / 6.0 == pytest.approx(wheel.solid.volume(), rel=1e-4)
    assert np.ptp(corners.reshape(-1, 3), axis=0) == pytest.approx([67.0, 20.0, 67.0], abs=0.1)
    outlines = list(ezdxf.readfile(tmp_path / "leg_arm.dxf").modelspace())  # type: ignore[attr-defined]
    assert len(outlines) == 1 + 8 + 4 + 2
    assert all(outline.closed for outline in outlines)
    points = np.array([point[:2] for point in outlines[0].get_points()])
    assert np.ptp(points, axis=0).max() == pytest.approx(163.0, abs=0.1)


def test_parts_that_differ_are_named(tmp_path, capsys):
    assert main(["robot", "export", "nominal", "--format", "parts", "--out", str(tmp_path)]) == 1
    text = capsys.readouterr().out
    assert [line.split()[0] for line in text.splitlines() if line.rstrip().endswith("differs")] == [
        "leg.mass",
        "leg.com_along_leg",
        "leg.inertia.x",
        "leg.inertia.z",
    ]


def test_a_body_too_light_for_its_parts():
    robot = load_robot("nominal")
    light = robot.model_copy(update={"body": robot.body.model_copy(update={"mass": 1.0})})
    with pytest.raises(InputError, match=r"the body's parts without ballast have 1\.\d+ kg.*expected less than 1\.000 kg"):
        make_kit(light)
