"""Change the version, or release it: check, build, try the wheels in a new environment, tag, and upload on request.

    python scripts/release.py version 0.2.0 # write the new version into every file that states the version
    make release VERSION=0.1.0              # all but the upload; needs no network
    make release VERSION=0.1.0 UPLOAD=1     # all steps, then upload with twine (TWINE_REPOSITORY chooses the index)

The distributions are built from the commit, so they contain no ignored files and no leftovers of other builds. They are
written to dist/VERSION. The tag is vVERSION; a second run on the tagged commit builds again.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Annotated

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # An import by another module must not change how Ctrl-C works.
    end_at_interrupt()

import typer

from perilune_shared.console.command_line import run_command_line
from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_text

ROOT = Path(__file__).resolve().parents[1]
VERSION = re.compile(r"\d+\.\d+\.\d+((a|b|rc)\d+)?")
PLACES = {
    "*/perilune*/__init__.py": r'^__version__ = "(?P<version>[^"]+)"',
    "*/pyproject.toml": r'"perilune(-\w+)?(\[[\w,]+\])?==(?P<version>[^"]+)"|^version = "(?P<package_version>[^"]+)"',
    "CITATION.cff": r"^version: (?P<version>\S+)$",
}
"""Pattern of the version in each file. A pyproject.toml states the version or takes it from the package."""
CHANGELOG = "CHANGELOG.md"
_PROGRAMS = (("perilune-manifest", "--help"), ("perilune-render", "--help"), ("perilune-train", "models"))
_IMPORTED = """
import importlib, sys
from importlib import metadata
for name in sys.argv[2:]:
    package = importlib.import_module(name)
    assert package.__file__.startswith(sys.prefix), f"{name} was imported from {package.__file__}"
    assert package.__version__ == metadata.version(name) == sys.argv[1], f"{name} has version {package.__version__}"
"""

app = typer.Typer(add_completion=False, no_args_is_help=True)


@app.command()
def version(new: Annotated[str | None, typer.Argument(help="New version, for example 0.2.0.")] = None) -> None:
    """Show where the version is stated, or change it everywhere."""
    if new is not None:
        write_version(new)
    for path, stated in stated_versions().items():
        print(f"{path.relative_to(ROOT)}: {', '.join(stated)}")


@app.command()
def release(
    version: Annotated[str, typer.Argument(help="Version to release, for example 0.1.0.")],
    upload: Annotated[bool, typer.Option("--upload", help="Upload the distributions at the end.")] = False,
) -> None:
    """Check, build, try and tag a version; upload it on request."""
    check(version, ROOT, datetime.now(UTC).date())
    run("make", "lint")
    files = build(version)
    try_installed(version, [file for file in files if file.suffix == ".whl"])
    if tagged_commit(version, ROOT) is None:
        run("git", "tag", "-a", tag(version), "-m", f"perilune {version}")
    print(f"{tag(version)}: tagged; git push origin {tag(version)} publishes the tag")
    if upload:
        run(sys.executable, "-m", "twine", "upload", *map(str, files))
    else:
        print(f"not uploaded: make release VERSION={version} UPLOAD=1 uploads {len(files)} files of dist/{version}")


def stated_versions(root: Path = ROOT) -> dict[Path, list[str]]:
    """The versions that each file states, in the order of the text; files without a version are omitted."""
    found = {
        path: [text for each in _matches(path, pattern) for text in each.groupdict().values() if text]
        for pattern, path in _files(root)
    }
    return {path: versions for path, versions in found.items() if versions}


def check_version(version: str) -> None:
    """Raise UserError if the text is not a version such as 0.1.0 or 1.0.0rc1."""
    if not VERSION.fullmatch(version):
        raise UserError("VERSION", "version", version, "three numbers, such as 0.1.0, or a candidate, such as 0.1.0rc1")


def write_version(version: str, root: Path = ROOT) -> list[Path]:
    """Write the version into every file that states a version; return the changed files."""
    check_version(version)
    changed = []
    for pattern, path in _files(root):
        text = path.read_text(encoding="utf-8")
        written = text
        # Replace from the end, so that the positions of earlier matches stay valid.
        for match in reversed(_matches(path, pattern)):
            group = "package_version" if match.groupdict().get("package_version") else "version"
            written = written[: match.start(group)] + version + written[match.end(group) :]
        if written != text:
            write_text(path, written)
            changed.append(path)
    return changed


def _files(root: Path) -> list[tuple[str, Path]]:
    return [(pattern, path) for glob, pattern in PLACES.items() for path in sorted(root.glob(glob))]


def _matches(path: Path, pattern: str) -> list[re.Match[str]]:
    return list(re.finditer(pattern, path.read_text(encoding="utf-8"), re.MULTILINE))


def check(version: str, root: Path, today: date) -> None:
    """Raise UserError if the working tree is not ready for this release."""
    check_version(version)
    for path, stated in stated_versions(root).items():
        for other in stated:
            if other != version:
                expected = f"{version}; write it with `python scripts/release.py version {version}`"
                raise UserError(path.relative_to(root), "version", other, expected)
    _check_changelog(version, root / CHANGELOG, today)
    changed = git(root, "status", "--porcelain")
    if changed:
        first, *others = changed.splitlines()
        more = f" and {len(others)} more" if others else ""
        raise UserError(root, "working tree", f"{first.strip()}{more}", "all files committed")
    commit = tagged_commit(version, root)
    if commit not in (None, git(root, "rev-parse", "HEAD")):
        raise UserError(root, "tag", f"{tag(version)} at {commit}", "no such tag, or one at the current commit")


def _check_changelog(version: str, path: Path, today: date) -> None:
    """Raise UserError if the version's section is missing, has no text, or has a date in the future."""
    text = path.read_text(encoding="utf-8")
    heading = f"## [{version}] - {today}"
    section = re.search(rf"^## \[{re.escape(version)}\](.*)\n((?:(?!## ).*\n?)*)", text, re.MULTILINE)
    if section is None:
        raise UserError(path.name, "section", "none of this version", heading)
    try:
        day = date.fromisoformat(section.group(1).removeprefix(" - "))
    except ValueError:
        raise UserError(path.name, "section", f"## [{version}]{section.group(1)}", heading) from None
    if day > today:
        raise UserError(path.name, "date of the section", day, f"at most {today}")
    if not section.group(2).strip():
        raise UserError(path.name, "section", "no text", "what changes for users")


def tag(version: str) -> str:
    """Name of the release's tag."""
    return f"v{version}"


def tagged_commit(version: str, root: Path) -> str | None:
    """The commit that has the tag of this version; None without such a tag."""
    command = ["git", "-C", str(root), "rev-parse", "-q", "--verify", f"refs/tags/{tag(version)}^{{commit}}"]
    return subprocess.run(command, capture_output=True, text=True).stdout.strip() or None


def build(version: str) -> list[Path]:
    """Wheels and source distributions of the current commit, in dist/VERSION, with checked metadata."""
    out = ROOT / "dist" / version
    shutil.rmtree(out, ignore_errors=True)
    # With the date of the commit, repeated builds of a commit give wheels that are equal byte for byte.
    times = {"SOURCE_DATE_EPOCH": git(ROOT, "log", "-1", "--format=%ct")}
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(["git", "-C", str(ROOT), "archive", "HEAD"], check=True, capture_output=True).stdout
        subprocess.run(["tar", "-x", "-C", folder], check=True, input=archive)
        for project in distributions(Path(folder)):
            run(sys.executable, "-m", "build", "-q", "--no-isolation", "--outdir", str(out), str(project), **times)
    files = sorted(out.iterdir())
    run(sys.executable, "-m", "twine", "check", "--strict", *map(str, files))
    return files


def distributions(root: Path) -> list[Path]:
    """Folders of the distributions: those that have a pyproject.toml."""
    return [path.parent for path in sorted(root.glob("*/pyproject.toml"))]


def try_installed(version: str, wheels: list[Path]) -> None:
    """Install the wheels in a new environment and use them there.

    The dependencies come from the current environment, so no network is needed. scripts/test-wheels also installs the
    dependencies.
    """
    packages = [wheel.name.split("-")[0] for wheel in wheels]
    with tempfile.TemporaryDirectory() as folder:
        run(sys.executable, "-m", "venv", folder)
        programs = Path(folder) / "bin"
        run(str(programs / "python"), "-m", "pip", "install", "-q", "--no-index", "--no-deps", *map(str, wheels))
        ours, (new,) = Path(typer.__file__).parents[1], Path(folder).glob("lib/python*/site-packages")
        # A folder that a .pth file names comes after the wheels on the path. Python ignores the .pth files in that
        # folder, so the editable installs of this checkout are not found.
        (new / "dependencies.pth").write_text(f"{ours}\n")
        run(str(programs / "python"), "-c", _IMPORTED, version, *packages, cwd=folder)
        for program, argument in _PROGRAMS:
            run(str(programs / program), argument, cwd=folder)
        picture, found = ROOT / "docs/pictures/lunar_frame.png", Path(folder) / "found"
        run(str(programs / "perilune-train"), "detect", "predict", str(picture), "--out", str(found), cwd=folder)
        if not (found / "detections.csv").stat().st_size:
            raise UserError(picture, "detections", "none", "the craters of this frame")


def run(*command: str, cwd: str | Path = ROOT, **variables: str) -> None:
    """Run a command without PYTHONPATH, so that it does not import the sources of this checkout.

    Raises UserError if the command fails.
    """
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | variables
    print(f"$ {' '.join(Path(word).name if word == command[0] else word for word in command)[:150]}", flush=True)
    code = subprocess.run(command, cwd=cwd, env=environment).returncode
    if code:
        raise UserError(Path(command[0]).name, "exit code", code, "0")


def git(root: Path, *arguments: str) -> str:
    """Output of a git command."""
    command = ["git", "-C", str(root), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


if __name__ == "__main__":
    run_command_line(app)
