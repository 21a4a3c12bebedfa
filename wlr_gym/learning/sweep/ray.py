"""Sweeps on Ray. It chooses the node; there a trial is the same process as on one machine. Ray Tune searches settings.

What a search knows, Tune keeps in ``.ray_tune`` in the folder of the sweep, and goes on from there when the sweep is resumed.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from wlr_gym.base.errors import InputError
from wlr_gym.base.jobs import Ended, Job, follow
from wlr_gym.learning.curves import METRICS
from wlr_gym.learning.sweep.loop import SweepLoop
from wlr_gym.learning.sweep.plan import REDUCTION, SCORES, Trial
from wlr_gym.learning.sweep.results import STOPPED_EARLY, UNFINISHED
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

#: No files of its own for each trial, no warnings, and Ctrl-C ends it. What it knows is on the disk a second later.
_ENVIRONMENT = {
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
    "TUNE_WARN_THRESHOLD_S": "60",
    "TUNE_DISABLE_SIGINT_HANDLER": "1",
    "TUNE_DISABLE_STRICT_METRIC_CHECKING": "1",
    "TUNE_GLOBAL_CHECKPOINT_S": "1",
    "RAY_AIR_NEW_OUTPUT": "0",
}


def search_with_tune(loop: SweepLoop, at_once: int | None) -> list[Trial]:
    """Search on the connected cluster, or go on with a search; each settings is trained with the first seed.

    Args:
        loop: of the sweep; it is told which trials begin, and how they ended.
        at_once: most trials at a time; None = as many as the cluster has cores.

    Returns:
        The trials that had failed before the search was resumed, which Tune does not try again.
    """
    os.environ.update(_ENVIRONMENT | {name: os.environ[name] for name in _ENVIRONMENT if name in os.environ})
    import optuna
    from ray import tune
    from ray.tune.schedulers import ASHAScheduler
    from ray.tune.search.optuna import OptunaSearch

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    plan, known = loop.plan, loop.plan.known_settings()
    search, out = plan.search, loop.folder.resolve()
    assert search is not None
    total = plan.settings.get("total_steps", 0) if search.early_stopping else 0
    stopper = None
    if search.early_stopping:  # max_t: no rung at the end, a trial that gets there writes its policy
        rungs: dict[str, Any] = {"max_t": total - 1, "grace_period": total // SCORES, "reduction_factor": REDUCTION}
        stopper = ASHAScheduler(time_attr="steps", stop_last_trials=False, **rungs)
    ran: set[str] = set()
    seen: dict[str, bool] = {}

    def trial_of(config: Mapping[str, Any]) -> Trial:
        return Trial(config["settings"], plan.seed_list[0])

    def note(trials: Iterable[Any]) -> None:
        """Note trials of Tune that have begun or ended, each once; say how those ended that ran here."""
        for one in trials:
            over = one.is_finished()
            if seen.get(one.trial_id) == over:
                continue
            seen[one.trial_id] = over
            last, trial = one.last_result or {}, trial_of(one.config)
            if not over:
                loop.note(trial)
                continue
            error = f"Ray: {one.get_error()}" if one.status == "ERROR" else last.get("error", "")
            found = loop.note(trial, STOPPED_EARLY if last.get("steps", total) < total else UNFINISHED, error)
            if one.trial_id in ran:
                loop.tell(found, str(sum(seen.values())))

    class Watch(tune.Callback):
        def on_step_begin(self, iteration: int, trials: list[Any], **info: Any) -> None:
            note(trials)

        def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
            ran.add(trial.trial_id)

    def train(config: Mapping[str, Any]) -> None:
        job = job_of(plan, trial_of(config), out, say=True)
        error = follow(job, lambda scores: tune.report(dict(scores)))
        if error:
            tune.report({plan.metric: _WORST if METRICS[plan.metric] else -_WORST, "error": error})

    storage = out / ".ray_tune"
    found = tune.run(
        train,
        name="search",
        storage_path=str(storage),
        resume="AUTO+ERRORED" if any(storage.glob("search/experiment_state-*.json")) else None,
        config={"settings": tune.grid_search(known) if known else {name: _domain(one) for name, one in plan.space.items()}},
        search_alg=None if known else OptunaSearch(sampler=optuna.samplers.TPESampler(seed=search.seed)),
        scheduler=stopper,
        num_samples=1 if known else search.trials,
        metric=plan.metric,
        mode="min" if METRICS[plan.metric] else "max",
        max_failures=RETRIES,  # nodes that are lost; a trial's own error raises nothing
        max_concurrent_trials=at_once,
        raise_on_failed_trial=False,
        resources_per_trial={"cpu": 1},
        callbacks=[Watch()],
        verbose=0,
    )
    note(found.trials)
    return [trial_of(one.config) for one in found.trials if one.trial_id not in ran and (one.last_result or {}).get("error")]


def _domain(values: Any) -> Any:
    """Return the values of a setting, a list or a range, as Tune takes them."""
    from ray import tune

    if isinstance(values, list):
        return tune.choice(values)
    if values.whole:
        return (tune.lograndint if values.log else tune.randint)(int(values.low), int(values.high) + 1)
    return (tune.loguniform if values.log else tune.uniform)(values.low, values.high)
