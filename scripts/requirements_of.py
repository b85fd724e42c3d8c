"""Write what a Python version needs: requirements.txt of all packages, and constraints.txt with the pins for it.

    python scripts/requirements_of.py 3.13 FOLDER

pip compares markers such as `python_version < "3.12"` with the Python that runs it, also where it resolves for another
one. So they are compared here. Used by scripts/test-resolves.
"""

import sys
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("shared", "render", "train", "perilune")
ONLY_ON = {"bpy": "3.11"}
"""Dependencies of extras that exist for one Python version."""


def requirements_of(version: str) -> list[str]:
    """Requirements of all packages with all their extras, without those on each other, for a Python version."""
    found = set()
    for package in PACKAGES:
        project = tomllib.loads((ROOT / package / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        groups = {"": project["dependencies"], **project.get("optional-dependencies", {})}
        for group in groups.values():
            if any(ONLY_ON.get(Requirement(each).name, version) != version for each in group):
                continue
            found |= {each for each in group if not each.startswith("perilune-")}
    return sorted(found)


def constraints_of(version: str) -> list[str]:
    """Lines of constraints.txt that hold for a Python version, without their markers."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [Requirement(line.partition("#")[0].strip()) for line in lines if line.partition("#")[0].strip()]
    environment = {"python_version": version, "python_full_version": f"{version}.0"}
    return [f"{pin.name}{pin.specifier}" for pin in pins if pin.marker is None or pin.marker.evaluate(environment)]


def main(version: str, folder: Path) -> None:
    """Write both files."""
    for name, lines in (("requirements", requirements_of(version)), ("constraints", constraints_of(version))):
        (folder / f"{name}.txt").write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
