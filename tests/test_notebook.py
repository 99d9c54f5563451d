"""The notebook runs as it stands, and is committed without its outputs."""

import json
import os
import subprocess
import sys
from pathlib import Path

NOTEBOOK = Path(__file__).parent.parent / "examples" / "first_mesh.ipynb"


def cells(kind):
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    return [cell for cell in notebook["cells"] if cell["cell_type"] == kind]


def test_the_notebook_runs(tmp_path):
    code = "\n".join("".join(cell["source"]) for cell in cells("code"))
    where = {"TMPDIR": str(tmp_path), "TEMP": str(tmp_path), "MPLBACKEND": "agg"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False, env=os.environ | where
    )
    assert done.returncode == 0, done.stderr
    assert "60 of 60 frames are tracked" in done.stdout
    (mesh,) = tmp_path.glob("*/mesh.ply")
    assert mesh.stat().st_size > 1e6


def test_the_notebook_is_stripped():
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells("code"))
    assert NOTEBOOK.stat().st_size < 20_000
