"""Nothing that is read can run, and files from elsewhere are opened in one place: properties of the source."""

import ast
from pathlib import Path

SOURCE = Path(__file__).parents[2] / "src" / "dudmap"
FORBIDDEN = {"eval", "exec", "compile", "__import__"}
KERNELS = {"core/shipped_kernels.py", "lab/wheel_kernels.py"}
"""Files that pickle the compiled kernels of the package itself, which are code as its sources are."""
MODULES = {"pickle", "cPickle", "marshal", "shelve", "dill", "cloudpickle", "joblib"}


def trees():
    for path in sorted(SOURCE.rglob("*.py")):
        yield path.relative_to(SOURCE), ast.parse(path.read_text(encoding="utf-8"))


def test_nothing_that_is_read_can_run():
    """No pickle, no eval, no shell, and ``np.load`` without objects, in all of the source."""
    wrong = []
    for path, tree in trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = (
                    {alias.name.partition(".")[0] for alias in node.names} if isinstance(node, ast.Import) else set()
                )
                names |= {(node.module or "").partition(".")[0]} if isinstance(node, ast.ImportFrom) else set()
                wrong += [
                    f"{path}:{node.lineno} imports {name}" for name in names & MODULES if path.as_posix() not in KERNELS
                ]
            if not isinstance(node, ast.Call):
                continue
            name = ast.unparse(node.func)
            options = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
            if name in FORBIDDEN or name in ("os.system", "os.popen") or options.get("shell") == "True":
                wrong.append(f"{path}:{node.lineno} calls {name}")
            if name.startswith("yaml.") and name not in ("yaml.safe_load", "yaml.parse"):
                wrong.append(f"{path}:{node.lineno} calls {name}; expected yaml.safe_load")
            if name in ("np.load", "numpy.load") and options.get("allow_pickle") != "False":
                wrong.append(f"{path}:{node.lineno} calls {name} without allow_pickle=False")
    assert wrong == []


READERS = ("sequences", "geometry", "mapping", "places", "calibration", "viewing", "exporting", "evaluation")
EXCEPTIONS = {"report.py", "memory_limit.py"}
"""Read the page's own template, and what the system says of the process."""


def test_files_from_elsewhere_are_opened_in_one_place():
    wrong = []
    for path, tree in trees():
        if path.parts[0] not in READERS or path.name in EXCEPTIONS:
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                if node.func.attr in ("read_text", "read_bytes", "loadtxt", "genfromtxt", "imread"):
                    wrong.append(f"{path}:{node.lineno} {ast.unparse(node.func)}")
                if ast.unparse(node.func) in ("np.load", "json.loads", "json.load", "tomllib.loads", "tomllib.load"):
                    wrong.append(f"{path}:{node.lineno} {ast.unparse(node.func)}")
    assert [line for line in wrong if "ORIGIN" not in line] == []
