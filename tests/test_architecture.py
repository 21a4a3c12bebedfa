"""The package and its studies: class names exist once, no import circles, what strings name exists, agents are thin."""

from __future__ import annotations

import ast
import builtins
import importlib
import keyword
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: What ``agents/*/agent.py`` may import: an agent is only a registration, so that import-linter sees all code behind it.
AGENTS_IMPORT = ("wlr_gym.policy", "wlr_gym.learning", "wlr_gym.robot", "wlr_gym.base", "numpy")
#: Dotted names that are no Python names: keys in the metadata of a policy file, modules that a test makes, a misspelling.
NO_PYTHON = {"wlr_gym.contract", "wlr_gym.sha256", "wlr_gym.cli.probe", "wlr_gym.evalute"}
#: Folders of ``wlr_gym`` that only a wheel has.
IN_WHEELS = ("wlr_gym/configs", "wlr_gym/agents")
#: Packages whose code is checked.
TOPS = ("wlr_gym", "studies")


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


PATHS = {module_name(path): path for top in TOPS for path in sorted((ROOT / top).rglob("*.py"))}
SOURCES = {name: path.read_text(encoding="utf-8") for name, path in PATHS.items()}
#: Every text that may name a module: code, configs and documents.
TEXTS = {
    str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
    for pattern in (
        "wlr_gym/**/*.py",
        "studies/**/*.py",
        "agents/*/*.py",
        "tests/**/*.py",
        "configs/**/*.yaml",
        "docs/*.md",
        ".ci/**/*.py",
        "*.md",
        "*.toml",
    )
    for path in sorted(ROOT.glob(pattern))
    if path.name != "CHANGELOG.md"
}
IMPORT_FROM = re.compile(r"\bfrom ((?:wlr_gym|studies)[\w.]*) import (?:\(([^)]+)\)|([\w, ]+))")
DOTTED = re.compile(r"(?<![\w./])(?:wlr_gym|studies)(?:\.[A-Za-z_]\w*)+(?::\w+)?(?![\w/])")
PATH = re.compile(r"(?<![\w./])(?:wlr_gym|studies|tests)/[\w./*]+")
ROLE = re.compile(r":(?:mod|class|func|data|meth|attr):`([^`]+)`")


@cache
def trees() -> dict[str, ast.Module]:
    return {name: ast.parse(source) for name, source in SOURCES.items()}


def classes(tree: ast.AST) -> Iterator[ast.ClassDef]:
    return (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef))


def imports(name: str, tree: ast.AST) -> Iterator[str]:
    """Yield the modules and names that a module imports, inside functions and for type checking too."""
    package = name if PATHS[name].name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (one.name for one in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package.rsplit(".", node.level - 1)[0] if node.level else ""
            source = ".".join(filter(None, (base, node.module)))
            yield from (f"{source}.{one.name}" for one in node.names)


def import_graph() -> dict[str, set[str]]:
    graph = {}
    for name, tree in trees().items():
        found = {one if one in trees() else one.rpartition(".")[0] for one in imports(name, tree)}
        graph[name] = {one for one in found if one in trees() and one != name}
    return graph


def circles(graph: dict[str, set[str]]) -> list[str]:
    """Return import circles, each as its modules in order; opens one import of every circle found to find the next."""
    found = []
    while True:
        try:
            TopologicalSorter(graph).prepare()
        except CycleError as error:
            circle = error.args[1][::-1]  # each imports the next
            found.append(" -> ".join(circle))
            graph[circle[0]].discard(circle[1])
        else:
            return found


def bound(body: list[ast.stmt]) -> Iterator[tuple[str, ast.stmt]]:
    """Yield the names that statements bind, those of ``if``, ``try``, ``with`` and loops included, and the statements."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name, node
        elif isinstance(node, ast.Import | ast.ImportFrom):
            yield from ((one.asname or one.name.partition(".")[0], node) for one in node.names)
        else:
            targets = (one for one in ast.walk(node) if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store))
            yield from ((one.id, node) for one in targets)
            for block in ("body", "orelse", "finalbody"):
                yield from bound(getattr(node, block, []))


@cache
def module_names(module: str) -> dict[str, ast.stmt]:
    return dict(bound(trees()[module].body))


@cache
def lazy_names(module: str) -> dict[str, str]:
    """Return the table ``HOMES`` of a package that loads its names when asked for: name -> module; {}: it has none."""
    node = module_names(module).get("HOMES")
    table = getattr(node, "value", None)
    return ast.literal_eval(table) if isinstance(table, ast.Dict) else {}


@cache
def members(module: str, owner: str) -> set[str]:
    """Return the names of a class: fields, methods, attributes that methods set, and those of its bases."""
    node = module_names(module)[owner]
    assert isinstance(node, ast.ClassDef)
    found = {name for name, _ in bound(node.body)}
    found |= {one.attr for one in ast.walk(node) if isinstance(one, ast.Attribute) and isinstance(one.ctx, ast.Store)}
    for base in node.bases:
        place = home(module, base.id) if isinstance(base, ast.Name) else None
        found |= members(*place) if place else set()
    return found


def home(module: str, name: str) -> tuple[str, str] | None:
    """Return the module that defines a class known under ``name`` in a module; None: no class of this package."""
    node = module_names(module).get(name)
    if isinstance(node, ast.ClassDef):
        return module, name
    if isinstance(node, ast.ImportFrom) and node.module in trees():
        return home(node.module, name)
    return None


def exists(dotted: str) -> bool:
    """Tell whether a dotted name is a module, a name in one, or a member of a class in one."""
    words = dotted.replace(":", ".").split(".")
    module = next(name for end in range(len(words), 0, -1) if (name := ".".join(words[:end])) in trees())
    rest = words[module.count(".") + 1 :]
    return not rest or known(module, rest)


def known(module: str, words: list[str]) -> bool:
    """Tell whether a module knows ``words[0]``, and that what follows."""
    name, *rest = words
    node = module_names(module).get(name)
    if node is None and name in lazy_names(module):
        return known(lazy_names(module)[name], words)
    if node is None:  # every module has __doc__ and its kind; one that makes its names when asked for has no __all__
        return name.startswith("__") or ("__getattr__" in module_names(module) and "__all__" not in module_names(module))
    if not rest:
        return True
    if isinstance(node, ast.ImportFrom) and f"{node.module}.{name}" in trees():
        return known(f"{node.module}.{name}", rest)
    place = home(module, name)
    return rest[0] in members(*place) if place else True  # a module or an object of another package


def role_exists(module: str, target: str) -> bool:
    """Tell whether what a docstring refers to exists: a full name, one relative to its package, or one of its own module."""
    if target.startswith(TOPS):
        return exists(target)
    package = module if PATHS[module].name == "__init__.py" else module.rpartition(".")[0]
    if target.startswith("."):
        return exists(package + target)
    first, *rest = target.split(".")
    if f"{package}.{first}" in trees():
        return exists(f"{package}.{target}")
    if first in module_names(module):
        return known(module, [first, *rest])
    nested = {name for node in classes(trees()[module]) for name, _ in bound(node.body)}
    inherited = {name for name in module_names(module) if (place := home(module, name)) for name in members(*place)}
    return first in nested | inherited or hasattr(builtins, first)


def failing(faults: list[str], title: str) -> None:
    """Fail with one fault a line."""
    if faults:
        pytest.fail(f"{title}:\n  " + "\n  ".join(faults), pytrace=False)


def test_no_public_class_name_twice():
    places = defaultdict(list)
    for name, tree in trees().items():
        for node in classes(tree):
            places[node.name].append(name)
    twice = [f"{name}: {', '.join(found)}" for name, found in sorted(places.items()) if name[0] != "_" and len(found) > 1]
    failing(twice, "public class names that exist more than once")


def test_no_import_circles():
    """The acyclic contract of import-linter covers sibling packages, this test covers modules."""
    failing(circles(import_graph()), "import circles")


def test_dotted_names_exist():
    """Backends, benches, ``-m`` entry points, monkeypatch targets, headers of generated code, documents."""
    faults = []
    for place, text in TEXTS.items():
        named = {match.group() for match in DOTTED.finditer(text)} - NO_PYTHON
        for match in IMPORT_FROM.finditer(text):
            names = re.sub(r"#.*", "", match.group(2) or match.group(3)).split(",")
            named |= {f"{match.group(1)}.{name.split()[0]}" for name in names if name.strip()}
        faults += [f"{place}: {name}" for name in sorted(named) if not exists(name) and not name.endswith((".md", ".py"))]
    failing(faults, "names that do not exist")


def test_paths_exist():
    faults = []
    for place, text in TEXTS.items():
        paths = {match.group().rstrip("./") for match in PATH.finditer(text)}
        faults += [f"{place}: {path}" for path in sorted(paths) if not path.startswith(IN_WHEELS) and not path_exists(path)]
    failing(faults, "paths that do not exist")


def path_exists(path: str) -> bool:
    """Tell whether a file or folder exists; words in capitals, as in MODEL.yaml, stand for any name."""
    pattern = re.sub(r"\b[A-Z]{4,}\b", "*", path)
    return any(ROOT.glob(pattern))


def test_docstrings_refer_to_what_exists():
    faults = []
    for name, source in SOURCES.items():
        faults += [f"{name}: {target}" for target in sorted(set(ROLE.findall(source))) if not role_exists(name, target)]
    failing(faults, "references that lead nowhere")


@pytest.mark.parametrize("module", [name for name, source in SOURCES.items() if "\nHOMES" in source])
def test_lazy_names_exist(module):
    faults = [f"{module}: {place}.{name}" for name, place in lazy_names(module).items() if not exists(f"{place}.{name}")]
    failing(faults, "lazy names that do not exist")
    assert set(lazy_names(module)) <= set(importlib.import_module(module).__all__)


def test_commands_exist():
    (table,) = (node for name, node in bound(trees()["wlr_gym.cli"].body) if name == "COMMANDS")
    assert isinstance(table, ast.Assign)
    modules = {name: f"{name}_" if keyword.iskeyword(name) else name for name in ast.literal_eval(table.value)}
    lacking = [
        name for name, one in modules.items() if not any(exists(f"wlr_gym.cli.{one}.{what}") for what in ("run", "COMMANDS"))
    ]
    failing(lacking, "commands without code")


def test_agents_are_registrations():
    faults = []
    for path in sorted(ROOT.glob("agents/*/agent.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            named = [one.name for one in node.names] if isinstance(node, ast.Import) else []
            named += [node.module or "."] if isinstance(node, ast.ImportFrom) else []
            faults += [f"{path.relative_to(ROOT)}: {name}" for name in named if not agent_may_import(name)]
    failing(faults, "imports that hide an agent's code from the import contracts")


def agent_may_import(name: str) -> bool:
    return name.partition(".")[0] in sys.stdlib_module_names or any(f"{name}.".startswith(f"{one}.") for one in AGENTS_IMPORT)


def test_agents_of_a_user_load(tmp_path, monkeypatch):
    """A folder of one's own may hold more than a registration: modules beside agent.py, imported relatively."""
    from wlr_gym.policy import agents

    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "gains.py").write_text("GAIN = 2.0\n")
    (tmp_path / "mine" / "agent.py").write_text(
        "from .gains import GAIN\n\ndef make_policy(contract, config):\n    return GAIN\n"
    )
    monkeypatch.setattr(agents, "data_directory", lambda name: tmp_path)
    assert agents.agent_names() == ["mine"]
    assert agents.agent_function("mine", "make_policy")({}, {}) == 2.0
