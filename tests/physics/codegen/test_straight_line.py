"""Straight-line source as LLVM instructions gives what numba makes of the same source, to the bit."""

import numpy as np
import pytest

from wlr_gym.physics.codegen import Graph, emit, load_module, ops, straight_line_source

INPUTS, WIDTH = 6, 8
PLAIN = "@njit(nogil=True, error_model='numpy')"


def expressions() -> dict[str, object]:
    """Every operation that can be traced, of inputs and of numbers."""
    owner = Graph()
    a, b, c, d, e, f = (owner.input(str(k)) for k in range(INPUTS))
    return {
        "fused": a * b + c,
        "fused_minus": c - a * b,
        "fused_less": a * b - 0.3,
        "kept_apart": ops.rounded(a * b) + c,
        "quotient": a / (b - 7.5),
        "reciprocal": 2.0 / c,
        "negative": -(a * d),
        "chosen": ops.where_positive(a - b, c, -1.5),
        "smaller": ops.minimum(a, b),
        "larger": ops.clip(c, -0.5, d),
        "root": ops.sqrt(ops.absolute(e)),
        "floor": ops.floor(f * 10.0),
        "sine": ops.sin(e) + ops.cos(f),
        "library": ops.exp(a) + ops.tanh(b) * ops.arctan2(c, d),
        "decay": ops.decay(ops.absolute(f)),
    }


def source(precision: str, straight: bool) -> str:
    outputs = expressions()
    place = {name: INPUTS + k for k, name in enumerate(outputs)}
    lines = emit(
        outputs,
        lambda name: f"w[{int(name) * WIDTH} + k]",
        lambda name, text: f"w[{place[name] * WIDTH} + k] = {text}",
        "" if straight else " " * 8,
        lambda value: f"F({value!r})",
        fused=True,
    )
    block = straight_line_source("block", ["w", "k"], lines) if straight else []
    body = ["        block(w, k)"] if straight else lines
    head = [PLAIN, "def run(W):", "    w = numbers_of(W)", f"    for k in range({WIDTH}):"]
    return "\n".join([f"F = np.{precision}", *block, *head, *body, ""])


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_the_same_bits_as_numbas_own(precision, tmp_path, monkeypatch):
    monkeypatch.setenv("WLR_GYM_CACHE", str(tmp_path))
    generator = np.random.default_rng(1)
    count = INPUTS + len(expressions())
    numbers = generator.normal(0.0, 3.0, (count, WIDTH)).astype(precision)
    numbers[:INPUTS, 0] = [0.0, -0.0, np.nan, np.inf, -np.inf, 1e-30]
    results = []
    for straight in (True, False):
        values = numbers.flatten()
        load_module(f"block_{precision}_{straight}", source(precision, straight)).run(values)
        results.append(values.reshape(count, WIDTH))
    kind = {"float32": np.uint32, "float64": np.uint64}[precision]
    finite = ~np.isnan(results[1])
    assert np.array_equal(finite, ~np.isnan(results[0]))
    assert np.array_equal(results[0].view(kind)[finite], results[1].view(kind)[finite])
    assert finite[INPUTS:].mean() > 0.8
    assert np.array_equal(results[0][:INPUTS], numbers[:INPUTS], equal_nan=True)


def test_what_it_does_not_know_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("WLR_GYM_CACHE", str(tmp_path))
    for number, line in enumerate(["if w[0] > 1.0: pass", "w[0] = w[1] ** 2", "w[0] = math.erf(w[1])"]):
        block = straight_line_source("block", ["w"], [line])
        module = load_module(f"refused_{number}", "\n".join([*block, PLAIN, "def run(W):", "    block(numbers_of(W))", ""]))
        with pytest.raises(TypeError, match="straight_line"):
            module.run(np.zeros(2))
