"""A module that tests need must not be missing in continuous integration."""

import pytest
from tests.train.report.needed import needed


def test_a_missing_module_skips_here_and_fails_in_continuous_integration(monkeypatch):
    monkeypatch.delenv("CI", raising=False)
    assert needed("json").dumps({}) == "{}"
    with pytest.raises(pytest.skip.Exception):
        needed("no_such_module")
    monkeypatch.setenv("CI", "true")
    with pytest.raises(ModuleNotFoundError):
        needed("no_such_module")
