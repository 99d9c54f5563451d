"""Report of a study, in Markdown and HTML."""

import base64
import html
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dudmap.evaluation.tables import grid
from dudmap.lab.study.designs import Factor, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dudmap.lab.study.response_surface import Optimum, Surface

STYLE = (
    "body{font:15px/1.5 sans-serif;max-width:70em;margin:2em auto;padding:0 1em}img{max-width:100%}"
    "table{border-collapse:collapse;font-size:13px}"
    "td,th{padding:.2em .7em;border-bottom:1px solid #ccc;text-align:right}"
)


class Report:
    """A report filled from top to bottom."""

    def __init__(self, title: str) -> None:
        self.title = title
        self._parts = [f"# {title}\n"]
        self._figures: dict[str, bytes] = {}

    def heading(self, text: str) -> None:
        """Begin a section."""
        self._parts.append(f"## {text}\n")

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._parts.append(f"{text}\n")

    def items(self, lines: Iterable[str]) -> None:
        """Add a list."""
        self._parts.append("".join(f"* {line}\n" for line in lines))

    def table(self, frame: Table) -> None:
        """Add a table without its index."""
        rows = [[shown(value) for value in row] for row in frame.itertuples(index=False)]
        self._parts.append(grid([str(column) for column in frame.columns], rows, words=1))

    def figure(self, image: bytes, caption: str) -> None:
        """Add a PNG figure."""
        name = f"figures/{len(self._parts)}.png"
        self._figures[name] = image
        self._parts.append(f"![{caption}]({name})\n\n{caption}\n")

    def save(self, folder: Path) -> None:
        """Write report.md, figures/<number>.png, and report.html."""
        from markdown_it import MarkdownIt

        (folder / "figures").mkdir(parents=True, exist_ok=True)
        for left in (folder / "figures").glob("*.png"):
            left.unlink()
        text = "\n".join(self._parts)
        page = MarkdownIt("commonmark", {"html": False}).enable("table").render(text)
        for name, image in self._figures.items():
            (folder / name).write_bytes(image)
            page = page.replace(f'src="{name}"', f'src="data:image/png;base64,{base64.b64encode(image).decode()}"')
        (folder / "report.md").write_text(text, encoding="utf-8")
        (folder / "report.html").write_text(
            f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(self.title)}</title>'
            f"<style>{STYLE}</style><body>{page}</body></html>\n",
            encoding="utf-8",
        )


def shown(value: object) -> str:
    """Text of a cell: four significant digits, nothing for NaN."""
    if isinstance(value, float):
        return "" if value != value else f"{value:.4g}"
    return str(value)


COLORS = 64


def png(figure: "Figure") -> bytes:
    """PNG file with a palette, a quarter of the size."""
    from PIL import Image

    drawn, out = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=110)
    Image.open(drawn).convert("RGB").quantize(COLORS).save(out, format="PNG", optimize=True)
    return out.getvalue()


def _axes(
    rows: int, columns: int, width: float = 3.0, height: float = 2.6, same_y: bool = False
) -> "tuple[Figure, Any]":
    from matplotlib.figure import Figure

    figure = Figure((max(width * columns, 4.0), max(height * rows, 3.0)), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, sharey=same_y)


def _label(level: object) -> str:
    return f"{level:.3g}" if isinstance(level, float | int) and not isinstance(level, bool) else str(level)


def main_effects_figure(effects: Table, heading: str) -> bytes:
    """Mean at every level of every factor, with confidence intervals."""
    keys = list(dict.fromkeys(effects["factor"]))
    figure, axes = _axes(1, len(keys), same_y=True)
    for ax, key in zip(axes[0], keys, strict=True):
        part = effects[effects["factor"] == key]
        x = np.arange(len(part))
        bars = np.nan_to_num(np.abs(np.array([part["mean"] - part["low"], part["high"] - part["mean"]], dtype=float)))
        ax.errorbar(x, part["mean"], yerr=bars, marker="o", capsize=3)
        ax.set_xticks(x, [_label(level) for level in part["level"]])
        ax.axhline(np.average(part["mean"], weights=part["runs"]), color="0.7", lw=0.8, zorder=0)
        ax.set_xlabel(key.rpartition(".")[2])
    axes[0][0].set_ylabel(heading)
    return png(figure)


def interactions_figure(tables: dict[tuple[str, str], Table], factors: Sequence[Factor], heading: str) -> bytes:
    """Mean at all pairs of levels: a plot per pair, a line per row level."""
    count = len(factors)
    figure, axes = _axes(count, count, 2.5, 2.2)
    for row, first in enumerate(factors):
        for column, second in enumerate(factors):
            ax = axes[row][column]
            if row == column:
                ax.text(0.5, 0.5, first.name, ha="center", va="center", transform=ax.transAxes)
                ax.set_xticks([])
                ax.set_yticks([])
                continue
            pair = (first.key, second.key)
            table = tables[pair] if pair in tables else tables[second.key, first.key].T
            for level, line in table.iterrows():
                ax.plot(range(len(line)), line.to_numpy(), marker="o", ms=3, label=_label(level))
            ax.set_xticks(range(table.shape[1]), [_label(level) for level in table.columns], fontsize=7)
            ax.tick_params(axis="y", labelsize=7)
            ax.legend(fontsize=6, title=first.name, title_fontsize=6)
    figure.supylabel(heading, fontsize=9)
    return png(figure)


def surface_figure(surface: "Surface", best: "Optimum", heading: str) -> bytes:
    """Prediction along every factor through the optimum, with intervals."""
    count = len(surface.factors)
    figure, axes = _axes(1, count, same_y=True)
    for n, (ax, factor) in enumerate(zip(axes[0], surface.factors, strict=True)):
        coded = np.tile(best.coded, (41, 1))
        coded[:, n] = np.linspace(-1, 1, 41)
        frame = surface.mean_interval(coded)
        x = [factor.value(float(at)) for at in coded[:, n]]
        ax.plot(x, frame[:, 0])
        ax.fill_between(x, frame[:, 1], frame[:, 2], alpha=0.2)
        ax.axvline(best.values[factor.key], color="0.6", lw=0.8, ls="--")
        ax.set_xscale(factor.scale)
        ax.set_xlabel(factor.name)
    axes[0][0].set_ylabel(f"predicted {heading}")
    return png(figure)


def screening_figure(effects: Table, keys: Sequence[str], heading: str) -> bytes:
    """Effects of the keys on every recording, with intervals."""
    recordings = list(dict.fromkeys(effects["recording"]))
    figure, axes = _axes(1, len(recordings), 3.2, 0.24 * len(keys) + 1.0)
    y = np.arange(len(keys))[::-1]
    for ax, recording in zip(axes[0], recordings, strict=True):
        part = effects[effects["recording"] == recording].set_index("key").loc[list(keys)]
        bars = np.array([part["effect"] - part["low"], part["high"] - part["effect"]])
        ax.errorbar(part["effect"], y, xerr=bars, fmt="o", ms=3, capsize=2, lw=1)
        ax.axvline(0, color="0.7", lw=0.8, zorder=0)
        ax.set_yticks(y, keys if ax is axes[0][0] else [""] * len(keys), fontsize=7)
        ax.tick_params(axis="x", labelsize=7)
        ax.set_title(recording, fontsize=8, parse_math=False)
    figure.supxlabel(f"effect on {heading}", fontsize=8)
    return png(figure)
