"""Every script of examples/ runs in its quick form, in a folder of its own, and leaves nothing in it."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from waiting import LONGEST

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("script", EXAMPLES, ids=lambda script: script.stem)
def test_it_runs_from_anywhere(script, tmp_path):
    here, temporary = tmp_path / "here", tmp_path / "temporary"
    here.mkdir()
    temporary.mkdir()
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "TMPDIR": str(temporary), "PYTHONPATH": paths}
    environment["RAY_worker_niceness"] = "0"  # not behind other tests
    environment["RAY_TMPDIR"] = tempfile.mkdtemp(prefix="r")  # a socket's path has 107 letters at most
    ran = subprocess.run(
        [sys.executable, script, "--quick"], cwd=here, env=environment, capture_output=True, text=True, timeout=LONGEST
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.strip()
    assert not list(here.iterdir())


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda script: script.stem)
def test_it_says_how_to_run_it(script):
    assert f"python examples/{script.name}" in script.read_text(encoding="utf-8").split('"""')[1]
