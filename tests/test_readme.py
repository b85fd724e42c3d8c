"""README.md: its programs run, and a reader sees what the project does on the first screen."""

import re
from pathlib import Path

import pytest

TOP = Path(__file__).parent.parent
README = (TOP / "README.md").read_text(encoding="utf-8")
PROGRAMS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_program_runs(program, quick, tmp_path, monkeypatch):
    """In the repository, after `make dataset PRESET=tiny`."""
    for address, target in {"docs": TOP / "docs", "data/tiny": quick}.items():
        (tmp_path / address).parent.mkdir(exist_ok=True)
        (tmp_path / address).symlink_to(target)
    monkeypatch.chdir(tmp_path)
    exec(compile(program, "README.md", "exec"), {})  # noqa: S102 - our own page
    assert list(tmp_path.glob("*.png"))


def test_there_are_three_short_programs():
    assert len(PROGRAMS) == 3
    assert all(len(program.splitlines()) <= 10 for program in PROGRAMS)


def test_a_picture_of_the_detector_comes_before_the_first_program():
    pictures = re.findall(r'<img src="([^"]+)"', README.split("```python")[0])
    assert pictures == ["docs/pictures/lunar_frame_craters.jpg"] and (TOP / pictures[0]).is_file()


def test_the_python_that_rendering_needs_is_named():
    assert "Python 3.11" in README and "mv .venv .venv-old" in README
