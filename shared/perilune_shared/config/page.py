"""Format a resolved configuration as YAML; comments state meaning, choices and default of each key."""

import json
import textwrap
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pydantic.fields import FieldInfo

from perilune_shared.config.resolve import Section

_WIDTH = 118


@dataclass(frozen=True)
class Key:
    """Description of one key of a configuration."""

    name: str
    """Full name, for example dataset.camera.width_px."""
    field: FieldInfo
    """Pydantic's field, with type and limits."""
    meaning: str
    """Docstring of the field, on one line."""
    choices: tuple[str, ...]
    """Values of a Literal; empty for any other type."""
    default: str | None
    """Default value, as YAML on one line; None if the key is required."""
    value: str
    """Value in this configuration, as YAML on one line."""


def keys(section: str, config: Section) -> Iterator[Key]:
    """Yield every key of a resolved section, in the order of the configuration file.

    The keys of an optional section are yielded even if the section is not set. A key without a default then has the
    value `required`.
    """
    plain = config.model_dump(mode="json")
    for name, field in type(config).model_fields.items():
        value, full = getattr(config, name), f"{section}.{name}"
        if isinstance(value, Section) and not _is_span(value):
            yield from keys(full, value)
        else:
            default = None if field.is_required() else _default(field)
            yield Key(full, field, _meaning(field), _choices(field), default, _flow(plain[name]))
            if value is None and (optional := _section_of(field)):
                for inner, inner_field in optional.model_fields.items():
                    usual = "required" if inner_field.is_required() else _default(inner_field)
                    yield Key(
                        f"{full}.{inner}", inner_field, _meaning(inner_field), _choices(inner_field), usual, usual
                    )


def annotated_yaml(section: str, config: Section) -> str:
    """Return the section as a commented configuration file that `resolve` can read.

    The unit of a key is in its name or in its meaning.
    """
    return "\n".join([f"{section}:", *_lines(config, 1)]) + "\n"


def _lines(config: Section, depth: int) -> Iterator[str]:
    indent = "  " * depth
    plain = config.model_dump(mode="json")
    for name, field in type(config).model_fields.items():
        value = getattr(config, name)
        nested = isinstance(value, Section) and not _is_span(value)
        comment = _meaning(field) if nested else f"{_meaning(field)}{_one_of(field)} Default: {_default(field)}."
        yield from textwrap.wrap(comment, _WIDTH, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")
        if nested:
            yield f"{indent}{name}:"
            yield from _lines(value, depth + 1)
        else:
            yield f"{indent}{name}: {_flow(plain[name])}"


def _meaning(field: FieldInfo) -> str:
    return " ".join((field.description or "").split())


def _choices(field: FieldInfo) -> tuple[str, ...]:
    """Return the values of a Literal, also if it is a member of a union."""
    kinds = [field.annotation, *typing.get_args(field.annotation)]
    return tuple(
        str(value) for kind in kinds if typing.get_origin(kind) is typing.Literal for value in typing.get_args(kind)
    )


def _section_of(field: FieldInfo) -> type[Section] | None:
    """Return the type of an optional section; None for any other field."""
    kinds = typing.get_args(field.annotation)
    return next((kind for kind in kinds if isinstance(kind, type) and issubclass(kind, Section)), None)


def _one_of(field: FieldInfo) -> str:
    values = _choices(field)
    return f" One of: {', '.join(values)}." if values else ""


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "none (required)"
    value: Any = field.get_default(call_default_factory=True)
    return _flow(value.model_dump(mode="json") if isinstance(value, Section) else value)


def _flow(value: Any) -> str:
    """Format a value as YAML on one line: JSON without quotes around keys and single words."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_flow(each)}" for key, each in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_flow, value)) + "]"
    if isinstance(value, str) and value.isidentifier() and value.lower() not in ("null", "true", "false"):
        return value
    return json.dumps(value)


def _is_span(value: Section) -> bool:
    """Whether a section has no keys but `low` and `high`; such a section is shown on one line."""
    return set(type(value).model_fields) == {"low", "high"}
