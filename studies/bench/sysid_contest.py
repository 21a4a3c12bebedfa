"""A calibration in two hands: the same numbers fitted to the same data by our fit and by ``mujoco.sysid``, in one paired run.

Time is the processor's, on one thread each, so that other jobs on the machine count little.
"""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from studies.bench.measure import Measurement, against_fastest
from wlr_gym.gap.estimation.fit import CONVERGED, fit
from wlr_gym.gap.estimation.model import nominal_model
from wlr_gym.gap.problem import Problem, Quantity

Array = NDArray[np.float64]

Optimiser = Literal["mujoco", "scipy_parallel_fd"]
#: The peer's two ways to a minimum: its own optimiser, and scipy's on the same batched finite differences.
OPTIMISERS: Mapping[str, Optimiser] = {"mujoco.sysid": "mujoco", "mujoco.sysid, scipy": "scipy_parallel_fd"}
#: Of its finite differences, in tolerances: its own 1.5e-8 is below what a contact solver resolves.
PEER_STEP = 1e-4
#: Of its iterations, at most: on contacts its own tolerances of 1e-8 are not met by noise of the solver's size.
PEER_ITERATIONS = 20
#: Numbers scaled by the Jacobian, as its authors advise.
OPTIONS: Mapping[str, Mapping[str, Any]] = {
    "mujoco": {"x_scale": "jac", "eps": PEER_STEP},
    "scipy_parallel_fd": {"x_scale": "jac", "diff_step": PEER_STEP},
}


#: Fits once.
Fitter = Callable[[], "Fitted"]


@dataclass(frozen=True, eq=False)
class Fitted:
    """What one side found.

    Attributes:
        values: (numbers) SI.
        seconds: of processor time to its own convergence.
        settled: s until its sum of squares was within ``CONVERGED`` of its last; a fit of ours ends there by itself.
    """

    values: Array
    seconds: float
    settled: float


@dataclass(frozen=True, eq=False)
class Contest:
    """One system that both sides calibrate.

    Attributes:
        name: of the system, with the size of the task.
        quantities: what is fitted. truth: (numbers) their values behind the data.
        ours: fits with this package. peers: fit with ``mujoco.sysid``, by name of the optimiser.
    """

    name: str
    quantities: tuple[Quantity, ...]
    truth: Array
    ours: Fitter
    peers: Mapping[str, Fitter]

    def error(self, found: Fitted) -> float:
        """Return the largest error of a fit, in % of a tolerance."""
        sigma = np.array([quantity.sigma for quantity in self.quantities])
        return 100.0 * float(np.abs((found.values - self.truth) / sigma).max())


@dataclass(frozen=True, eq=False)
class PeerRun:
    """One run as ``mujoco.sysid`` sees it.

    Attributes:
        model: of the right sizes.
        build: from the fitted numbers to a compiled model.
        times: (steps) s. control: (steps, actuators). start: full physics state.
        residual: from the fitted numbers and the states (steps - 1, states) after each step to residuals.
    """

    model: Any
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

    def fit(self, optimiser: Optimiser) -> Fitted:
        """Minimise to the optimiser's own tolerances."""
        from mujoco import sysid

        names = ("nominal", "sigma", "low", "high")
        nominal, sigma, low, high = (np.array([getattr(q, name) for q in self.quantities]) for name in names)
        parameters = sysid.ParameterDict()
        parameters.add(sysid.Parameter("tolerances", np.zeros(len(sigma)), (low - nominal) / sigma, (high - nominal) / sigma))
        parts = [_residual_function(run, lambda given: nominal + sigma * given.as_vector()) for run in self.runs]
        trace: list[tuple[float, float]] = []

        def residuals(x: Array, given: Any, **options: Any) -> tuple[list[Array], list[Any], list[Any]]:
            found = [block for part in parts for block in part(x, given, **options)[0]]
            found.append(x)
            if x.ndim == 1 or x.shape[1] == 1:
                trace.append((time.process_time() - begin, sum(float(np.sum(block**2)) for block in found)))
            return found, [], []

        begin = time.process_time()
        with contextlib.redirect_stdout(io.StringIO()):  # its optimisers cannot be told to be silent
            chosen = sysid.optimize(
                parameters, residuals, optimiser, verbose=False, max_iters=PEER_ITERATIONS, **OPTIONS[optimiser]
            )[1].x
        seconds = time.process_time() - begin
        return Fitted(nominal + sigma * np.ravel(chosen), seconds, settled(trace))


def settled(trace: Sequence[tuple[float, float]]) -> float:
    """Return when (s) a trace of time and sum of squares first came within ``CONVERGED`` of its least."""
    least = min(cost for _, cost in trace)
    return next(seconds for seconds, cost in trace if cost <= least + CONVERGED)


@dataclass(frozen=True)
class _Compiled:
    """All that ``ModelSequences`` asks of a specification where models are built elsewhere."""

    model: Any

    def compile(self) -> Any:
        return self.model


def _residual_function(run: PeerRun, numbers: Callable[[Any], Array]) -> Callable[..., Any]:
    from mujoco import sysid

    measured = sysid.TimeSeries(run.times, np.zeros((len(run.times), 0)))

    def compare(given: Any, predicted: Any, _: Any, model: Any, return_all: bool, state: Array) -> tuple[Array, Any, Any]:
        return run.residual(numbers(given), state), measured, measured

    control = sysid.TimeSeries(run.times, run.control)
    sequence = sysid.ModelSequences("model", _Compiled(run.model), "run", run.start, control, measured)
    return sysid.build_residual_fn(
        models_sequences=[sequence],
        build_model=lambda given, spec: run.build(numbers(given)),
        modify_residual=compare,
        n_threads=1,
        resample_true=False,
    )


def contest_between(name: str, problem: Problem, truth: Array, peer: PeerProblem) -> Contest:
    """Return the contest over all runs of a problem; ours is the fit with which the gap workflow calibrates."""
    runs = range(len(problem.runs))

    def ours() -> Fitted:
        begin = time.process_time()
        values = fit(problem, runs, nominal_model(problem), steps=problem.steps).model.quantities
        seconds = time.process_time() - begin
        return Fitted(values, seconds, seconds)

    peers = {label: partial(peer.fit, optimiser) for label, optimiser in OPTIMISERS.items()}
    return Contest(f"{name}, {len(truth)} numbers", problem.quantities, truth, ours, peers)


def rows(contest: Contest, rounds: int) -> list[Measurement]:
    """Let both sides fit in turn, and return what a contest adds to the report."""
    fitters = {"ours": contest.ours, **contest.peers}
    contest.ours()  # compiles
    found: dict[str, list[Fitted]] = {name: [] for name in fitters}
    for _ in range(rounds):
        for name, fitter in fitters.items():
            found[name].append(fitter())
    report = []
    for what, clock in (("same fit", "settled"), ("own convergence", "seconds")):
        rates = {name: tuple(3600.0 / max(getattr(one, clock), 1e-9) for one in fits) for name, fits in found.items()}
        bar = 1.0 if clock == "settled" else None
        ours = rates.pop("ours")
        report.append(against_fastest("sysid", f"{contest.name}, to {what}", "fits/h", ours, rates, bar))
    for name, fits in found.items():
        errors = tuple(contest.error(one) for one in fits)
        report.append(Measurement("sysid", f"{contest.name}, largest error, {name}", "% of a tolerance", errors))
    return report
