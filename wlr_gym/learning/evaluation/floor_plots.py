"""Picture of what a randomisation draws: floors seen from above, coloured by friction, each with its robot's wheels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.plots import new_figure, save
from wlr_gym.base.random import episode_seeds
from wlr_gym.robot import CORNER_SIGNS
from wlr_gym.robot.parameter_table import PATCHES
from wlr_gym.robot.parameters import Parameters

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize

    from wlr_gym.envs.tasks import Randomization

Array = NDArray[np.float64]

#: Floors of one randomisation.
COUNT = 8
#: Floors of one randomisation beside each other, randomisations beside each other.
_COLUMNS, _BLOCKS = 4, 3
#: m from the start that is shown.
_REACH = 1.3
_COLOURS = "viridis"


def draw_floors(path: Path, randomizations: Sequence[Randomization], first_seed: int = 0, count: int = COUNT) -> None:
    """Draw the floors of ``reset(seed=first_seed)`` and the next seeds, a block per randomisation, and write the picture."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm

    columns, beside = min(count, _COLUMNS), min(len(randomizations), _BLOCKS)
    rows, below = -(-count // columns), -(-len(randomizations) // beside)
    size = 2.2 if beside == 1 else 1.75 if count == 1 else 1.2
    height = (size * rows + 0.2) * below + 0.3
    figure = new_figure(size * (columns + 0.2) * beside + 0.4, height + 0.7)
    norm = LogNorm(0.05, 1.0, clip=True)  # friction coefficients at the ends of the colours
    floors, foot = figure.add_gridspec(2, 1, height_ratios=(height, 0.6))
    widths = [*([1.0] * columns + [0.2]) * beside][:-1]  # a gap between blocks
    grid = floors.subgridspec(rows * below, len(widths), width_ratios=widths)
    robot_seeds = first_seed + np.arange(count, dtype=np.uint64)
    for block, randomization in enumerate(randomizations):
        top, left = rows * (block // beside), (columns + 1) * (block % beside)
        panels = [figure.add_subplot(grid[top + k // columns, left + k % columns]) for k in range(count)]
        _draw_block(panels, randomization, robot_seeds, norm)
        for k, axes in enumerate(panels):
            is_first, is_last = left + k % columns == 0, block + beside >= len(randomizations) and k + columns >= count
            axes.tick_params(labelleft=is_first, labelbottom=is_last)
            axes.set_ylabel("y (m)" if is_first else "", fontsize=8)
            axes.set_xlabel("x (m)" if is_last else "", fontsize=8)
    place = figure.add_subplot(foot.subgridspec(1, 3, width_ratios=(1, 2, 1))[1])
    ticks = [0.05, 0.1, 0.2, 0.5, 1.0]
    bar = figure.colorbar(ScalarMappable(norm, _COLOURS), place, orientation="horizontal", ticks=ticks, format="%g")
    bar.set_label("friction coefficient along the heading", fontsize=9)
    bar.ax.minorticks_off()
    bar.ax.tick_params(labelsize=8)
    save(figure, path)


def _draw_block(panels: Sequence[Axes], randomization: Randomization, robot_seeds: NDArray[np.uint64], norm: Normalize) -> None:
    seeds = episode_seeds(robot_seeds, np.zeros(len(robot_seeds), np.int64))
    parameters = randomization.parameters(robot_seeds, seeds)
    state = randomization.state(parameters, seeds)
    yaw = 2 * np.arctan2(state.quaternion[:, 3], state.quaternion[:, 0])
    for k, axes in enumerate(panels):
        _draw(axes, Parameters(parameters.values[k : k + 1]), float(yaw[k]), norm)
    panels[0].set_title(randomization.config.name, fontsize=10, loc="left")


def _draw(axes: Axes, parameters: Parameters, yaw: float, norm: Normalize) -> None:
    from matplotlib import colormaps
    from matplotlib.patches import Rectangle
    from matplotlib.transforms import Affine2D

    colours = colormaps[_COLOURS]
    ground = float(parameters["ground.mu_x"].mean())
    axes.set_facecolor(colours(norm(ground)))
    ink = "black" if norm(ground) > 0.6 else "white"
    areas = [_area(parameters, k) for k in range(len(PATCHES))]
    for mu, x_min, x_max, y_min, y_max in areas:
        if x_max > x_min and y_max > y_min:
            axes.add_patch(Rectangle((x_min, y_min), x_max - x_min, y_max - y_min, color=colours(norm(mu)), linewidth=0))
    turn = Affine2D().rotate(yaw) + axes.transData
    hip_x, hip_y, _ = parameters["hip.position"][0]
    for (sign_x, sign_y), grip, mu_x in zip(
        CORNER_SIGNS, parameters["wheel.grip"][0], parameters["ground.mu_x"][0], strict=True
    ):
        x, y = sign_x * hip_x, sign_y * hip_y
        place = np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y
        mu = grip * next((area[0] for area in reversed(areas) if _holds(area, *place)), mu_x)
        wheel = Rectangle((x - 0.11, y - 0.06), 0.22, 0.12, facecolor=colours(norm(mu)), edgecolor=ink, linewidth=0.8)
        wheel.set_transform(turn)
        axes.add_patch(wheel)
    axes.plot([0.0, 0.4], [0.0, 0.0], color=ink, linewidth=1.2, transform=turn)
    axes.set(xlim=(-_REACH, _REACH), ylim=(-_REACH, _REACH), aspect="equal", xticks=[-1, 0, 1], yticks=[-1, 0, 1])
    axes.tick_params(labelsize=7)


def _area(parameters: Parameters, patch: int) -> tuple[float, ...]:
    """Friction and edges of one patch: mu, x_min, x_max, y_min, y_max."""
    return tuple(float(parameters[f"patch.{name}"][0, patch]) for name in ("mu", "x_min", "x_max", "y_min", "y_max"))


def _holds(area: tuple[float, ...], x: float, y: float) -> bool:
    _, x_min, x_max, y_min, y_max = area
    return x_min < x < x_max and y_min < y < y_max
