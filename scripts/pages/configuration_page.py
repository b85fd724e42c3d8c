"""Generate the reference page of the configuration keys from the pydantic models."""

import typing
from collections.abc import Iterator
from typing import Any

from perilune_shared.config.page import Key, keys
from perilune_shared.config.resolve import PRESETS, Section, resolve

UNITS = {
    "_e_per_s": "e/s",
    "_minutes": "min",
    "_percentile": "%",
    "_px": "px",
    "_deg": "deg",
    "_gib": "GiB",
    "_gyr": "Gyr",
    "_m": "m",
    "_s": "s",
    "_e": "e",
}
"""Units by the end of a key's name, longest ends first. Other keys have no unit or state it in their meaning."""
LIMITS = {"gt": "above", "ge": "from", "lt": "below", "le": "to", "multiple_of": "multiple of"}


def configuration_page(title: str, package: str, models: dict[str, type[Section]]) -> str:
    """Return the page of one program's sections: a table of keys for each group, and the presets' values."""
    pieces = [f"# {title}", "", "`null` in a file is None in Python. A range (`low`, `high`) may be one number.", ""]
    for section, model in models.items():
        presets = {name: list(keys(section, resolve(model, section, package, name))) for name in PRESETS}
        described = presets["small"]
        for group in dict.fromkeys(_group(key) for key in described):
            pieces.append(f"## {group}\n\n| Key | Unit | Default | Allowed | Meaning |\n|---|---|---|---|---|")
            pieces += [_row(key) for key in described if _group(key) == group]
            pieces.append("")
        pieces += _presets(section, presets)
    return "\n".join(pieces)


def _group(key: Key) -> str:
    return key.name.rpartition(".")[0]


def _row(key: Key) -> str:
    name = key.name.rpartition(".")[2]
    default = "in the preset" if key.default is None else f"`{key.default}`"
    return f"| `{name}` | {_unit(name)} | {default} | {_allowed(key)} | {key.meaning.replace('|', chr(92) + '|')} |"


def _unit(name: str) -> str:
    return next((unit for end, unit in UNITS.items() if name.endswith(end)), "")


def _allowed(key: Key) -> str:
    limits = [
        f"{word} {getattr(limit, kind)}"
        for limit in key.field.metadata or _inner_limits(key.field.annotation)
        for kind, word in LIMITS.items()
        if hasattr(limit, kind)
    ]
    return ", ".join(limits) or " ".join(f"`{each}`" for each in key.choices)


def _inner_limits(kind: Any) -> list[Any]:
    """Return the limits of the first number within a union or a tuple."""
    for inner in typing.get_args(kind):
        stated = getattr(inner, "__metadata__", ())
        limits = [limit for each in stated for limit in getattr(each, "metadata", [each])]
        if limits := limits or _inner_limits(inner):
            return limits
    return []


def _presets(section: str, presets: dict[str, list[Key]]) -> Iterator[str]:
    """Yield a table with the values in all presets, for keys whose value differs from the default in any preset."""
    yield f"## Presets of {section}\n\n| Key | {' | '.join(PRESETS)} |\n|---|{'---|' * len(PRESETS)}"
    for same in zip(*presets.values(), strict=True):
        if any(key.value != key.default for key in same):
            yield f"| `{same[0].name}` | {' | '.join(f'`{key.value}`' for key in same)} |"
    yield ""
