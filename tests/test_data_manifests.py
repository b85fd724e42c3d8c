"""The shared manifests are whole, and a frame of each comes out as it did when they were written."""

import hashlib
import json
import os
import re
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pytest
from rich.progress import Progress

from perilune_render.dataset.manifest_only import frames_left_out, write_left_out_frames
from perilune_render.dataset.regenerate import OUTLIERS, png_outlier_share, regenerate
from perilune_render.dataset.tables import frame_table
from perilune_render.flight.plan import make_plan
from perilune_render.provenance.recipe import config_of
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.names import frame_path
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_shared.validation.validate import validate

FOLDER = Path(__file__).parent.parent / "data_manifests"
NAMES = sorted(path.parent.name for path in FOLDER.glob("*/dataset.json"))
PARTS = ("highland", "mare", "camera", "npb", "npc")
"""Parts of the benchmark for both kinds. `benchmark-detect-oblique` has no counterpart for navigation."""
REAL = os.environ.get("PERILUNE_REAL_DEM")
LEFT_OUT = {
    "paper-detect": "ab9d3a3410fd2316ef245586c5eee6cd86a3ed18525f9c17f5bca51dda905949",
    "paper-nav": "68e4ddec9f50e3510b6d72b6d7e855d1f73c259ea4f694b08ecefec872978646",
    "shipped-detect": "20ecd82e3a10d5e3efa428cf3393b111bcb5545b660ee4ecc0e19e0fc14c1aa5",
    "oblique-detect": "4028eea675294af85e9734056731edbae5f5d410901947985e9f8049621d4e7b",
    "large-nav": "a2515951e5cc670ba29a27220a082002c00131cf5d7b8f734e40ebfce067052d",
}
"""Manifests without the table `frames`, and the SHA-256 of its rows, as JSON, from before it was left out."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Open a shared manifest with all its tables."""
    made = {}

    def opened(name):
        if name not in LEFT_OUT:
            return open_dataset(FOLDER / name)
        if name not in made:
            made[name] = tmp_path_factory.mktemp("whole") / name
            with Progress(disable=True) as progress:
                write_left_out_frames(open_dataset(FOLDER / name), made[name], progress)
        return open_dataset(made[name])

    return opened


def test_all_are_here():
    kinds = ("detect", "nav")
    of_presets = [f"{p}-{k}" for p in ("small", "paper", "large") for k in kinds]
    benchmark = [f"benchmark-{k}-{part}" for k in kinds for part in PARTS]
    others = ["benchmark-detect-oblique", "oblique-detect", "shipped-detect", "shipped-nav", "south-pole-detect"]
    assert sorted([*of_presets, *benchmark, *others]) == NAMES
    counts = {name: open_dataset(FOLDER / name).info.counts for name in NAMES}
    assert {open_dataset(FOLDER / name).info.licence for name in NAMES} == {"CC-BY-4.0"}, "as LICENSE says"
    assert [counts[f"{p}-{k}"].trajectories for p in ("paper", "large") for k in kinds] == [343, 49, 343, 49]
    assert all(
        counts[f"{p}-{k}"].frames == 100 * counts[f"{p}-{k}"].trajectories for p in ("paper", "large") for k in kinds
    )


LARGE = ("large-detect", "paper-detect")
"""Manifests that take seconds to validate."""


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] if n in LARGE else []) for n in NAMES])
def test_it_is_whole_and_named_in_the_readme(name, whole):
    dataset = whole(name)
    assert validate(dataset) == [] and dataset.info.images == "planned"
    sha256 = hashlib.sha256((FOLDER / name / "dataset.json").read_bytes()).hexdigest()
    readme = (FOLDER / "README.md").read_text(encoding="utf-8")
    assert re.search(rf"`{name}`.*`{sha256[:16]}`", readme), f"{name}: {sha256[:16]}"


def test_no_two_manifests_share_terrain_but_the_papers():
    """A network trained on one preset has seen no test terrain of another; the paper has one landing area."""
    owners = defaultdict(set)
    for name in NAMES:
        for content in open_dataset(FOLDER / name).table("scenes", ["content_sha256"])["content_sha256"].to_pylist():
            owners[content].add(name)
    assert len(owners) == 343 + 49 + 24 + 6 + 64 + 16 + 1 + 1 + 2 * 22 + 6 + 32
    assert [names for names in owners.values() if len(names) > 1] == [{"paper-detect", "paper-nav"}]


@pytest.mark.parametrize("kind", ["detect", "nav"])
def test_the_benchmark_has_test_frames_under_low_and_high_suns(kind):
    parts = [open_dataset(FOLDER / f"benchmark-{kind}-{part}") for part in PARTS]
    assert sum(part.info.counts.scenes for part in parts) == 22
    assert all(part.table("frames", ["split"])["split"].unique().to_pylist() == ["test"] for part in parts)
    sun = [angle for part in parts for angle in part.table("scenes")["sun_elevation_deg"].to_pylist()]
    assert 8 <= min(sun) < 15 and 55 < max(sun) <= 65
    altitude = [place[2] for part in parts for place in part.table("frames")["position_m"].to_pylist()]
    assert min(altitude) < 220 and max(altitude) > 1480


def test_the_oblique_part_has_all_tilts_and_directions():
    part = open_dataset(FOLDER / "benchmark-detect-oblique")
    assert (part.info.counts.scenes, part.info.counts.frames) == (6, 240)
    assert part.table("frames", ["split"])["split"].unique().to_pylist() == ["test"]
    axes = [matrix_from_quaternion(each)[2] for each in part.table("frames")["rotation_wxyz"].to_pylist()]
    tilt_deg = np.degrees(np.arccos(-np.array(axes)[:, 2]))
    counts, _ = np.histogram(tilt_deg, [15, 30, 40, 50, 65])
    assert counts.sum() == 240 and counts.min() >= 30
    towards = np.degrees(np.arctan2(np.array(axes)[:, 0], np.array(axes)[:, 1]))
    quarters, _ = np.histogram(towards, [-180, -90, 0, 90, 180])
    assert quarters.min() >= 30


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] if n in LARGE else []) for n in LEFT_OUT])
def test_frames_that_were_left_out_come_back(name, whole):
    """To the last bit; with the libraries of constraints.txt also the same dataset.json, which holds all hashes."""
    assert frames_left_out(open_dataset(FOLDER / name))
    rows = whole(name).table("frames").sort_by("frame_id").to_pylist()
    assert hashlib.sha256(json.dumps(rows).encode()).hexdigest() == LEFT_OUT[name]


OF_PRESETS = [n for n in NAMES if n.startswith(("small", "large-detect", "shipped-nav", "benchmark-detect-oblique"))]


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] if n in LARGE else []) for n in OF_PRESETS])
def test_the_frames_follow_from_the_recipe(name):
    """In seconds and without ground, to the last bit.

    Only the attitudes of large-detect differ in the last bits: earlier code drew them. So its table `frames` is kept.
    """
    manifest = open_dataset(FOLDER / name)
    recipe = manifest.info.recipe()
    plan = make_plan(config_of(recipe, FOLDER / name, None, None), recipe.kind)
    suns = {scene.scene_id: scene.sun for scene in plan.scenes}
    parts = []
    for each in plan.trajectories:
        paths = [{"png_path": frame_path(each.frame_id(place), "png")} for place in range(len(each.splits))]
        parts.append(frame_table(each, plan.camera, suns[each.scene_id], paths))
    recorded = manifest.table("frames", parts[0].column_names)
    again = pa.concat_tables(parts).cast(recorded.schema)
    if name == "large-detect":
        pairs = [np.array(rows["rotation_wxyz"].to_pylist()) for rows in (again, recorded)]
        np.testing.assert_allclose(*pairs, rtol=0, atol=1e-15)
        again, recorded = (rows.drop_columns(["rotation_wxyz"]) for rows in (again, recorded))
    assert recorded.num_rows and again.equals(recorded)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_frame_is_made_again(name, whole, tmp_path):
    """The reference picture was rendered with the manifest; another kind of machine may differ in single pixels."""
    dem = None
    if name.startswith("south-pole") or name.endswith(("npb", "npc")):
        if REAL is None:
            pytest.skip("PERILUNE_REAL_DEM is not set to the elevation model NPC_2km.tif")
        dem = Path(REAL).with_name("NPB_1km.tif") if name.endswith("npb") else Path(REAL)
    (reference,) = (FOLDER / "reference_frames" / name).rglob("*.png")
    frame_id = reference.relative_to(FOLDER / "reference_frames" / name).with_suffix("").as_posix()
    with Progress(disable=True) as progress:
        (outcome,) = regenerate(whole(name), [frame_id], tmp_path, progress, dem)
    assert outcome.same_ground
    again = Path(outcome.png_path).read_bytes()
    assert png_outlier_share(reference.read_bytes(), again) <= OUTLIERS
    image = cv2.imdecode(np.frombuffer(again, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image.shape == (256, 256) and image.std() > 5
