"""The notebook runs as it stands, and is committed without its outputs."""

import json
import tempfile
from pathlib import Path

NOTEBOOK = Path(__file__).parent.parent / "examples" / "first_mesh.ipynb"


def cells(kind):
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    return [cell for cell in notebook["cells"] if cell["cell_type"] == kind]


def test_the_notebook_runs(tmp_path, monkeypatch, capsys):
    code = "\n".join("".join(cell["source"]) for cell in cells("code"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    exec(compile(code, NOTEBOOK.name, "exec"), {"__name__": "__main__"})
    assert "60 of 60 frames are tracked" in capsys.readouterr().out
    (mesh,) = tmp_path.glob("*/mesh.ply")
    assert mesh.stat().st_size > 1e6


def test_the_notebook_is_stripped():
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells("code"))
    assert NOTEBOOK.stat().st_size < 20_000
