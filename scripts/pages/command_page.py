"""Generate the reference page of a command line: every command, argument and option, from the typer app."""

import enum
import re
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

NAMES = {Path: "path", str: "text", int: "integer", float: "number"}


def command_page(program: str, app: typer.Typer) -> str:
    """Return the page of one program, with a section for each of its commands."""
    root = typer.main.get_command(app)
    return "\n".join([f"# {program}", "", root.help or "", "", *_sections(program, root)])


def commands(program: str, app: typer.Typer) -> dict[str, Any]:
    """Return every command by its full name, for example "perilune-train detect train". Former names are left out."""
    return dict(_leaves(program, typer.main.get_command(app)))


def _leaves(name: str, command: Any) -> Iterator[tuple[str, Any]]:
    for below, each in getattr(command, "commands", {}).items():
        full = f"{name} {below}"
        if each.hidden:
            continue
        yield from _leaves(full, each) if hasattr(each, "commands") else [(full, each)]


def _sections(program: str, root: Any) -> Iterator[str]:
    for name, command in _leaves(program, root):
        arguments = [each for each in command.params if each.param_type_name == "argument"]
        usage = " ".join([name, *map(_placeholder, arguments), "[OPTIONS]"])
        yield f"## {name}\n\n{_text(command.help)}\n\n```\n{usage}\n```\n"
        if command.params:
            yield "| Name | Value | Default | Meaning |\n|---|---|---|---|"
            yield from map(_row, command.params)
        yield ""


def _placeholder(argument: Any) -> str:
    name = argument.name.upper() + ("..." if argument.nargs == -1 else "")
    return name if argument.required else f"[{name}]"


def _row(parameter: Any) -> str:
    names = parameter.name.upper() if parameter.param_type_name == "argument" else ", ".join(parameter.opts)
    names = " / ".join([names, *parameter.secondary_opts])
    meaning, default = _meaning(parameter)
    return f"| `{names}` | {_value(parameter)} | {default or _default(parameter)} | {meaning} |"


def _text(text: str) -> str:
    """Escape characters that Markdown would read as HTML or as the end of a table cell."""
    return text.replace("<", "&lt;").replace("|", "\\|")


def _meaning(parameter: Any) -> tuple[str, str]:
    """Split a help text into its meaning and the default that it may state at its end as [default: ...]."""
    text = " ".join((parameter.help or "").split())
    words = re.search(r" ?\[default: (.*)\]$", text)
    return _text(text[: words.start()] if words else text), _text(words[1]) if words else ""


def _value(parameter: Any) -> str:
    kind = next(kind for kind in _plain(parameter.type_descriptor.annotation) if kind is not type(None))
    if kind is bool:
        return "flag"
    if isinstance(kind, enum.EnumType):
        return " ".join(f"`{each.value}`" for each in kind)
    if typing.get_origin(kind) is typing.Literal:
        return " ".join(f"`{each}`" for each in typing.get_args(kind))
    return f"{NAMES[kind]}{_range(parameter)}" + (", repeatable" if parameter.multiple else "")


def _plain(kind: Any) -> list[Any]:
    """Return the types of a value, without Annotated, list and unions around them."""
    if typing.get_origin(kind) is typing.Literal or not typing.get_args(kind):
        return [kind]
    inside = typing.get_args(kind)
    return [each for part in inside for each in _plain(part)]


def _range(parameter: Any) -> str:
    if parameter.min is not None and parameter.max is not None:
        return f", {parameter.min} to {parameter.max}"
    return f", from {parameter.min}" if parameter.min is not None else ""


def _default(parameter: Any) -> str:
    if parameter.required:
        return "required"
    if parameter.default is True:
        return f"`{parameter.opts[0]}`"
    default = parameter.default.value if isinstance(parameter.default, enum.Enum) else parameter.default
    return "" if default in (None, False, ()) else f"`{default}`"
