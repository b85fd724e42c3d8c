"""Print how the code is laid out: files per folder, depth of imports, longest files.

python scripts/measure_code.py [ROOT]
"""

import argparse
import ast
from collections import Counter
from functools import cache
from pathlib import Path

PACKAGES = {"perilune_shared": "shared", "perilune_render": "render", "perilune_train": "train"}


def modules_in(root: Path) -> dict[str, Path]:
    """Dotted name and path of every module of the three packages under `root`."""
    modules = {}
    for package, folder in PACKAGES.items():
        for path in sorted((root / folder / package).rglob("*.py")):
            parts = path.relative_to(root / folder).with_suffix("").parts
            modules[".".join(parts).removesuffix(".__init__")] = path
    return modules


def import_depth(modules: dict[str, Path], package: str) -> int:
    """Number of modules in the longest chain of imports within `package`, counting imports at the top of files only."""

    @cache
    def imports(name: str) -> tuple[str, ...]:
        targets: set[str] = set()
        for node in ast.parse(modules[name].read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and node.module:
                targets |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
            elif isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names}
        return tuple(t for t in targets if t in modules and t != name and t.startswith(package))

    @cache
    def depth(name: str) -> int:
        return 1 + max((depth(target) for target in imports(name)), default=0)

    return max(depth(name) for name in modules if name.startswith(package))


def main() -> None:
    """Print the two tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("root", nargs="?", type=Path, default=Path(__file__).parent.parent)
    root = parser.parse_args().root
    modules = modules_in(root)
    lengths = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in modules.values()}

    print("| package | files | lines | folders | files in the fullest folder | depth of imports |")
    print("|---|---|---|---|---|---|")
    for package, folder in PACKAGES.items():
        paths = [path for path in modules.values() if path.is_relative_to(root / folder / package)]
        counts = Counter(path.parent for path in paths)
        fullest, most = counts.most_common(1)[0]
        name = fullest.relative_to(root / folder)
        depth = import_depth(modules, package)
        lines = sum(lengths[path] for path in paths)
        print(f"| {package} | {len(paths)} | {lines} | {len(counts)} | {most} ({name}) | {depth} |")

    print("\n| longest files | lines |\n|---|---|")
    for path, lines in Counter(lengths).most_common(10):
        print(f"| {path.relative_to(root)} | {lines} |")


if __name__ == "__main__":
    main()
