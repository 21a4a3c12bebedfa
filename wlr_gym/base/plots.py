"""One style for all figures: colours, axes, legend, file. Matplotlib without a display, imported when something is drawn."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from wlr_gym.base.files import replace_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, WINE, SKY = "#1f4e9c", "#e06c00", "#2e9e6b", "#6d1a36", "#8cc8f0"
#: Curves and bars side by side: different to colour-blind readers too.
COLOURS = (BLUE, ORANGE, GREEN, WINE, SKY)
#: What was measured or is only a reference, and what is not chosen.
GREY, PALE = "#8c8c8c", "#c9c9c9"
_DPI = 110


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of this size (inches)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def tidy(axes: Axes, grid: Literal["both", "x", "y"] = "both") -> None:
    """Give axes a pale grid behind what is drawn, small numbers at round values, and no frame above and on the right."""
    from matplotlib.ticker import AutoLocator

    axes.grid(alpha=0.25, axis=grid)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8)
    for line in (axes.xaxis, axes.yaxis):
        line.label.set_fontsize(9)
        if isinstance(locator := line.get_major_locator(), AutoLocator):
            locator.set_params(steps=[1, 2, 5, 10])
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def log_axis(axis: Axis) -> None:
    """Write the numbers of a logarithmic axis without powers."""
    from matplotlib.ticker import LogLocator

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")


def text_colour(background: Sequence[float]) -> Literal["black", "white"]:
    """Return the colour of text that is easier to read on a colour (red, green, blue, ...; 0 to 1), by its luminance."""
    linear = [((part + 0.055) / 1.055) ** 2.4 for part in background[:3]]
    luminance = sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))
    return "black" if luminance > 0.18 else "white"  # there the contrasts with both are equal


def legend_below(figure: Figure, columns: int = 4) -> None:
    """Explain what is drawn in any of the axes once, below all of them."""
    handles = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if handles:
        place = {"loc": "outside lower center", "ncols": min(columns, len(handles))}
        figure.legend(list(handles.values()), list(handles), frameon=False, fontsize=9, **place)


def png(figure: Figure) -> bytes:
    """Return a figure as PNG."""
    stream = io.BytesIO()
    figure.savefig(stream, dpi=_DPI, format="png", metadata={"Software": None}, pil_kwargs={"optimize": True})
    return stream.getvalue()


def save(figure: Figure, path: Path) -> Path:
    """Write a figure in the format that the path's suffix names (PNG without one); return the path."""
    kind = path.suffix[1:] or "png"
    if kind == "png":
        replace_file(path, lambda temporary: temporary.write_bytes(png(figure)))
    else:
        replace_file(path, lambda temporary: figure.savefig(temporary, format=kind))
    return path
