"""Insert the output of the benchmarks into the documentation.

    python benchmarks/docs_tables.py runs/benchmark/limits/limits.md runs/benchmark/synthetic/synthetic.md ...

Accepts limits.md (with the heat maps in its folder), synthetic.md and recordings.md. Each replaces the text between
``<!-- NAME -->`` and ``<!-- end of NAME -->`` in docs/limits.md or docs/benchmarks.md. Of synthetic.md some columns are
kept, and recordings.md becomes a table with a column per system.
"""

import re
import shutil
import sys
from pathlib import Path

DOCS = Path(__file__).parent.parent / "docs"


def table(rows: list[list[str]]) -> str:
    """Rows as Markdown, the first as head, numbers to the right."""
    rule = ["---", *["---:"] * (len(rows[0]) - 1)]
    return "\n".join("| " + " | ".join(row) + " |" for row in (rows[0], rule, *rows[1:]))


def shortened(name: str, text: str) -> str:
    """The part of a table that the documentation shows."""
    if name not in ("synthetic", "recordings"):
        return text
    head, _, *rows = (
        [cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if "|" in line
    )
    runs = [dict(zip(head, row, strict=True)) for row in rows]
    for run in runs:
        run["ate"] = run["ATE RMSE, cm"] + (f" ({run['lost']} lost)" if run["lost"] != "0" else "")
    if name == "synthetic":
        cells = [[run["sequence"], run["ate"], run["mask IoU"], run["ghost, m2"]] for run in runs]
        return table([["sequence", "ATE RMSE, cm", "mask IoU", "ghost, m2"], *cells])
    systems = list(dict.fromkeys(run["system"] for run in runs))
    figures = {
        (run["sequence"], run["system"]): " / ".join(filter(None, (run["ate"], run["mask IoU"]))) for run in runs
    }
    sequences = dict.fromkeys(run["sequence"] for run in runs)
    return table([["sequence", *systems], *([one, *(figures[one, system] for system in systems)] for one in sequences)])


def insert(written: Path) -> None:
    """Replace one section, and copy its images."""
    name, text = written.stem, written.read_text(encoding="utf-8")
    page = DOCS / ("limits.md" if name == "limits" else "benchmarks.md")
    text = shortened(name, re.sub(r"\A# .*\n+", "", text))  # the page has its own heading
    for picture in sorted(written.parent.glob(f"{name}-*.png")):
        (DOCS / "images").mkdir(exist_ok=True)
        shutil.copy(picture, DOCS / "images" / picture.name)
        text += f"\n![{picture.stem.replace('-', ', ')}](images/{picture.name})\n"
    old = page.read_text(encoding="utf-8")
    between = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end of {name} -->)", re.DOTALL)
    if not between.search(old):
        sys.exit(f"{page} has no section <!-- {name} --> ... <!-- end of {name} -->")
    page.write_text(between.sub(lambda found: f"{found[1]}\n{text.strip()}\n\n{found[2]}", old), encoding="utf-8")
    print(f"{page}: section {name} from {written}")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    for argument in sys.argv[1:]:
        insert(Path(argument))
