"""Modules that tests need: without one they are skipped, but fail in continuous integration."""

import importlib
import os
from types import ModuleType

import pytest


def needed(name: str) -> ModuleType:
    """Import a module. Without it, skip the tests of the calling file; fail if the variable CI is set."""
    if os.environ.get("CI"):
        return importlib.import_module(name)
    return pytest.importorskip(name)
