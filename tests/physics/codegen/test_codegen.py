"""The tracer gives what numpy gives, and compiled kernels give it bit for bit at any width."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from llvmlite import binding
from numba import njit

from wlr_gym.physics.codegen import Graph, emit, hoist, load_module, ops, straight_line_source


@pytest.mark.skipif(not binding.get_host_cpu_features().get("avx512f"), reason="no vector registers of 512 bits")
def test_whole_registers_are_used_where_they_are_asked_for():
    lines = ["@compiled", "def run(x):", "    whole_registers()", "    w = numbers_of(x)"]
    lines += ["    for k in range(256):", "        w[k] = fma(w[k + 256], w[k + 256], w[k])", ""]
    kept = load_module("test_registers", "\n".join(lines)).run
    run: Any = njit(kept.py_func)  # compiled here: what is kept from an earlier run has no listing
    run(np.ones(512, np.float32))
    assert "zmm" in "".join(run.inspect_asm().values())


def test_hoist_separates_constants_and_keeps_the_value():
    graph = Graph()
    x, p, q = graph.input("x"), graph.input("p"), graph.input("q")
    outputs = {"out": (p * q + 1.0) * x + p}
    rewritten, hoisted = hoist(outputs, lambda name: name in "pq", "h")
    assert len(hoisted) == 1
    source = emit(rewritten, lambda n: n, lambda n, v: f"{n} = {v}", "")
    setup = emit(hoisted, lambda n: n, lambda n, v: f"{n} = {v}", "")
    scope = {"x": 2.0, "p": 3.0, "q": 5.0}
    exec("\n".join(setup + source), scope)
    assert scope["out"] == 16.0 * 2.0 + 3.0
    assert not any("q" in line for line in source)


def test_sin_cos_reduces_large_angles():
    angles = np.concatenate([np.linspace(-10, 10, 997), [1e3, -1e4]])
    graph = Graph()
    s, c = ops.sin_cos(graph.input("x"))
    source = "\n".join(emit({"s": s, "c": c}, lambda n: n, lambda n, v: f"{n} = {v}", ""))
    for angle in angles:
        scope = {"x": float(angle), "np": np}
        exec(source, scope)
        rounding = 1e-15 + 1e-15 * abs(angle)
        assert scope["s"] == pytest.approx(np.sin(angle), abs=rounding)
        assert scope["c"] == pytest.approx(np.cos(angle), abs=rounding)


def test_python_branches_on_traced_values_are_refused():
    with pytest.raises(TypeError, match="where_positive"):
        bool(Graph().input("x"))


def test_threads_that_load_a_module_at_once_are_given_it_whole(monkeypatch, tmp_path):
    """A module is known by its name as soon as it begins to run: nobody may be given it before it has run."""
    monkeypatch.setenv("WLR_GYM_CACHE", str(tmp_path))
    slow = f"import time\ntime.sleep(0.2)\nvalue = {tmp_path.name!r}\n"
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: load_module("test_slow", slow).value, range(4)))
    assert found == [tmp_path.name] * 4


def test_a_compact_block_overwrites_what_it_reads_without_losing_it():
    """Outputs are stored early, yet never before the input of their name is read: a swap, a chain, and a plain number."""
    owner = Graph()
    a, b, c = (owner.input(name) for name in "abc")
    outputs = {"a": b, "b": a, "d": a * b + c * (a - b), "c": (a - b) * c, "e": 2.0}
    expected = {"a": 5.0, "b": 3.0, "d": 1.0, "c": -14.0, "e": 2.0}
    for compact in (False, True):
        lanes = {"a": 3.0, "b": 5.0, "c": 7.0}
        lines = emit(outputs, lambda n: f"w[{n!r}]", lambda n, v: f"w[{n!r}] = {v}", "", compact=compact)
        exec("\n".join(lines), {"w": lanes})
        assert lanes == expected


# ---- straight-line source as LLVM instructions gives what numba makes of the same source, to the bit -----------------


INPUTS, WIDTH = 6, 8
PLAIN = "@compiled(error_model='numpy')"


def expressions(a, b, c, d, e, f) -> dict[str, Any]:
    """Every operation that can be traced, of inputs and of numbers."""
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


def source(precision: str, straight: bool, width: int) -> str:
    owner = Graph()
    outputs = expressions(*(owner.input(str(k)) for k in range(INPUTS)))
    place = {name: INPUTS + k for k, name in enumerate(outputs)}
    lines = emit(
        outputs,
        lambda name: f"w[{int(name) * width} + k]",
        lambda name, text: f"w[{place[name] * width} + k] = {text}",
        "" if straight else " " * 8,
        lambda value: f"F({value!r})",
        fused=True,
    )
    block = straight_line_source("block", ["w", "k"], lines) if straight else []
    body = ["        block(w, k)"] if straight else lines
    head = [PLAIN, "def run(W):", "    w = numbers_of(W)", f"    for k in range({width}):"]
    return "\n".join([f"F = np.{precision}", *block, *head, *body, ""])


def computed(numbers: np.ndarray, precision: str, straight: bool = False) -> np.ndarray:
    """Inputs and outputs (rows, width) of the compiled expressions."""
    values, width = numbers.astype(precision).flatten(), numbers.shape[1]
    load_module(f"block_{precision}_{straight}_{width}", source(precision, straight, width)).run(values)
    return values.reshape(numbers.shape)


@pytest.fixture
def numbers(tmp_path, monkeypatch) -> np.ndarray:
    monkeypatch.setenv("WLR_GYM_CACHE", str(tmp_path))
    return np.random.default_rng(1).normal(0.0, 3.0, (INPUTS + len(expressions(*np.ones(INPUTS))), WIDTH))


def test_numpys_values_and_the_same_bits_at_every_width(numbers):
    found = computed(numbers, "float64")
    alone = np.hstack([computed(numbers[:, k : k + 1], "float64") for k in range(WIDTH)])
    np.testing.assert_array_equal(found, alone)
    np.testing.assert_allclose(found[INPUTS:], list(expressions(*numbers[:INPUTS]).values()), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_the_same_bits_as_numbas_own(precision, numbers):
    numbers[:INPUTS, 0] = [0.0, -0.0, np.nan, np.inf, -np.inf, 1e-30]
    straight, numbas = computed(numbers, precision, True), computed(numbers, precision)
    kind = {"float32": np.uint32, "float64": np.uint64}[precision]
    finite = ~np.isnan(numbas)
    assert np.array_equal(finite, ~np.isnan(straight))
    assert np.array_equal(straight.view(kind)[finite], numbas.view(kind)[finite])
    assert finite[INPUTS:].mean() > 0.8
    assert np.array_equal(straight[:INPUTS], numbers[:INPUTS].astype(precision), equal_nan=True)


def test_what_it_does_not_know_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("WLR_GYM_CACHE", str(tmp_path))
    for number, line in enumerate(["if w[0] > 1.0: pass", "w[0] = w[1] ** 2", "w[0] = math.erf(w[1])"]):
        block = straight_line_source("block", ["w"], [line])
        module = load_module(f"refused_{number}", "\n".join([*block, PLAIN, "def run(W):", "    block(numbers_of(W))", ""]))
        with pytest.raises(TypeError, match="straight_line"):
            module.run(np.zeros(2))
