"""Write the requirements for a Python version, and check the packages that pip resolved (for scripts/test-resolves).

    python scripts/python_versions.py write 3.13 FOLDER    # write requirements.txt and constraints.txt
    python scripts/python_versions.py check 3.13 FOLDER    # check report.json, which pip wrote

When pip resolves for another Python version, it still evaluates markers such as `python_version < "3.12"` and
`Requires-Python` for the Python that runs pip. `write` therefore evaluates the markers of constraints.txt itself, and
`check` compares `Requires-Python` of each package with the other version.
"""

import json
import sys
import tomllib
from pathlib import Path

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    end_at_interrupt()

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("shared", "render", "train", "perilune")
ONLY_ON = {"bpy": "3.11"}
"""Dependencies that exist for one Python version only; for other versions their extras are left out."""


def requirements_of(version: str) -> list[str]:
    """Requirements of all packages and extras for a Python version, without perilune's packages."""
    requirements = set()
    for package in PACKAGES:
        project = tomllib.loads((ROOT / package / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        groups = {"": project["dependencies"], **project.get("optional-dependencies", {})}
        for group in groups.values():
            if any(ONLY_ON.get(Requirement(each).name, version) != version for each in group):
                continue
            requirements |= {each for each in group if not each.startswith("perilune-")}
    return sorted(requirements)


def constraints_of(version: str) -> list[str]:
    """Lines of constraints.txt that hold for a Python version, without their markers."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [Requirement(line.partition("#")[0].strip()) for line in lines if line.partition("#")[0].strip()]
    environment = {"python_version": version, "python_full_version": f"{version}.0"}
    return [f"{pin.name}{pin.specifier}" for pin in pins if pin.marker is None or pin.marker.evaluate(environment)]


def write(version: str, folder: Path) -> None:
    """Write requirements.txt and constraints.txt into a folder."""
    for name, lines in (("requirements", requirements_of(version)), ("constraints", constraints_of(version))):
        (folder / f"{name}.txt").write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def check(version: str, folder: Path) -> None:
    """Print how many packages pip resolved; end with an error if a package does not support this Python."""
    packages = json.loads((folder / "report.json").read_text(encoding="utf-8"))["install"]
    refused = unfit([package["metadata"] for package in packages], version)
    if refused:
        sys.exit(f"Python {version}: {', '.join(refused)}")
    print(f"Python {version}: {len(packages)} packages resolved")


def unfit(packages: list[dict[str, str]], version: str) -> list[str]:
    """Packages that do not support a Python version, according to their metadata."""
    return [
        f"{each['name']} {each['version']} requires Python {each['requires_python']}"
        for each in packages
        if not SpecifierSet(each.get("requires_python") or "").contains(f"{version}.0")
    ]


if __name__ == "__main__":
    if {"-h", "--help"} & set(sys.argv):
        print(__doc__)
        sys.exit()
    if len(sys.argv) != 4 or sys.argv[1] not in ("write", "check"):
        print("error: expected write or check, a Python version and a folder; see --help", file=sys.stderr)
        sys.exit(2)
    {"write": write, "check": check}[sys.argv[1]](sys.argv[2], Path(sys.argv[3]))
