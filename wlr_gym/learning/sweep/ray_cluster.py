"""Jobs on a Ray cluster: Ray chooses the node; there a job is the same process as on one machine."""

from __future__ import annotations

import importlib
import os
import socket
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from wlr_gym.base import jobs as jobs_module
from wlr_gym.base.errors import InputError
from wlr_gym.base.jobs import Ended, Job, follow

#: Address that means: start Ray on this machine.
LOCAL = "local"
#: How often a job is started again after its node was lost.
RETRIES = 20
#: Which nodes may be used, as Ray takes it; empty = all.
NodeSelector = Mapping[str, str]


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
        with carried(jobs_module, importlib.import_module(__name__)):
            yield
    finally:
        ray.shutdown()


@contextmanager
def carried(*modules: Any) -> Iterator[None]:
    """Let Ray send functions of modules whole: nodes that lack this package can then say so."""
    from ray import cloudpickle

    for module in modules:
        cloudpickle.register_pickle_by_value(module)
    try:
        yield
    finally:
        for module in modules:
            cloudpickle.unregister_pickle_by_value(module)


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
