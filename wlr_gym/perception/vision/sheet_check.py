"""Check print and layout of the marker sheets from one photograph.

The camera's calibration makes tilt and distance known, so four markers in a plane leave two things that a photograph shows: how
much more the print is stretched along x than along y, and how far the layout is out of square. Its scale needs a caliper.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.detection import Detection, Image, detect
from wlr_gym.perception.markers.pose import FLOOR_TOLERANCE, find_laid_target
from wlr_gym.perception.markers.sheet_fault import sheet_fault
from wlr_gym.perception.markers.targets import Target
from wlr_gym.perception.vision.adjustment import TargetView, adjust
from wlr_gym.perception.vision.sheets import target_pages
from wlr_gym.perception.vision.tracking import check_size, seen_at

Array = NDArray[np.float64]

#: 1 sigma of a print's stretch before the photograph is looked at, where the target file states none.
_STRETCH = 0.01
#: m, 1 sigma of a marker's place on a sheet, stretch apart.
_PRINT = 0.0001
#: A print that is stretched by less is right.
_RIGHT = 0.001
#: Sigmas from which on something is worth a warning.
_FAR = 3.0


@dataclass(frozen=True, eq=False)
class SheetCheck:
    """What a photograph says about one target.

    Attributes:
        target: as its file has it. seen: number of its markers. fault: why it was not found; empty = found.
        stretch, stretch_std: (2,) along x and y of a target that is one print, and 1 sigma; None = separate sheets.
        difference_std: 1 sigma of the difference of the two.
        misfit: m, rms by which the markers miss the places in the file, as far as a photograph shows it.
    """

    target: Target
    seen: int
    fault: str = ""
    stretch: Array | None = None
    stretch_std: Array | None = None
    difference_std: float = 0.0
    misfit: float = 0.0

    @property
    def warnings(self) -> tuple[str, ...]:
        """What should be corrected before anything is measured."""
        return (self.fault,) if self.fault else tuple(self._warnings())

    def _warnings(self) -> Iterator[str]:
        target = self.target
        if self.stretch is not None and self.stretch_std is not None:
            x, y = self.stretch
            stated = math.hypot(target.stretch, _RIGHT)
            if abs(x - y) > _FAR * math.hypot(stated, self.difference_std):
                yield (
                    f"'{target.name}' is stretched by {100 * (x - y):+.2f} % more along x than along y: print it anew, or "
                    "state stretch and caliper in its file"
                )
            if target.caliper is not None and abs(x) > _FAR * math.hypot(stated, self.stretch_std[0]):
                yield f"'{target.name}' is stretched by {100 * x:+.2f} % along x: was it printed at 100 %?"
        elif self.misfit > _FAR * target.slack:
            yield (
                f"markers of '{target.name}' miss the places in its file by {1e3 * self.misfit:.1f} mm rms: more than its "
                f"tolerance ({1e3 * target.tolerance:g} mm); measure the layout anew"
            )


def check_sheets(image: Image, camera: Camera, targets: Sequence[Target]) -> list[SheetCheck]:
    """Check the targets in one photograph.

    Args:
        image: (H, W) grey. camera: its lens. targets: that should be in it.

    Raises:
        InputError: an image of another size than the camera was calibrated for.
    """
    check_size(image, camera, "photograph")
    detections = detect(image, camera)
    return [_checked(image, camera, target, detections) for target in targets]


def _checked(image: Image, camera: Camera, target: Target, detections: Sequence[Detection]) -> SheetCheck:
    found = find_laid_target(detections, target.model_copy(update={"tolerance": FLOOR_TOLERANCE}), camera)
    if found is None:
        own = sum(detection.code in target.codes for detection in detections)
        return SheetCheck(target, own, sheet_fault(detections, target, camera))
    seen = seen_at(image, target, camera.values, found.rotation, found.position)
    misfit = found.residual * float(found.position[2]) / camera.focal[0]
    if len(target_pages(target)) > 1:
        return SheetCheck(target, len(seen), misfit=misfit)
    view = TargetView(seen, found.rotation, found.position, np.zeros(6))
    printed = target.model_copy(update={"stretch": max(target.stretch, _STRETCH), "tolerance": min(target.tolerance, _PRINT)})
    result = adjust(printed, [view], camera.height, 0.0)
    # stretch is what the affine map from the drawn places to those found has on its diagonal
    solve = np.linalg.pinv(np.column_stack([np.ones(len(target.markers)), target.positions[:, :2]]))[1:]
    stretch = np.diag(solve @ result.target.positions[:, :2]) - 1
    rows = np.zeros((2, len(target.markers), 3))
    rows[0, :, 0], rows[1, :, 1] = solve
    spread = rows.reshape(2, -1) @ result.covariance @ rows.reshape(2, -1).T
    difference = math.sqrt(float(spread[0, 0] + spread[1, 1] - 2 * spread[0, 1]))
    return SheetCheck(target, len(seen), "", stretch, np.sqrt(np.diag(spread)), difference, misfit)
