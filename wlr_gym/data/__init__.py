"""Measured runs: read, check, write, convert and replay them. The format: ``docs/run_format.md``.

``read_run`` and ``read_dataset`` refuse what is not a run; ``check_table`` reports what is odd about one. ``replay`` lives in
:mod:`wlr_gym.data.replay`. ``simulate_again`` repeats a simulated run that has its record beside it.
"""

from typing import TYPE_CHECKING

from wlr_gym.data.format import COLUMNS, Column, Finding, Profile, RunMeta, check_table
from wlr_gym.data.runs import DataSet, Run, Simulation, convert, read_dataset, read_meta, read_run, write_meta, write_run

if TYPE_CHECKING:
    from wlr_gym.data.replay import simulate_again, simulated_parameters

__all__ = [
    "COLUMNS",
    "Column",
    "DataSet",
    "Finding",
    "Profile",
    "Run",
    "RunMeta",
    "Simulation",
    "check_table",
    "convert",
    "read_dataset",
    "read_meta",
    "read_run",
    "simulate_again",
    "simulated_parameters",
    "write_meta",
    "write_run",
]


def __getattr__(name: str) -> object:
    """Load a replay's simulators and effects when they are asked for: a robot that logs its runs needs none."""
    if name not in ("simulate_again", "simulated_parameters"):
        raise AttributeError(f"module 'wlr_gym.data' has no attribute '{name}'")
    from wlr_gym.data import replay

    return getattr(replay, name)
