"""Every code block of README.md and docs/ is run, page by page, or says why not; what comes out is what the page says."""

from __future__ import annotations

import importlib
from collections import Counter
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from blocks import PAGES, ROOT, blocks, run_page

from wlr_gym.cli import main
from wlr_gym.data import read_dataset

#: Page -> number of its blocks that nothing runs; each says why. All others are run.
NOT_RUN = {
    "docs/build.md": 2,  # a board
    "docs/camera.md": 1,  # a camera
    "docs/evaluation.md": 1,  # runs of one training with several seeds
    "docs/gap.md": 4,  # minutes each; the quickstart has one
    "docs/extending.md": 1,  # examples/own_plant.py
    "docs/gap_benchmark.md": 1,  # hours
    "docs/paper.md": 1,  # minutes
    "docs/pictures.md": 1,  # a window
    "docs/own_robot.md": 5,  # examples/own_robot.py goes the same way
    "docs/first_day.md": 2,  # a robot
    "docs/own_logs.md": 1,  # logs of somebody else's
    "docs/policy_file.md": 1,  # an archive of somebody else's
    "docs/own_rig.md": 2,  # examples/linear_axis.py goes the same way
    "docs/quickstart.md": 2,  # installation
    "docs/randomization.md": 1,  # the result of an analysis
    "docs/driving.md": 1,  # a robot
    "docs/emulator.md": 1,  # until Ctrl-C
    "docs/robot.md": 1,  # a robot
    "docs/learning.md": 1,  # a cluster
    "docs/vision.md": 4,  # installation, pictures, a film, a photograph
}
#: Pages whose blocks take longest; the slow suite runs them.
LONG = {
    "README.md",
    *(f"docs/{name}.md" for name in ("camera", "compare", "driving", "learning", "pictures", "robot")),
    *(f"docs/{name}.md" for name in ("quickstart", "run_format")),
}
BLOCKS = [block for page in PAGES for block in blocks(page)]


def _pages(*marks: str) -> list[Path]:
    return [page for page in PAGES if any(block.mark in marks for block in blocks(page))]


def _name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def _run(page: Path, request: pytest.FixtureRequest, *, slow: bool) -> None:
    chosen = [block for block in blocks(page) if not block.mark or (slow and block.mark == "slow")]
    drawn = (".render()", "wlr_gym.render", "--video", "robot show")
    if any(word in block.text for block in chosen for word in drawn):
        request.getfixturevalue("graphics")  # skips where there is no OpenGL
    run_page(page, slow=slow)


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.slow] if _name(page) in LONG else [], id=_name(page))
        for page in _pages("")
        if page.name != "extending.md" and not (_name(page) in LONG and page in _pages("slow"))  # whole: below
    ],
)
def test_page_runs(page, workplace, request):
    _run(page, request, slow=False)


@pytest.mark.slow
@pytest.mark.parametrize("page", _pages("slow"), ids=_name)
def test_page_runs_with_what_takes_long(page, workplace, request):
    _run(page, request, slow=True)


def test_what_is_not_run_says_why():
    found = [block for block in BLOCKS if block.mark == "not run"]
    assert Counter(_name(block.page) for block in found) == NOT_RUN
    assert all(len(block.words) > 5 for block in found)


def test_every_other_block_can_be_run():
    for block in BLOCKS:
        assert block.mark or block.language in ("python", "bash"), f"{block}: '{block.language}': say what it is for"


def test_tests_that_marks_name_exist():
    for block in BLOCKS:
        if block.mark == "checked by":
            assert block.page.name in (ROOT / block.words).read_text(encoding="utf-8"), f"{block}: {block.words}"
        for path in [word.strip("();,") for word in block.words.split() if word.strip("();,").startswith(("tests/", "docs/"))]:
            assert (ROOT / path).is_file(), f"{block}: {path}"


def test_the_meta_file_of_run_format_md_is_read(tmp_path):
    (example,) = [block for block in blocks(ROOT / "docs" / "run_format.md") if block.mark == "checked by"]
    options = ["--backend", "gibbs_appell", "--excitation", "straight", "--seconds", "0.2", "--out", str(tmp_path)]
    assert main(["record", *options]) == 0
    (tmp_path / "meta.yaml").write_text(example.text, encoding="utf-8")
    (run,) = read_dataset(tmp_path).runs
    assert run.meta.ground == yaml.safe_load(example.text)["ground"]
    assert not run.meta.states_profile  # numbers of an example would be copied unread


def _parameters(env: gym.Env, name: str) -> np.ndarray:
    env.reset(seed=0)
    return env.unwrapped.core.plant.parameters[name][0]  # type: ignore[attr-defined]


@pytest.mark.slow
def test_extending_makes_what_it_says(workplace):
    page = ROOT / "docs" / "extending.md"
    names = run_page(page, slow=False, smaller=False)
    assert names["leg_rate_reward"] < 0.0
    rows = [line for line in names["described"].splitlines() if line.startswith("side_speed") and "left, right" in line]
    assert [row.partition("  ")[0] for row in rows] == ["side_speed", *(f"side_speed, lag {k} (steps)" for k in (1, 2))]
    assert (names["env_id"], names["batch"].num_envs) == ("WLR-Spin-v0", 64)
    nominal = _parameters(gym.make("WLR-Velocity-v0", randomization="none"), "servo.stall_torque")
    for simulator in ("on_engine", "on_mujoco"):
        hot = _parameters(names[simulator], "servo.stall_torque")
        np.testing.assert_allclose(hot / nominal, [1, 1, 1, 1, 0.6, 0.6, 1, 1])
    with_xm430 = gym.make("WLR-Velocity-v0", robot="my_servos.yaml", randomization="none")
    np.testing.assert_allclose(_parameters(with_xm430, "servo.stall_torque"), [4.1] * 4 + [1.5] * 4)
    assert (workplace / "out" / "calm" / "policy").is_dir()
    assert (workplace / "out" / "spin" / "policy").is_dir()
    # each addition is one file; a task has a module besides, for the commands
    files = [block.words for block in blocks(page) if block.mark == "file"]
    assert files == ["my_reward.py", "my_observation.py", "spin.yaml", "my_task.py", "my_effect.py", "my_servos.yaml"]


def test_the_example_of_a_plant_rolls(workplace, capsys):
    """A second at 3 rad/s on wheels of 34 mm."""
    (workplace / "own_plant.py").write_bytes((ROOT / "examples" / "own_plant.py").read_bytes())
    importlib.import_module("own_plant").main()
    assert capsys.readouterr().out == "travelled: 0.102 m\n"
