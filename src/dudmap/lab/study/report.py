"""Report of a study: one Markdown file with its figures beside it, and one HTML file that holds everything."""

import base64
import html
from collections.abc import Iterable
from pathlib import Path

from dudmap.lab.benchmark.table import grid
from dudmap.lab.study.factors import Table

STYLE = (
    "body{font:15px/1.5 sans-serif;max-width:70em;margin:2em auto;padding:0 1em}img{max-width:100%}figure{margin:1em 0}"
    "table{border-collapse:collapse;font-size:13px}"
    "td,th{padding:.2em .7em;border-bottom:1px solid #ccc;text-align:right}"
)


class Report:
    """A report that is filled from top to bottom.

    Args:
        title: Its title.
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self._markdown, self._html = [f"# {title}\n"], [f"<h1>{html.escape(title)}</h1>"]
        self._figures: dict[str, bytes] = {}

    def heading(self, text: str) -> None:
        """Begin a section."""
        self._add(f"## {text}\n", f"<h2>{html.escape(text)}</h2>")

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._add(f"{text}\n", f"<p>{html.escape(text)}</p>")

    def items(self, lines: Iterable[str]) -> None:
        """Add a list."""
        lines = list(lines)
        listed = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
        self._add("".join(f"* {line}\n" for line in lines), f"<ul>{listed}</ul>")

    def table(self, frame: Table) -> None:
        """Add a table without its index."""
        header = [str(column) for column in frame.columns]
        rows = [[shown(value) for value in row] for row in frame.itertuples(index=False)]
        lines = ["".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row)
                 for tag, row in [("th", header), *(("td", row) for row in rows)]]  # fmt: skip
        self._add(grid(header, rows, words=1), "<table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>")

    def figure(self, image: bytes, caption: str) -> None:
        """Add a figure, the bytes of a PNG file."""
        name, text, data = f"{len(self._markdown)}.png", html.escape(caption), base64.b64encode(image).decode()
        self._figures[name] = image
        self._add(
            f"![{caption}](figures/{name})\n\n{caption}\n",
            f'<figure><img alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>',
        )

    def _add(self, markdown: str, page: str) -> None:
        self._markdown.append(markdown)
        self._html.append(page)

    def save(self, folder: Path) -> None:
        """Write report.md, report.html and figures/<number>.png."""
        (folder / "figures").mkdir(parents=True, exist_ok=True)
        for left in (folder / "figures").glob("*.png"):
            left.unlink()
        for name, image in self._figures.items():
            (folder / "figures" / name).write_bytes(image)
        (folder / "report.md").write_text("\n".join(self._markdown), encoding="utf-8")
        (folder / "report.html").write_text(
            f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(self.title)}</title>'
            f"<style>{STYLE}</style><body>{''.join(self._html)}</body></html>\n",
            encoding="utf-8",
        )


def shown(value: object) -> str:
    """Text of a cell: four significant digits, nothing for NaN."""
    if isinstance(value, float):
        return "" if value != value else f"{value:.4g}"
    return str(value)
