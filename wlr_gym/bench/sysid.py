"""Calibration against ``mujoco.sysid``: the same numbers fitted to the same data, in one paired run.

Time is the processor's, on one thread each, so that other jobs on the machine count little.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.bench.measure import Measurement, Size, against_fastest, interleave
from wlr_gym.errors import MissingPackageError
from wlr_gym.gap.fit import SETTLED
from wlr_gym.gap.problem import Quantity

Array = NDArray[np.float64]

#: The peer's two ways to a minimum: its own optimiser, and scipy's on the same batched finite differences. Both scale the
#: numbers by the Jacobian, as its documentation advises where they differ in size.
OPTIMISERS = {"mujoco.sysid": "mujoco", "mujoco.sysid, scipy": "scipy_parallel_fd"}


@dataclass(frozen=True, eq=False)
class Fitted:
    """What one side found.

    Attributes:
        values: (numbers) SI.
        seconds: of processor time to its own convergence.
        settled: s until its sum of squares was within ``SETTLED`` of its last; a fit of ours ends there by itself.
    """

    values: Array
    seconds: float
    settled: float


@dataclass(frozen=True, eq=False)
class PeerRun:
    """One run as ``mujoco.sysid`` sees it.

    Attributes:
        spec: a model with the right names and sizes.
        build: from the fitted numbers to a compiled model.
        times: (steps) s. control: (steps, actuators). start: full physics state.
        residual: from the fitted numbers and the states (steps - 1, states) after each step to residuals.
    """

    spec: Any
    build: Callable[[Array], Any]
    times: Array
    control: Array
    start: Array
    residual: Callable[[Array, Array], Array]


@dataclass(frozen=True, eq=False)
class PeerProblem:
    """A calibration in the terms of ``mujoco.sysid``; nominal values weigh by their tolerances, as residuals of their own."""

    quantities: tuple[Quantity, ...]
    runs: Sequence[PeerRun]

    def fit(self, optimiser: str) -> Fitted:
        """Minimise to the optimiser's own tolerances."""
        from mujoco import sysid

        names = ("nominal", "sigma", "low", "high")
        nominal, sigma, low, high = (np.array([getattr(q, name) for q in self.quantities]) for name in names)
        parameters = sysid.ParameterDict()
        parameters.add(sysid.Parameter("numbers", nominal, low, high))
        parts = [_residual_function(run) for run in self.runs]
        trace: list[tuple[float, float]] = []

        def residuals(x: Array, given: Any, **options: Any) -> tuple[list[Array], list[Any], list[Any]]:
            found = [block for part in parts for block in part(x, given, **options)[0]]
            found.append(((x.T - nominal) / sigma).T)
            if x.ndim == 1 or x.shape[1] == 1:
                trace.append((time.process_time() - begin, sum(float(np.sum(block**2)) for block in found)))
            return found, [], []

        begin = time.process_time()
        chosen = sysid.optimize(parameters, residuals, optimiser, verbose=False, x_scale="jac")[1].x
        seconds = time.process_time() - begin
        return Fitted(np.asarray(chosen, np.float64).ravel(), seconds, settled(trace))


def settled(trace: Sequence[tuple[float, float]]) -> float:
    """Return when (s) a trace of time and sum of squares first came within ``SETTLED`` of its least."""
    least = min(cost for _, cost in trace)
    return next(seconds for seconds, cost in trace if cost <= least + SETTLED)


def _residual_function(run: PeerRun) -> Callable[..., Any]:
    from mujoco import sysid

    measured = sysid.TimeSeries(run.times, np.zeros((len(run.times), 1)))

    def compare(given: Any, predicted: Any, _: Any, model: Any, return_all: bool, state: Array) -> tuple[Array, Any, Any]:
        return run.residual(given.as_vector(), state), measured, measured

    sequence = sysid.ModelSequences(
        "model", run.spec, "run", run.start, sysid.TimeSeries(run.times, run.control), measured, allow_missing_sensors=True
    )
    return sysid.build_residual_fn(
        models_sequences=[sequence],
        build_model=lambda given, spec: run.build(given.as_vector()),
        modify_residual=compare,
        n_threads=1,
        resample_true=False,
    )
