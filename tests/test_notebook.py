"""The notebook runs as it stands, and holds outputs of this code (``python docs/notebook.py``)."""

import json
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
    exec(compile(code, NOTEBOOK.name, "exec"), {"__name__": "__main__"})
    assert "60 of 60 frames are tracked" in capsys.readouterr().out
    (mesh,) = tmp_path.rglob("mesh.ply")
    assert mesh.stat().st_size > 1e6


def test_the_notebook_shows_what_it_prints_and_draws():
    for number, cell in enumerate(cells("code"), start=1):
        code = "".join(cell["source"])
        kinds = [output["output_type"] for output in cell["outputs"]]
        assert kinds == ["stream"] * ("print(" in code) + ["display_data"] * ("plt.subplots" in code)
        assert cell["execution_count"] == number
    assert NOTEBOOK.stat().st_size < 200_000
