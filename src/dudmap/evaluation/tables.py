"""Tables of metrics: Markdown, CSV, LaTeX (booktabs)."""

import csv
import io
from collections.abc import Iterable
from typing import Any, NamedTuple

from dudmap.errors import ConfigError

FORMATS = {"md": "md", "csv": "csv", "latex": "tex"}

Cells = list[str] | tuple[str, ...]

Row = dict[str, Any]


class Column(NamedTuple):
    """Heading with unit, factor, and decimals of a metric."""

    key: str
    heading: str
    factor: float = 1.0
    digits: int = 0


def shown(value: Any, column: Column) -> str:  # noqa: ANN401 - figures and words alike
    """Text of one cell."""
    if value is None:
        return ""
    return f"{value * column.factor:.{column.digits}f}" if isinstance(value, int | float) else str(value)


def grid(header: Cells, rows: Iterable[Cells], words: int = 2) -> str:
    """Markdown table; the first ``words`` columns are left-aligned."""
    lines = ["| " + " | ".join(header) + " |"]
    lines.append("|" + "|".join("---" if number < words else "---:" for number in range(len(header))) + "|")
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def comma_separated(rows: list[dict[str, Any]]) -> str:
    """CSV with a column per key, in stored units."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(key for row in rows for key in row)), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def latex(header: Cells, rows: Iterable[Cells], words: int = 2) -> str:
    """LaTeX ``tabular`` (booktabs), aligned as ``grid``."""
    head, *body = (" & ".join(map(_in_latex, cells)) + r" \\" for cells in (header, *rows))
    lines = [r"\begin{tabular}{" + "l" * words + "r" * (len(header) - words) + "}", r"\toprule", head, r"\midrule"]
    return "\n".join([*lines, *body, r"\bottomrule", r"\end{tabular}"]) + "\n"


def _in_latex(text: str) -> str:
    marks = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    return "".join(marks.get(letter, f"\\{letter}" if letter in "&%$#_{}" else letter) for letter in text)


def table(rows: list[dict[str, Any]], columns: Iterable[Column], kind: str, words: int = 1) -> str:
    """Table in a format of ``FORMATS``, without empty columns; CSV has every metric in stored units."""
    if kind not in FORMATS:
        raise ConfigError(f"found --table-format {kind}; expected {', '.join(FORMATS)}")
    if kind == "csv":
        return comma_separated(rows)
    used = [column for column in columns if any(row.get(column.key) is not None for row in rows)]
    cells = [[shown(row.get(column.key), column) for column in used] for row in rows]
    return (grid if kind == "md" else latex)([column.heading for column in used], cells, words)
