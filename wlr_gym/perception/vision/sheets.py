"""Sheets to print at 100 %: the robot's markers, one page per floor marker, the calibration board. SVG and PDF, to scale.

A page is a list of shapes in millimetres, x right, y down from its upper left corner. Every page has a ruler of 100 mm: a
printer that scales shows there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wlr_gym.base.files import replace_file, write_text
from wlr_gym.perception.markers.boards import Board
from wlr_gym.perception.markers.targets import QUIET_ZONE, Marker, Target, ring_radii

# Landscape, mm.
A4 = (297.0, 210.0)
A3 = (420.0, 297.0)
# Shade: 0 black to 1 white.
_BLACK = 0.0
_GREY = 0.6
_MARGIN = 8.0  # mm that printers leave white
_ARC = 0.5522847498  # control points of a quarter circle


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
    paths = [folder / f"{name}.pdf"]
    replace_file(paths[0], lambda temporary: temporary.write_bytes(pdf(pages)))
    for page in pages:
        paths.append(folder / f"{page.name}.svg")
        write_text(paths[-1], svg(page))
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


def svg(page: Page) -> str:
    """The page as SVG, one user unit = 1 mm."""
    width, height = page.size
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}mm" height="{height:g}mm" viewBox="0 0 {width:g} {height:g}">'
    )
    body = [f'<rect width="{width:g}" height="{height:g}" fill="#fff"/>', *(_svg_shape(shape) for shape in page.shapes)]
    return "\n".join([head, *body, "</svg>", ""])


def _svg_shape(shape: Shape) -> str:
    if isinstance(shape, Text):
        words = shape.words.replace("&", "&amp;").replace("<", "&lt;")
        font = f'font-size="{shape.height:g}" font-family="Helvetica, Arial"'
        return f'<text x="{shape.x:.4f}" y="{shape.y:.4f}" {font}>{words}</text>'
    level = round(255 * shape.shade)
    fill = f'fill="#{level:02x}{level:02x}{level:02x}"'
    if isinstance(shape, Disc):
        return f'<circle cx="{shape.x:.4f}" cy="{shape.y:.4f}" r="{shape.radius:.4f}" {fill}/>'
    return f'<rect x="{shape.x:.4f}" y="{shape.y:.4f}" width="{shape.width:.4f}" height="{shape.height:.4f}" {fill}/>'


def pdf(pages: Sequence[Page]) -> bytes:
    """All pages as a PDF 1.4 file."""
    count = len(pages)
    kids = " ".join(f"{4 + 2 * k} 0 R" for k in range(count))
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        f"<< /Type /Pages /Kids [{kids}] /Count {count} >>".encode(),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    for k, page in enumerate(pages):
        width, height = (side * 72 / 25.4 for side in page.size)
        objects.append(
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4f} {height:.4f}] /Contents {5 + 2 * k} 0 R "
            "/Resources << /Font << /F1 3 0 R >> >> >>".encode()
        )
        content = "\n".join(
            [f"{72 / 25.4:.8f} 0 0 {72 / 25.4:.8f} 0 0 cm", *(_pdf_shape(s, page.size[1]) for s in page.shapes)]
        )
        data = content.encode("cp1252", "replace")
        objects.append(b"<< /Length %d >>\nstream\n%s\nendstream" % (len(data), data))
    file, places = b"%PDF-1.4\n", []
    for number, content in enumerate(objects, start=1):
        places.append(len(file))
        file += b"%d 0 obj\n%s\nendobj\n" % (number, content)
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    start = len(file)
    file += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1) + table
    return file + b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, start)


def _pdf_shape(shape: Shape, height: float) -> str:
    y = height - shape.y  # PDF counts up
    if isinstance(shape, Text):
        words = shape.words.replace("\u2192", "->").replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
        return f"0 g BT /F1 {shape.height:g} Tf {shape.x:.4f} {y:.4f} Td ({words}) Tj ET"
    if isinstance(shape, Box):
        return f"{shape.shade:g} g {shape.x:.4f} {y - shape.height:.4f} {shape.width:.4f} {shape.height:.4f} re f"
    x, r, c = shape.x, shape.radius, _ARC * shape.radius
    arcs = [(r, c, c, r, 0, r), (-c, r, -r, c, -r, 0), (-r, -c, -c, -r, 0, -r), (c, -r, r, -c, r, 0)]
    curves = " ".join(f"{x + a:.5f} {y + b:.5f} {x + d:.5f} {y + e:.5f} {x + f:.5f} {y + g:.5f} c" for a, b, d, e, f, g in arcs)
    return f"{shape.shade:g} g {x + r:.5f} {y:.5f} m {curves} f"
