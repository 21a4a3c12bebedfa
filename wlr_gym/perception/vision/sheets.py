"""Sheets to print at 100 %, and their check from one photograph.

The robot's markers, one page per floor marker, the calibration board: SVG and PDF, to scale. A page is a list of shapes in
millimetres, x right, y down from its upper left corner. Every page has a ruler of 100 mm: a printer that scales shows there.

The camera's calibration makes tilt and distance known, so four markers in a plane leave two things that a photograph shows: how
much more the print is stretched along x than along y, and how far the layout is out of square. Its scale needs a caliper.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
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
from wlr_gym.perception.markers.targets import QUIET_ZONE, Marker, Target, ring_radii
from wlr_gym.perception.vision.adjustment import TargetView, adjust
from wlr_gym.perception.vision.tracking import check_size, seen_at

# Landscape, mm.
A4 = (297.0, 210.0)
A3 = (420.0, 297.0)
# Shade: 0 black to 1 white.
_BLACK = 0.0
_GREY = 0.6
_MARGIN = 8.0  # mm that printers leave white
_INCH = 25.4  # mm


@dataclass(frozen=True)
class Disc:
    """A filled circle: centre and radius (mm), shade 0 black to 1 white."""

    x: float
    y: float
    radius: float
    shade: float = _BLACK


@dataclass(frozen=True)
class Box:
    """A filled rectangle: upper left corner and size (mm)."""

    x: float
    y: float
    width: float
    height: float
    shade: float = _BLACK


@dataclass(frozen=True)
class Text:
    """A line of text that starts at (x, y), height in mm."""

    x: float
    y: float
    height: float
    words: str


Shape = Disc | Box | Text


@dataclass(frozen=True)
class Page:
    """A page: name, size (mm), shapes, drawn in order."""

    name: str
    size: tuple[float, float]
    shapes: tuple[Shape, ...]


def target_pages(target: Target) -> list[Page]:
    """All markers on one page when they fit on A3, else one A4 page per marker."""
    positions, reach = 1000 * target.positions[:, :2], 1000 * QUIET_ZONE * target.radii.max()
    if np.all(np.ptp(positions, axis=0) + 2 * reach < np.array(A3) - _MARGIN):
        return [_together(target, positions)]
    return [_alone(target, marker) for marker in target.markers]


def board_page(board: Board) -> Page:
    """The calibration board on the smallest of A4 and A3 that takes it."""
    width, height = 1000 * board.square * board.columns, 1000 * board.square * board.rows
    size = A4 if width < A4[0] - 2 * _MARGIN and height < A4[1] - 35 else A3
    left, top = (size[0] - width) / 2, (size[1] - height) / 2 - 4
    module = 50 * board.square  # a square is twenty half modules of its marker, so that all edges are whole
    pixels = board.aruco().generateImage((20 * board.columns, 20 * board.rows), marginSize=0, borderBits=1)
    shapes = [Box(left + x * module, top + y * module, w * module, h * module) for x, y, w, h in _black_boxes(pixels < 128)]
    words = f"calibration board, {board.columns} x {board.rows} squares of {1000 * board.square:g} mm"
    return Page("calibration_board", size, (*shapes, *_ruler(size, words)))


def write_pages(folder: Path, name: str, pages: Sequence[Page]) -> list[Path]:
    """Write ``name``.pdf with all pages, and one SVG per page; return the paths."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_pdf import PdfPages

    def write_pdf(path: Path) -> None:
        with PdfPages(path, metadata={"CreationDate": None}) as file:
            for figure in figures:
                file.savefig(figure)

    figures, paths = [drawn(page) for page in pages], [folder / f"{name}.pdf"]
    replace_file(paths[0], write_pdf)
    for page, figure in zip(pages, figures, strict=True):
        paths.append(folder / f"{page.name}.svg")
        with rc_context({"svg.hashsalt": page.name}):  # else every writing names its parts anew
            replace_file(paths[-1], lambda path, figure=figure: figure.savefig(path, format="svg", metadata={"Date": None}))
    return paths


def marker_shapes(marker: Marker, code: int, x: float, y: float) -> list[Shape]:
    """The three circles of a marker about (x, y) in mm."""
    return [
        Disc(x, y, 1000 * marker.radius * share, shade) for share, shade in zip(ring_radii(code), (0.0, 1.0, 0.0), strict=True)
    ]


def _together(target: Target, positions: np.ndarray) -> Page:
    middle = 0.5 * (positions.max(axis=0) + positions.min(axis=0))
    centre = np.array(A3) / 2
    shapes: list[Shape] = []
    for marker, code, (x, y) in zip(target.markers, target.codes, positions, strict=True):
        shapes += marker_shapes(marker, int(code), centre[0] + x - middle[0], centre[1] - y + middle[1])
    x, y = centre[0] - middle[0], centre[1] + middle[1]
    shapes += [Box(x - 15, y - 0.1, 30, 0.2, _GREY), Box(x - 0.1, y - 15, 0.2, 30, _GREY)]
    shapes += [Text(x + 18, y + 2, 6, "x, front \u2192"), Text(x + 2, y - 17, 4, f"origin of the {target.name}")]
    return Page(f"{target.name}_markers", A3, (*shapes, *_ruler(A3, f"{target.name} markers", 0.32 * A3[0])))


def _alone(target: Target, marker: Marker) -> Page:
    x, y = A4[0] / 2, A4[1] / 2 - 8
    code = int(target.codes[target.markers.index(marker)])
    reach = 1000 * QUIET_ZONE * marker.radius
    ticks: list[Shape] = []
    for side in (-1, 1):
        ticks += [Box(x + side * (reach + 4) - 4, y - 0.1, 8, 0.2), Box(x - 0.1, y + side * (reach + 4) - 4, 0.2, 8)]
    place = ", ".join(f"{value:g}" for value in marker.position[:2])
    words = f"{target.name} marker '{marker.name}', centre at ({place}) m"
    shapes = [*marker_shapes(marker, code, x, y), *ticks, *_ruler(A4, words)]
    return Page(f"{target.name}_marker_{marker.name}", A4, tuple(shapes))


def _ruler(size: tuple[float, float], words: str, left: float = 2 * _MARGIN) -> list[Shape]:
    y = size[1] - _MARGIN - 2
    marks: list[Shape] = [Box(left, y, 100, 0.3)]
    marks += [Box(left + 10 * k - 0.1, y - (4 if k % 5 == 0 else 2), 0.2, 4 if k % 5 == 0 else 2) for k in range(11)]
    return [*marks, Text(left, y - 6, 3.5, f"100 mm: measure it. {words}. Print at 100 %, not fitted to the page.")]


def _black_boxes(black: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Cover black pixels with rectangles (x, y, width, height): runs along rows, joined downwards where they are equal."""
    boxes: list[tuple[int, int, int, int]] = []
    growing: dict[tuple[int, int], tuple[int, int]] = {}
    for y, row in enumerate([*black, np.zeros(black.shape[1], bool)]):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        runs = {(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)}
        for run, (top, height) in list(growing.items()):
            if run not in runs:
                boxes.append((run[0], top, run[1] - run[0], height))
                del growing[run]
        for run in runs:
            top, height = growing.get(run, (y, 0))
            growing[run] = (top, height + 1)
    return boxes


def drawn(page: Page) -> Figure:
    """Return a page as a figure of its size, to be saved as SVG or PDF; one unit of its axes is 1 mm."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle, Rectangle

    width, height = page.size
    figure = Figure((width / _INCH, height / _INCH), facecolor="white")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.set_axis_off()
    for order, shape in enumerate(page.shapes):
        if isinstance(shape, Text):
            axes.text(shape.x, shape.y, shape.words, fontsize=72 / _INCH * shape.height, zorder=order)
        elif isinstance(shape, Disc):
            axes.add_patch(Circle((shape.x, shape.y), shape.radius, color=str(shape.shade), linewidth=0, zorder=order))
        else:
            corner = shape.x, shape.y
            axes.add_patch(Rectangle(corner, shape.width, shape.height, color=str(shape.shade), linewidth=0, zorder=order))
    return figure


# --- check of a photograph --------------------------------------------------------------------------------------------


if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
