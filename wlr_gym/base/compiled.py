"""Compiled functions that take records of this package, and their machine code kept from one process to the next."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit
from numba.core.caching import FunctionCache

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
