"""Sweeps on Ray. It chooses the node; there a trial is the same process as on one machine. Ray Tune searches settings.

What a search knows is in the folder of the sweep alone. One that is resumed first tries the settings that it had begun: trials
that are over say their scores again, the others go on from their checkpoints, and new ones follow.
"""

from __future__ import annotations

import importlib
import json
import os
import shutil
import socket
from collections.abc import Callable, Container, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from wlr_gym.base import jobs as jobs_module
from wlr_gym.base.errors import InputError
from wlr_gym.base.jobs import Ended, Job, follow
from wlr_gym.learning.curves import METRICS
from wlr_gym.learning.sweep.plan import REDUCTION, SCORES, SearchPlan, SweepPlan, Trial, trial_of
from wlr_gym.learning.sweep.trial import job_of

#: Address that means: start Ray on this machine.
LOCAL = "local"
#: How often a job is started again after its node was lost.
RETRIES = 20
#: Which nodes may be used, as Ray takes it; empty = all.
NodeSelector = Mapping[str, str]
#: Score of a trial that failed, worse than any (negative where more is better).
_WORST = 1e9


@contextmanager
def connected(address: str, workers: int | None) -> Iterator[None]:
    """Connect to a Ray cluster, or start Ray on this machine (loopback only, no dashboard), until the end of the block.

    Args:
        address: :data:`LOCAL`, ``auto`` or that of the head node (``10.0.0.1:6379``).
        workers: cores of a Ray that is started here; None = all.

    Raises:
        InputError: there is no such cluster, or Ray cannot be started.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    os.environ.setdefault("RAY_worker_niceness", "0")  # 15 otherwise: trials would stand still beside other work
    import ray
    from ray import cloudpickle

    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    try:
        if address == LOCAL:
            ray.init(address="local", num_cpus=workers, include_dashboard=False, _node_ip_address="127.0.0.1", **quiet)
        else:
            host, _, port = address.rpartition(":")
            if host and port.isdigit():  # where nothing listens, Ray itself would wait for minutes
                socket.create_connection((host, int(port)), timeout=5.0).close()
            ray.init(address=address, **quiet)
    except Exception as error:  # Ray raises that itself where a node takes more than 30 s to start
        what = "Ray cannot be started" if address == LOCAL else "no Ray cluster answers"
        raise InputError(f"--ray {address}: {what}: {next(iter(str(error).splitlines()), type(error).__name__)}") from None
    whole = (jobs_module, importlib.import_module(__name__))  # sent whole: nodes that lack this package can then say so
    for module in whole:
        cloudpickle.register_pickle_by_value(module)
    try:
        yield
    finally:
        for module in whole:
            cloudpickle.unregister_pickle_by_value(module)
        ray.shutdown()


def spread_on_ray(jobs: Iterable[Job], nodes: NodeSelector, at_once: int | None = None) -> Generator[Ended, None, None]:
    """Run jobs on the connected cluster, a core each; yield how each ended, as it does.

    A job whose node is lost is started again on another one.

    Args:
        jobs: what to run; their logs lie on storage that all nodes share.
        nodes: of :func:`fit_nodes`.
        at_once: most jobs at a time; None = as many as the cluster has cores.
    """
    import ray

    left, running = list(jobs)[::-1], {}
    run = ray.remote(num_cpus=1, max_retries=RETRIES)(run_on_node).options(label_selector=dict(nodes))
    try:
        while left or running:
            while left and (at_once is None or len(running) < at_once):
                job = left.pop()
                running[run.remote(job)] = job
            ready, _ = ray.wait(list(running), num_returns=1)
            yield Ended(running.pop(ready[0]).name, _error(ready[0]))
    finally:
        for reference in running:
            ray.cancel(reference, force=True)


def _error(reference: Any) -> str:
    import ray
    from ray.exceptions import RayError

    try:
        return ray.get(reference)
    except RayError as error:
        return f"Ray: {str(error).strip().splitlines()[0]}"


def fit_nodes(check: Job, say: Callable[[str], object]) -> NodeSelector:
    """Run a job on every node of the connected cluster and return the nodes on which it ends well.

    Args:
        check: finds out whether a node has what is needed.
        say: told of nodes that are left out, and why.

    Raises:
        InputError: there is none.
    """
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    run = ray.remote(num_cpus=0, max_retries=0)(run_on_node)
    hosts = {
        node["NodeID"]: f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})" for node in ray.nodes() if node["Alive"]
    }
    asked = {
        node: run.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False)).remote(check) for node in hosts
    }
    errors = {node: error for node, reference in asked.items() if (error := _error(reference))}
    for node, error in errors.items():
        say(f"node {hosts[node]} is left out: {error}")
    if len(errors) == len(hosts):
        raise InputError(f"no node of the cluster can train; {hosts[next(iter(errors))]}: {next(iter(errors.values()))}")
    return {"ray.io/node-id": f"!in({','.join(errors)})"} if errors else {}


def run_on_node(job: Job, hear: Callable[[dict[str, Any]], object] = lambda message: None) -> str:
    """Run a job on the node where this is called, and ``hear`` what it says; return its error, empty where all went well."""
    try:
        importlib.import_module("wlr_gym")
    except ImportError as error:
        return f"{error}; it needs wlr-gym[train], the version that started this"
    folder = os.path.dirname(job.log)
    if not os.path.isdir(folder):
        return f"it does not see {folder}: all nodes must share that storage"
    return follow(job, hear)


# ---- searches by Ray Tune --------------------------------------------------------------------------------------------


def search_with_tune(
    plan: SweepPlan,
    out: Path,
    first: Sequence[Mapping[str, Any]],
    stopped: Container[str],
    nodes: NodeSelector,
    at_once: int | None,
    began: Callable[[Trial], object],
    ended: Callable[[Trial, str, bool], object],
) -> None:
    """Search on the connected cluster; each settings is trained with the first seed.

    Args:
        plan: with a search.
        out: folder of the sweep.
        first: settings that are tried first: all of a grid or of random ones, or what Optuna chose before an interruption.
        stopped: names of trials that were stopped early before.
        nodes: of :func:`fit_nodes`.
        at_once: most trials at a time; None = as many as the cluster has cores.
        began: told of each trial that begins.
        ended: told of each trial that is over, its error, and whether it was stopped early.
    """
    for name, value in _QUIET.items():
        os.environ.setdefault(name, value)
    import optuna
    from ray import tune
    from ray.tune.schedulers import ASHAScheduler
    from ray.tune.search.optuna import OptunaSearch

    search = plan.search
    assert search is not None
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    mode: dict[str, Any] = {"metric": search.metric, "mode": "min" if METRICS[search.metric] else "max"}
    searcher = OptunaSearch(
        space={name: _distribution(values) for name, values in plan.space.items()},
        # a resumed search draws other numbers than those that are known already
        sampler=optuna.samplers.TPESampler(seed=search.seed + len(first)),
        points_to_evaluate=[_coded(plan, settings, json.dumps) for settings in first] or None,
        **mode,
    )
    total = plan.settings.get("total_steps", 0)
    stopper = ASHAScheduler(
        time_attr="steps",
        max_t=total - 1,  # no rung at the end: a trial that gets there writes its policy
        stop_last_trials=False,
        grace_period=total // SCORES,
        reduction_factor=REDUCTION,
        **mode,
    ) if search.early_stopping else None  # fmt: skip
    selector: dict[str, Any] = {"bundle_label_selector": [dict(nodes)]} if nodes else {}
    storage = out.resolve() / ".ray_tune"
    tuner = tune.Tuner(
        tune.with_resources(
            _trainable(plan, search, out.resolve(), stopped), tune.PlacementGroupFactory([{"CPU": 1.0}], **selector)
        ),
        tune_config=tune.TuneConfig(
            search_alg=searcher,
            scheduler=stopper,
            num_samples=max(search.trials, len(first)) if search.method == "optuna" else len(first),
            max_concurrent_trials=at_once,
        ),
        run_config=tune.RunConfig(
            name="search",
            storage_path=str(storage),
            failure_config=tune.FailureConfig(max_failures=RETRIES),  # nodes that are lost; a trial's own error raises nothing
            callbacks=[_watch(plan, total if search.early_stopping else 0, began, ended)],
            verbose=0,
        ),
    )
    try:
        tuner.fit()
    finally:
        shutil.rmtree(storage, ignore_errors=True)


#: No files of its own for each trial, no warnings, and Ctrl-C ends it.
_QUIET = {
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
    "TUNE_WARN_THRESHOLD_S": "60",
    "TUNE_DISABLE_SIGINT_HANDLER": "1",
    "TUNE_DISABLE_STRICT_METRIC_CHECKING": "1",
    "RAY_AIR_NEW_OUTPUT": "0",
}


def _trainable(plan: SweepPlan, search: SearchPlan, out: Path, stopped: Container[str]) -> Callable[[Mapping[str, Any]], None]:
    """Return what Tune runs on a node: a trial's job, whose scores it hears."""

    def train(config: Mapping[str, Any]) -> None:
        from ray import tune

        trial = _trial(plan, config)
        job = job_of(plan, trial, out, report=True, train=trial.name not in stopped)
        error = run_on_node(job, lambda scores: tune.report(dict(scores)))
        if error:
            tune.report({search.metric: _WORST if METRICS[search.metric] else -_WORST, "error": error})

    return train


def _watch(plan: SweepPlan, total: int, began: Callable[[Trial], object], ended: Callable[[Trial, str, bool], object]) -> Any:
    """Return a callback that tells which trials begin, and how they ended: early, where that was before ``total`` steps."""
    from ray import tune

    class Watch(tune.Callback):
        began: Callable[[Trial], object]
        ended: Callable[[Trial, str, bool], object]

        def __getstate__(self) -> dict[str, Any]:
            return {}  # Tune keeps copies of its settings, which need not tell anybody

        def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
            self.began(_trial(plan, trial.config))

        def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
            last = trial.last_result or {}
            self.ended(_trial(plan, trial.config), last.get("error", ""), last.get("steps", total) < total)

        def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
            self.ended(_trial(plan, trial.config), f"Ray: {trial.get_error()}", False)

    watch = Watch()
    watch.began, watch.ended = began, ended  # here, not in the class: that is copied with all that it refers to
    return watch


def _distribution(values: Any) -> Any:
    """Return the values of a setting, a list or a range, as Optuna takes them."""
    from optuna import distributions

    if isinstance(values, list):
        return distributions.CategoricalDistribution([json.dumps(value) for value in values])
    if values.whole:
        return distributions.IntDistribution(int(values.low), int(values.high), log=values.log)
    return distributions.FloatDistribution(values.low, values.high, log=values.log)


def _coded(plan: SweepPlan, settings: Mapping[str, Any], code: Callable[[Any], Any]) -> dict[str, Any]:
    """Return settings with those from lists, which Optuna has as JSON, coded to it or back."""
    return {name: code(settings[name]) if isinstance(values, list) else settings[name] for name, values in plan.space.items()}


def _trial(plan: SweepPlan, config: Mapping[str, Any]) -> Trial:
    return trial_of(_coded(plan, config, json.loads), plan.seed_list[0])
