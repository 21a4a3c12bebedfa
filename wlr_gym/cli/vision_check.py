"""Check print and layout of the marker sheets from one photograph: which are there, stretch of the print, what misfits."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.cli import FAILED, OK
from wlr_gym.cli.options import JsonOption
from wlr_gym.cli.results import print_json

if TYPE_CHECKING:
    from wlr_gym.perception.vision.sheets import SheetCheck


@dataclass(frozen=True)
class VisionCheckOptions(JsonOption):
    """Sheets in one photograph.

    Attributes:
        photo: picture, taken by the calibrated camera, focus and size as in the calibration.
        camera: calibration file; make one with: wlr calibrate camera.
        markers: markers on the robot: name in configs/vision/ or path.
        floor: markers on the floor: name in configs/vision/ or path.
        only: which of them the photograph shows, when it is one: markers or floor.
    """

    photo: Annotated[Path, tyro.conf.Positional]
    camera: Path
    markers: str = "body"
    floor: str = "floor"
    only: str | None = None


def run(options: VisionCheckOptions) -> int:
    """Check and print; 0 when everything fits.

    Raises:
        InputError: unreadable photograph, camera or target; wrong image size.
    """
    require_package("cv2", "vision")

    from wlr_gym.perception.vision import load_camera, load_target
    from wlr_gym.perception.vision.sheets import check_sheets
    from wlr_gym.perception.vision.video import read_image

    if options.only not in (None, "markers", "floor"):
        raise InputError(f"--only {options.only}: expected markers or floor")
    files = {"markers": options.markers, "floor": options.floor}
    targets = [load_target(file) for name, file in files.items() if options.only in (None, name)]
    camera = load_camera(options.camera)
    image = read_image(options.photo) if options.photo.is_file() else None
    if image is None:
        raise InputError(f"{options.photo}: no such picture, or it cannot be read as one")
    checks = check_sheets(image, camera, targets)
    if options.json:
        print_json([_content(check) for check in checks])
    for check in checks:
        print(_line(check))
        print("".join(f"  {warning}\n" for warning in check.warnings), end="")
    return FAILED if any(check.warnings for check in checks) else OK


def _content(check: SheetCheck) -> dict[str, object]:
    """Return a check as JSON has it: m, shares."""
    names = ("seen", "fault", "stretch", "stretch_std", "difference_std", "misfit", "warnings")
    return {"target": check.target.name, "markers": len(check.target.markers), **{name: getattr(check, name) for name in names}}


def _line(check: SheetCheck) -> str:
    head = f"{check.target.name}: {check.seen} of {len(check.target.markers)} markers"
    if check.fault:
        return f"{head}; not found"
    text = f"{head}, off their places by {1e3 * check.misfit:.2f} mm rms (as far as one photograph shows it)"
    if check.stretch is None or check.stretch_std is None:
        return text
    (x, y), (x_std, y_std) = 100 * check.stretch, 100 * check.stretch_std
    if check.target.caliper is None:
        return (
            f"{text}; x stretched by {x - y:+.2f} ± {100 * check.difference_std:.2f} % more than y (the scale itself needs a "
            "caliper reading in the target file)"
        )
    return f"{text}; stretched by {x:+.2f} ± {x_std:.2f} % along x, {y:+.2f} ± {y_std:.2f} % along y"
