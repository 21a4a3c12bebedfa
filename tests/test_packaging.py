"""What a clone says about itself agrees: version, licence, citation, constraints, README's commands."""

import re
import tomllib
from pathlib import Path

import yaml

import wlr_gym

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def requirement_names(requirements: list[str]) -> set[str]:
    return {re.split(r"[\[<>=!~; ]", line, maxsplit=1)[0].lower().replace("_", "-") for line in requirements}


def test_versions_agree():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert PROJECT["project"]["version"] == wlr_gym.__version__ == citation["version"]


def test_citation_names_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    (paper,) = citation["references"]
    assert paper["journal"] == "Robotica"
    assert [author["family-names"] for author in paper["authors"]] == ["Korayem", "Nikseresht", "Asadi"]


def test_licence_is_there_and_declared():
    assert PROJECT["project"]["license"] == "MIT"
    assert (ROOT / "LICENSE").read_text(encoding="utf-8").startswith("MIT License")


def test_every_direct_dependency_is_pinned_and_nothing_else():
    pins = [line for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines() if line and line[0] != "#"]
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][0-9a-z.]*", pin) for pin in pins), pins
    wanted = requirement_names(PROJECT["project"]["dependencies"] + PROJECT["build-system"]["requires"])
    for extra in PROJECT["project"]["optional-dependencies"].values():
        wanted |= requirement_names(extra)
    assert requirement_names(pins) == wanted - {"wlr-gym"}  # the extra "all" names the others


def test_wheel_takes_configs_and_agents():
    included = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert included == {"configs": "wlr_gym/configs", "agents": "wlr_gym/agents"}


def test_readme_has_one_command_per_marker():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for marker in ("demo-command", "test-command"):
        (block,) = re.findall(rf"<!-- {marker} -->\n```bash\n(.+?)\n```\n<!-- /{marker} -->", readme, re.DOTALL)
        assert "\n" not in block
        assert block.startswith("pip install -c constraints.txt")


def test_every_python_that_is_named_is_at_least_the_required_one():
    named = [line.rpartition(" ")[2] for line in PROJECT["project"]["classifiers"] if re.search(r":: 3\.\d+$", line)]
    assert f">={named[0]}" == PROJECT["project"]["requires-python"]
    assert named == sorted(named, key=lambda version: int(version.partition(".")[2]))
