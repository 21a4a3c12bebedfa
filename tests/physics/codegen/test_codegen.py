"""The tracer gives what numpy gives, and compiled kernels give it bit for bit at any width."""

import os
import tempfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from llvmlite import binding

from wlr_gym.base.errors import InputError
from wlr_gym.physics.codegen import Graph, emit, hoist, load_module, ops
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
