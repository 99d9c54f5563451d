"""Insert the output of the benchmarks into the documentation.

    python benchmarks/docs_tables.py runs/benchmark/limits/limits.md runs/benchmark/synthetic/synthetic.md ...

Accepts limits.md (with the heat maps in its folder), synthetic.md, recordings.md and ablation.md. Each replaces the
text between ``<!-- NAME -->`` and ``<!-- end of NAME -->`` in docs/limits.md or docs/benchmarks.md, unchanged.
"""

import re
import shutil
import sys
from pathlib import Path

DOCS = Path(__file__).parent.parent / "docs"


def insert(written: Path) -> None:
    """Replace one section, and copy its images."""
    name, text = written.stem, written.read_text(encoding="utf-8")
    page = DOCS / ("limits.md" if name == "limits" else "benchmarks.md")
    text = re.sub(r"\A# .*\n+", "", text)  # the page has its own heading
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
