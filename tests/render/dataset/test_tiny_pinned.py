"""The preset `tiny` is as it was when tiny_pinned.json was written: ground, plan, and every byte of tables and images.

Bytes are compared only with the libraries with which they were written. The C library is one of them; its functions and
Cycles differ in last digits between processors with and without AVX2 and FMA. Rendered images also differ on processors
with AVX512-FP16, for a reason that is not known; they have hashes of their own ("differs").
"""

import hashlib
import json
import platform
import sys
from importlib import metadata
from pathlib import Path

import pyarrow as pa
import pytest
from llvmlite.binding import get_host_cpu_features
from tests.helpers import in_process

from perilune_render.cli.main import main
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.schema import OPTIONAL_TABLES, stored

PINNED = Path(__file__).with_name("tiny_pinned.json")
KINDS = ("detect", "nav")
CODE = ("perilune_render", "perilune_shared", "generator", "renderer", "imaging")
OF_IMAGES = ("png_sha256", "png_bytes", "exr_sha256", "exr_bytes")


def made_with(folder):
    """Processor and libraries of this machine; libraries as recorded, without perilune's own code."""
    recorded = open_dataset(folder / "detect").info.recipe().versions
    libraries = {name: version for name, version in recorded.items() if name not in CODE}
    features = get_host_cpu_features()
    processor = "with AVX2 and FMA" if features["avx2"] and features["fma"] else "without AVX2 or FMA"
    if features.get("avx512fp16"):
        processor = "with AVX512-FP16"
    return {
        "processor": processor,
        "libraries": libraries | {"pyarrow": metadata.version("pyarrow"), "C": "-".join(platform.libc_ver())},
    }


def hash_of(content):
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def plan_of(folder):
    """Per dataset: hashes of each scene's ground, and of the names, numbers and seeds in each table of the plan.

    What is counted on rendered frames is left out: a plan and a rendered dataset have the same hashes.
    """
    found = {}
    for kind in KINDS:
        dataset = open_dataset(folder / kind)
        scenes = dataset.table("scenes").sort_by("scene_id")
        found[kind] = dict(zip(scenes["scene_id"].to_pylist(), scenes["content_sha256"].to_pylist(), strict=True))
        for name in ("scenes", "trajectories", "frames"):
            table = stored(name, dataset.table(name))
            left_out = ("recipe", "n_craters_above_max_radius", *OF_IMAGES)
            fields = [f.name for f in table.schema if f.name not in left_out and not holds_floats(f.type)]
            found[kind][name] = hash_of(table.select(fields).to_pylist())
    return found


def holds_floats(kind):
    return pa.types.is_floating(kind.value_type if pa.types.is_fixed_size_list(kind) else kind)


def bytes_of(folder):
    """Per dataset: hashes of the tables' values, and of the files by folder and kind.

    The recipe's key in the table scenes, the index and dataset.json hold the hash of the code, which may change.
    """
    found = {}
    for kind in KINDS:
        root = folder / kind
        dataset = open_dataset(root)
        tables = {
            name: stored(name, dataset.table(name))
            for name in ("scenes", "craters", "boulders", "trajectories", "frames", *OPTIONAL_TABLES)
            if name in ("inertial", "ranges") or len(dataset.table(name))
        }
        tables = {**tables, "scenes": tables["scenes"].drop_columns(["recipe"]), "labels": dataset.table("labels")}
        groups = {}
        for path in sorted(path for path in root.rglob("*") if path.suffix in (".png", ".exr", ".parquet")):
            name = path.relative_to(root).as_posix()
            if not name.startswith(("manifest/scenes/", "index/")):
                group = path.name if path.parent == root else f"{name.partition('/')[0]}/*{path.suffix}"
                groups.setdefault(group, []).append([name, hashlib.sha256(path.read_bytes()).hexdigest()])
        found[kind] = {name: hash_of(table.to_pylist()) for name, table in tables.items()}
        found[kind] |= {group: hash_of(files) for group, files in groups.items()}
    return found


REMEDY = "if this is intended, see `Change what is rendered` in CONTRIBUTING.md"


def different(found, pinned):
    """Dataset and name of each hash that is not as pinned."""
    names = {(kind, name) for hashes in (found, pinned) for kind in hashes for name in hashes[kind]}
    return sorted(f"{kind} {name}" for kind, name in names if found[kind].get(name) != pinned[kind].get(name))


def test_ground_and_plan_of_tiny_are_as_before(tmp_path):
    """The plan holds both, so that nothing is rendered."""
    for kind in KINDS:
        made = in_process.call(main, "plan", "--preset", "tiny", "--kind", kind, "--out", tmp_path / kind)
        assert made.returncode == 0, made.stderr
    assert different(plan_of(tmp_path), json.loads(PINNED.read_text())["plan"]) == [], REMEDY


@pytest.mark.slow
def test_every_byte_of_tiny_is_as_before(tiny):
    pinned, here = json.loads(PINNED.read_text()), made_with(tiny)
    assert different(plan_of(tiny), pinned["plan"]) == [], REMEDY
    differs = {pinned["made_with"]["processor"]: {}} | pinned["differs"]
    if here["libraries"] != pinned["made_with"]["libraries"] or here["processor"] not in differs:
        pytest.skip(f"pinned with {pinned['made_with']}, this machine has {here}: bytes may differ")
    own = differs[here["processor"]]
    expected = {kind: hashes | own.get(kind, {}) for kind, hashes in pinned["bytes"].items()}
    assert different(bytes_of(tiny), expected) == [], REMEDY


def written(folder):
    """Content of tiny_pinned.json with this machine's hashes: all of them, or those that differ on this processor."""
    here, found = made_with(folder), bytes_of(folder)
    before = json.loads(PINNED.read_text())
    if here["processor"] == before["made_with"]["processor"]:
        return {"made_with": here, "plan": plan_of(folder), "bytes": found, "differs": {}}
    common = before["bytes"]
    own = {
        kind: {name: value for name, value in hashes.items() if common[kind].get(name) != value}
        for kind, hashes in found.items()
    }
    return before | {"differs": before.get("differs", {}) | {here["processor"]: own}}


if __name__ == "__main__":
    print(json.dumps(written(Path(sys.argv[1])), indent=1))
