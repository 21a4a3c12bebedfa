"""What numba lacks: fused multiply-add, choice without a branch, arrays by address, whole vector registers."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic


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
