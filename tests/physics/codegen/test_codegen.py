"""The tracer gives what numpy gives, and compiled kernels give it bit for bit at any width."""

import os
import tempfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from llvmlite import binding

from wlr_gym.base.errors import InputError
from wlr_gym.physics.codegen import Graph, emit, hoist, load_module, ops, straight_line_source
from wlr_gym.physics.codegen.compilation import cache_directory


def formula(x, y, p):
    s, c = ops.sin_cos(x)
    a = ops.where_positive(y - 0.2, s * c - y, y * y + 3.0 * x)
    return ops.clip(a * p + ops.sqrt(ops.absolute(x)) - 0.5 * (x * y), -2.0, 2.0) + ops.minimum(x, y) * ops.tanh(y)


def compiled(width, dtype="float64", fused=True):
    graph = Graph()
    out = formula(graph.input("x"), graph.input("y"), graph.input("p") * graph.input("p"))
    lines = emit({"out": out}, lambda n: f"W[{'xyp'.index(n)}, k]", lambda n, v: f"W[3, k] = {v}", "            ", fused=fused)
    body = [
        "@njit(cache=True, nogil=True, error_model='numpy')",
        "def run(X):",
        f"    W = np.empty((4, {width}), np.{dtype})",
        f"    for e in range(X.shape[0] // {width}):",
        f"        W[:] = X[e * {width} : (e + 1) * {width}].T",
        f"        for k in range({width}):",
        *lines,
        f"        X[e * {width} : (e + 1) * {width}] = W.T",
    ]
    return load_module("test_formula", "\n".join(body) + "\n").run


@pytest.fixture
def table():
    return np.random.default_rng(0).normal(scale=2.0, size=(64, 4))


def test_compiled_equals_numpy(table):
    expected = formula(table[:, 0], table[:, 1], table[:, 2] ** 2)
    compiled(8)(table)
    np.testing.assert_allclose(table[:, 3], expected, rtol=2e-14, atol=2e-14)


def test_same_bits_at_every_width(table):
    narrow, wide = table.copy(), table.copy()
    compiled(1)(narrow)
    compiled(8)(wide)
    assert np.array_equal(narrow, wide)


@pytest.mark.skipif(not binding.get_host_cpu_features().get("avx512f"), reason="no vector registers of 512 bits")
def test_whole_registers_are_used_where_they_are_asked_for():
    lines = ["@njit", "def run(x):", "    whole_registers()", "    w = numbers_of(x)"]
    lines += ["    for k in range(256):", "        w[k] = fma(w[k + 256], w[k + 256], w[k])", ""]
    run = load_module("test_registers", "\n".join(lines)).run
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


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="users of other systems have no number")
def test_code_is_not_taken_from_another_users_folder(monkeypatch, tmp_path):
    (tmp_path / "no_folder").touch()
    monkeypatch.setenv("WLR_GYM_CACHE", str(tmp_path / "no_folder"))
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    assert cache_directory().parent == tmp_path
    owner = os.getuid()
    (tmp_path / f"wlr_gym-{owner + 1}").mkdir()
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    with pytest.raises(InputError, match="is another user's"):
        cache_directory()


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
