"""The documentation as a site: ``make docs`` builds it from the pages of this folder and the docstrings."""

import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "docs")]

from command_reference import command_pages

import dudmap

project = "dudmap"
author = "the dudmap authors"
version = release = dudmap.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode", "sphinx_copybutton"]
exclude_patterns = ["README.md", "_build"]

html_theme = "furo"
html_title = f"dudmap {release}"
html_static_path, html_css_files = ["_static"], ["site.css"]
html_show_copyright = False
smartquotes = False  # options begin with two hyphens

myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence", "html_image"]
suppress_warnings = ["myst.strikethrough"]
pygments_style, pygments_dark_style = "default", "monokai"
highlight_language = "text"

autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_type_aliases = {"NDArray": "NDArray"}
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True  # attributes of data classes are described in the docstring of the class

LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((\.\./[^)]*)\)")


def _read(app: Any, name: str, source: list[str]) -> None:
    """Fill in the commands, link the index of the site, and print links to other files of the repository as names."""
    if name == "commands":
        source[0] += command_pages()
    source[0] = source[0].replace("](README.md)", "](index.md)")
    source[0] = LINK.sub(lambda found: f"{found[1]} (`{found[2].removeprefix('../')}`)", source[0])


def _public(app: Any, env: Any, node: Any, text: Any) -> Any:
    """Link a public name that a signature gives with its module, such as dudmap.core.slam.Slam."""
    name = node.get("reftarget", "").rpartition(".")[2]
    if node.get("refdomain") != "py" or name not in dudmap.__all__:
        return None
    page = node.get("refdoc", "api")
    return env.get_domain("py").resolve_xref(env, page, app.builder, "obj", f"dudmap.{name}", node, text)


def setup(app: Any) -> dict[str, bool]:
    """Connect this file's hooks."""
    app.connect("source-read", _read)
    app.connect("missing-reference", _public)
    app.connect("env-get-outdated", lambda *_: ["commands", "api"])  # they change with the code
    return {"parallel_read_safe": True, "parallel_write_safe": True}
