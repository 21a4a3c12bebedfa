"""Every fault of the camera in every phase of a run: nothing stops the robot, no wrong pose is believed for more than 0.2 s."""

import pytest

pytest.importorskip("cv2")
pytest.importorskip("dynamixel_sdk")

from camera_rig import FORWARD, STAND, TURN, CameraRig

from wlr_gym.hardware.camera.reading import CAMERA_FAULTS
from wlr_gym.hardware.emulator import FAULTS
from wlr_gym.hardware.safety.camera import BACKWARD, CONTRADICTIONS, SETTLING, STALLED, TOO_OLD
from wlr_gym.perception.vision.tracking import DARK, FROZEN, GLARE, IMPOSSIBLE, LOST, MEANINGS, MOVED, NO_FLOOR

#: s for which a wrong pose may be believed.
BOUND = 0.2
#: s of the phases, and of the pause after each, in which the camera is well.
PHASE, PAUSE = 0.6, 0.4
ENDED = "the camera process has ended (exit code -9)"
NOT_SEEN = (MEANINGS[LOST], MEANINGS[IMPOSSIBLE], MEANINGS[NO_FLOOR], MEANINGS[MOVED])
#: Fault -> reasons one of which is given while it lasts; empty = poses may well go on.
EXPECTED: dict[str, tuple[str, ...]] = {
    "camera_covered": (MEANINGS[DARK],),
    "camera_frozen": (MEANINGS[FROZEN],),
    "camera_stalled": (STALLED,),
    "camera_dead": (ENDED,),
    "camera_moved": (),
    "camera_sheet": NOT_SEEN,
    "camera_back_to_front": (),
    "camera_mirrored": NOT_SEEN,
    "camera_rotated": (),
    "camera_stamps": (),
    "camera_late": (),
    "camera_lag": (),
    "camera_glare": (MEANINGS[GLARE], *NOT_SEEN),
    "camera_blurred": (),
    "camera_decoy": (),
}
#: The same where it is otherwise in mid-run. Robot and floor are nearly their own mirror image in the picture's middle.
STRIKING: dict[str, tuple[str, ...]] = {
    "camera_mirrored": (),
    "camera_moved": NOT_SEEN,
    "camera_rotated": (*NOT_SEEN, *CONTRADICTIONS),
    "camera_late value=2": (TOO_OLD,),
    "camera_lag": (*CONTRADICTIONS, SETTLING, BACKWARD),
}


def test_the_table_has_every_fault():
    assert set(EXPECTED) == set(CAMERA_FAULTS) <= set(FAULTS)


def check(rig: CameraRig) -> None:
    rig.loop.stop()
    assert rig.loop.reason == "end"
    assert rig.loop.ended_well
    assert rig.longest_wrong() <= BOUND, rig.errors()


@pytest.mark.slow
@pytest.mark.parametrize("fault", EXPECTED)
def test_before_the_start(fault):
    rig = CameraRig(tick=0.004)
    rig.machine.inject(fault)
    rig.start(0.1, STAND)
    rig.drive(0.7, FORWARD)
    if EXPECTED[fault]:
        assert set(rig.reasons[-20:]) <= set(EXPECTED[fault])
    check(rig)


@pytest.mark.slow
@pytest.mark.parametrize("fault", [*EXPECTED, "camera_late value=2"])
def test_while_it_stands_drives_and_turns(fault):
    rig = CameraRig(tick=0.004)
    rig.start(0.2, STAND)
    expected = STRIKING.get(fault, EXPECTED.get(fault, ()))
    for setpoints in (STAND, FORWARD, TURN):
        rig.drive(PAUSE, setpoints)
        rig.machine.inject(f"{fault} duration={PHASE}")
        before = len(rig.reasons)
        rig.drive(PHASE, setpoints)
        if expected and not (fault == "camera_lag" and setpoints is STAND):
            assert set(rig.reasons[before:]) & set(expected), (setpoints, set(rig.reasons[before:]))
    check(rig)
