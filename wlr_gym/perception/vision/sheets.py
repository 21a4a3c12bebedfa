"""Sheets to print at 100 %, and their check from one photograph.

The robot's markers, one page per floor marker, the calibration board: SVG and PDF, to scale. Every page has a ruler of 100 mm:
a printer that scales shows there.

The camera's calibration makes tilt and distance known, so four markers in a plane leave two things that a photograph shows: how
much more the print is stretched along x than along y, and how far the layout is out of square. Its scale needs a caliper.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.files import replace_file
from wlr_gym.perception.markers.calibration import Board
from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.detection import Detection, Image, detect
from wlr_gym.perception.markers.pose import FLOOR_TOLERANCE, find_laid_target, sheet_fault
from wlr_gym.perception.markers.targets import QUIET_ZONE, Target, ring_radii
from wlr_gym.perception.vision.adjustment import TargetView, adjust
from wlr_gym.perception.vision.tracking import check_size, seen_at

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

# Landscape, mm.
A4 = (297.0, 210.0)
A3 = (420.0, 297.0)
_MARGIN = 8.0  # mm that printers leave white
_INCH = 25.4  # mm


def target_pages(target: Target) -> dict[str, Figure]:
    """Name -> page: all markers on one when they fit on A3, else one A4 page per marker."""
    positions, codes = 1000 * target.positions[:, :2], target.codes.tolist()
    if _is_one_print(target):
        page, axes = _new_page(A3, f"{target.name} markers", 0.32 * A3[0])
        middle = 0.5 * (positions.max(axis=0) + positions.min(axis=0))
        x, y = A3[0] / 2 - middle[0], A3[1] / 2 + middle[1]  # of the target's origin
        for radius, code, place in zip(target.radii, codes, positions, strict=True):
            _draw_marker(axes, x + place[0], y - place[1], radius, code)
        _draw_box(axes, x - 15, y - 0.1, 30, 0.2, 0.6)
        _draw_box(axes, x - 0.1, y - 15, 0.2, 30, 0.6)
        _write(axes, x + 18, y + 2, 6, "x, front \u2192")
        _write(axes, x + 2, y - 17, 4, f"origin of the {target.name}")
        return {f"{target.name}_markers": page}
    pages = {}
    for marker, code in zip(target.markers, codes, strict=True):
        place = ", ".join(f"{value:g}" for value in marker.position[:2])
        page, axes = _new_page(A4, f"{target.name} marker '{marker.name}', centre at ({place}) m")
        x, y, reach = A4[0] / 2, A4[1] / 2 - 8, 1000 * QUIET_ZONE * marker.radius + 4
        _draw_marker(axes, x, y, marker.radius, code)
        for side in (-1, 1):  # ticks to align the sheet by
            _draw_box(axes, x + side * reach - 4, y - 0.1, 8, 0.2)
            _draw_box(axes, x - 0.1, y + side * reach - 4, 0.2, 8)
        pages[f"{target.name}_marker_{marker.name}"] = page
    return pages


def board_page(board: Board) -> Figure:
    """The calibration board on the smallest of A4 and A3 that takes it."""
    width, height = 1000 * board.square * board.columns, 1000 * board.square * board.rows
    size = A4 if width < A4[0] - 2 * _MARGIN and height < A4[1] - 35 else A3
    left, top = (size[0] - width) / 2, (size[1] - height) / 2 - 4
    page, axes = _new_page(size, f"calibration board, {board.columns} x {board.rows} squares of {1000 * board.square:g} mm")
    module = 50 * board.square  # a square is twenty half modules of its marker, so that all edges are whole
    pixels = board.aruco().generateImage((20 * board.columns, 20 * board.rows), marginSize=0, borderBits=1)
    for x, y, across, down in _black_boxes(pixels < 128):
        _draw_box(axes, left + x * module, top + y * module, across * module, down * module)
    return page


def write_pages(folder: Path, name: str, pages: Mapping[str, Figure]) -> list[Path]:
    """Write ``name``.pdf with all pages, and one SVG per page by its name; return the paths."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_pdf import PdfPages

    def write_pdf(path: Path) -> None:
        with PdfPages(path, metadata={"CreationDate": None}) as file:
            for page in pages.values():
                file.savefig(page)

    paths = [folder / f"{name}.pdf", *(folder / f"{page}.svg" for page in pages)]
    replace_file(paths[0], write_pdf)
    for path, (own, page) in zip(paths[1:], pages.items(), strict=True):
        with rc_context({"svg.hashsalt": own}):  # else every writing names its parts anew
            replace_file(path, lambda part, page=page: page.savefig(part, format="svg", metadata={"Date": None}))
    return paths


def _is_one_print(target: Target) -> bool:
    """Whether the markers fit on one page of A3."""
    reach = 1000 * QUIET_ZONE * target.radii.max()
    return bool(np.all(1000 * np.ptp(target.positions[:, :2], axis=0) + 2 * reach < np.array(A3) - _MARGIN))


def _new_page(size: tuple[float, float], words: str, left: float = 2 * _MARGIN) -> tuple[Figure, Axes]:
    """A page with its ruler; a unit of its axes is 1 mm, x right, y down from the upper left corner."""
    from matplotlib.figure import Figure

    width, height = size
    page = Figure((width / _INCH, height / _INCH), facecolor="white")
    axes = page.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.set_axis_off()
    y = height - _MARGIN - 2
    _draw_box(axes, left, y, 100, 0.3)
    for k in range(11):
        length = 4 if k % 5 == 0 else 2
        _draw_box(axes, left + 10 * k - 0.1, y - length, 0.2, length)
    _write(axes, left, y - 6, 3.5, f"100 mm: measure it. {words}. Print at 100 %, not fitted to the page.")
    return page, axes


def _draw_marker(axes: Axes, x: float, y: float, radius: float, code: int) -> None:
    from matplotlib.patches import Circle

    for share, colour in zip(ring_radii(code), ("black", "white", "black"), strict=True):
        axes.add_patch(Circle((x, y), 1000 * radius * share, color=colour, linewidth=0))


def _draw_box(axes: Axes, x: float, y: float, width: float, height: float, shade: float = 0.0) -> None:
    from matplotlib.patches import Rectangle

    axes.add_patch(Rectangle((x, y), width, height, color=str(shade), linewidth=0))


def _write(axes: Axes, x: float, y: float, height: float, words: str) -> None:
    axes.text(x, y, words, fontsize=72 / _INCH * height)


def _black_boxes(black: NDArray[np.bool_]) -> list[tuple[int, int, int, int]]:
    """Cover black pixels with rectangles (x, y, width, height): runs along rows, joined downwards where they are equal."""
    boxes: list[tuple[int, int, int, int]] = []
    growing: dict[tuple[int, int], int] = {}  # run -> the row in which it began
    for y, row in enumerate([*black, np.zeros(black.shape[1], bool)]):
        edges = np.flatnonzero(np.diff(row.astype(int), prepend=0, append=0)).tolist()
        runs = set(zip(edges[::2], edges[1::2], strict=True))
        for start, stop in growing.keys() - runs:
            top = growing.pop((start, stop))
            boxes.append((start, top, stop - start, y - top))
        for run in runs:
            growing.setdefault(run, y)
    return sorted(boxes)


# --- check of a photograph --------------------------------------------------------------------------------------------


#: 1 sigma of a print's stretch before the photograph is looked at, where the target file states none.
_STRETCH = 0.01
_PRINT = 0.0001  # m, 1 sigma of a marker's place on a sheet, stretch apart
_RIGHT = 0.001  # a print that is stretched by less is right
_FAR = 3.0  # sigmas from which on something is worth a warning


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
    def warnings(self) -> list[str]:
        """What should be corrected before anything is measured."""
        if self.fault:
            return [self.fault]
        target, found = self.target, []
        if self.stretch is not None and self.stretch_std is not None:
            x, y = self.stretch
            stated = math.hypot(target.stretch, _RIGHT)
            if abs(x - y) > _FAR * math.hypot(stated, self.difference_std):
                found.append(
                    f"'{target.name}' is stretched by {100 * (x - y):+.2f} % more along x than along y: print it anew, or "
                    "state stretch and caliper in its file"
                )
            if target.caliper is not None and abs(x) > _FAR * math.hypot(stated, self.stretch_std[0]):
                found.append(f"'{target.name}' is stretched by {100 * x:+.2f} % along x: was it printed at 100 %?")
        elif self.misfit > _FAR * target.slack:
            found.append(
                f"markers of '{target.name}' miss the places in its file by {1e3 * self.misfit:.1f} mm rms: more than its "
                f"tolerance ({1e3 * target.tolerance:g} mm); measure the layout anew"
            )
        return found


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
    if not _is_one_print(target):
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
