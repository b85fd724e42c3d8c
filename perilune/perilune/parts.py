"""Import the parts of perilune, each of which may be missing."""

from importlib import import_module
from typing import Any

from perilune_shared.errors import UserError


class MissingPart(UserError, ImportError):
    """A part of perilune that is needed is not installed; the message says what to install."""


def part(module: str, what: str) -> Any:
    """Import a module of a part, for `what`. Raises MissingPart if the part, or a library that it needs, is missing."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        extra = "render" if module.startswith("perilune_render") else "train"
        found = f"no module {str(error.name).split('.')[0]}"
        cure = f"perilune_{extra}: `make setup` in a checkout of perilune, or pip install 'perilune[{extra}]'"
        raise MissingPart("perilune", what, found, cure) from None
