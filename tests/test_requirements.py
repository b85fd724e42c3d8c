"""Requirements and pins for each Python version, which scripts/test-resolves gives to pip."""

import pytest
from packaging.requirements import Requirement
from scripts.python_versions import constraints_of, requirements_of, unfit

VERSIONS = ("3.11", "3.12", "3.13")


@pytest.mark.parametrize("version", VERSIONS)
def test_every_requirement_has_one_pin(version):
    pins = [Requirement(line) for line in constraints_of(version)]
    names = [pin.name.lower() for pin in pins]
    assert len(set(names)) == len(names)
    wanted = {Requirement(each).name.lower() for each in requirements_of(version)}
    assert len(wanted) > 25 and wanted <= set(names)
    fits = {pin.name.lower(): next(iter(pin.specifier)).version for pin in pins}
    for each in map(Requirement, requirements_of(version)):
        assert each.specifier.contains(fits[each.name.lower()]), each


def test_blender_is_for_one_version_only():
    has = {version: any(each.startswith("bpy") for each in requirements_of(version)) for version in VERSIONS}
    assert has == {"3.11": True, "3.12": False, "3.13": False}
    numpy = {
        version: next(line for line in constraints_of(version) if line.startswith("numpy==")) for version in VERSIONS
    }
    assert numpy["3.11"].startswith("numpy==1.") and numpy["3.12"] == numpy["3.13"] != numpy["3.11"]


def test_a_package_for_another_python_is_named():
    packages = [
        {"name": "a", "version": "1", "requires_python": ">=3.12"},
        {"name": "b", "version": "2", "requires_python": "==3.11.*"},
        {"name": "c", "version": "3"},
    ]
    assert unfit(packages, "3.11") == ["a 1 requires Python >=3.12"]
    assert unfit(packages, "3.13") == ["b 2 requires Python ==3.11.*"]
