"""Searches by Ray Tune: settings that Optuna chooses, and trials that ASHA stops early.

What a search knows is in the folder of the sweep alone. One that is resumed first tries the settings that it had begun: trials
that are over say their scores again, the others go on from their checkpoints, and new ones follow.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Container, Mapping, Sequence
from pathlib import Path
from typing import Any

from wlr_gym.learning.sweep.plan import METRICS, NumberRange, SweepPlan, Trial, known_settings, trial_of
from wlr_gym.learning.sweep.ray_cluster import RETRIES, NodeSelector, run_on_node
from wlr_gym.learning.sweep.trial import job_of

#: Of the trials at a rung, one in so many goes on.
REDUCTION = 3
#: Rungs, below the end of the training: at a ninth and a third of its steps.
RUNGS = 2
#: Score of a trial that failed, worse than any (negative where more is better).
_WORST = 1e9
#: Called with a trial that is over, its error, and whether it was stopped early.
TellEnd = Callable[[Trial, str, bool], object]


def search_with_tune(
    plan: SweepPlan,
    out: Path,
    begun: Sequence[Mapping[str, Any]],
    stopped: Container[str],
    nodes: NodeSelector,
    at_once: int | None,
    began: Callable[[Trial], object],
    ended: TellEnd,
) -> None:
    """Search on the connected cluster; each settings is trained with the first seed.

    Args:
        plan: with a search.
        out: folder of the sweep.
        begun: settings that Optuna chose before the search was interrupted.
        stopped: names of trials that it had stopped early.
        nodes: of :func:`wlr_gym.learning.sweep.ray_cluster.fit_nodes`.
        at_once: most trials at a time; None = as many as the cluster has cores.
        began, ended: told of each trial that begins, and that is over.
    """
    for name, value in _QUIET.items():
        os.environ.setdefault(name, value)
    from ray import tune

    search = plan.search
    assert search is not None
    known = known_settings(plan)
    storage = out.resolve() / ".ray_tune"
    selector: dict[str, Any] = {"bundle_label_selector": [dict(nodes)]} if nodes else {}
    tuner = tune.Tuner(
        tune.with_resources(_trainable(plan, out.resolve(), stopped), tune.PlacementGroupFactory([{"CPU": 1.0}], **selector)),
        param_space={"settings": tune.grid_search([json.dumps(one) for one in known])} if known is not None else {},
        tune_config=tune.TuneConfig(
            # a searcher of its own knows what it optimises
            metric=search.metric if known is not None else None,
            mode=_mode(search.metric) if known is not None else None,
            search_alg=None if known is not None else _optuna(plan, begun),
            scheduler=_asha(plan) if search.early_stopping else None,
            num_samples=1 if known is not None else max(search.trials, len(begun)),
            max_concurrent_trials=at_once,
        ),
        run_config=tune.RunConfig(
            name="search",
            storage_path=str(storage),
            failure_config=tune.FailureConfig(max_failures=RETRIES),  # nodes that are lost; a trial's own error raises nothing
            callbacks=[_watch(plan, began, ended)],
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


def _mode(metric: str) -> str:
    return "min" if METRICS[metric] else "max"


def _trainable(plan: SweepPlan, out: Path, stopped: Container[str]) -> Callable[[Mapping[str, Any]], None]:
    """Return what Tune runs on a node: a trial's job, whose scores it hears."""

    def train(config: Mapping[str, Any]) -> None:
        from ray import tune

        assert plan.search is not None
        trial = _trial(plan, config)
        job = job_of(plan, trial, out, report=True, train=trial.name not in stopped)
        error = run_on_node(job, lambda scores: tune.report(dict(scores)))
        if error:
            tune.report({plan.search.metric: _WORST if METRICS[plan.search.metric] else -_WORST, "error": error})

    return train


def _watch(plan: SweepPlan, began: Callable[[Trial], object], ended: TellEnd) -> Any:
    """Return a callback that tells which trials begin, and how they ended."""
    from ray import tune

    assert plan.search is not None
    total = plan.settings.get("total_steps", 0) if plan.search.early_stopping else 0

    class Watch(tune.Callback):
        began: Callable[[Trial], object]
        ended: TellEnd

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


def _optuna(plan: SweepPlan, begun: Sequence[Mapping[str, Any]]) -> Any:
    import optuna
    from ray.tune.search.optuna import OptunaSearch

    assert plan.search is not None
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    choices = {name for name, values in plan.space.items() if isinstance(values, list)}  # Optuna gets them as JSON
    points = [{name: json.dumps(value) if name in choices else value for name, value in one.items()} for one in begun]
    return OptunaSearch(
        space={name: _distribution(values) for name, values in plan.space.items()},
        metric=plan.search.metric,
        mode=_mode(plan.search.metric),
        # a resumed search draws other numbers than those that are known already
        sampler=optuna.samplers.TPESampler(seed=plan.search.seed + len(begun)),
        points_to_evaluate=points or None,
    )


def _distribution(values: NumberRange | list[Any]) -> Any:
    from optuna import distributions

    if isinstance(values, list):
        return distributions.CategoricalDistribution([json.dumps(value) for value in values])
    if values.whole:
        return distributions.IntDistribution(int(values.low), int(values.high), log=values.log)
    return distributions.FloatDistribution(values.low, values.high, log=values.log)


def _asha(plan: SweepPlan) -> Any:
    from ray.tune.schedulers import ASHAScheduler

    assert plan.search is not None
    total = plan.settings["total_steps"]
    keywords: dict[str, Any] = {}
    if plan.search.method == "optuna":
        keywords = {"metric": plan.search.metric, "mode": _mode(plan.search.metric)}
    return ASHAScheduler(
        time_attr="steps",
        max_t=total - 1,  # no rung at the end: a trial that gets there writes its policy
        stop_last_trials=False,
        grace_period=total // REDUCTION**RUNGS,
        reduction_factor=REDUCTION,
        **keywords,
    )


def _trial(plan: SweepPlan, config: Mapping[str, Any]) -> Trial:
    if "settings" in config:
        settings = json.loads(config["settings"])
    else:
        choices = {name for name, values in plan.space.items() if isinstance(values, list)}
        settings = {name: json.loads(config[name]) if name in choices else config[name] for name in plan.space}
    return trial_of(settings, plan.seed_list[0])
