"""Strict configuration: preset, then the user's YAML file, then single settings; every key must be known.

A configuration file has up to four sections, one for each command that reads it: `dataset` (the renderer),
`detect`, `navigate` and `explain` (the trainer). A command validates its own section and ignores the others,
so that one file can describe a whole experiment.
"""

import difflib
import json
import re
import typing
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from perilune_shared.errors import UserError

SECTIONS = ("dataset", "detect", "navigate", "explain")
PRESETS = ("tiny", "small", "paper", "large")
_LARGEST_FILE_BYTES = 1_000_000


class Section(BaseModel):
    """Base of every part of a configuration: frozen, strict types, unknown keys refused."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


SectionType = TypeVar("SectionType", bound=Section)


class _Loader(yaml.SafeLoader):
    """YAML 1.1 reads 1e-4 as text; a number without a dot is a number here. Aliases are refused (they can explode)."""

    def compose_node(self, parent, index):
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases (*name) are not allowed")
        return super().compose_node(parent, index)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+0123456789.")
)


def parse_yaml(text: str, where: object) -> Any:
    """Plain data from YAML text; raises UserError where it is not YAML."""
    try:
        return yaml.load(text, Loader=_Loader)  # noqa: S506 - a SafeLoader with stricter rules
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise UserError(where, "syntax", str(error).replace("\n", " "), "YAML with plain values") from None


def read_config_file(path: Path) -> dict[str, dict]:
    """The sections of a user's YAML file. Raises UserError on a missing file or an unknown section."""
    if not path.is_file():
        raise UserError(path, "configuration", "no such file", "a YAML file")
    if path.stat().st_size > _LARGEST_FILE_BYTES:
        raise UserError(path, "configuration", f"{path.stat().st_size} bytes", f"at most {_LARGEST_FILE_BYTES}")
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise UserError(path, "configuration", "bytes that are not UTF-8", "a YAML file") from None
    content = parse_yaml(text, path) or {}
    if not isinstance(content, dict):
        raise UserError(path, "configuration", type(content).__name__, "a mapping of sections")
    for name, section in content.items():
        if name not in SECTIONS:
            raise UserError(path, str(name), "unknown section", nearest(str(name), SECTIONS))
        if not isinstance(section, dict):
            raise UserError(path, name, repr(section), "a mapping of settings")
    return content


def parse_setting(text: str) -> tuple[list[str], Any]:
    """`"dataset.seed=3"` as (["dataset", "seed"], 3). Raises UserError on another form."""
    key, separator, value = text.partition("=")
    path = key.strip().split(".")
    if not separator or len(path) < 2 or not all(path):
        raise UserError("--set", text, "not section.key=value", "for example dataset.seed=3")
    if path[0] not in SECTIONS:
        raise UserError("--set", key, "unknown section", nearest(path[0], SECTIONS))
    return path, parse_yaml(value, f"--set {key}")


def resolve(
    model: type[SectionType],
    section: str,
    package: str,
    preset: str,
    config_file: Path | None = None,
    settings: tuple[str, ...] = (),
) -> SectionType:
    """The section `section` from a preset of `package`, a user's file and single settings, later ones winning.

    Raises UserError naming the source, the key, the value and what would be right.
    """
    if preset not in PRESETS:
        raise UserError("--preset", "preset", preset, nearest(preset, PRESETS))
    preset_text = resources.files(package).joinpath("presets", f"{preset}.yaml").read_text(encoding="utf-8")
    base = parse_yaml(preset_text, preset).get(section, {})
    return resolve_over(model, section, f"preset {preset}", base, config_file, settings)


def resolve_over(
    model: type[SectionType],
    section: str,
    base_name: str,
    base: dict,
    config_file: Path | None = None,
    settings: tuple[str, ...] = (),
) -> SectionType:
    """As `resolve`, from the plain data `base` in place of a preset; errors name it `base_name`."""
    sources: list[tuple[str, dict]] = [(base_name, base)]
    if config_file is not None:
        sources.append((str(config_file), read_config_file(config_file).get(section, {})))
    for text in settings:
        path, value = parse_setting(text)
        if path[0] == section:
            sources.append(("--set", _nested(path[1:], value)))
    merged: dict = {}
    for _, content in sources:
        merged = _merge(merged, content)
    try:
        return model.model_validate_json(json.dumps(merged))
    except ValidationError as error:
        raise _explain(error, model, section, sources) from None
    except (TypeError, ValueError) as error:
        raise UserError(sources[-1][0], section, error, "numbers, text, lists and mappings") from None


def to_yaml(section: str, config: Section) -> str:
    """A resolved section as YAML that `resolve` reads again."""
    return yaml.safe_dump({section: config.model_dump(mode="json")}, sort_keys=False)


def _nested(path: list[str], value: Any) -> Any:
    for key in reversed(path):
        value = {key: value}
    return value


def _merge(base: dict, over: dict) -> dict:
    merged = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merge(merged[key], value) if both else value
    return merged


def nearest(name: str, known: typing.Iterable[str]) -> str:
    """What a user may have meant by an unknown name: the known one most like it, or all of them."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"{close[0]} (nearest known)" if close else "one of " + ", ".join(known)


def _explain(error: ValidationError, model: type[Section], section: str, sources: list[tuple[str, dict]]) -> UserError:
    fault = error.errors(include_url=False)[0]
    location = [str(part) for part in fault["loc"]]
    where = next((name for name, content in reversed(sources) if _holds(content, location)), sources[-1][0])
    field = ".".join([section, *location])
    if fault["type"] == "extra_forbidden":
        return UserError(where, field, "unknown key", nearest(location[-1], _fields_at(model, location[:-1])))
    if fault["type"] == "missing":
        return UserError(where, field, "nothing", "a value")
    wanted = fault["msg"][0].lower() + fault["msg"][1:]
    return UserError(where, field, repr(fault["input"]), wanted.removeprefix("value error, "))


def _holds(content: Any, location: list[str]) -> bool:
    for key in location:
        if isinstance(content, list):
            return True
        if not isinstance(content, dict) or key not in content:
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
