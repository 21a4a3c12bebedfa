"""Which colour stands for which friction coefficient and slip speed. RGB in 0..1."""

from __future__ import annotations

import numpy as np

Colour = tuple[float, float, float]

#: Friction coefficient -> colour: ice is blue (not the sky's), the nominal floor (0.6) light grey, a very rough floor brown.
FRICTION = ((0.0, (0.22, 0.54, 0.74)), (0.3, (0.62, 0.82, 0.90)), (0.6, (0.80, 0.80, 0.78)), (1.0, (0.72, 0.50, 0.30)))
#: Slip speed (m/s) -> colour of its arrow.
SLIP = ((0.0, (1.0, 0.85, 0.10)), (0.05, (1.0, 0.55, 0.05)), (0.2, (0.90, 0.08, 0.08)))
#: Arrows of friction and of normal force on a wheel.
FORCE: Colour = (0.10, 0.45, 0.15)
LOAD: Colour = (0.45, 0.62, 0.45)
#: Paths over the floor: as commanded, and as driven.
WANTED: Colour = (0.10, 0.10, 0.12)
DRIVEN: Colour = (0.95, 0.10, 0.55)


def friction_colour(mu: float) -> Colour:
    """Return the colour of a floor with friction coefficient ``mu``."""
    return _between(FRICTION, mu)


def slip_colour(speed: float) -> Colour:
    """Return the colour of a slip arrow; ``speed`` in m/s."""
    return _between(SLIP, speed)


def _between(table: tuple[tuple[float, Colour], ...], value: float) -> Colour:
    places = [place for place, _ in table]
    red, green, blue = (float(np.interp(value, places, [colour[k] for _, colour in table])) for k in range(3))
    return red, green, blue
