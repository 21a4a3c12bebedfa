"""Examples of files in docs/ that no command on their page reads."""

from __future__ import annotations

import pytest
import yaml
from blocks import ROOT, blocks

from wlr_gym.cli import main
from wlr_gym.data import read_dataset


def test_the_meta_file_of_run_format_md_is_read(tmp_path):
    (example,) = [block for block in blocks(ROOT / "docs" / "run_format.md") if block.mark == "checked by"]
    assert (
        main(["record", "--backend", "gibbs_appell", "--excitation", "straight", "--seconds", "0.2", "--out", str(tmp_path)])
        == 0
    )
    (tmp_path / "meta.yaml").write_text(example.text, encoding="utf-8")
    (run,) = read_dataset(tmp_path).runs
    assert run.meta.ground == yaml.safe_load(example.text)["ground"]
    assert run.meta.profile.wheel_acceleration == pytest.approx(11.2)
