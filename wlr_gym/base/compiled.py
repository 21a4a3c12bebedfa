"""All that goes beyond numba's public use: nothing else in the package touches its or LLVM's insides.

Functions that take records of this package, and their machine code kept from one process to the next; straight-line source
lowered to LLVM; what numba lacks.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from llvmlite import binding as llvm
from llvmlite import ir
from numba import njit, types
from numba.core.caching import FunctionCache
from numba.extending import intrinsic

#: Decorator of a kernel that only other kernels call: without what Python would call it by, which takes time to compile.
inner_kernel: Any = njit(  # numba's stubs lack two of the options
    cache=True,
    nogil=True,
    no_cpython_wrapper=True,
    no_cfunc_wrapper=True,  # pyright: ignore[reportCallIssue]
)


class _Kept(FunctionCache):
    """Machine code beside the source; what another version left there and cannot be read any more counts as none.

    numba reads the whole index, classes of its arguments included, before it asks whether the index is of this source: where
    such a class has been moved or renamed since, its own cache fails.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # whatever a file of another version makes its reader raise
            self.flush()
            return None


def compiled(function: Callable[..., Any], *signatures: Any) -> Any:
    """Compile a function at its first call, or at once for given signatures only, and keep it (``numba.njit`` with a cache).

    For functions whose arguments are named tuples of this package; those of arrays and numbers need no more than numba's own.
    """
    dispatcher = njit(nogil=True)(function)
    dispatcher._cache = _Kept(function)  # pyright: ignore[reportAttributeAccessIssue]
    for signature in signatures:
        dispatcher.compile(signature)
    if signatures:
        dispatcher.disable_compile()
    return dispatcher


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
