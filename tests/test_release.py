"""A release is refused unless version, changelog and working tree are ready, and it uploads only if told."""

import shlex
import shutil
import subprocess
import sys
from datetime import date
from pathlib import Path

import pytest
from scripts import release

from perilune_shared.errors import UserError
from tests.test_make import make

ROOT = Path(__file__).parent.parent
TODAY = date(2026, 12, 1)
SECTION = "## [0.3.0] - 2026-11-30\n\n- Something new.\n\n## [0.2.0] - 2026-01-01\n"


def git(root: Path, *arguments: str) -> None:
    identity = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
    subprocess.run(["git", "-C", str(root), *identity, *arguments], check=True, capture_output=True)


@pytest.fixture
def ready(tmp_path) -> Path:
    """A repository with our files that state a version, ready to release 0.3.0."""
    for pattern in release.PLACES:
        for path in ROOT.glob(pattern):
            copied = tmp_path / path.relative_to(ROOT)
            copied.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copied)
    release.write_version("0.3.0", tmp_path)
    (tmp_path / "CHANGELOG.md").write_text(f"# Changelog\n\n## [Unreleased]\n\n{SECTION}")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "Release 0.3.0")
    return tmp_path


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_our_files_state_one_version():
    stated = release.stated_versions()
    assert len({each for found in stated.values() for each in found}) == 1
    names = {path.relative_to(ROOT).as_posix() for path in stated}
    packages = {"shared/perilune_shared/__init__.py", "render/perilune_render/__init__.py"}
    assert packages | {"train/pyproject.toml", "CITATION.cff"} <= names
    assert len(stated[ROOT / "train/pyproject.toml"]) == (ROOT / "train/pyproject.toml").read_text().count("==0.")


def test_one_command_changes_the_version_everywhere(ready):
    before = {path: path.read_text() for path in release.stated_versions(ready)}
    assert release.write_version("1.10.0rc2", ready) == list(before)
    assert {each for found in release.stated_versions(ready).values() for each in found} == {"1.10.0rc2"}
    assert all(path.read_text().replace("1.10.0rc2", "0.3.0") == text for path, text in before.items())
    assert release.write_version("1.10.0rc2", ready) == []
    meta = ready / "another/pyproject.toml"
    meta.parent.mkdir()
    meta.write_text(
        '[project]\nname = "another"\nversion = "0.3.0"\ndependencies = ["perilune-train[s3,gcs]==0.3.0"]\n'
    )
    assert release.write_version("1.10.0rc2", ready) == [meta] and meta.read_text().count('1.10.0rc2"') == 2


def test_a_tree_that_is_ready_is_released(ready):
    release.check("0.3.0", ready, TODAY)
    git(ready, "tag", "-a", "v0.3.0", "-m", "perilune 0.3.0")
    release.check("0.3.0", ready, TODAY)  # again, to upload what was tagged


@pytest.mark.parametrize("wrong", ["v0.3.0", "0.3", "0.3.0; true", "../0.3.0", ""])
def test_a_version_that_is_none_is_refused(ready, wrong):
    with pytest.raises(UserError, match="three numbers"):
        release.check(wrong, ready, TODAY)


def test_another_version_in_a_file_is_refused(ready):
    with pytest.raises(UserError, match=r"__init__\.py: version: got 0\.3\.0, expected 0\.4\.0"):
        release.check("0.4.0", ready, TODAY)
    edit(ready / "render/pyproject.toml", "perilune-shared[gcs]==0.3.0", "perilune-shared[gcs]==0.2.0")
    with pytest.raises(UserError, match=r"render/pyproject\.toml: version: got 0\.2\.0, expected 0\.3\.0"):
        release.check("0.3.0", ready, TODAY)


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ("## [0.2.0] - 2026-01-01\n\n- Old.\n", "got none of this version"),
        ("## [0.3.0]\n\n- New.\n", r"got ## \[0.3.0\], expected ## \[0.3.0\] - 2026-12-01"),
        ("## [0.3.0] - 30 November\n\n- New.\n", r"got ## \[0.3.0\] - 30 November"),
        ("## [0.3.0] - 2026-12-02\n\n- New.\n", "got 2026-12-02, expected at most 2026-12-01"),
        ("## [0.3.0] - 2026-11-30\n\n## [0.2.0] - 2026-01-01\n\n- Old.\n", "got no text"),
    ],
)
def test_a_changelog_without_a_dated_section_is_refused(ready, section, message):
    edit(ready / "CHANGELOG.md", SECTION, section)
    git(ready, "commit", "-q", "-a", "-m", "Change")
    with pytest.raises(UserError, match=message):
        release.check("0.3.0", ready, TODAY)


def test_a_tree_with_changes_is_refused(ready):
    (ready / "new.py").write_text("")
    with pytest.raises(UserError, match=r"got \?\? new\.py, expected all files committed"):
        release.check("0.3.0", ready, TODAY)
    git(ready, "add", "new.py")
    git(ready, "commit", "-q", "-m", "Add")
    edit(ready / "CHANGELOG.md", "Something", "Some things")
    with pytest.raises(UserError, match=r"got M CHANGELOG\.md"):
        release.check("0.3.0", ready, TODAY)


def test_a_tag_on_another_commit_is_refused(ready):
    git(ready, "tag", "v0.3.0")
    git(ready, "commit", "-q", "--allow-empty", "-m", "Later")
    with pytest.raises(UserError, match=r"got v0\.3\.0 at"):
        release.check("0.3.0", ready, TODAY)


@pytest.mark.parametrize("upload", [False, True])
def test_the_tag_follows_the_tests_and_the_upload_only_if_told(monkeypatch, upload, capsys):
    """Commands alone: what they do is for `make release` itself."""
    steps: list[str] = []
    wheel = Path("dist/0.3.0/perilune_shared-0.3.0-py3-none-any.whl")
    monkeypatch.setattr(release, "check", lambda *_: steps.append("check"))
    monkeypatch.setattr(release, "build", lambda _: [wheel])
    monkeypatch.setattr(release, "try_installed", lambda _, wheels: steps.append(f"try {len(wheels)}"))
    monkeypatch.setattr(release, "tagged_commit", lambda *_: None)
    monkeypatch.setattr(release, "run", lambda *command, **_: steps.append(" ".join(command)))
    release.release("0.3.0", upload=upload)
    expected = ["check", "make lint", "try 1", "git tag -a v0.3.0 -m perilune 0.3.0"]
    assert steps == expected + upload * [f"{sys.executable} -m twine upload {wheel}"]
    assert ("not uploaded" in capsys.readouterr().out) is not upload


def test_a_command_that_fails_ends_the_release():
    with pytest.raises(UserError, match="false: exit code: got 1, expected 0"):
        release.run("false")


def test_make_uploads_only_if_told():
    def arguments(*variables: str) -> list[str]:
        done = make("-n", "release", *variables)
        (line,) = (each for each in done.stdout.replace("\\\n", " ").splitlines() if "scripts/release.py " in each)
        return shlex.split(line.split("scripts/release.py ")[1])

    assert arguments("VERSION=0.3.0") == ["release", "0.3.0"]
    assert arguments("VERSION=0.3.0", "UPLOAD=0") == ["release", "0.3.0"]
    assert arguments("VERSION=0.3.0", "UPLOAD=1") == ["release", "0.3.0", "--upload"]
    done = make("-n", "release", check=False)
    assert done.returncode == 2 and "VERSION: got nothing" in done.stderr
