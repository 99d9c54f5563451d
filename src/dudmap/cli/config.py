"""``dudmap config``: all parameters with their meanings."""

import textwrap
from typing import TYPE_CHECKING

from dudmap.cli import options as o
from dudmap.cli.output import answer

if TYPE_CHECKING:
    from dudmap.config import Config


def config(system: o.SystemOption = None, as_json: o.JsonOption = False) -> None:
    """Print all parameters with their meanings as TOML, the format of --config."""
    found = o.read_config(None, system, None)
    answer(found.model_dump(mode="json"), commented(found).rstrip("\n"), as_json=as_json)


def commented(config: "Config") -> str:
    """TOML text of a configuration, with the meaning of each parameter as a comment."""
    parts = {"": type(config).model_fields}
    for name, field in type(config).model_fields.items():
        parts[name] = getattr(type(getattr(config, name)), "model_fields", {}) or {name: field}
    lines, part = [], ""
    for line in config.to_toml().splitlines():
        if line.startswith("["):
            part = line.strip("[]")
            about = type(getattr(config, part)).__doc__ or ""
            lines += textwrap.wrap(" ".join(about.split()), 100, initial_indent="# ", subsequent_indent="# ")
        elif " = " in line:
            about = parts[part][line.partition(" = ")[0]].description or ""
            lines += textwrap.wrap(about, 100, initial_indent="# ", subsequent_indent="# ")
        lines.append(line)
    return "\n".join(lines) + "\n"
