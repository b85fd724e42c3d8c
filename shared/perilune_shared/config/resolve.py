"""Load configurations strictly: a preset, then the user's YAML file, then single settings.

Unknown keys are errors. A configuration file has up to four sections, one for each command that reads it: `dataset`
(the renderer), `detect`, `navigate` and `explain` (the trainer). A command validates its own section and ignores the
others, so one file can describe a whole experiment.
"""

import json
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from perilune_shared.config.errors import nearest, user_error_of
from perilune_shared.config.yaml_text import parse_yaml, to_yaml_text
from perilune_shared.errors import UserError

SECTIONS = ("dataset", "detect", "navigate", "explain")
PRESETS = ("tiny", "demo", "small", "paper", "large")
_LARGEST_FILE_BYTES = 100_000


class Section(BaseModel):
    """Base class of all parts of a configuration: frozen and strictly typed; unknown keys are errors."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


SectionType = TypeVar("SectionType", bound=Section)


def read_config_file(path: Path) -> dict[str, dict]:
    """Read the sections of a user's YAML file. Raises UserError if the file cannot be read as sections."""
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
            raise UserError(path, str(name), "an unknown section", nearest(str(name), SECTIONS))
        if not isinstance(section, dict):
            raise UserError(path, name, repr(section), "a mapping of settings")
    return content


def parse_setting(text: str) -> tuple[list[str], Any]:
    """Parse `"dataset.seed=3"` to (["dataset", "seed"], 3). Raises UserError on any other form."""
    key, separator, value = text.partition("=")
    path = key.strip().split(".")
    if not separator or len(path) < 2 or not all(path):
        raise UserError("--set", "", text, "section.key=value, for example dataset.seed=3")
    if path[0] not in SECTIONS:
        raise UserError("--set", key, "an unknown section", nearest(path[0], SECTIONS))
    return path, parse_yaml(value, f"--set {key}")


def resolve(
    model: type[SectionType],
    section: str,
    package: str,
    preset: str,
    config_file: Path | None = None,
    settings: tuple[str, ...] = (),
) -> SectionType:
    """Resolve a section of the configuration from a preset, a user's file and single settings.

    `package` contains the presets. `settings` are texts such as "dataset.seed=3". Later sources override earlier ones.
    Raises UserError with the source, the key, the value and the expected value.
    """
    if preset not in PRESETS:
        raise UserError("--preset", "", preset, nearest(preset, PRESETS))
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
    """Resolve a section as `resolve` does, from plain data `base` instead of a preset.

    Error messages call the data `base_name`.
    """
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
        raise user_error_of(error, model, section, sources) from None
    except (TypeError, ValueError) as error:
        raise UserError(sources[-1][0], section, error, "numbers, text, lists and mappings") from None


def to_yaml(section: str, config: Section) -> str:
    """Return a resolved section as YAML that `resolve` can read."""
    return to_yaml_text({section: config.model_dump(mode="json")})


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
