"""The floor as data: a base, pieces that stand on it, its friction, and what of it is drawn anew for every episode.

A floor writes parameters (``wave.*``, ``bumps.*``, ``piece.*``, ``patch.*``, ``ground.mu_*``), as randomisation and effects do:
both simulators, snapshots, logs and pictures know of no other. What they mean: :mod:`wlr_gym.physics.plants.relief`.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wlr_gym.base.errors import InputError, nearest
from wlr_gym.base.paths import named_in
from wlr_gym.base.random import stream_numbers, uniforms
from wlr_gym.base.settings import ORDERED, SettingsModel, parse_config, read_config
from wlr_gym.physics.plants.relief import LARGEST_CURVATURE, map_of
from wlr_gym.robot import Robot
from wlr_gym.robot.parameter_table import ELEMENTS, PATCHES, PIECES, SPECS, WAVES, range_in_words
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]
Number = float | Array
#: Draws of a seed: a whole number from 0 on, below.
SEEDS = int(SPECS["bumps.seed"].high) + 1
EACH_EPISODE = "each_episode"

Length = Annotated[float, Field(gt=0.0)]
Place = tuple[float, float]


class Plane(SettingsModel):
    """A plane, z = 0."""

    kind: Literal["plane"] = "plane"


class Wave(SettingsModel):
    """One sine: half of crest to trough (m), crest to crest (m), direction across the crests and phase at the origin (rad)."""

    height: float = Field(ge=0.0)
    length: float = Field(gt=0.0)
    heading: float = 0.0
    phase: float = 0.0


class Waves(SettingsModel):
    """The sum of sines."""

    kind: Literal["waves"]
    waves: list[Wave] = Field(min_length=1, max_length=len(WAVES))


class Bumps(SettingsModel):
    """A smooth surface over a square lattice, of whose points a share is raised by a random part of the height.

    Attributes:
        height: of the highest bump, m.
        spacing: of the lattice, m.
        share: of its points that are raised; the others are level.
        seed: which ones.
    """

    kind: Literal["bumps"]
    height: float = Field(ge=0.0)
    spacing: Length
    share: float = Field(default=1.0, gt=0.0, le=1.0)
    seed: int = Field(default=0, ge=0, lt=SEEDS)


class Map(SettingsModel):
    """Numbers in square cells, seen from above: columns along x, the first row with the largest y.

    Attributes:
        cell: width, m.
        file: CSV, NPY or PNG (0 for black to 1 for white); relative to the floor's own file. Read once, by :func:`load_floor`.
        data: what was in it; in the content of every floor with a map.
        at: its middle, m. heading: of its x axis, rad. scale: factor on its numbers.
    """

    cell: Length
    file: str = ""
    data: str = ""
    at: Place = (0.0, 0.0)
    heading: float = 0.0
    scale: float = Field(default=1.0, ge=0.0)

    def text(self) -> str:
        """Return its numbers as text, see :mod:`wlr_gym.physics.maps`."""
        return self.data

    @model_validator(mode="after")
    def _there(self) -> Map:
        from wlr_gym.physics.maps import map_values

        if not self.text():
            raise ValueError("has neither 'file' nor 'data': expected the file of a map")
        map_values(self.text())
        return self


class RandomHeights(SettingsModel):
    """Gaussian heights: seed, root mean square (m), length over which they are correlated (m), size along x and y (m)."""

    seed: int = Field(default=0, ge=0)
    height: float = Field(ge=0.0)
    length: Length
    size: tuple[Length, Length] = (10.0, 10.0)


class Grid(Map):
    """A smooth surface through heights (m) in the middles of cells, from a file or random; beyond them it goes on level."""

    kind: Literal["grid"]
    random: RandomHeights | None = None

    def text(self) -> str:
        """Return its heights as text."""
        if self.random is None:
            return self.data
        from wlr_gym.physics.maps import random_heights

        return random_heights(cell=self.cell, **self.random.model_dump())

    @model_validator(mode="after")
    def _one_source(self) -> Grid:
        if self.random is not None and (self.file or self.data):
            raise ValueError(f"has both '{'file' if self.file else 'data'}' and 'random': expected one of them")
        return self


class Kerb(SettingsModel):
    """A piece with upright faces: a kerb or step where it has no end, a plank where it has a depth along its heading (m)."""

    kind: Literal["kerb", "step", "plank"]
    at: Place
    heading: float = 0.0
    height: Length
    depth: Length = math.inf
    edge_radius: Length = 0.003

    model_config = SettingsModel.model_config | {"allow_inf_nan": True}


class Ramp(SettingsModel):
    """A way up of a slope (rad), a level top (m; default: no end), and a way down of a slope (default: the same)."""

    kind: Literal["ramp"]
    at: Place
    heading: float = 0.0
    slope: float = Field(gt=0.0, lt=math.pi / 2)
    height: Length
    depth: Length = math.inf
    down_slope: float | None = Field(default=None, gt=0.0, le=math.pi / 2)
    edge_radius: Length = 0.003

    model_config = SettingsModel.model_config | {"allow_inf_nan": True}


class Stairs(SettingsModel):
    """Steps of a rise and a run (m); the last has no end."""

    kind: Literal["stairs"]
    at: Place
    heading: float = 0.0
    rise: Length
    run: Length
    count: int = Field(ge=1, le=len(PIECES))
    edge_radius: Length = 0.003


class FrictionPatch(SettingsModel):
    """A rectangle of another friction; x and y: [from, to] in m, without them the floor has no end there."""

    mu: float = Field(ge=0.0)
    x: Annotated[tuple[float, float], ORDERED] = (-1e3, 1e3)
    y: Annotated[tuple[float, float], ORDERED] = (-1e3, 1e3)


class FloorFriction(SettingsModel):
    """Friction of the floor (None: the robot's), a map of another (that of the cell), and patches over it; later ones win."""

    mu: float | None = Field(default=None, ge=0.0)
    map: Map | None = None
    patches: list[FrictionPatch] = Field(default=[], max_length=len(PATCHES))


Base = Annotated[Plane | Waves | Bumps | Grid, Field(discriminator="kind")]
Piece = Annotated[Kerb | Ramp | Stairs, Field(discriminator="kind")]


class Floor(SettingsModel):
    """Contents of ``configs/floor/*.yaml``.

    Attributes:
        name: of it. summary: in words.
        base: on which pieces stand; a piece's height counts from z = 0.
        pieces: kerbs, planks, ramps and stairs; each step of stairs counts as one of eight.
        friction: of the floor.
        randomise: dotted place of a number (``pieces.0.height``) -> [low, high], or ``each_episode`` for a seed: drawn evenly
            from the seed of the episode.
    """

    name: str = Field(default="floor", pattern=r"^[a-z][a-z0-9_]*$")
    summary: str = ""
    base: Base = Plane()
    pieces: list[Piece] = Field(default=[])
    friction: FloorFriction = FloorFriction()
    randomise: dict[str, Annotated[tuple[float, float], ORDERED] | Literal["each_episode"]] = Field(default={})

    @model_validator(mode="after")
    def _possible(self) -> Floor:
        count = sum(piece.count if isinstance(piece, Stairs) else 1 for piece in self.pieces)
        if count > len(PIECES):
            raise InputError(f"pieces: {count} pieces and steps, expected at most {len(PIECES)}")
        for place, drawn in self.randomise.items():
            self._check_draw(place, drawn)
        return self

    def _check_draw(self, place: str, drawn: Any) -> None:
        numbers = dict(_numbers(self.model_dump(exclude={"name", "summary", "randomise"})))
        if place not in numbers:
            raise InputError(
                f"randomise: '{place}': no number of this floor{nearest(place, numbers)}; it has {', '.join(numbers)}"
            )
        places = "base.at.0, base.at.1, base.heading or base.scale"
        if ".random." in place:
            raise InputError(f"randomise: '{place}': heights cannot be drawn; expected {places}")
        if place == "base.cell" and "base.random.length" in numbers:
            length = numbers["base.random.length"]
            raise InputError(f"randomise: '{place}': would also stretch base.random.length = {length:g} m; expected {places}")
        if (drawn == EACH_EPISODE) != place.endswith(".seed"):
            wanted = f"'{EACH_EPISODE}'" if place.endswith(".seed") else "[low, high]"
            raise InputError(f"randomise: {place} = {drawn!r}: expected {wanted}")
        if place.endswith(".count"):
            raise InputError(f"randomise: '{place}': how many steps there are cannot be drawn")

    def content(self) -> dict[str, Any]:
        """Return what a file says of it: all but what was not given."""
        return self.model_dump(mode="json", exclude_unset=True)

    @property
    def is_flat(self) -> bool:
        """Whether it is a plane with the robot's friction, so that it changes no parameter."""
        return isinstance(self.base, Plane) and not self.pieces and self.friction == FloorFriction()

    def drawn(self, seed: int = 0) -> Floor:
        """Return the floor that the episode of a seed meets: the numbers that :meth:`write` lays, nothing left to be drawn."""
        if not self.randomise:
            return self
        content, complete = self.content(), self.model_dump(mode="json")
        content.pop("randomise")
        for place, value in self._draw(np.array([seed], np.uint64)).items():
            _put(content, complete, place, int(value[0]) if place.endswith(".seed") else float(value[0]))
        return parse_config(Floor, content, f"floor '{self.name}'")

    # ---- as parameters ----

    def write(self, parameters: Parameters, seeds: NDArray[np.uint64]) -> None:
        """Lay robots' parameters (N) on this floor, drawn by the seeds (N) of their episodes."""
        if not self.is_flat:
            self._write(parameters, self._draw(seeds))

    def elements(self) -> dict[str, str]:
        """Return the elements of the parameter table that it states, each with the part of the floor that states it."""
        blank = Parameters(np.full((1, len(ELEMENTS)), np.nan))
        self.write(blank, np.zeros(1, np.uint64))
        parts = {"wave": "base", "bumps": "base", "grid": "base", "piece": "pieces", "ground": "friction.mu"}
        parts |= {"patch": "friction.patches", "friction_map": "friction.map"}
        return {ELEMENTS[k]: parts[ELEMENTS[k].partition(".")[0]] for k in np.flatnonzero(np.isfinite(blank.values[0]))}

    def _draw(self, seeds: NDArray[np.uint64]) -> dict[str, Array]:
        """Return dotted place -> numbers (N) that seeds (N) draw for it."""
        if not self.randomise:
            return {}
        draws = uniforms(seeds, stream_numbers(*(f"floor.{place}" for place in self.randomise)))
        return {place: self._between(place, draws[:, column]) for column, place in enumerate(self.randomise)}

    def _between(self, place: str, share: Array) -> Array:
        """Return a number that is drawn, at a share (N) of its range."""
        limits = self.randomise[place]
        if isinstance(limits, str):
            return np.floor(share * SEEDS)
        return limits[0] + (limits[1] - limits[0]) * share

    def _write(self, parameters: Parameters, drawn: Mapping[str, Array]) -> None:
        def of(place: str, value: float) -> Number:
            return drawn.get(place, value)

        self._write_base(parameters, of)
        slots = iter(range(len(PIECES)))
        for number, piece in enumerate(self.pieces):
            for shape in _shapes(piece, f"pieces.{number}", of):
                slot = next(slots)
                for name, value in shape.items():
                    parameters[f"piece.{name}"][:, slot] = value
        self._write_friction(parameters, of)

    def _write_friction(self, parameters: Parameters, of: Drawn) -> None:
        if self.friction.mu is not None:
            for name in ("ground.mu_x", "ground.mu_y"):
                parameters[name].T[:] = of("friction.mu", self.friction.mu)
        if self.friction.map is not None:
            from wlr_gym.physics.maps import enter_friction

            parameters["friction_map.number"] = enter_friction(self.friction.map.text())
            _write_map(parameters, "friction_map", self.friction.map, "friction.map", of)
        for number, patch in enumerate(self.friction.patches):
            where = f"friction.patches.{number}"
            parameters["patch.mu"][:, number] = of(f"{where}.mu", patch.mu)
            for axis, limits in (("x", patch.x), ("y", patch.y)):
                for end, name in enumerate(("min", "max")):
                    parameters[f"patch.{axis}_{name}"][:, number] = of(f"{where}.{axis}.{end}", limits[end])

    def _write_base(self, parameters: Parameters, of: Drawn) -> None:
        match self.base:
            case Waves(waves=waves):
                for number, wave in enumerate(waves):
                    for field in ("height", "length", "heading", "phase"):
                        place = f"base.waves.{number}.{field}"
                        parameters[f"wave.{field}"][:, number] = of(place, getattr(wave, field))
            case Bumps() as bumps:
                for field in ("height", "spacing", "share", "seed"):
                    parameters[f"bumps.{field}"][:] = of(f"base.{field}", getattr(bumps, field))
            case Grid() as grid:
                from wlr_gym.physics.maps import enter_heights

                parameters["grid.number"] = enter_heights(grid.text())
                _write_map(parameters, "grid", grid, "base", of)

    # ---- what cannot be ----

    def check(self, robot: Robot) -> None:
        """Refuse a floor on which a robot cannot be simulated, or whose start is inside a piece, wherever it may be drawn.

        Raises:
            InputError: with the number, and what was expected.
        """
        if 0.25 * robot.wheel.width >= robot.wheel.radius:
            raise InputError(
                f"floor '{self.name}': robot '{robot.name}': its wheels are {robot.wheel.width:g} m wide, their radius is "
                f"{robot.wheel.radius:g} m: expected less than four times the radius"
            )
        for shares in self._tried():
            parameters = Parameters.nominal(robot, 1)
            drawn = zip(self.randomise, shares, strict=True)
            self._write(parameters, {place: self._between(place, np.full(1, share)) for place, share in drawn})
            parameters.validate()
            self._check_curvature(parameters, robot)
            self._check_pieces(parameters, robot)
            self._check_friction_map(parameters)

    def _tried(self) -> Iterator[Sequence[float]]:
        """Yield shares of the ranges that are drawn from: ends and places between; of many ranges, ends and a sample."""
        last, count = 1.0 - 1e-9, len(self.randomise)
        if count <= 3:
            yield from itertools.product((0.0, 0.25, 0.5, 0.75, last), repeat=count)
            return
        yield from ([0.0] * count, [last] * count)
        yield from np.random.default_rng(0).choice([0.0, 0.5, last], (100, count)).tolist()

    def _check_curvature(self, parameters: Parameters, robot: Robot) -> None:
        number = 2.0 * np.pi / parameters["wave.length"][0]
        curvature = float((parameters["wave.height"][0] * number**2).sum())
        curvature += float(2.5 * parameters["bumps.height"][0] / parameters["bumps.spacing"][0] ** 2)
        if isinstance(self.base, Grid):
            from wlr_gym.physics.maps import sharpest

            size = float(parameters["grid.scale"][0] / parameters["grid.cell"][0] ** 2)
            curvature = size * sharpest(int(parameters["grid.number"][0]))
        product = curvature * robot.wheel.radius
        if product > LARGEST_CURVATURE:
            raise InputError(
                f"floor '{self.name}': base: its curvature reaches {curvature:.3g} 1/m, {product:.2g} over the wheels' radius: "
                f"expected at most {LARGEST_CURVATURE:g} over {robot.wheel.radius:g} m; a sharper base touches a wheel at "
                "several places at once: lower it, stretch it, or make it a piece"
            )

    def _check_friction_map(self, parameters: Parameters) -> None:
        if self.friction.map is None:
            return
        spec, friction = SPECS["patch.mu"], parameters["friction_map.scale"][0] * map_of(parameters["friction_map.number"][0])
        if friction.min() < spec.low or friction.max() > spec.high:
            raise InputError(
                f"floor '{self.name}': friction.map: its friction is {friction.min():g} to {friction.max():g}: "
                f"expected {range_in_words(spec.low, spec.high, spec.unit)}"
            )

    def _check_pieces(self, parameters: Parameters, robot: Robot) -> None:
        there = np.flatnonzero(parameters["piece.height"][0] > 0.0)
        pieces = [{name: float(parameters[f"piece.{name}"][0, k]) for name in _SHAPE} for k in there]
        reach = math.hypot(robot.hip_position.x, robot.hip_position.y) + robot.wheel.radius
        for number, piece in enumerate(pieces, 1):
            _check_edges(f"floor '{self.name}': piece {number}", piece)
            foot, end = _along(piece, piece)
            if foot < reach and end > -reach and not (foot <= -reach and end >= reach):
                raise InputError(
                    f"floor '{self.name}': piece {number}: it lies from {foot:.3g} to {end:.3g} m ahead of the robot's start, "
                    f"(0, 0): expected {reach:.3g} m between the start and a face"
                )
        for (first, low), (second, high) in itertools.combinations(enumerate(pieces, 1), 2):
            if abs(math.cos(low["heading"] - high["heading"])) < 1.0 - 1e-9:
                continue  # they cross somewhere; a wheel touches the two that are deepest
            (foot, end), (other_foot, other_end) = _along(low, low), _along(high, low)
            stacked = high["height"] > low["height"] and other_foot >= foot
            if other_foot < end and foot < other_end and not stacked:
                raise InputError(
                    f"floor '{self.name}': pieces {first} and {second} overlap, from {max(foot, other_foot):.3g} to "
                    f"{min(end, other_end):.3g} m along their heading: expected the later one higher and on top of the earlier"
                )


def _write_map(parameters: Parameters, kind: str, map_: Map, where: str, of: Drawn) -> None:
    for field in ("scale", "cell", "heading"):
        parameters[f"{kind}.{field}"] = of(f"{where}.{field}", getattr(map_, field))
    for k, axis in enumerate("xy"):
        parameters[f"{kind}.{axis}"] = of(f"{where}.at.{k}", map_.at[k])


#: Returns the number at a dotted place of a floor: what was drawn for it (N), else what the file says.
Drawn = Callable[[str, float], Number]
_SHAPE = ("x", "y", "heading", "height", "length", "front_slope", "rear_slope", "edge_radius")


def _shapes(piece: Kerb | Ramp | Stairs, where: str, of: Drawn) -> Iterator[dict[str, Number]]:
    """Yield the parameters of a piece's profile; of stairs step by step."""

    def number(field: str) -> Number:
        return of(f"{where}.{field}", getattr(piece, field))

    x, y = (of(f"{where}.at.{axis}", piece.at[axis]) for axis in range(2))
    heading, upright = number("heading"), math.pi / 2
    shape = {"x": x, "y": y, "heading": heading, "front_slope": upright, "rear_slope": upright}
    shape |= {"edge_radius": number("edge_radius"), "length": SPECS["piece.length"].high}
    if isinstance(piece, Stairs):
        for step in range(piece.count):
            ahead = step * number("run")
            place = {"x": x + ahead * np.cos(heading), "y": y + ahead * np.sin(heading)}
            yield shape | place | {"height": (step + 1) * number("rise")}
        return
    shape |= {"height": number("height"), "length": np.minimum(number("depth"), SPECS["piece.length"].high)}
    if isinstance(piece, Ramp):
        slope = number("slope")
        shape |= {"front_slope": slope, "rear_slope": slope if piece.down_slope is None else number("down_slope")}
    yield shape


def _check_edges(where: str, piece: Mapping[str, float]) -> None:
    radius, insets = piece["edge_radius"], sum(math.tan(0.5 * piece[slope]) for slope in ("front_slope", "rear_slope"))
    if radius > piece["height"]:
        raise InputError(f"{where}: edge_radius = {radius:g} m: expected at most the height, {piece['height']:g} m")
    if radius * insets > piece["length"]:
        raise InputError(
            f"{where}: edge_radius = {radius:g} m: expected a top of {radius * insets:.3g} m or more, which is "
            f"{piece['length']:g} m, or a smaller radius"
        )


def _along(piece: Mapping[str, float], other: Mapping[str, float]) -> tuple[float, float]:
    """Return where a piece begins and ends along the heading of another, from the floor's origin, m."""
    foot = piece["x"] * math.cos(other["heading"]) + piece["y"] * math.sin(other["heading"])
    faces = sum(piece["height"] / math.tan(piece[slope]) for slope in ("front_slope", "rear_slope"))
    end = foot + math.copysign(piece["length"] + faces, math.cos(piece["heading"] - other["heading"]))
    return min(foot, end), max(foot, end)


def _numbers(content: Any, place: str = "") -> Iterator[tuple[str, float]]:
    """Yield every number of a floor with its dotted place."""
    if isinstance(content, Mapping | list | tuple):
        for key, value in content.items() if isinstance(content, Mapping) else enumerate(content):
            yield from _numbers(value, f"{place}.{key}" if place else str(key))
    elif isinstance(content, int | float):
        yield place, content


def _put(content: Any, complete: Any, place: str, value: float) -> None:
    """Set the number at a dotted place of a floor's content; what that leaves out on the way is taken from ``complete``."""
    head, _, rest = place.partition(".")
    key: Any = int(head) if isinstance(content, list) else head
    if not rest:
        content[key] = value
        return
    if isinstance(content, dict):
        content.setdefault(key, copy.deepcopy(complete[key]))
    _put(content[key], complete[key], rest, value)


#: What ``floor=`` and ``--floor`` take; see :func:`load_floor`.
FloorSource = str | Path | Mapping[str, Any] | Floor | None


def load_floor(source: FloorSource, robot: Robot | None = None, where: str = "floor") -> Floor:
    """Return a floor.

    Args:
        source: name in ``configs/floor/``, path of a YAML file, its content, or a floor; None = ``flat``.
        robot: that shall drive on it; None = nothing is checked against one.
        where: a mapping comes from, for messages.

    Raises:
        InputError: naming file, field, value, what was expected and the nearest valid name.
    """
    if isinstance(source, Floor):
        floor = source
    else:
        data, place = (dict(source), where) if isinstance(source, Mapping) else read_config("floor", source or "flat")
        floor = parse_config(Floor, _with_maps(data, place), place)
    if robot is not None:
        floor.check(robot)
    return floor


def _with_maps(data: Any, place: str) -> Any:
    """Return a floor's content with what is in the files of its maps, where it does not have that yet."""
    data = copy.deepcopy(data)
    base, friction = (data.get("base"), data.get("friction")) if isinstance(data, dict) else (None, None)
    for held in (base, friction.get("map") if isinstance(friction, dict) else None):
        if isinstance(held, dict) and isinstance(held.get("file"), str | Path) and not held.get("data"):
            from wlr_gym.physics.maps import read_map

            held |= {"data": read_map(named_in(place, held["file"])), "file": str(held["file"])}
    return data


def lay_floor(floor: Floor, parameters: Parameters) -> Parameters:
    """Return robots' parameters on a floor that has nothing left to be drawn, see :meth:`Floor.drawn`."""
    laid = parameters.copy()
    floor.write(laid, np.zeros(len(laid), np.uint64))
    return laid


def floor_noted(floor: Floor | None) -> dict[str, Any] | None:
    """Return what the files of runs say of a floor: its content; None = it is flat, as in files that say nothing of it."""
    return None if floor is None or floor.is_flat else floor.content()
