"""Train settings x seeds, or search settings. Ctrl-C leaves checkpoints; --resume continues every trial from its newest one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
import yaml

from wlr_gym.base.errors import InputError
from wlr_gym.base.settings import parse_config, parse_yaml
from wlr_gym.base.text import counted, number, pairs, quoted
from wlr_gym.cli import FAILED, IMPORTED, OK
from wlr_gym.cli.options import Count, FloorOption, JsonOption, ray_address, refuse_given
from wlr_gym.cli.terminal import print_json
from wlr_gym.learning.sweep.book import SweepResult
from wlr_gym.learning.sweep.plan import SweepPlan, read_plan
from wlr_gym.learning.sweep.results import PAGE_FILE, TABLE_FILE, words
from wlr_gym.learning.sweep.running import resume_sweep, start_sweep
from wlr_gym.policy.agents import apply_changes


@dataclass(frozen=True)
class SweepOptions(JsonOption, FloorOption):
    what: tyro.conf.Positional[str | None] = None
    """File of a sweep (YAML; see docs/learning.md) or environment id (see: wlr envs)."""
    config: str | None = None
    """Settings of the agent: name in configs/agent/ or path of a YAML file; default: the agent's own."""
    agent: str | None = None
    """Agent to train: a folder of agents/; default: ppo."""
    init: str | None = None
    """Trained policy that every trial starts from."""
    robot: str | None = None
    """Robot of all trials: robot file, or name in configs/robot/; default: that of the settings, else the task's."""
    set: tuple[str, ...] = ()
    """Settings, as key=value; several values make a grid: --set learning_rate=1e-3,2e-3 total_steps=500_000"""
    search: Path | None = None
    """File (YAML) with 'space' and 'search': what is searched, and how."""
    seeds: Count | None = None
    """Trainings of each settings, with seeds from 0 on; default: 5."""
    out: Path | None = None
    """Folder of the sweep; default: runs_out/sweep_<environment or file>."""
    resume: Path | None = None
    """Folder of a sweep to resume, as it was planned; --ray and --workers may be others than before."""
    ray: tuple[str, ...] | None = None
    """Run on Ray: alone, it is started on this machine; with an address (auto, 10.0.0.1:6379), that cluster is used."""
    workers: Count | None = None
    """Most trials at a time, each on one core; default: one per core."""


def run(options: SweepOptions) -> int:
    """Train, say how it goes, and print where table and page are."""
    ray = ray_address(options.ray)
    if options.resume is not None:
        own = ("what", "config", "agent", "init", "search", "seeds", "out", "robot", "set", "floor")
        refuse_given(options, own, "--resume continues a sweep as it was planned; beside it there are --ray and --workers only")
        found = resume_sweep(options.resume, ray=ray, workers=options.workers, say=_say)
    else:
        plan = _plan(options)
        out = options.out or Path("runs_out") / f"sweep_{Path(options.what or '').stem.rpartition(':')[2]}"
        found = start_sweep(plan, out, ray=ray, workers=options.workers, say=_say)
    return _report(found, options.json)


def _say(line: str) -> None:
    print(line, flush=True)


def _plan(options: SweepOptions) -> SweepPlan:
    """Return the plan of a file, of the options, or of a file with options laid over it."""
    if options.what is None:
        raise InputError("expected the file of a sweep, or an environment id (see: wlr envs)")
    changes: dict[str, Any] = {"imports": list(IMPORTED)} if IMPORTED else {}
    given = {"config": options.config, "agent": options.agent, "init": options.init, "seeds": options.seeds}
    changes |= {name: value for name, value in given.items() if value is not None}
    changes |= _settings(options.set)
    if options.robot is not None:
        apply_changes(changes["settings"], [f"environment.robot={json.dumps(options.robot)}"])
    if (floor := options.load_floor()) is not None:
        apply_changes(changes["settings"], [f"environment.floor={json.dumps(floor.content())}"])
    if not options.what.endswith((".yaml", ".yml")):
        changes["environment"] = options.what
    elif options.search is not None:
        raise InputError(
            f"--search {options.search}: expected an environment id beside it, not {options.what}, which may have a search"
        )
    file = options.what if "environment" not in changes else options.search
    return read_plan(Path(file), changes) if file is not None else parse_config(SweepPlan, changes, "sweep")


def _settings(words: tuple[str, ...]) -> Mapping[str, Any]:
    """Return what ``--set`` says: a setting with one value is for all trials, others span the grid."""
    settings: dict[str, Any] = {}
    space: dict[str, list[Any]] = {}
    for name, text in pairs("--set", words, "learning_rate=1e-3,2e-3").items():
        try:
            values = parse_yaml(f"[{text}]")
        except yaml.YAMLError:
            values = None
        if not values:
            raise InputError(f"--set {name}={text}: expected one value or several, such as learning_rate=1e-3,2e-3")
        if len(values) > 1:
            space[name] = values
        else:
            apply_changes(settings, [f"{name}={json.dumps(values[0], default=str)}"])
    return {"settings": settings, "space": space}


def _report(found: SweepResult, as_json: bool) -> int:
    if as_json:
        files = {"folder": found.folder, "table": found.folder / TABLE_FILE, "page": found.folder / PAGE_FILE}
        print_json(files | {"ranking": found.ranking, "failed": len(found.failed)})
        return FAILED if found.failed else OK
    if found.ranking:
        best = found.ranking[0]
        _say(f"best: {words(best.settings)}: {number(best.mean)} over {counted(len(best.values), 'seed')}")
        _say(f"score it: wlr evaluate {best.policies}")
    _say(f"table: {found.folder / TABLE_FILE}\npage: {found.folder / PAGE_FILE}")
    if found.failed:
        _say(f"{counted(len(found.failed), 'trial')} FAILED; try them again: wlr sweep --resume {quoted(found.folder)}")
    return FAILED if found.failed else OK
