"""Logs of other programs: read them as runs, and write runs as MCAP and rosbag2. What is read and how: ``docs/own_logs.md``.

``suggest_map`` proposes what a log's topics and fields mean and asks what their names leave open, ``import_log`` makes runs of
it, ``export_run`` writes one for Foxglove, PlotJuggler and ROS, ``read_exported`` reads that back to the bit. ``read_logs``
reads any log as numbers and times.
"""

from wlr_gym.data.logs.importing import ImportedRun, import_log, suggest_map
from wlr_gym.data.logs.map import LogMap, read_map
from wlr_gym.data.logs.messages import ExportedRun, export_run, read_exported
from wlr_gym.data.logs.readers import read_logs
from wlr_gym.data.logs.suggest import Proposal
from wlr_gym.data.logs.topics import Log, Topic

__all__ = [
    "ExportedRun",
    "ImportedRun",
    "Log",
    "LogMap",
    "Proposal",
    "Topic",
    "export_run",
    "import_log",
    "read_exported",
    "read_logs",
    "read_map",
    "suggest_map",
]
