"""Sweeps on Ray. It chooses the node; there a trial is the same process as on one machine. Ray Tune searches settings.

What a search knows is in the folder of the sweep alone. One that is resumed first tries the settings that it had begun: trials
that are over say their scores again, the others go on from their checkpoints, and new ones follow.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
from collections.abc import Callable, Container, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError
from wlr_gym.base.jobs import Ended, Job, follow
from wlr_gym.learning.curves import METRICS
from wlr_gym.learning.sweep.book import Book
from wlr_gym.learning.sweep.plan import REDUCTION, SCORES, SweepPlan, Trial
from wlr_gym.learning.sweep.trial import job_of

#: Address that means: start Ray on this machine.
LOCAL = "local"
#: How often a job is started again after its node was lost.
RETRIES = 20
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
    try:
        yield
    finally:
        ray.shutdown()


def spread_on_ray(jobs: Iterable[Job], at_once: int | None = None) -> Generator[Ended, None, None]:
    """Run jobs on the connected cluster, a core each; yield how each ended, as it does.

    A job whose node is lost is started again on another one.

    Args:
        jobs: what to run; their logs lie on storage that all nodes share.
        at_once: most jobs at a time; None = as many as the cluster has cores.
    """
    import ray
    from ray.exceptions import RayError

    def follow_quietly(job: Job) -> str:
        return follow(job, lambda said: None)

    left, running = list(jobs), {}
    run = ray.remote(num_cpus=1, max_retries=RETRIES)(follow_quietly)
    try:
        while left or running:
            while left and (at_once is None or len(running) < at_once):
                job = left.pop(0)
                running[run.remote(job)] = job
            (ready,), _ = ray.wait(list(running), num_returns=1)
            try:
                error = ray.get(ready)
            except RayError as problem:
                error = f"Ray: {str(problem).strip().splitlines()[-1]}"  # the lines above are the trace
            yield Ended(running.pop(ready).name, error)
    finally:
        for reference in running:
            ray.cancel(reference, force=True)


# ---- searches by Ray Tune --------------------------------------------------------------------------------------------

#: No files of its own for each trial, no warnings, and Ctrl-C ends it.
_QUIET = {
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
    "TUNE_WARN_THRESHOLD_S": "60",
    "TUNE_DISABLE_SIGINT_HANDLER": "1",
    "TUNE_DISABLE_STRICT_METRIC_CHECKING": "1",
    "RAY_AIR_NEW_OUTPUT": "0",
}


def search_with_tune(book: Book, at_once: int | None) -> None:
    """Search on the connected cluster; each settings is trained with the first seed, and told to the sweep's book.

    Args:
        book: of the sweep. What it has begun is tried first: all of a grid or of random settings, or what Optuna chose before
            an interruption.
        at_once: most trials at a time; None = as many as the cluster has cores.
    """
    os.environ.update(_QUIET | {name: os.environ[name] for name in _QUIET if name in os.environ})
    import optuna
    from ray import tune
    from ray.tune.schedulers import ASHAScheduler
    from ray.tune.search.optuna import OptunaSearch

    plan, first = book.plan, book.begun()
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
    total = plan.settings.get("total_steps", 0) if search.early_stopping else 0
    stopper = None
    if search.early_stopping:  # max_t: no rung at the end, a trial that gets there writes its policy
        rungs: dict[str, Any] = {"max_t": total - 1, "grace_period": total // SCORES, "reduction_factor": REDUCTION}
        stopper = ASHAScheduler(time_attr="steps", stop_last_trials=False, **rungs, **mode)
    storage = book.folder.resolve() / ".ray_tune"
    trainable = _trainable(plan, book.folder.resolve(), book.stopped)
    tuner = tune.Tuner(
        tune.with_resources(trainable, {"cpu": 1}),
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
            callbacks=[_watch(book, total)],
            verbose=0,
        ),
    )
    try:
        tuner.fit()
    finally:
        shutil.rmtree(storage, ignore_errors=True)


def _trainable(plan: SweepPlan, out: Path, stopped: Container[str]) -> Callable[[Mapping[str, Any]], None]:
    """Return what Tune runs on a node: a trial's job, whose scores it hears; of one that was stopped before, those it has."""

    def train(config: Mapping[str, Any]) -> None:
        from ray import tune

        trial = _trial(plan, config)
        job = job_of(plan, trial, out, "say" if trial.name in stopped else "train and say")
        error = follow(job, lambda scores: tune.report(dict(scores)))
        if error:
            tune.report({plan.metric: _WORST if METRICS[plan.metric] else -_WORST, "error": error})

    return train


def _watch(book: Book, total: int) -> Any:
    """Return a callback that tells which trials begin, and how they ended: early, where that was before ``total`` steps."""
    from ray import tune

    class Watch(tune.Callback):
        book: Book

        def __getstate__(self) -> dict[str, Any]:
            return {}  # Tune keeps copies of its settings, which need not tell anybody

        def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
            self.book.begin(_trial(self.book.plan, trial.config))

        def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
            last = trial.last_result or {}
            self.book.end(_trial(self.book.plan, trial.config), last.get("error", ""), last.get("steps", total) < total)

        def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
            self.book.end(_trial(self.book.plan, trial.config), f"Ray: {trial.get_error()}", False)

    watch = Watch()
    watch.book = book  # here, not in the class: that is copied with all that it refers to
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
    return Trial(_coded(plan, config, json.loads), plan.seed_list[0])
