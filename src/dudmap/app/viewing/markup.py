"""HTML text in which every value is escaped, unless it is HTML that was made here."""

import base64
import hashlib
import string
from collections.abc import Iterable
from html import escape


class Html(str):
    """Text that is HTML already: made by ``html`` or ``joined``, or shipped with dudmap. All other text is escaped."""

    __slots__ = ()


class _Escaping(string.Formatter):
    def format_field(self, value: object, format_spec: str) -> str:
        return value if isinstance(value, Html) else escape(format(value, format_spec))


def html(template: str, /, **values: object) -> Html:
    """HTML of a template in the syntax of ``str.format``, whose values are escaped."""
    return Html(_Escaping().vformat(template, (), values))


def joined(parts: Iterable[object], between: str = "") -> Html:
    """Parts one after the other; those that are no HTML are escaped."""
    return Html(between.join(html("{part}", part=part) for part in parts))


def script_source(script: str) -> str:
    """Source in a content security policy that allows this script."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"
