"""Run every notebook of docs/notebooks from top to bottom: ``python .ci/docs/notebooks.py``; nothing is written into them."""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).resolve().parents[2] / "docs" / "notebooks"
#: s that a cell may take.
TIMEOUT = 300


def run(path: Path) -> float:
    """Run a notebook in an empty folder; return the seconds it took."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(nbformat.read(path, as_version=4), timeout=TIMEOUT, resources={"metadata": {"path": folder}}).execute()
    return time.monotonic() - began


if __name__ == "__main__":
    for notebook in map(Path, sys.argv[1:] or sorted(NOTEBOOKS.glob("*.ipynb"))):
        print(f"{notebook.name}: {run(notebook):.0f} s", flush=True)
