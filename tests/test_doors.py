"""Imports between the parts of the package run one way: down."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import dudmap

ROOT = Path(dudmap.__file__).parent
DOORS = ("core", "thesis", "io", "evaluation", "app", "lab", "fleet", "cli")
"""From the bottom up: each may import those before it."""
FOUNDATION = {
    "atomic_file",
    "config",
    "errors",
    "extras",
    "gone_keys",
    "input_files",
    "ranges",
    "interruption",
    "own_folder",
    "config_section",
    "thesis_config",
    "version",
}
"""Modules of the root, which every part may import, and which import only each other."""


def imports(file: Path) -> set[str]:
    """Names of the parts that a file imports, at any depth of its functions."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module] if node.module != "dudmap" else [f"dudmap.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        found |= {name.split(".")[1] for name in names if name.startswith("dudmap.")}
    return found


def test_each_part_imports_only_those_below_it():
    wrong = []
    for number, door in enumerate(DOORS):
        allowed = FOUNDATION | set(DOORS[: number + 1]) | set(dudmap.__all__ if door != "core" else ())
        files = sorted((ROOT / door).rglob("*.py"))
        assert files
        wrong += [f"{file.relative_to(ROOT)}: {up}" for file in files for up in sorted(imports(file) - allowed)]
    assert not wrong


def test_the_foundation_imports_nothing_above_it():
    modules = {path.stem for path in ROOT.glob("*.py")} - {"__init__", "__main__"}
    assert modules == FOUNDATION
    assert {path.name for path in ROOT.iterdir() if (path / "__init__.py").exists()} == set(DOORS)
    assert not {name for module in FOUNDATION for name in imports(ROOT / f"{module}.py") - FOUNDATION}


def test_no_file_imports_itself_by_way_of_others():
    """Imports inside functions and for types alone count, too."""
    files = {".".join(path.relative_to(ROOT.parent).with_suffix("").parts): path for path in ROOT.rglob("*.py")}
    files = {name.removesuffix(".__init__"): path for name, path in files.items()}
    graph = {}
    for module, path in files.items():
        names = []
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names += [f"{node.module}.{alias.name}" for alias in node.names]
        found = {name if name in files else name.rpartition(".")[0] for name in names}
        graph[module] = (found & files.keys()) - {module}
    TopologicalSorter(graph).prepare()  # raises an error that names a circle
