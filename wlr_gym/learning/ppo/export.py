"""The network of a policy as an ONNX graph: the mean action, clipped, as the policy computes it."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch

#: Before the names of weights that do not act.
LEARNER = "learner."


def to_onnx(actor: torch.nn.Module, width: int) -> bytes:
    """Return a serialised ONNX model: ``observation`` (N, width) to ``action``, N free, nothing else in it.

    Args:
        actor: maps observations to actions, both float32.
        width: of the observation.
    """
    robots = torch.export.Dim("robots")
    with _quiet():
        program = torch.onnx.export(
            actor.eval(),
            (torch.zeros(2, width),),
            dynamo=True,
            input_names=["observation"],
            output_names=["action"],
            dynamic_shapes=({0: robots},),
            external_data=False,
            verbose=False,
        )
    assert program is not None
    model: Any = program.model_proto
    graph = model.graph
    # Without what the exporter notes about itself: source files, stack traces, intermediate shapes.
    del model.metadata_props[:], graph.metadata_props[:], graph.value_info[:]
    for part in [*graph.node, *graph.input, *graph.output, *graph.initializer]:
        part.doc_string = ""
        del part.metadata_props[:]
    return model.SerializeToString(deterministic=True)


def with_learner(graph: bytes, weights: Mapping[str, torch.Tensor]) -> bytes:
    """Return an ONNX model that also holds what only a training needs: critic and exploration noise, beside the graph.

    Args:
        graph: serialised model. weights: those that do not act, by their names in the network.
    """
    import onnx
    from onnx import numpy_helper

    model = onnx.load_from_string(graph)
    for name, value in weights.items():
        model.graph.initializer.append(numpy_helper.from_array(value.numpy(), LEARNER + name))
    return model.SerializeToString(deterministic=True)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's warnings about packages that are not installed and its own deprecated calls."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
