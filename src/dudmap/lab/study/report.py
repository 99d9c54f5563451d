"""Report of a study: one Markdown file with its figures beside it, and one HTML file that holds everything."""

import base64
import html
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

from dudmap.lab.benchmark.table import grid
from dudmap.lab.study.tables import Table

STYLE = (
    "body{font:15px/1.5 sans-serif;max-width:70em;margin:2em auto;padding:0 1em}img{max-width:100%}figure{margin:1em 0}"
    "table{border-collapse:collapse;font-size:13px}"
    "td,th{padding:.2em .7em;border-bottom:1px solid #ccc;text-align:right}"
)


class Block(NamedTuple):
    """Part of a report.

    Attributes:
        kind: What it is.
        text: Heading, paragraph, or caption; of a list, one line per item.
        table: Header and rows of a table.
        image: PNG file of a figure.
    """

    kind: Literal["heading", "text", "list", "table", "figure"]
    text: str = ""
    table: tuple[list[str], list[list[str]]] = ([], [])
    image: bytes = b""


@dataclass
class Report:
    """A report that is filled from top to bottom.

    Attributes:
        title: Its title.
        blocks: Its parts in order.
    """

    title: str
    blocks: list[Block] = field(default_factory=list)

    def heading(self, text: str) -> None:
        """Begin a section."""
        self.blocks.append(Block("heading", text))

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self.blocks.append(Block("text", text))

    def items(self, lines: Iterable[str]) -> None:
        """Add a list."""
        self.blocks.append(Block("list", "\n".join(lines)))

    def table(self, frame: Table) -> None:
        """Add a table without its index."""
        rows = [[shown(value) for value in row] for row in frame.itertuples(index=False)]
        self.blocks.append(Block("table", table=([str(column) for column in frame.columns], rows)))

    def figure(self, image: bytes, caption: str) -> None:
        """Add a figure."""
        self.blocks.append(Block("figure", caption, image=image))

    def save(self, folder: Path) -> None:
        """Write report.md, report.html and figures/<number>.png."""
        (folder / "figures").mkdir(parents=True, exist_ok=True)
        for left in (folder / "figures").glob("*.png"):
            left.unlink()
        markdown, page = [f"# {self.title}\n"], [f"<h1>{html.escape(self.title)}</h1>"]
        for number, block in enumerate(self.blocks, 1):
            markdown.append(_markdown(block, number, folder))
            page.append(_html(block))
        (folder / "report.md").write_text("\n".join(markdown), encoding="utf-8")
        (folder / "report.html").write_text(
            f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(self.title)}</title>'
            f"<style>{STYLE}</style><body>{''.join(page)}</body></html>\n",
            encoding="utf-8",
        )


def shown(value: object) -> str:
    """Text of a cell: four significant digits, nothing for NaN."""
    if isinstance(value, float):
        return "" if value != value else f"{value:.4g}"
    return str(value)


def _markdown(block: Block, number: int, folder: Path) -> str:
    if block.kind == "heading":
        return f"## {block.text}\n"
    if block.kind == "list":
        return "".join(f"* {line}\n" for line in block.text.splitlines())
    if block.kind == "table":
        return grid(*block.table, words=1)
    if block.kind == "figure":
        (folder / "figures" / f"{number}.png").write_bytes(block.image)
        return f"![{block.text}](figures/{number}.png)\n\n{block.text}\n"
    return f"{block.text}\n"


def _html(block: Block) -> str:
    text = html.escape(block.text)
    if block.kind == "heading":
        return f"<h2>{text}</h2>"
    if block.kind == "list":
        return "<ul>" + "".join(f"<li>{line}</li>" for line in text.splitlines()) + "</ul>"
    if block.kind == "table":
        header, rows = block.table
        lines = ["".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row)
                 for tag, row in [("th", header), *(("td", row) for row in rows)]]  # fmt: skip
        return "<table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"
    if block.kind == "figure":
        data = base64.b64encode(block.image).decode()
        return f'<figure><img alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'
    return f"<p>{text}</p>"
