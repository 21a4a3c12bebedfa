"""Write scalar maths once, trace it, compile it.

A function written with ``ops`` and the arithmetic operators runs on floats, on numpy arrays, and on :class:`Graph` nodes.
On nodes it builds an expression graph with shared sub-expressions, which :func:`emit` prints as straight-line source and
:func:`load_module` compiles with numba and caches. One source thus serves the readable reference and the fast kernel.
"""

from wlr_gym.physics.codegen.compilation import emit, load_module, source_of, straight_line_source
from wlr_gym.physics.codegen.ops import Graph, Inputs, Node, hoist, inputs_of

__all__ = ["Graph", "Inputs", "Node", "emit", "hoist", "inputs_of", "load_module", "source_of", "straight_line_source"]
