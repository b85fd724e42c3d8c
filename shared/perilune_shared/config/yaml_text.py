"""Parse untrusted YAML 1.2 with the core schema (specification 1.2.2, section 10.3), and write YAML.

In the core schema, `yes`, `off`, `1:30`, `1_000` and `2024-01-17` are text, `012` is the number 12 (octal is `0o14`),
and `1e-4` is a number. Keys are always text.

The parser is stricter than YAML. A repeated key, an alias, an anchor, a tag, a directive, a second document and a key
that is not a scalar are errors. Size and depth are limited.
"""

import io
import re
from collections.abc import Callable, Iterator
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    DocumentEndEvent,
    DocumentStartEvent,
    Event,
    MappingEndEvent,
    MappingStartEvent,
    NodeEvent,
    ScalarEvent,
    SequenceEndEvent,
    SequenceStartEvent,
    StreamEndEvent,
)
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.representer import SafeRepresenter

from perilune_shared.errors import UserError, shortened

_MAX_CHARACTERS = 100_000
_MAX_DEPTH = 20
_EXPECTED = "YAML 1.2 with plain values"
_CORE_SCHEMA: tuple[tuple[re.Pattern, Callable[[str], Any]], ...] = (
    (re.compile(r"null|Null|NULL|~|"), lambda text: None),
    (re.compile(r"true|True|TRUE|false|False|FALSE"), lambda text: text.lower() == "true"),
    (re.compile(r"[-+]?[0-9]+"), int),
    (re.compile(r"0o[0-7]+"), lambda text: int(text[2:], 8)),
    (re.compile(r"0x[0-9a-fA-F]+"), lambda text: int(text[2:], 16)),
    (re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"), float),
    (re.compile(r"[-+]?\.(inf|Inf|INF)"), lambda text: float(text.replace(".", "").lower())),
    (re.compile(r"\.(nan|NaN|NAN)"), lambda text: float("nan")),
)
# Text that is read as text without quotes in every YAML version.
_PLAIN_TEXT = re.compile(r"(?!(?:y|n|yes|no|on|off|true|false|null)$)[A-Za-z][\w ./()-]*(?<! )", re.IGNORECASE)


class _Refused(ValueError):
    """Error for valid YAML that this parser does not accept."""

    def __init__(self, event: Event, got: str, expected: str = _EXPECTED):
        self.got, self.expected = f"{got} at line {event.start_mark.line + 1}", expected


def parse_yaml(text: str, where: object) -> Any:
    """Parse YAML text to plain data (dict, list, str, int, float, bool, None); empty text gives None.

    Raises UserError if the text is not YAML or if this parser does not accept it. Messages name `where`.
    """
    if len(text) > _MAX_CHARACTERS:
        raise UserError(where, "size", f"{len(text)} characters", f"at most {_MAX_CHARACTERS}")
    try:
        return _document(iter(YAML(typ="safe", pure=True).parse(io.StringIO(text))))
    except _Refused as error:
        raise UserError(where, "syntax", error.got, error.expected) from None
    except (YAMLError, ValueError, RecursionError) as error:
        raise UserError(
            where, "syntax", f"text that is not YAML ({shortened(_problem_with_line(error))})", _EXPECTED
        ) from None


def to_yaml_text(data: dict[str, Any]) -> str:
    """Format plain data as block YAML; keys keep their order.

    Quotes text that YAML 1.1 could read as another type.
    """
    yaml = YAML(typ="safe", pure=True)
    yaml.Representer = _Representer
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.width = 4096
    out = io.StringIO()
    yaml.dump(data, out)
    return out.getvalue()


class _Representer(SafeRepresenter):
    pass


def _quoted(representer: SafeRepresenter, text: str) -> ScalarNode:
    style = None if _PLAIN_TEXT.fullmatch(text) else '"'
    return representer.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Representer.add_representer(str, _quoted)


def _document(events: Iterator[Event]) -> Any:
    next(events)  # skip the start of the stream
    event = next(events)
    if isinstance(event, StreamEndEvent):
        return None
    assert isinstance(event, DocumentStartEvent)
    if event.version or event.tags:
        raise _Refused(event, "a directive (%)")
    content = _node(next(events), events, 0)
    event = next(events)
    assert isinstance(event, DocumentEndEvent)
    event = next(events)
    if not isinstance(event, StreamEndEvent):
        raise _Refused(event, "a second document")
    return content


def _node(event: Event, events: Iterator[Event], depth: int) -> Any:
    assert isinstance(event, NodeEvent)
    if isinstance(event, AliasEvent) or event.anchor:
        raise _Refused(event, f"an alias or anchor ({event.anchor})")
    tag = getattr(event, "tag", None)
    if tag:
        raise _Refused(event, f"a tag ({tag})")
    if depth > _MAX_DEPTH:
        raise _Refused(event, f"more than {_MAX_DEPTH} levels")
    if isinstance(event, ScalarEvent):
        return _scalar(event)
    if isinstance(event, SequenceStartEvent):
        items = []
        while not isinstance(event := next(events), SequenceEndEvent):
            items.append(_node(event, events, depth + 1))
        return items
    assert isinstance(event, MappingStartEvent)
    return _mapping(events, depth)


def _mapping(events: Iterator[Event], depth: int) -> dict[str, Any]:
    content: dict[str, Any] = {}
    while not isinstance(key := next(events), MappingEndEvent):
        if not isinstance(key, ScalarEvent):
            raise _Refused(key, "a key that is not text")
        _node(key, events, depth + 1)
        name = key.value
        value = next(events)
        if key.style is None and ":" in name and isinstance(value, ScalarEvent) and value.value == "":
            spaced = re.sub(r":(?! )", ": ", name)
            raise _Refused(key, f"the key {name!r} without a value", f"a space after the colon: {{{spaced}}}")
        if name in content:
            raise _Refused(key, f"the key {name!r} twice", "each key once")
        content[name] = _node(value, events, depth + 1)
    return content


def _scalar(event: ScalarEvent) -> Any:
    if event.style is not None:
        return event.value
    for form, read in _CORE_SCHEMA:
        if form.fullmatch(event.value):
            return read(event.value)
    return event.value


def _problem_with_line(error: Exception) -> str:
    problem, mark = getattr(error, "problem", None), getattr(error, "problem_mark", None)
    at = f" at line {mark.line + 1}" if mark is not None else ""
    return f"{problem}{at}" if problem else str(error)
