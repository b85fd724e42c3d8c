"""The hashes of a recipe change with all that frames follow from, and with nothing else."""

import re
import shutil
import sys
from pathlib import Path

import pytest

import perilune_render
import perilune_shared
from perilune_render.provenance import versions
from perilune_render.provenance.fingerprint import Fingerprint, _fingerprint, compiled_functions, fingerprint

ROOTS = {
    "generator": versions.GROUND,
    "renderer": versions.RENDERING,
    "rays": versions.RAYS,
    "imaging": versions.IMAGING,
    "outputs": versions.OUTPUTS,
}
HOLDERS = {"pandas", "pyarrow", "mathutils"}
"""Libraries that hold values and compute none, or come with Blender."""


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """Folders of a copy of both packages."""
    root = tmp_path_factory.mktemp("copy")
    only = shutil.ignore_patterns("__pycache__", "presets")
    return {
        package.__name__: Path(shutil.copytree(package.__path__[0], root / package.__name__, ignore=only))
        for package in (perilune_render, perilune_shared)
    }


def hashes(copy):
    folders = tuple(sorted(copy.items()))
    return {name: _fingerprint.__wrapped__(roots, folders).sha256 for name, roots in ROOTS.items()}


def changed(copy, module, pattern, replacement):
    """Names of the hashes that change with one edit of one file."""
    package, *parts = module.split(".")
    path = copy[package].joinpath(*parts).with_suffix(".py")
    text = path.read_text()
    edited, count = re.subn(pattern, replacement, text, count=1, flags=re.M)
    assert count == 1, (module, pattern)
    before = {name: fingerprint(*roots).sha256 for name, roots in ROOTS.items()}
    try:
        path.write_text(edited)
        after = hashes(copy)
    finally:
        path.write_text(text)
    return {name for name in before if before[name] != after[name]}


@pytest.mark.parametrize(
    ("module", "name", "expected"),
    [
        ("perilune_render.terrain.scene", "_MIN_RIM", {"generator"}),
        ("perilune_render.terrain.craters.profile", "REACH", {"generator"}),
        ("perilune_render.terrain.craters.rims", "_N_RIM", {"generator"}),
        ("perilune_render.engines.blender.stage", "_EARTH_ANGULAR_DIAMETER_DEG", {"renderer"}),
        ("perilune_render.engines.blender.renderer", "_FAR_M", {"renderer"}),
        ("perilune_shared.photometry", "MIN_SINE_SQUARED", {"renderer", "rays"}),
        ("perilune_render.engines.heightfield.shade", "_TERMINATOR", {"rays"}),
        ("perilune_render.imaging.sensor", "FAINT_E", {"imaging"}),
        ("perilune_render.config.dataset", "_SPREAD_FIELDS", set(ROOTS)),
        ("perilune_render.terrain.level_ground", "_MAX_SAMPLES", {"renderer"}),
        ("perilune_render.labels.pixels", "N_FITTED", {"imaging"}),
        ("perilune_render.labels.frame_labels", "_N_RIM", {"imaging"}),
        ("perilune_shared.labels.masks", "SLACK_RADII, SLACK_PX", {"imaging"}),
        ("perilune_shared.geometry.ellipse", "_N_FITTED", {"imaging"}),
        ("perilune_shared.geometry.camera", "_MAX_UNDISTORTION_ERROR", set(ROOTS)),
        ("perilune_shared.geometry.frames", "MOON_RADIUS_M", {"generator", "renderer", "rays", "imaging", "outputs"}),
    ],
)
def test_a_constant_changes_the_hashes_of_what_uses_it(copy, module, name, expected):
    assert changed(copy, module, rf"^{name} = .*$", f"{name} = 123.25") == expected


@pytest.mark.parametrize(
    ("module", "pattern", "replacement", "expected"),
    [
        ("perilune_render.imaging.resampling", "INTER_LANCZOS4", "INTER_CUBIC", {"imaging"}),
        ("perilune_render.imaging.exr", "ZIP_COMPRESSION", "NO_COMPRESSION", {"imaging", "outputs"}),
        ("perilune_render.dataset.frame_files", '".png", stored', '".png", stored + 1', {"imaging"}),
        ("perilune_render.dataset.real_ground", "> 0\\.5", "> 0.6", {"imaging"}),
        ("perilune_render.engines.blender.nodes", "MULTIPLY", "ADD", {"renderer"}),
        ("perilune_render.terrain.noise", r"njit\(\)", "njit(fastmath=True)", {"generator"}),
    ],
)
def test_a_call_changes_the_hashes_of_what_makes_it(copy, module, pattern, replacement, expected):
    assert changed(copy, module, pattern, replacement) == expected


@pytest.mark.parametrize(
    ("module", "pattern", "replacement"),
    [
        ("perilune_render.terrain.scene", '^r"""', 'r"""Another docstring. '),
        ("perilune_render.imaging.sensor", '    """Grey image', '    """Another docstring'),
        ("perilune_render.terrain.scene", '"""Smallest remaining', '"""Another text'),
        ("perilune_render.terrain.craters.stamp", r"^_N_RIM = 16", "# Why.\n_N_RIM = (\n    16\n)  # another comment"),
        ("perilune_render.terrain.relief", r"raise UserError\(", "raise UserError('more', "),
        ("perilune_render.cli.main", '"Folder', '"Another folder'),
        ("perilune_render.preview.contact_sheet", "_N_FRAMES = 4", "_N_FRAMES = 5"),
        ("perilune_render.dataset.finish", "= 12, 3, 6$", "= 13, 3, 6"),
        ("perilune_render.config.cameras", "= 256$", "= 257"),
        ("perilune_render.config.dataset", "_GROUND_FIELDS = ", "_GROUND_FIELDS = 1, "),
        ("perilune_render.config.dataset", "gt=0", "gt=1"),
        ("perilune_shared.export.card", "^def ", "def another():\n    return 1\n\n\ndef "),
        ("perilune_shared.errors", "got", "found"),
        ("perilune_shared.storage.files", "LONGEST_PATH = 500", "LONGEST_PATH = 501"),
    ],
)
def test_what_changes_no_frame_changes_no_hash(copy, module, pattern, replacement):
    assert changed(copy, module, pattern, replacement) == set()


def test_splitting_a_file_changes_no_hash(tmp_path):
    constant, function = "N = 3\n", "def f():\n    return N\n"
    files = {
        "whole/a.py": constant + function,
        "split/a.py": "from package.b import N\n" + function,
        "split/b.py": constant,
        "other/a.py": constant.replace("3", "4") + function,
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    hashes = {
        name: fingerprint("package.a:f", folders={"package": tmp_path / name}).sha256
        for name in ("whole", "split", "other")
    }
    assert hashes["whole"] == hashes["split"] != hashes["other"]


def test_an_import_in_a_function_counts_as_one_at_the_top_of_the_file(tmp_path):
    function = "def f():\n    return scipy.special.erf(N)\n"
    inside = "def f():\n    import scipy.special\n    from package.b import N\n\n    return scipy.special.erf(N)\n"
    types = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import scipy\n"
    files = {
        "top/a.py": "import scipy.special\nfrom package.b import N\n" + function,
        "top/b.py": "N = 3\n",
        "inside/a.py": types + inside,
        "inside/b.py": "N = 3\n",
        "other/a.py": inside,
        "other/b.py": "N = 4\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    top, inside, other = (
        fingerprint("package.a:f", folders={"package": tmp_path / name}) for name in ("top", "inside", "other")
    )
    assert top.libraries == inside.libraries == other.libraries == {"scipy"}
    assert top.sha256 == inside.sha256 != other.sha256 and top.modules == other.modules


def test_every_library_that_computes_is_recorded():
    prints = [fingerprint(*roots) for roots in ROOTS.values()]
    assert all(isinstance(each, Fingerprint) and sys.stdlib_module_names.isdisjoint(each.libraries) for each in prints)
    assert set().union(*(each.libraries for each in prints)) - HOLDERS == set(versions.LIBRARIES)
    recorded = versions.all_versions(with_dem=True)
    assert {"blender", "numpy", "numba", "scipy", "opencv", "openexr", "trimesh", "rasterio"} < set(recorded)
    assert set(recorded) - set(versions.all_versions(with_dem=False)) == {"rasterio"}
    assert "blender" not in versions.ground_versions(with_dem=True) and "blender" not in versions.imaging_versions()


def test_compiled_functions_are_found_in_every_module():
    known = {name.partition(":")[0].rpartition(".")[2] for name in compiled_functions()}
    terrain = {"grid", "albedo", "older_ground", "stamp", "noise", "interpolation", "level_ground", "unstamp"}
    assert known == terrain | {
        "pixels",
        "surface",
        "draws",
        "rocks",
        "cast",
        "cell",
        "shade",
        "light",
        "query",
        "beam",
        "horizon",
        "hazard",
    }
