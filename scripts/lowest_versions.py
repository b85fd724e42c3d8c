"""Print the lowest versions required by perilune-shared and perilune-train, one per line, as constraints for pip."""

import re
import tomllib
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]
_BOUND = re.compile(r"([A-Za-z0-9._-]+)(?:\[[^]]*\])?>=([0-9.]+)")


def lowest(project: Path) -> dict[str, str]:
    """Name and lowest version of each dependency of a project.

    Raises ValueError if a dependency has no lower bound. Build requirements are left out, because torch itself requires
    a newer setuptools than the build.
    """
    content = tomllib.loads((project / "pyproject.toml").read_text(encoding="utf-8"))
    versions = {}
    for requirement in content["project"]["dependencies"]:
        match = _BOUND.match(requirement)
        if match is not None:
            versions[match[1].lower()] = match[2]
        elif not requirement.startswith("perilune-"):
            raise ValueError(f"{project.name}/pyproject.toml: {requirement}: no lower bound")
    return versions


def main() -> None:
    """Print the lowest version of each dependency; if the projects differ, the higher version."""
    bounds: dict[str, str] = {}
    for project in ("shared", "train"):
        for name, version in lowest(_ROOT / project).items():
            bounds[name] = max(version, bounds.get(name, version), key=lambda text: [int(n) for n in text.split(".")])
    for name, version in sorted(bounds.items()):
        print(f"{name}=={version}")


if __name__ == "__main__":
    main()
