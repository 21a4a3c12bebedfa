"""The robot's parts: what they weigh against the robot file, their files, and whether they fit into each other."""

import importlib.util
import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.cli import main
from wlr_gym.robot import load_robot
from wlr_gym.robot.parts import INSERTS, Mass, Part, compare, make_kit, posed, together

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
    assert off == {"leg.mass", "leg.com_along_leg", "leg.inertia.x", "leg.inertia.y", "leg.inertia.z"}


#: mm: what must stay between two pieces that move against each other.
CLEARANCE = 1.0
#: What turns, by the piece it turns against.
ROLLING, SWINGING = {"wheel", "tyre"}, {"leg_arm", "wheel_servo"}


def test_nothing_is_in_the_way_of_anything(kit):
    """Over the legs' whole range, what moves keeps its distance, and no two other pieces overlap."""
    robot = load_robot("kit")
    for angle in np.linspace(*robot.leg_limits, 7):
        pieces = [piece for piece in posed(kit, robot, [angle] * 4) if piece[0] not in ("cables", "leg_screws")]
        for (one, a), (other, b) in itertools.combinations(pieces, 2):
            if apart(a, b):
                continue
            if group(one) != group(other):
                assert a.min_gap(b, 2 * CLEARANCE) >= CLEARANCE, f"{one} and {other} at {angle:.2f} rad"
            elif angle == robot.leg_limits[0]:
                assert (a ^ b).volume() < 1.0, f"{one} and {other} overlap"


def group(name):
    return 2 if name in ROLLING else 1 if name in SWINGING else 0


def apart(a, b):
    """Return whether the boxes around two solids are apart by the clearance."""
    first, second = np.reshape(a.bounding_box(), (2, 3)), np.reshape(b.bounding_box(), (2, 3))
    return (first[1] + CLEARANCE < second[0]).any() or (second[1] + CLEARANCE < first[0]).any()


def test_horns_are_where_the_robot_has_its_axles(kit):
    """Case, horn and arm stack up: the hip's horn carries the arm, the wheel's the boss, at the heights of the drawings."""
    robot = load_robot("kit")
    pieces = posed(kit, robot, [np.pi / 2] * 4)
    hip, arm, servo, wheel = (
        max(
            (np.reshape(solid.bounding_box(), (2, 3)) for name, solid in pieces if name == wanted),
            key=lambda found: found.sum(),
        )
        for wanted in ("hip_servo", "leg_arm", "wheel_servo", "wheel")
    )
    assert arm[0, 1] - hip[1, 1] == pytest.approx(2.6)
    assert wheel[0, 1] - servo[1, 1] == pytest.approx(2.0)
    assert wheel.mean(axis=0) == pytest.approx([175.0, 160.0, -135.0])
    assert hip[1, 0] - 13.75 == pytest.approx(175.0)
    assert servo[0, 2] + 11.25 == pytest.approx(-135.0)


def test_holes_are_those_of_the_servos(kit):
    """Centres and diameters against ROBOTIS's drawings: HN13-N101, XL-430's case and hub."""
    holes = {(round(x, 2), round(y, 2), round(d, 2)) for x, y, d in find(kit.leg, "leg_arm").sheet.holes}
    ring = {(round(-67.5 + 11 * np.cos(a), 2), round(11 * np.sin(a), 2), 2.7) for a in np.arange(8) * np.pi / 4}
    case = {(67.5 + u, v, 2.7) for u in (8.0, -32.0) for v in (11.0, -11.0)}
    assert holes == {(-67.5, 0.0, 10.2), (67.5, 0.0, 8.4), (-10.0, 0.0, 14.0)} | ring | case


def test_the_wheel_fits_its_horn(kit):
    """Four M2 on 16 mm with 5 mm of boss under each head, and room for the ring on the horn's face; nothing to fill inside."""
    wheel = find(kit.wheel, "wheel").solid
    for x, z in ((8, 0), (-8, 0), (0, 8), (0, -8)):
        assert (wheel ^ pin(2.0, 40.0).translate((x, 0, z))).volume() == pytest.approx(0.0, abs=0.1)
        head = pin(3.8, 15.0).translate((x, 2.5, z))
        assert (wheel ^ head).volume() == pytest.approx(0.0, abs=0.1)
        assert (wheel ^ pin(3.8, 5.0).translate((x, -7.5, z))).volume() > 20.0
    assert (wheel ^ pin(10.6, 2.4).translate((0, -10, 0))).volume() == pytest.approx(0.0, abs=0.1)
    assert (wheel ^ pin(20.5, 0.2).translate((0, -9.9, 0))).volume() > 20.0  # the horn bears on it
    assert wheel.genus() == 6 + 4


def pin(diameter, length):
    from manifold3d import Manifold

    return Manifold.cylinder(length, diameter / 2, circular_segments=48, center=True).rotate((90.0, 0.0, 0.0))


def find(parts, name):
    return next(part for part in parts if part.name == name)


def test_screws_reach_the_hip_servos_and_the_ballast(kit):
    """Each hip block takes eight screws into its servo and has inserts under the plates' holes; bars hang on two screws."""
    pieces = posed(kit, load_robot("kit"), [np.pi / 2] * 4)
    blocks = [solid for name, solid in pieces if name == "hip_block"]
    servos = [solid.bounding_box() for name, solid in pieces if name == "hip_servo"]
    plates = [find(kit.body, name) for name in ("body_plate_lower", "body_plate_upper")]
    drill = pin(2.5, 80.0).rotate((90.0, 0.0, 0.0))
    for block in blocks:
        low, high = np.reshape(block.bounding_box(), (2, 3))
        case = next(
            box for box in servos if low[0] < (box[0] + box[3]) / 2 < high[0] and low[1] < (box[1] + box[4]) / 2 < high[1]
        )
        x, y = (case[0] + case[3]) / 2, (case[1] + case[4]) / 2
        for dx, dy in ((9.5, 8.0), (9.5, -8.0), (-22.5, 8.0), (-22.5, -8.0)):
            assert (block ^ drill.translate((x + np.sign(x) * dx, y + np.sign(y) * dy, 0.0))).volume() < 0.1
        for plate in plates:
            inside = [hole for hole in plate.sheet.holes if low[0] < hole.x < high[0] and low[1] < hole.y < high[1]]
            for dx, dy in INSERTS:
                at = (x + np.sign(x) * dx, y + np.sign(y) * dy)
                assert any(hole[:2] == pytest.approx(at) for hole in inside)
                assert (block ^ drill.translate((*at, np.sign(plate.places[0][2]) * 60.0))).volume() < 0.1  # 13 mm deep
    bar, foot = find(kit.body, "ballast"), find(kit.body, "ballast_foot")
    for dx in (25.0, -25.0):
        at = (dx, bar.places[0][1], 0.0)
        assert any(hole[:2] == pytest.approx(at[:2], abs=0.05) for hole in plates[1].sheet.holes)
        assert (foot.solid ^ drill.translate((dx, 0.0, 0.0))).volume() < 0.1
        assert (bar.solid ^ drill.translate((dx, 0.0, 40.0))).volume() < 0.1
    assert bar.places[0][2] + bar.solid.bounding_box()[5] == pytest.approx(
        foot.places[0][2] + foot.solid.bounding_box()[2], abs=0.1
    )


def test_files(kit, tmp_path, capsys):
    code = main(["robot", "export", "kit", "--format", "parts", "--out", str(tmp_path), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert code == 0
    names = {path.name for path in tmp_path.iterdir()}
    assert {"body_plate_lower.dxf", "body_plate_upper.stl", "hip_block.stl", "leg_arm.dxf", "wheel.stl", "parts.csv"} <= names
    assert len(found["files"]) == len(names)
    raw = (tmp_path / "wheel.stl").read_bytes()
    corners = np.frombuffer(raw[84:], [("n", "<3f4"), ("c", "<(3,3)f4"), ("e", "<u2")])["c"].astype(float)
    wheel = next(part for part in kit.wheel if part.name == "wheel")
    assert np.linalg.det(corners).sum() / 6.0 == pytest.approx(wheel.solid.volume(), rel=1e-4)
    assert np.ptp(corners.reshape(-1, 3), axis=0) == pytest.approx([67.0, 20.0, 67.0], abs=0.1)
    drawn = list(ezdxf.readfile(tmp_path / "leg_arm.dxf").modelspace())  # type: ignore[attr-defined]
    assert [entity.dxftype() for entity in drawn] == ["LWPOLYLINE"] + ["CIRCLE"] * (9 + 4 + 2)
    assert drawn[0].closed
    points = np.array([point[:2] for point in drawn[0].get_points()])
    assert np.ptp(points, axis=0).max() == pytest.approx(167.0, abs=0.1)
    rows = [line.split(",") for line in (tmp_path / "parts.csv").read_text().splitlines()]
    assert {row[0]: row[1] for row in rows}["hip_block"] == "4"


def test_parts_that_differ_are_named(tmp_path, capsys):
    assert main(["robot", "export", "nominal", "--format", "parts", "--out", str(tmp_path)]) == 1
    text = capsys.readouterr().out
    assert [line.split()[0] for line in text.splitlines() if line.rstrip().endswith("differs")] == [
        "leg.mass",
        "leg.com_along_leg",
        "leg.inertia.x",
        "leg.inertia.y",
        "leg.inertia.z",
    ]


def test_a_body_too_light_for_its_parts():
    robot = load_robot("nominal")
    light = robot.model_copy(update={"body": robot.body.model_copy(update={"mass": 1.0})})
    with pytest.raises(InputError, match=r"the body's parts without ballast have 1\.\d+ kg.*expected less than 1\.000 kg"):
        make_kit(light)


def test_the_wiring_diagram_is_what_its_script_draws():
    spec = importlib.util.spec_from_file_location("kit_figures", Path(__file__).parents[2] / ".ci/docs/kit.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    assert (script.FIGURES / "wiring.svg").read_text() == script.wiring()
