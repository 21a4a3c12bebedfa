import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def hold_file(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """File of :func:`hold`, which processes that outlive a test know."""
    file = tmp_path_factory.mktemp("hold") / "hold"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SWEEP_HOLD", str(file))
        patch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path]))
        yield file


@pytest.fixture
def hold(hold_file: Path) -> Iterator[Path]:
    """File: trials that begin while it exists wait at their checkpoints until they are asked to stop, or it is gone."""
    yield hold_file
    hold_file.unlink(missing_ok=True)  # however the test ended: nothing waits for ever
