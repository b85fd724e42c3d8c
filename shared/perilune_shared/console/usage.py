"""Describe a mistake in the options or arguments of a command line in one line."""

import re
from difflib import get_close_matches
from typing import Any

from perilune_shared.config.errors import expected_of
from perilune_shared.errors import UserError, one_line, shortened

_WORDINGS = (
    (r"(.*) is not one of (.*)", "one of {}"),
    (r"(.*) is not in the range x>=?(.*)", "at least {}"),
    (r"(.*) is not in the range x<=?(.*)", "at most {}"),
    (r"(.*) is not in the range (.*)", "{}"),
    (r"(.*) is not a valid integer(.*)", "an integer"),
    (r"(.*) is not a valid float(.*)", "a number"),
    (r"(.*) is not a valid boolean(.*)", "true or false"),
)
"""Messages of Typer and Click about a wrong value (group 1), and what was expected ({} is group 2)."""


def usage_line(error: Any) -> str:
    """Return the line that describes a `UsageError` of Typer or Click, without the leading "error: "."""
    kind, parameter = type(error).__name__, getattr(error, "param", None)
    name = getattr(error, "option_name", None) or (_name(parameter) if parameter is not None else None)
    command = error.ctx.command if error.ctx else None
    if kind == "NoSuchOption":
        return _unknown("option", error.option_name, error.possibilities or (), error)
    if kind == "MissingParameter" and name:
        return _got(name, "nothing", f"a value{_help_hint(error)}")
    if kind == "BadParameter" and name:
        return _got(name, *_wrong_value(error))
    if kind == "BadOptionUsage" and name:
        return _got(name, *(("a value", "none") if "not take" in error.message else ("nothing", "a value")))
    if unknown := re.match(r"No such command '(.*?)'\.", f"{error.message}."):
        return _unknown("command", unknown[1], list(getattr(command, "commands", ())), error)
    if error.message.startswith("Missing command"):
        return _got(error.ctx.info_name, "no command", "one of " + ", ".join(_commands(command)))
    if extra := re.match(r"Got unexpected extra arguments?(?:\(s\))? \((.*)\)$", error.message):
        return _got(error.ctx.info_name, extra[1], "no further argument")
    return one_line(error.format_message())


def _got(name: str, value: object, expected: str) -> str:
    return str(UserError(name, "", value, expected))


def _unknown(kind: str, name: str, known: Any, error: Any) -> str:
    """Return the line on an unknown option or command, with the most similar known name if there is one."""
    close = get_close_matches(name, known, n=1)
    hint = f"; did you mean {close[0]}?" if close else _help_hint(error)
    return f"no such {kind} {one_line(shortened(name))}{hint}"


def _help_hint(error: Any) -> str:
    return f"; see `{error.ctx.command_path} --help`" if error.ctx else ""


def _commands(group: Any) -> list[str]:
    return [name for name, command in group.commands.items() if not command.hidden]


def _name(parameter: Any) -> str:
    """Return the long name of an option, or the name of an argument."""
    is_option = parameter.param_type_name == "option"
    return max(parameter.opts, key=len) if is_option else parameter.name


def _wrong_value(error: Any) -> tuple[object, str]:
    """Return the wrong value of a parameter, and what was expected."""
    message = re.sub(r"^(Value error|Assertion failed), ", "", error.message).rstrip(".")
    for pattern, expected in _WORDINGS:
        if wording := re.fullmatch(pattern, message):
            return wording[1].strip("'"), expected.format(wording[2].replace("'", ""))
    faults = getattr(error.__cause__, "errors", None)
    if faults:
        # Recent versions of Typer validate values with pydantic.
        fault = faults()[0]
        return fault["input"], expected_of(fault)
    return "another value", message
