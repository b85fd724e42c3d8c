import dataclasses
import os
import subprocess
import sys
import time

import numpy as np
import pytest
from tests.helpers.scenes import config_with

from perilune_render.config.dataset import FlightConfig
from perilune_render.flight.view import view_envelope
from perilune_render.terrain import cache
from perilune_render.terrain.scene import grow_scene
from perilune_shared.geometry.camera import Camera
from perilune_shared.storage.store import open_store

CAMERA = Camera.from_field_of_view(32, 32, 50.0)
FLIGHT = FlightConfig()
VIEW = view_envelope(CAMERA, FLIGHT)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("PERILUNE_CACHE", str(tmp_path / "scenes"))
    return tmp_path / "scenes"


def same(first, second):
    for field in dataclasses.fields(first):
        a, b = getattr(first, field.name), getattr(second, field.name)
        if dataclasses.is_dataclass(a):
            same(a, b)
        else:
            # Values that are not known are NaN.
            is_real = isinstance(a, np.ndarray) and a.dtype.kind == "f"
            assert type(a) is type(b) and np.array_equal(a, b, equal_nan=is_real), field.name
            assert not isinstance(a, np.ndarray) or a.dtype == b.dtype, field.name


def test_a_cached_scene_is_the_grown_one(folder):
    grown = grow_scene(config_with(), VIEW, 3)
    same(cache.cached_scene(config_with(), VIEW, 3), grown)
    assert len(list(folder.iterdir())) == 1
    same(cache.cached_scene(config_with(), VIEW, 3), grown)
    assert len(list(folder.iterdir())) == 1


def test_whatever_changes_the_ground_changes_the_key(tmp_path):
    base = cache.scene_key(config_with(), VIEW, 3)
    assert base == cache.scene_key(config_with(sensor={"bits": 12}, render={"samples": 9}), VIEW, 3)
    dem = tmp_path / "a.tif"
    dem.write_bytes(b"II*\0one")
    with_dem = cache.scene_key(config_with(terrain={"dem": str(dem)}), VIEW, 3)
    dem.write_bytes(b"II*\0two")
    others = [
        cache.scene_key(config_with(), VIEW, 4),
        cache.scene_key(config_with(), view_envelope(CAMERA, FlightConfig(downrange_m=400.0)), 3),
        cache.scene_key(config_with(), view_envelope(dataclasses.replace(CAMERA, fx_px=30.0), FLIGHT), 3),
        cache.scene_key(
            config_with(terrain={"relief": {"rms_slope_deg": {"low": 1.0, "high": 1.0}}}),
            VIEW,
            3,
        ),
        cache.scene_key(config_with(light={"albedo_variation": 0.5}), VIEW, 3),
        with_dem,
        cache.scene_key(config_with(terrain={"dem": str(dem)}), VIEW, 3),
    ]
    assert len({base, *others}) == 8


def test_a_damaged_file_is_grown_again_and_no_cache_keeps_nothing(folder):
    cache.cached_scene(config_with(render={"cache_gib": 0.0}), VIEW, 3)
    assert not folder.exists()
    grown = cache.cached_scene(config_with(), VIEW, 3)
    path = next(folder.iterdir())
    for content in (path.read_bytes()[:5000], b"", b"rubbish"):
        path.write_bytes(content)
        same(cache.cached_scene(config_with(), VIEW, 3), grown)
    assert path.stat().st_size > 5000


def test_the_least_recently_used_goes_first(folder):
    config = config_with()
    for seed in (1, 2):
        cache.cached_scene(config, VIEW, seed)
    time.sleep(0.02)
    cache.cached_scene(config, VIEW, 1)
    size = max(path.stat().st_size for path in folder.iterdir())
    cache.cached_scene(config_with(render={"cache_gib": 2.3 * size / 2**30}), VIEW, 3)
    kept = {path.stem for path in folder.iterdir()}
    assert kept == {cache.scene_key(config, VIEW, seed) for seed in (1, 3)}


def test_a_folder_that_cannot_be_written_is_no_failure(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("PERILUNE_CACHE", str(tmp_path / "file" / "scenes"))
    assert cache.cached_scene(config_with(), VIEW, 3).seed == 3


WRITE = """
import resource, signal, sys
import numpy as np
from pathlib import Path
from tests.helpers.scenes import config_with, flat_scene, round_craters
from perilune_render.terrain import cache
scene = flat_scene(3000, 201, round_craters([(10, 0, 60, 0.1)]))
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000))
try:
    cache._write(Path(sys.argv[1]), scene)
except OSError:
    print("full")
"""


@pytest.mark.slow
def test_a_full_disk_is_one_error_and_leaves_no_file(tmp_path):
    """A file size limit stands in for a full disk."""
    plain = {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE_")}
    command = [sys.executable, "-c", WRITE, str(tmp_path / "scene.npz")]
    done = subprocess.run(command, capture_output=True, text=True, env=plain)
    assert (done.stdout, done.stderr) == ("full\n", "") and not list(tmp_path.iterdir())


def test_a_scene_is_shared_with_machines_that_have_another_cache(folder, monkeypatch):
    shared = open_store("memory://shared-scenes")
    grown = cache.cached_scene(config_with(), VIEW, 3, shared)
    (kept,) = folder.iterdir()
    assert shared.read(kept.name) == kept.read_bytes()
    kept.unlink()
    monkeypatch.setattr(cache, "grow_scene", None)  # not called
    same(cache.cached_scene(config_with(), VIEW, 3, shared), grown)
    assert [path.name for path in folder.iterdir()] == [kept.name]


def test_a_scene_that_another_machine_has_shared_meanwhile_is_left_alone(folder, monkeypatch):
    shared = open_store("memory://shared-meanwhile")
    shared.write(f"{cache.scene_key(config_with(), VIEW, 3)}.npz", b"of another machine")
    grown = cache.cached_scene(config_with(), VIEW, 3, shared)
    same(cache.cached_scene(config_with(), VIEW, 3), grown)
    assert [shared.read(item.path) for item in shared.list()] == [b"of another machine"]
