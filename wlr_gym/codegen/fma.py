"""Fused multiply-add for numba: ``fma(a, b, c)`` = a*b + c rounded once, the same bits at every vector width."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic


@intrinsic
def fma(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """Return a*b + c with one rounding; float32 or float64, all operands alike."""
    kind = types.float32 if types.float32 in (a, b, c) else types.float64

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        operands = [context.cast(builder, value, source, kind) for value, source in zip(arguments, signature.args, strict=True)]
        llvm_type = ir.FloatType() if kind is types.float32 else ir.DoubleType()
        name = f"llvm.fma.{'f32' if kind is types.float32 else 'f64'}"
        function = builder.module.declare_intrinsic(name, (), ir.FunctionType(llvm_type, [llvm_type] * 3))
        return builder.call(function, operands)

    return kind(a, b, c), generate
