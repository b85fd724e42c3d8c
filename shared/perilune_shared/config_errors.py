"""Format validation errors of settings in one line: source, key, value found and value expected."""

import difflib
import json
import re
import typing
from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from perilune_shared.errors import UserError

_MIN_SIMILARITY = 0.75
"""Minimum similarity (ratio of difflib) of a name that is suggested."""

# Expected value by pydantic's error type; fields in braces come from the error's context.
_EXPECTED = {
    "missing": "a value",
    "none_required": "null",
    "bool_type": "true or false",
    "int_type": "an integer",
    "int_from_float": "an integer",
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


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a suggestion for an unknown name: the most similar known name, or all known names if none is similar."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1, cutoff=_MIN_SIMILARITY)
    return f"{close[0]} (nearest known)" if close else "one of " + ", ".join(known)


def expected_of(fault: ErrorDetails) -> str:
    """Return what pydantic expected, as a noun phrase or bound that completes "expected ..."."""
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
    text = re.sub(r"^(\w+ )?[Ii]nput should (be|have) (a valid )?", "", fault["msg"])
    return text[0].lower() + text[1:]


def formatted(value: Any) -> str:
    """Format a value for a message, with YAML's true, false and null."""
    if isinstance(value, bool) or value is None:
        return json.dumps(value)
    return repr(value)


def user_error_of(
    error: ValidationError, model: type[BaseModel], section: str, sources: list[tuple[str, dict[str, Any]]]
) -> UserError:
    """Return the first error as a UserError.

    The section was merged from `sources` (name, content); later sources override.
    """
    fault = error.errors(include_url=False)[0]
    location = [str(part) for part in fault["loc"]]
    where = next((name for name, content in reversed(sources) if _contains(content, location)), sources[-1][0])
    field = ".".join([section, *location])
    if fault["type"] == "extra_forbidden":
        return UserError(where, field, "an unknown key", nearest(location[-1], _fields_at(model, location[:-1])))
    got = "nothing" if fault["type"] == "missing" else formatted(fault["input"])
    return UserError(where, field, got, expected_of(fault))


def _contains(content: Any, location: list[str]) -> bool:
    for key in location:
        if isinstance(content, list):
            return True
        if not isinstance(content, Mapping) or key not in content:
            return False
        content = content[key]
    return True


def _fields_at(model: type[BaseModel], location: list[str]) -> list[str]:
    for key in location:
        field = model.model_fields.get(key)
        found = [] if field is None else _models_in(field.annotation)
        if not found:
            return []
        model = found[0]
    return list(model.model_fields)


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for part in typing.get_args(annotation) for found in _models_in(part)]
