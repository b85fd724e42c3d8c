"""Format a validation error of a setting in one line: source, key, value found and value expected."""

import difflib
import json
import re
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from perilune_shared.errors import UserError

_MIN_SIMILARITY = 0.75
"""Minimum similarity of a suggested name (ratio of difflib's SequenceMatcher)."""

# What was expected, by pydantic's error type. Pydantic's error context fills the fields in braces.
_EXPECTED = {
    "missing": "a value",
    "none_required": "null",
    "bool_type": "true or false",
    "int_type": "an integer",
    "int_from_float": "an integer",
    "int_parsing": "an integer",
    "float_parsing": "a number",
    "bool_parsing": "true or false",
    "int_parsing_size": "a smaller integer",
    "float_type": "a number",
    "finite_number": "a finite number",
    "string_type": "text",
    "string_too_short": "text of at least {min_length} characters",
    "string_too_long": "text of at most {max_length} characters",
    "string_pattern_mismatch": "text of the form {pattern}",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a mapping",
    "model_type": "a mapping",
    "model_attributes_type": "a mapping",
    "greater_than": "above {gt}",
    "greater_than_equal": "at least {ge}",
    "less_than": "below {lt}",
    "less_than_equal": "at most {le}",
    "multiple_of": "a multiple of {multiple_of}",
    "literal_error": "{expected}",
    "enum": "{expected}",
    "value_error": "{error}",
    "extra_forbidden": "only known keys",
}
_COUNTED = {"too_short": ("at least", "min_length"), "too_long": ("at most", "max_length")}


_KEY = "[key]"
_FEW = 3
"""Largest number of settings that a message lists if it names none of them."""
"""Last part of pydantic's location if a key of a mapping is wrong, not the value."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return the most similar known name, or all known names if none is similar, worded as a suggestion."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1, cutoff=_MIN_SIMILARITY)
    return f"{close[0]} (nearest known)" if close else "one of " + ", ".join(known)


def expected_of(fault: ErrorDetails) -> str:
    """Return what pydantic expected, worded to follow "expected" in a message."""
    kind, context = fault["type"], fault.get("ctx", {})
    if kind in _COUNTED:
        bound, key = _COUNTED[kind]
        return f"{bound} {context[key]} item{'s' if context[key] != 1 else ''}"
    if kind in _EXPECTED:
        short = {key: f"{value:g}" if isinstance(value, float) else value for key, value in context.items()}
        expected = _EXPECTED[kind].format_map(short)
        # `{low:5}` and `low:5` are text in YAML, since a colon needs a space after it.
        spaced = expected == "a mapping" and isinstance(fault["input"], str) and re.search(r":\S", fault["input"])
        return f"{expected}, with a space after each colon" if spaced else expected
    return "another value"  # not pydantic's message, which is worded differently


def formatted(value: Any) -> str:
    """Format a value for a message, with YAML's true, false and null."""
    if isinstance(value, bool) or value is None:
        return json.dumps(value)
    return repr(value)


def user_error_of(
    error: ValidationError, model: type[BaseModel], section: str, sources: list[tuple[str, dict[str, Any]]]
) -> UserError:
    """Return the first of pydantic's errors as a UserError.

    `sources` are the pairs of name and content from which the section was merged; later sources override earlier ones.
    The UserError names the last source that contains the wrong setting.
    """
    fault = error.errors(include_url=False)[0]
    location = [str(part) for part in fault["loc"]]
    where = next((name for name, content in reversed(sources) if _contains(content, location)), sources[-1][0])
    field = ".".join([section, *location])
    if fault["type"] == "extra_forbidden":
        return UserError(where, field, "an unknown key", nearest(location[-1], _fields_at(model, location[:-1])))
    if location and location[-1] == _KEY:
        field = ".".join([section, *location[:-2]])
        return UserError(where, field, f"the key {formatted(fault['input'])}", expected_of(fault))
    return UserError(where, field, got_of(fault), expected_of(fault))


def got_of(fault: ErrorDetails) -> str:
    """Return the wrong value, or the contradictory settings that pydantic's message names."""
    if fault["type"] == "missing":
        return "nothing"
    value = fault["input"]
    if fault["type"] == "value_error" and isinstance(value, Mapping):
        words = set(re.findall(r"\w+", expected_of(fault)))
        named = [f"{key} {formatted(each)}" for key, each in value.items() if key in words]
        if not named and len(value) <= _FEW and not any(isinstance(each, Mapping | list) for each in value.values()):
            named = [f"{key} {formatted(each)}" for key, each in value.items()]
        return ", ".join(named) if named else "settings that do not fit together"
    return formatted(value)


def _contains(content: Any, location: list[str]) -> bool:
    for key in location:
        if isinstance(content, list):
            return True
        if not isinstance(content, Mapping) or key not in content:
            return False
        content = content[key]
    return True


def _fields_at(model: type[BaseModel], location: list[str]) -> list[str]:
    """Return the names of the settings at a location below `model`.

    The result is empty if there is no section at the location.
    """
    annotation: Any = model
    for key in location:
        section = next(iter(_sections_in(annotation)), None)
        if section is not None:
            field = section.model_fields.get(key)
            annotation = None if field is None else field.annotation
        else:
            # `key` is a key of a mapping or the number of an item: continue with the type of the values.
            annotation = next(iter(typing.get_args(_container_in(annotation))[-1:]), None)
    return [name for section in _sections_in(annotation)[:1] for name in section.model_fields]


def _parts(annotation: Any) -> list[Any]:
    """Return the members of a union; a list with the type itself if it is no union. Removes Annotated."""
    if typing.get_origin(annotation) is typing.Annotated:
        return _parts(typing.get_args(annotation)[0])
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return [part for each in typing.get_args(annotation) for part in _parts(each)]
    return [annotation]


def _sections_in(annotation: Any) -> list[type[BaseModel]]:
    return [part for part in _parts(annotation) if isinstance(part, type) and issubclass(part, BaseModel)]


def _container_in(annotation: Any) -> Any:
    """Return the dict or list type in a type; a tuple type is returned as a list type."""
    for part in _parts(annotation):
        if typing.get_origin(part) in (dict, list):
            return part
        if typing.get_origin(part) is tuple:
            return list[typing.get_args(part)[0]]  # type: ignore[misc]
    return None
