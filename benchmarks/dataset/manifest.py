"""Time and memory of reading a manifest of 100,000 frames and 5 million labels, as parts and as whole tables.

The tables are filled with numbers of the right types and sizes; nothing is rendered. Each figure is the best of three,
in a separate process, measured from opening the dataset. Writes runs/bench/manifest.json.
"""

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from benchmarks.figures import write_figures
from perilune_shared.console.terminal import progress_bar
from perilune_shared.dataset.index import index_rows, seal
from perilune_shared.dataset.info_file import write_info
from perilune_shared.dataset.manifest import count_rows, open_dataset
from perilune_shared.dataset.metadata import CameraRecord, Counts, DatasetInfo, Recipe, recipes_of
from perilune_shared.dataset.names import frame_path
from perilune_shared.dataset.parts import write_part
from perilune_shared.dataset.schema import SCHEMA_VERSION, TABLES
from perilune_shared.editing.pack import pack
from perilune_shared.geometry.camera import Camera
from perilune_shared.storage.store import open_store

N_SCENES, N_FRAMES, N_LABELS, N_CRATERS = 1000, 100, 50, 2000
"""Scenes of one trajectory each, frames per scene, labels per frame, craters per scene."""
_MEASURED = """
import sys, time
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.export.stats import summary
import pandas

def peak_gib():
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmHWM")) / 2**20

base = peak_gib()
start = time.perf_counter()
dataset = open_dataset(sys.argv[1])
{work}
seconds = time.perf_counter() - start
print(seconds, peak_gib(), base)
"""
_WORKS = {
    "stats": "rows = summary(dataset); assert rows['labels'].sum() == 5_000_000",
    "one_descent": "key = dict(scene_id='scene-0417', trajectory_id='trajectory-0000')\n"
    "frames, labels = (dataset.table(name, **key).to_pandas() for name in ('frames', 'labels'))\n"
    "assert (len(frames), len(labels)) == (100, 5000)",
    "two_columns": "labels = dataset.table('labels', ['radius_px', 'contrast'])\nassert len(labels) == 5_000_000",
    "test_labels": "labels = dataset.table('labels', ['frame_id', 'radius_px'], split='test')\n"
    "assert len(labels) == 500_000",
}


def main() -> None:
    """Write the tables, measure the reading, write the figures."""
    with tempfile.TemporaryDirectory() as folder:
        parts, whole = Path(folder) / "parts", Path(folder) / "whole"
        with progress_bar() as progress:
            _fill(parts, progress)
            pack(open_dataset(parts), whole, progress=progress)
        figures: dict[str, float] = {}
        for layout, root in (("parts", parts), ("whole", whole)):
            for name, work in _WORKS.items():
                best = min((_measured(root, work) for _ in range(3)), key=lambda found: found[0])
                figures[f"{name}_{layout}_s"], figures[f"{name}_{layout}_peak_gib"] = best[:2]
        figures["highest_peak_gib"] = max(value for name, value in figures.items() if name.endswith("_peak_gib"))
        figures["imports_gib"] = best[2]
        figures["manifest_mb"] = sum(path.stat().st_size for path in parts.rglob("*") if path.is_file()) / 1e6
    write_figures(Path("runs/bench/manifest.json"), figures)


def _measured(root: Path, work: str) -> tuple[float, float, float]:
    """Run one of `_WORKS` in a new process: seconds, peak memory and memory after the imports, GiB."""
    command = [sys.executable, "-c", _MEASURED.format(work=work), str(root)]
    seconds, peak, base = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    return float(seconds), float(peak), float(base)


def _fill(root: Path, progress) -> None:
    """Write a dataset of random numbers, as parts."""
    rng = np.random.default_rng(1)
    camera = Camera.from_field_of_view(256, 256, 50.0)
    recipe = Recipe(preset="bench", kind="detect", seed=1, config={}, versions={"perilune_shared": "0"})
    info = DatasetInfo(
        name="bench",
        kind="detect",
        schema_version=SCHEMA_VERSION,
        complete=True,
        images="absent",
        split_by="scene",
        camera=CameraRecord.of(camera),
        recipes=recipes_of(recipe),
        counts=Counts(),
        licence="CC0-1.0",
    )
    write_info(root, info)
    written = []
    for s in progress.track(range(N_SCENES), description="writing scenes"):
        scene = f"scene-{s:04d}"
        split = "test" if s % 10 == 0 else "val" if s % 10 == 1 else "train"
        ids = np.array([f"{scene}/trajectory-0000/{k:06d}" for k in range(N_FRAMES)])
        fixed = {
            "scene_id": scene,
            "trajectory_id": "trajectory-0000",
            "split": split,
            "recipe": recipe.key,
            "n_frames": N_FRAMES,
            "photometry": "hapke_highland",
            "dem_source": "procedural",
            "origin": "primary",
            "width_px": 256,
            "height_px": 256,
        }
        own: dict[str, dict[str, Any]] = {
            "frames": {
                "frame_id": ids,
                "frame_index": np.arange(N_FRAMES),
                "png_path": [frame_path(name, "png") for name in ids],
                "png_sha256": [rng.bytes(32).hex() for _ in ids],
            },
            "labels": {"frame_id": np.repeat(ids, N_LABELS), "crater_id": np.tile(np.arange(N_LABELS), N_FRAMES)},
            "craters": {"crater_id": np.arange(N_CRATERS)},
            "scenes": {"content_sha256": [rng.bytes(32).hex()]},
        }
        sizes = {"scenes": 1, "craters": N_CRATERS, "boulders": 0, "trajectories": 1, "frames": N_FRAMES}
        for name in TABLES:
            n = sizes.get(name, N_FRAMES * N_LABELS)
            part = f"{scene}.trajectory-0000" if name in ("frames", "labels") else scene
            written.append(write_part(root, name, part, _table(name, n, {**fixed, **own.get(name, {})}, rng)))
    counted = info.model_copy(update={"counts": count_rows(open_dataset(root))})
    seal(open_store(root), counted, index_rows(written))


def _table(name: str, n: int, known: dict, rng: np.random.Generator) -> pa.Table:
    """A table of n rows: given columns, random numbers in the others, nulls for other texts."""
    columns = {}
    for field in TABLES[name]:
        if field.name in known:
            value = known[field.name]
            columns[field.name] = pa.array([value] * n if np.ndim(value) == 0 else value, field.type)
        elif pa.types.is_fixed_size_list(field.type):
            size = field.type.list_size
            columns[field.name] = pa.FixedSizeListArray.from_arrays(pa.array(rng.random(n * size)), size)
        elif pa.types.is_integer(field.type):
            columns[field.name] = pa.array(rng.integers(0, 2**40, n))
        elif pa.types.is_floating(field.type):
            columns[field.name] = pa.array(rng.random(n))
        else:
            columns[field.name] = pa.nulls(n, field.type)
    return pa.table(columns, schema=TABLES[name])


if __name__ == "__main__":
    main()
