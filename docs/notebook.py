"""Run the notebook in examples/ and write its outputs into it: ``python docs/notebook.py``."""

import base64
import contextlib
import io
import json
import os
from pathlib import Path
from typing import Any

import matplotlib as mpl

NOTEBOOK = Path(__file__).parent.parent / "examples" / "first_mesh.ipynb"


def outputs(code: str, names: dict[str, Any]) -> list[dict[str, Any]]:
    """Printed text and figures of a cell, in the format of notebooks."""
    from matplotlib import pyplot as plt

    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(compile(code, NOTEBOOK.name, "exec"), names)
    found: list[dict[str, Any]] = []
    if text := said.getvalue():
        found.append({"output_type": "stream", "name": "stdout", "text": text.splitlines(keepends=True)})
    for number in plt.get_fignums():
        image = io.BytesIO()
        plt.figure(number).savefig(image, format="jpg", dpi=80)
        data = {"image/jpeg": base64.b64encode(image.getvalue()).decode(), "text/plain": ["<Figure>"]}
        found.append({"output_type": "display_data", "metadata": {}, "data": data})
    plt.close("all")
    return found


def main() -> None:
    """Fill the notebook."""
    mpl.use("agg")
    notebook, names = json.loads(NOTEBOOK.read_text(encoding="utf-8")), {"__name__": "__main__"}
    os.chdir(NOTEBOOK.parents[1])
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for number, cell in enumerate(cells, start=1):
        cell |= {"execution_count": number, "outputs": outputs("".join(cell["source"]), names)}
    NOTEBOOK.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
