"""Measured runs: read, check, write, convert and replay them. The format: ``docs/run_format.md``.

``read_run`` and ``read_dataset`` refuse what is not a run; ``check_table`` reports what is odd about one. ``replay`` lives in
:mod:`wlr_gym.data.replay`. ``simulate_again`` repeats a simulated run that has its record beside it.
"""

from wlr_gym.data.check import Finding, check_table
from wlr_gym.data.format import COLUMNS, Column, Profile, RunMeta
from wlr_gym.data.replay import simulate_again, simulated_parameters
from wlr_gym.data.runs import DataSet, Run, Simulation, convert, read_dataset, read_meta, read_run, write_meta, write_run

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
