"""Reference of all commands, made from the commands themselves whenever the site is built."""

import re
from collections.abc import Iterator
from typing import Any

import typer

from dudmap.cli import COMMANDS, application_of


def command_pages() -> str:
    """One section of MyST Markdown per command: help, arguments, and options with their defaults."""
    return "\n".join(line for name in COMMANDS for line in _sections(name))


def _sections(name: str) -> Iterator[str]:
    command = typer.main.get_command(application_of(name))
    nested = getattr(command, "commands", None)
    yield from _section(f"dudmap {name}", "##", command, has_own_parameters=nested is None)
    for inner, subcommand in (nested or {}).items():
        yield from _section(f"dudmap {name} {inner}", "###", subcommand, has_own_parameters=True)


def _section(title: str, level: str, command: Any, *, has_own_parameters: bool) -> Iterator[str]:
    yield from ("", f"{level} {title}", "", _paragraphs(command.help or ""), "")
    if not has_own_parameters:
        return
    shown = [parameter for parameter in command.params if not getattr(parameter, "hidden", False)]
    arguments = [_argument(parameter) for parameter in shown if parameter.param_type_name == "argument"]
    yield from ("```text", " ".join([title, *arguments, "[OPTIONS]"]), "```", "", "| | | default |", "|---|---|---|")
    for parameter in shown:
        yield f"| {_names(parameter)} | {_cell(getattr(parameter, 'help', None) or '')} | {_default(parameter)} |"


def _argument(parameter: Any) -> str:
    name = (parameter.metavar or parameter.name).upper() + ("..." if parameter.nargs == -1 else "")
    return name if parameter.required else f"[{name}]"


def _names(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return f"`{_argument(parameter)}`"
    return " ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts))


def _default(parameter: Any) -> str:
    value = parameter.default
    if value is None or value is False or value == () or callable(value) or parameter.required:
        return ""
    if value is True:
        return "yes"
    return f"`{value}`"


def _paragraphs(text: str) -> str:
    return re.sub(r"``([^`]+)``", r"`\1`", text.replace("\b", "").replace("<", r"\<").replace("*", r"\*"))


def _cell(text: str) -> str:
    return " ".join(_paragraphs(text).replace("|", r"\|").split())
