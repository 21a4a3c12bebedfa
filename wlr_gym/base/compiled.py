"""All that goes beyond numba's public use: nothing else in the package touches its or LLVM's insides.

Functions that take records of this package, and their machine code kept from one process to the next; straight-line source
lowered to LLVM; what numba lacks.
"""

from __future__ import annotations

import ast
import atexit
import errno
import hashlib
import math
import os
import pickle
import platform
import shutil
import stat
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from types import CodeType
from typing import Any, ClassVar

import llvmlite
import numba
import numpy as np
from llvmlite import binding as llvm
from llvmlite import ir
from numba import njit, types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, InTreeCacheLocator
from numba.core.serialize import dumps
from numba.extending import intrinsic

from wlr_gym.base.files import try_lock, unlock

#: s that a process waits for another one that compiles the same.
PATIENCE = 120.0

# ---- machine code that is kept ---------------------------------------------------------------------------------------


def cache_directory() -> Path:
    """Return the folder for all that is compiled: ``$WLR_GYM_CACHE``, else ``wlr_gym`` in the user's cache.

    Where it cannot be written, one for temporary files that nobody else writes to; stderr says so once.
    """
    users = os.path.join(os.environ.get("XDG_CACHE_HOME") or "~/.cache", "wlr_gym")
    wanted = os.path.expanduser(os.environ.get("WLR_GYM_CACHE") or users)
    return _writable(wanted if wanted.startswith("~") else os.path.abspath(wanted))


@cache
def _writable(wanted: str) -> Path:
    try:
        if wanted.startswith("~"):
            raise OSError(errno.ENOENT, "this user has no home")
        os.makedirs(wanted, exist_ok=True)
        with tempfile.TemporaryFile(dir=wanted):
            return Path(wanted)
    except OSError as error:
        folder = _private_folder()
        text = f"wlr_gym: {wanted} cannot be written ({error.strerror}): compiled kernels are kept in {folder}"
        print(f"{text}; set WLR_GYM_CACHE to a folder of yours", file=sys.stderr, flush=True)
        return folder


def _private_folder() -> Path:
    """Return this user's folder among those for temporary files; a new one where others can write to it: it holds code."""
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = Path(tempfile.gettempdir()) / f"wlr_gym-{user}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    if stat.S_ISDIR(found.st_mode) and (os.name == "nt" or (found.st_uid == user and not found.st_mode & 0o022)):
        return folder
    folder = Path(tempfile.mkdtemp(prefix="wlr_gym-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def versions() -> list[str]:
    """Return what machine code and its files depend on besides the source."""
    return [sys.version, platform.machine(), numba.__version__, llvmlite.__version__, np.__version__]


@contextmanager
def compiling(name: str) -> Iterator[None]:
    """Compile what has this name while no other process does, as long as :data:`PATIENCE` lasts: then both do."""
    part = 1, int.from_bytes(hashlib.sha256(name.encode()).digest()[:7])  # of a file that holds nothing: one byte a name
    file = _lock_file(cache_directory())
    deadline = time.monotonic() + PATIENCE
    while not (held := try_lock(file, *part)) and time.monotonic() < deadline:
        time.sleep(0.05)
    try:
        yield
    finally:
        if held:
            unlock(file, *part)


@cache
def _lock_file(folder: Path) -> int:
    return os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o666)  # stays open: closing it would free all of its locks


@cache
def _file_hash(path: str, changed: int) -> bytes:
    return hashlib.sha256(Path(path).read_bytes()).digest()


class _Place(InTreeCacheLocator):
    """Where a function's machine code lies: a folder of the cache for its module's folder and the versions in use."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        super().__init__(py_func, py_file)
        self._cache_path = _folder_of(os.path.dirname(os.path.abspath(py_file)), cache_directory())

    def get_source_stamp(self) -> bytes:
        return _file_hash(self._py_file, os.stat(self._py_file).st_mtime_ns)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        return cls(py_func, py_file)


@cache
def _folder_of(sources: str, within: Path) -> str:
    name = hashlib.sha256("\0".join([sources, *versions()]).encode()).hexdigest()[:16]
    return str(within / f"{os.path.basename(sources)}_{name}")


class _Content(CompileResultCacheImpl):
    """Machine code as it is filed, with a checksum: what a power failure left of a file is not run."""

    _locator_classes: ClassVar[list[type[_Place]]] = [_Place]

    def reduce(self, cres: Any) -> Any:
        kept = dumps(super().reduce(cres))
        return zlib.crc32(kept), kept

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        checksum, kept = payload
        if zlib.crc32(kept) != checksum:
            raise ValueError("not what was written")
        return super().rebuild(target_context, pickle.loads(kept))


class _Kept(FunctionCache):
    """Machine code of one function, from one process to the next; a file that cannot be used counts as none.

    It is used as long as the function's file is the same, and so are the functions that it calls and the numbers that it names.
    """

    _impl_class = _Content

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        self._own = f"{self._impl.locator.get_source_stamp().hex()} {function.__qualname__}"  # now: of the code that is loaded
        self._compiling = ExitStack()

    def stamp(self, seen: set[str]) -> set[str]:
        """Add to ``seen``, and return, what the machine code depends on."""
        if self._own not in seen:
            seen.add(self._own)
            known = self._py_func.__globals__
            for name in _names(self._py_func.__code__):
                value = known.get(name)
                if isinstance(kept := getattr(value, "_cache", None), _Kept):
                    kept.stamp(seen)
                elif isinstance(value, int | float | str | tuple | np.generic) and " at 0x" not in (text := repr(value)):
                    seen.add(f"{name} = {text}")
        return seen

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        self._cache_file._source_stamp = " ".join(sorted(self.stamp(set())))
        found = self._load(sig, target_context)
        if found is None:
            self._compiling.enter_context(compiling(f"{self.cache_path} {self._impl.filename_base}"))
            found = self._load(sig, target_context)  # who held it may have kept it
        if found is not None:
            self._compiling.close()
        return found

    def _load(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # whatever a torn file, or one of another version, makes its reader raise
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        with self._compiling, suppress(OSError):  # a full disk: the next process compiles it again
            super().save_overload(sig, data)


def _names(code: CodeType) -> Iterator[str]:
    """Names that a function's code looks up, those of functions inside it included."""
    yield from code.co_names
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _names(inner)


def compiled(function: Callable[..., Any] | None = None, *, signatures: Sequence[Any] = (), **options: Any) -> Any:
    """Decorate a function that is compiled at its first call and kept: ``numba.njit`` with the cache of this package.

    Args:
        function: to compile.
        signatures: compile it at once, for these only.
        options: of ``numba.njit``.
    """
    if function is None:
        return partial(compiled, signatures=signatures, **options)
    dispatcher = njit(nogil=True, **options)(function)
    dispatcher._cache = _Kept(function)  # pyright: ignore[reportAttributeAccessIssue]
    for signature in signatures:
        dispatcher.compile(signature)
    if signatures:
        dispatcher.disable_compile()
    return dispatcher


#: Decorator of a kernel that only other kernels call: without what Python would call it by, which takes time to compile.
inner_kernel = partial(compiled, no_cpython_wrapper=True, no_cfunc_wrapper=True)


# ---- straight-line source as LLVM instructions -----------------------------------------------------------------------

# numba's own analysis takes four fifths of a large kernel's compile time. The source is what ``emit`` of
# wlr_gym.physics.codegen prints. Each operation becomes the one instruction that numba would choose: strict IEEE, ``fma`` with
# one rounding. The results are numba's own, to the bit (``tests/physics/codegen/test_codegen.py``).


_NUMBERS = {ast.Add: "fadd", ast.Sub: "fsub", ast.Mult: "fmul", ast.Div: "fdiv"}
_INDICES = {ast.Add: "add", ast.Mult: "mul"}
_COMPARISONS = {ast.Lt: "<", ast.Gt: ">"}
_FUNCTIONS = {"math.sqrt": "llvm.sqrt", "np.floor": "llvm.floor", "abs": "llvm.fabs"}
_LIBRARY = {"math.exp": math.exp, "math.tanh": math.tanh, "math.atan2": math.atan2}


def straight_line(text: str, names: str, kinds: Sequence[Any]) -> tuple[Any, Callable[..., Any]]:
    """Return what a numba ``@intrinsic`` returns for straight-line source.

    Args:
        text: one assignment a line, to a name or to ``pointer[index]``, of numbers: ``+ - * /``, ``fma(a, b, c)``, ``abs(a)``,
            ``select(a > b, c, d)``, ``np.floor(a)``, ``F(number)``, ``element(low, middle, high, index)`` (a float64 number at
            an index of the array at an address, its 16 lowest bits first), and of ``math``: sqrt, exp, tanh, atan2.
        names: the intrinsic's parameters, ``"w k step"``.
        kinds: their numba types: pointers (``numbers_of``), integers for indices, and numbers in the pointers' precision.
    """
    number = next(kind.dtype for kind in kinds if isinstance(kind, types.CPointer))
    wanted = [number if isinstance(kind, types.Float) else kind for kind in kinds]

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        lowering = _Lowering(context, builder, number, dict(zip(names.split(), values, strict=True)))
        for statement in ast.parse(text).body:
            lowering.assign(statement)
        if lowering.elements:
            lowering.separate()
        return context.get_dummy_value()

    return types.none(*wanted), generate


@cache
def _look_at_many_places() -> None:
    """Let LLVM tell apart what more than 250 places in memory hold; where it does not, it takes them all for one."""
    llvm.set_option("wlr_gym", "-alias-set-saturation-threshold=100000")


class _Lowering:
    """Writes instructions; ``known`` holds the values of names."""

    def __init__(self, context: Any, builder: Any, number: Any, known: dict[str, Any]) -> None:
        self.context = context
        self.builder = builder
        self.number = number
        self.known = known
        self.elements: list[Any] = []
        self.others: list[Any] = []

    def separate(self) -> None:
        """Tell LLVM that elements lie apart from all else that is read or written: it would go robot by robot otherwise."""
        _look_at_many_places()
        module = self.builder.module
        domain = module.add_metadata([ir.MetaDataString(module, "wlr_gym")])
        scopes = module.add_metadata([module.add_metadata([ir.MetaDataString(module, "elements"), domain])])
        for instructions, kind in ((self.elements, "alias.scope"), (self.others, "noalias")):
            for instruction in instructions:
                instruction.set_metadata(kind, scopes)

    def assign(self, statement: ast.stmt) -> None:
        match statement:
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                self.known[name] = self.value(value)
            case ast.Assign(targets=[ast.Subscript() as target], value=value):
                self.others.append(self.builder.store(self.value(value), self.address(target)))
            case _:
                raise TypeError(f"straight_line: not an assignment: {ast.unparse(statement)}")

    def address(self, node: ast.Subscript) -> Any:
        return self.builder.gep(self.value(node.value), [self.index(node.slice)])

    def index(self, node: ast.expr) -> Any:
        match node:
            case ast.Constant(value=int(value)):
                return ir.Constant(ir.IntType(64), value)
            case ast.BinOp(left=left, op=op, right=right):
                return getattr(self.builder, _INDICES[type(op)])(self.index(left), self.index(right), flags=["nsw"])
        return self.value(node)

    def value(self, node: ast.expr) -> Any:
        match node:
            case ast.Name(id=name):
                return self.known[name]
            case ast.Constant(value=value):
                return self.context.get_constant(self.number, value)
            case ast.Subscript():
                self.others.append(found := self.builder.load(self.address(node)))
                return found
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as value)):
                return self.context.get_constant(self.number, -value)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return self.builder.fneg(self.value(operand))
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub() | ast.Mult() | ast.Div() as op, right=right):
                return getattr(self.builder, _NUMBERS[type(op)])(self.value(left), self.value(right))
            case ast.Compare(left=left, ops=[op], comparators=[right]):
                return self.builder.fcmp_ordered(_COMPARISONS[type(op)], self.value(left), self.value(right))
            case ast.Call(func=function, args=arguments):
                return self.call(ast.unparse(function), [self.value(argument) for argument in arguments])
        raise TypeError(f"straight_line: unknown expression: {ast.unparse(node)}")

    def call(self, name: str, arguments: list[Any]) -> Any:
        match name:
            case "F":
                return arguments[0]
            case "fma":
                return self.builder.fma(*arguments)
            case "select":
                return self.builder.select(*arguments)
            case "element":
                return self.element(*arguments)
        if name in _LIBRARY:
            function = self.context.get_function(_LIBRARY[name], self.number(*[self.number] * len(arguments)))
            return function(self.builder, arguments)
        if name not in _FUNCTIONS:
            raise TypeError(f"straight_line: unknown function: {name}")
        function = self.builder.module.declare_intrinsic(_FUNCTIONS[name], (self.context.get_value_type(self.number),))
        return self.builder.call(function, arguments)

    def element(self, *arguments: Any) -> Any:
        """Read a number by address and index."""
        *parts, index = (self.builder.fptosi(value, ir.IntType(64)) for value in arguments)
        address = parts[0]
        for k, part in enumerate(parts[1:], 1):
            address = self.builder.or_(address, self.builder.shl(part, ir.Constant(ir.IntType(64), 16 * k)))
        array = self.builder.inttoptr(address, ir.DoubleType().as_pointer())
        found = self.builder.load(self.builder.gep(array, [index]))
        self.elements.append(found)
        return found if self.number is types.float64 else self.builder.fptrunc(found, self.context.get_value_type(self.number))


# ---- what numba lacks: fused multiply-add, choice without a branch, arrays by address, whole vector registers --------


@intrinsic
def fma(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """Return a*b + c rounded once, the same bits at every vector width; float32 or float64, all operands alike."""
    kind = types.float32 if types.float32 in (a, b, c) else types.float64

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        operands = [context.cast(builder, value, source, kind) for value, source in zip(arguments, signature.args, strict=True)]
        llvm_type = ir.FloatType() if kind is types.float32 else ir.DoubleType()
        name = f"llvm.fma.{'f32' if kind is types.float32 else 'f64'}"
        function = builder.module.declare_intrinsic(name, (), ir.FunctionType(llvm_type, [llvm_type] * 3))
        return builder.call(function, operands)

    return kind(a, b, c), generate


@intrinsic
def select(typing_context: Any, condition: Any, a: Any, b: Any) -> Any:
    """Return ``a if condition else b`` of two numbers of one type: one instruction, where numba's own makes three blocks."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(*arguments)

    return a(types.boolean, a, a), generate


@intrinsic
def array_at(typing_context: Any, address: Any) -> Any:
    """Return the float64 numbers that lie one after the other from ``address``; nothing checks the index."""
    kind = types.CPointer(types.float64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(kind))

    return kind(types.intp), generate


@intrinsic
def numbers_of(typing_context: Any, array: Any) -> Any:
    """Return the numbers of a contiguous array by their place; nothing checks the index."""
    kind = types.CPointer(array.dtype)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return context.make_array(array)(context, builder, arguments[0]).data

    return kind(array), generate


@intrinsic
def whole_registers(typing_context: Any) -> Any:
    """Let the function in which this stands use vector registers of 512 bits where there are any.

    Left alone, LLVM uses half of them on most processors that have them, in case other code suffers from a slower clock.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        # llvmlite checks names against its own list, which lacks the attributes that are texts.
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.none(), generate


@intrinsic
def bits_of(typing_context: Any, value: Any) -> Any:
    """Return the bits of a float64 as an int64."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(64))

    return types.int64(types.float64), generate


@intrinsic
def number_of_bits(typing_context: Any, value: Any) -> Any:
    """Return the float64 with the bits of an int64."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.DoubleType())

    return types.float64(types.int64), generate
