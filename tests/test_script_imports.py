"""Examples and the scripts of the documentation, which no other quick test runs, import only names that exist."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted(path for folder in ("docs", "examples") for path in (ROOT / folder).glob("*.py"))


def module_names(module):
    """Names that a module of the package binds, imports, or lists as a text (``__all__``), and its submodules."""
    path = ROOT / "src" / Path(*module.split("."))
    names = {part.stem for part in path.iterdir()} if path.is_dir() else set()
    tree = ast.parse((path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.ImportFrom | ast.Import):
            names |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            names.add(node.value)
    return names


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_a_script_imports_what_exists(script):
    for node in ast.walk(ast.parse(script.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "dudmap":
            missing = {alias.name for alias in node.names} - module_names(node.module)
            assert not missing, f"{node.module} has no {missing}"
