"""Import the optional parts of perilune, or say how to install them."""

from importlib import import_module
from typing import Any

from perilune_shared.errors import UserError


class MissingPart(UserError, ImportError):
    """A required part of perilune is not installed; the message says what to install."""


def part(module: str, what: str) -> Any:
    """Import and return a module of an optional part; `what` is the name that the user requested.

    Raises MissingPart if the part, or a library that it needs, is missing.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        extra = "render" if module.startswith("perilune_render") else "train"
        found = f"no module {str(error.name).split('.')[0]}"
        cure = f"perilune_{extra}: `make setup` in a checkout of perilune, or pip install 'perilune[{extra}]'"
        raise MissingPart("perilune", what, found, cure) from None
