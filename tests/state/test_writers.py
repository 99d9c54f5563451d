"""No file is written in place: a process that is killed leaves every file whole."""

import ast
import os
from pathlib import Path

import pytest

import dudmap
from dudmap.atomic_file import atomic_file, atomic_path, write_text

ROOT = Path(dudmap.__file__).parent
IN_PLACE = {"write_text", "write_bytes", "imwrite", "tofile", "savetxt", "to_csv", "symlink_to"}
"""Methods and functions that write under the final name."""
TO_FILES = {"savefig", "savez", "savez_compressed", "save", "export", "VideoWriter", "E57", "open"}
"""Those that may be given a file or a temporary name."""
WHOLE = {"file", "temporary", "buffer"}
"""Names that such a file has by convention."""
EXCEPTIONS = {
    "atomic_file.py": "writes the temporary file",
    "lab/synthetic/folder.py": "thousands of images of a new folder, whose lists come last; made anew by its command",
    "io/sequences/archive.py": "unpacks into a temporary folder, which is renamed",
    "io/cameras/recorder.py": "a stream that grows for hours and is readable up to where it ends",
    "app/viewing/rerun_log.py": "a stream of a library",
    "app/pipeline/observer.py": "a stream that is readable up to where it ends",
    "core/map/map_file.py": "members of an archive that is written as a temporary file",
    "core/backends/device.py": "writes to the null device",
    "app/viewing/plots.py": "writes into memory",
    "app/pipeline/run_folder.py": "the lock, which is no result",
    "app/pipeline/image_keeper.py": "a list that is readable up to where it ends; its images are whole files",
    "io/exporting/mesh_files.py": "writes text into memory",
    "fleet/change_watch.py": "a stream that is readable up to where it ends",
    "fleet/change_benchmark.py": "tables for developers, made anew by their command",
    "lab/study/": "tables and reports that the same command makes anew from the stored figures of the runs",
    "lab/benchmark/": "tables for developers, made anew by their command",
    "cli/benchmark.py": "tables for developers, made anew by their command",
    "lab/warmup.py": "a temporary folder",
}


def writers(tree):
    """Calls that write under a name which is not known to be temporary."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        method = isinstance(node.func, ast.Attribute)
        name = node.func.attr if method else getattr(node.func, "id", "")
        first = node.args[0] if node.args else None
        if isinstance(first, ast.Call) and first.args:  # str(temporary)
            first = first.args[0]
        if name in IN_PLACE and method:
            yield node
        elif name == "open":
            constants = [
                a.value for a in [*node.args, *(k.value for k in node.keywords)] if isinstance(a, ast.Constant)
            ]
            if any(isinstance(value, str) and set(value) & set("wax+") and len(value) <= 3 for value in constants):
                yield node
        elif name in TO_FILES - {"open", "save"} and method and not (isinstance(first, ast.Name) and first.id in WHOLE):
            yield node
        elif name == "save" and isinstance(node.func, ast.Attribute) and getattr(node.func.value, "id", "") == "np":
            yield node


def test_every_writer_goes_through_atomic_file():
    found = []
    for path in sorted(ROOT.rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        if any(name == one or (one.endswith("/") and name.startswith(one)) for one in EXCEPTIONS):
            continue
        found += [f"{name}:{node.lineno} {ast.unparse(node)[:60]}" for node in writers(ast.parse(path.read_text()))]
    assert found == []


@pytest.mark.parametrize("line", [
    "path.write_text('a')", "open(p, 'w')", "path.open('ab')", "cv2.imwrite(p, i)", "np.savez(path, a=1)",
    "figure.savefig(out)", "np.save(p, a)", "mesh.export(path)", "cv2.VideoWriter(str(path))",
])  # fmt: skip
def test_the_test_sees_writers(line):
    assert list(writers(ast.parse(line)))


def write_half(place):
    with place as given:
        if isinstance(given, Path):
            given.write_text("half of the n")
        else:
            given.write(b"half of the n")
        raise ZeroDivisionError


def test_an_error_leaves_the_old_file_and_nothing_beside_it(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "old")
    for manager in (atomic_file, atomic_path):
        with pytest.raises(ZeroDivisionError):
            write_half(manager(path))
        assert path.read_text() == "old"
        assert os.listdir(tmp_path) == ["a.txt"]
    write_text(path, "new")
    assert path.read_text() == "new"
