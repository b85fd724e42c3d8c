"""Planning and developing on a machine without Blender."""

import subprocess
import sys

import pytest

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.validation.validate import validate

HIDDEN = """
import importlib.metadata as metadata, sys
known = metadata.Distribution.from_name
def from_name(name):
    if name == "bpy":
        raise metadata.PackageNotFoundError(name)
    return known(name)
metadata.Distribution.from_name = from_name
sys.modules["bpy"] = None
try:
    import perilune_render.engines.blender.renderer
except ImportError:
    from perilune_render.cli.main import main
    main()
"""
PLAN = ["plan", "--preset", "tiny", "--set", "dataset.terrain.spacing_px=2.0", "--set", "dataset.detect.n_scenes=3"]


def run(*arguments):
    return subprocess.run([sys.executable, "-c", HIDDEN, *map(str, arguments)], capture_output=True, text=True)


@pytest.mark.slow
def test_plans_are_made_without_blender(tmp_path):
    done = run(*PLAN, "--out", tmp_path / "plan")
    assert done.returncode == 0, done.stderr
    made = open_dataset(tmp_path / "plan")
    assert validate(made) == [] and made.info.images == "planned"
    versions = made.info.recipe().versions
    assert {"generator", "numpy", "scipy", "numba"} <= set(versions) and not {"blender", "renderer"} & set(versions)


@pytest.mark.slow
def test_datasets_are_developed_without_blender(tiny, tmp_path):
    done = run("develop", "--dataset", tiny / "detect", "--out", tmp_path / "new")
    assert done.returncode == 0, done.stderr
    old, new = open_dataset(tiny / "detect"), open_dataset(tmp_path / "new")
    assert new.info.recipe().versions == old.info.recipe().versions
    assert new.table("frames")["png_sha256"].equals(old.table("frames")["png_sha256"])


@pytest.mark.parametrize(
    "command",
    [
        ("preview", "--preset", "tiny", "--out", "{out}/a.png"),
        ("dataset", "--preset", "tiny", "--out", "{out}/a"),
        ("serve", "--preset", "tiny", "--engine", "cycles"),
    ],
    ids=lambda command: command[0],
)
def test_rendering_by_cycles_without_blender_says_what_is_missing(command, tmp_path):
    done = run(*(word.format(out=tmp_path) for word in command))
    assert done.returncode == 2 and list(tmp_path.iterdir()) == []
    (line,) = [text for text in done.stderr.splitlines() if text.startswith("error: ")]
    found = "got cycles, without Blender's module bpy, expected heightfield, or on Python 3.11"
    assert line == f"error: configuration: dataset.render.engine: {found} `pip install 'perilune-render[blender]'`"


def test_the_other_engine_renders_without_blender(tmp_path):
    small = ("--set", "dataset.terrain.spacing_px=2.0", "--set", "dataset.render.engine=heightfield")
    done = run("preview", "--preset", "tiny", *small, "--out", tmp_path / "a.png")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_a_preview_is_a_png(tmp_path):
    """Any other suffix is refused before rendering."""
    done = run("preview", "--preset", "tiny", "--out", tmp_path / "a.jpg")
    assert done.returncode == 2 and done.stderr.strip() == f"error: {tmp_path}/a.jpg: format: got .jpg, expected .png"
