"""Sympy symbols for the paper's constants and state, shared by the symbolic tests."""

from dataclasses import fields

import numpy as np
import sympy as sp

from studies.paper.quantities import WHEELS, PaperConstants, State

PER_WHEEL = {field.name for field in fields(State) if "PerWheel" in str(field.type)}


def constants() -> PaperConstants:
    """Every constant a positive symbol of its own name."""
    return PaperConstants(**{field.name: sp.Symbol(field.name, positive=True) for field in fields(PaperConstants)})


def state(**replaced) -> State:
    """Every quantity a real symbol of its own name, ``theta_dd_rf`` for wheels."""
    values = {}
    for field in fields(State):
        if field.name in PER_WHEEL:
            values[field.name] = {wheel: sp.Symbol(f"{field.name}_{wheel}", real=True) for wheel in WHEELS}
        else:
            values[field.name] = sp.Symbol(field.name, real=True)
    return State(**(values | replaced))


def numbers(expressions, seed=0, count=12) -> np.ndarray:
    """Values (count, expressions) at random points; positive symbols positive."""
    symbols = sorted(set().union(*(sp.sympify(e).free_symbols for e in expressions)), key=str)
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.2, 1.4, (count, len(symbols)))
    negative = np.array([not symbol.is_positive for symbol in symbols]) & (rng.uniform(size=points.shape) < 0.5)
    function = sp.lambdify(symbols, list(expressions), "numpy")
    return np.array([function(*row) for row in np.where(negative, -points, points)], dtype=float)


def same(a, b, seed=0) -> bool:
    """Whether two expressions agree at twelve random points to 1e-10."""
    values = numbers([a, b], seed)
    return bool(np.allclose(values[:, 0], values[:, 1], rtol=1e-10, atol=1e-10))
