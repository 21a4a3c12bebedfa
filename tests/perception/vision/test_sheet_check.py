"""One photograph of the sheets: stretch of the print, layout, swapped and wrong sheets; through the command too."""

import numpy as np
import pytest
from vision_studio import pose_of

from wlr_gym.cli import BAD_INPUT, FAILED, OK, main
from wlr_gym.perception.markers.camera import save_camera
from wlr_gym.perception.vision.sheets import check_sheets


@pytest.fixture(scope="module")
def photo(studio):
    return studio.frame(pose_of()).image


def changed(target, factors=(1.0, 1.0), codes=None):
    """The target with places multiplied by ``factors`` and other codes: the photograph shows it as the opposite."""
    places = (target.positions * (*factors, 1.0)).tolist()
    codes = codes or [marker.code for marker in target.markers]
    together = zip(target.markers, places, codes, strict=True)
    markers = tuple(m.model_copy(update={"position": tuple(place), "code": code}) for m, place, code in together)
    return target.model_copy(update={"markers": markers})


def test_right_sheets_are_right(studio, photo):
    body, floor = check_sheets(photo, studio.camera, [studio.body, studio.floor])
    assert body.warnings == floor.warnings == []
    assert body.stretch is not None
    assert abs(body.stretch[0] - body.stretch[1]) < max(0.001, 3 * body.difference_std)
    assert floor.stretch is None  # four prints
    assert floor.misfit < 0.5e-3


def test_a_print_stretched_one_way_is_measured_and_named(studio, photo):
    (found,) = check_sheets(photo, studio.camera, [changed(studio.body, (1.0, 0.99))])
    assert found.stretch is not None
    assert found.stretch[0] - found.stretch[1] == pytest.approx(-0.01, abs=0.002)
    assert "more along x than along y" in found.warnings[0]


def test_a_caliper_reading_makes_both_stretches_known(studio, photo):
    target = changed(studio.body, (0.995, 0.99)).model_copy(update={"caliper": 0.28})
    (found,) = check_sheets(photo, studio.camera, [target])
    assert found.stretch == pytest.approx([0.005, 0.01], abs=0.002)
    assert found.stretch_std is not None
    assert found.stretch_std[0] == pytest.approx(0.0002 / 0.28, rel=0.3)


def test_a_layout_beyond_its_tolerance_is_named(studio, photo):
    laid = changed(studio.floor, (1.008, 0.994))
    loose, strict = check_sheets(photo, studio.camera, [laid, laid.model_copy(update={"tolerance": 5e-4})])
    assert loose.misfit > 2e-3
    assert loose.warnings == []
    assert "measure the layout anew" in strict.warnings[0]


@pytest.mark.parametrize(
    ("codes", "message"),
    [
        (("floor", "floor_key", "floor", "floor"), "'a' and 'b'|'b' and 'a'"),
        (("body_key", "body", "body", "body"), None),  # the robot's markers where the floor's should be: too far apart
    ],
)
def test_swapped_and_wrong_sheets_are_named(studio, photo, codes, message):
    (found,) = check_sheets(photo, studio.camera, [changed(studio.floor, codes=codes)])
    assert found.fault
    if message:
        (fault,) = found.warnings
        assert "lie in each other's places" in fault
        assert any(part in fault for part in message.split("|"))


def test_a_photograph_of_other_sheets_says_so(studio):
    image = studio.frame(None).image  # no robot
    (found,) = check_sheets(image, studio.camera, [studio.body])
    assert "0 of the 4 markers of 'body' seen" in found.fault
    assert "1 floor_key" in found.fault


def test_the_command_prints_and_judges(studio, photo, tmp_path, capsys):
    import cv2

    camera, picture = tmp_path / "camera.yaml", tmp_path / "photo.png"
    save_camera(camera, studio.camera)
    cv2.imwrite(str(picture), photo)
    assert main(["vision", "check", str(picture), "--camera", str(camera)]) == OK
    assert "body: 4 of 4 markers" in capsys.readouterr().out
    cv2.imwrite(str(picture), np.full_like(photo, 128))
    assert main(["vision", "check", str(picture), "--camera", str(camera), "--only", "floor"]) == FAILED
    assert "0 of the 4 markers of 'floor' seen" in capsys.readouterr().out
    assert main(["vision", "check", str(tmp_path / "none.png"), "--camera", str(camera)]) == BAD_INPUT
