"""The truths of the pictures' tests; without the extra ``web`` nothing of a page is tested."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))


@pytest.fixture(scope="session", autouse=True)
def viser():
    return pytest.importorskip("viser", minversion="1.1", reason="needs the extra web")
