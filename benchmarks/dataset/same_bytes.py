"""Hashes of every stage of a frame, to find where two processors first compute other bytes.

Computes single operations of each library, then the ground, the mesh, the rendering, the sensor, the labels and the
files of two frames of `tiny`, with both engines. Writes runs/bench/same_bytes.json, and the values of all stages as
runs/bench/same_bytes.npz. With files of another machine, prints the first stage that differs and by how much:

    python -m benchmarks.dataset.same_bytes --compare other/same_bytes.npz
"""

import argparse
import hashlib
import io
import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

# Sets how the libraries compute, before NumPy is imported.
import perilune_render.provenance.processor

import cv2  # isort: skip
import numba  # isort: skip
import numpy as np  # isort: skip
import scipy.fft  # isort: skip
import scipy.linalg  # isort: skip
import scipy.ndimage  # isort: skip
from llvmlite.binding import get_host_cpu_features, get_host_cpu_name  # type: ignore[import-untyped]  # isort: skip

from benchmarks.figures import write_figures
from perilune_render.config.dataset import DatasetConfig
from perilune_render.dataset.frame_files import png_bytes
from perilune_render.dataset.shots import planned_shot
from perilune_render.engines.frame_source import FrameSource
from perilune_render.engines.open_engine import open_engine
from perilune_render.flight.plan import Plan, make_plan
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.terrain.export import vertices
from perilune_render.terrain.scene import Scene, grow_scene
from perilune_shared.config.resolve import resolve
from perilune_shared.storage.files import write_bytes

Values = dict[str, np.ndarray]
"""Values by the name of their stage, in the order in which they are computed."""
ENGINES = ("heightfield", "cycles")
N_FRAMES = 2
FEATURES = ("avx2", "fma", "avx512f", "avx512bf16", "avx512fp16", "amx-tile", "amx-bf16")


@numba.njit
def _compiled(x: np.ndarray) -> np.ndarray:
    """Products and sums that a compiler could fuse, and functions of the C library."""
    out = np.empty_like(x)
    for i in range(len(x)):
        out[i] = x[i] * x[i] + 0.1 * x[i] + math.sin(x[i]) * math.exp(-x[i]) + math.sqrt(x[i])
    return out


def operations() -> Values:
    """Single operations of the libraries on fixed numbers."""
    rng = np.random.default_rng(0)
    x, image = rng.uniform(0.01, 10, 10_000), rng.random((128, 128)).astype(np.float32)
    matrix = rng.normal(size=(64, 64))
    found: Values = {}
    for kind in (np.float64, np.float32):
        own = x.astype(kind)
        for name in ("sin", "cos", "arctan", "exp", "log", "sqrt", "cbrt", "tanh"):
            found[f"numpy {name} {kind.__name__}"] = getattr(np, name)(own)
        found[f"numpy power {kind.__name__}"] = np.power(own, kind(1.7))
        found[f"numpy sum {kind.__name__}"] = np.array([own.sum(), own.mean(), own.std()])
    found["C library"] = np.array(
        [[math.sin(v), math.exp(-v), math.log(v), v**1.7, math.atan2(v, 2)] for v in x[:2000]]
    )
    found["numpy matmul"] = matrix @ matrix
    found["numpy einsum"] = np.einsum("ij,kj->ik", matrix, matrix)
    found["lapack solve"] = scipy.linalg.solve(matrix, matrix[:, 0])
    found["scipy filter"] = scipy.ndimage.gaussian_filter(image, 1.3)
    found["scipy fft"] = scipy.fft.rfft2(image).view(np.float32)
    found["numba"] = _compiled(x)
    found["opencv blur"] = cv2.GaussianBlur(image, (0, 0), 1.3)
    found["opencv resize"] = cv2.resize(image, (75, 75), interpolation=cv2.INTER_AREA)
    places = rng.uniform(0, 127, (2, 128, 128)).astype(np.float32)
    found["opencv remap"] = cv2.remap(image, places[0], places[1], cv2.INTER_CUBIC)
    found["opencv filter"] = cv2.filter2D(image, -1, image[:7, :7])
    return found


def arrays(prefix: str, value: Any) -> Iterator[tuple[str, np.ndarray]]:
    """All arrays and numbers in a value and in the dataclasses that it holds, by name."""
    if isinstance(value, np.ndarray):
        yield prefix, value
    elif isinstance(value, int | float):
        yield prefix, np.array(value)
    elif is_dataclass(value):
        for field in fields(value):
            yield from arrays(f"{prefix} {field.name}", getattr(value, field.name))


def rendered(engine_name: str, config: DatasetConfig, plan: Plan, scene: Scene) -> Values:
    """Rendering, exposure, image, labels and PNG of frames of the first trajectory."""
    config = config.model_copy(update={"render": config.render.model_copy(update={"engine": engine_name})})
    scene_plan = plan.scenes[0]
    trajectory = plan.of_scene(scene_plan.scene_id)[0]
    mounted = plan.rig[trajectory.camera]
    found: Values = {}
    with open_engine(scene, config, mounted.exr_camera, scene_plan.sun) as engine:
        source = FrameSource.of(engine, config, mounted.camera, RimCircles.of_scene(scene), trajectory.camera)
        for index in np.linspace(0, len(trajectory.splits) - 1, N_FRAMES).astype(int):
            frame = source.take(planned_shot(trajectory, index))
            name = f"{engine_name} frame {index}"
            found |= dict(arrays(f"{name} shot", frame.shot))
            found |= dict(arrays(f"{name} radiance", frame.radiance))
            found |= dict(arrays(f"{name} exposure", frame.exposure))
            found[f"{name} image"] = frame.image
            found |= dict(arrays(f"{name} labels", source.labels(frame)))
            found[f"{name} PNG"] = np.frombuffer(png_bytes(frame.image, config.sensor.bits), np.uint8)
    return found


def stages() -> Values:
    """The values of all stages."""
    config = resolve(DatasetConfig, "dataset", "perilune_render", "tiny", None, ())
    plan = make_plan(config, "detect")
    # Without the cache, which may have been filled on another machine.
    scene = grow_scene(config, plan.view, plan.scenes[0].seed)
    found = operations() | dict(arrays("terrain", scene))
    found["mesh vertices"] = vertices(scene.grid, scene.height_m)
    found["mesh faces"] = np.asarray(scene.grid.quads())
    for name in ENGINES:
        found |= rendered(name, config, plan, scene)
    return found


def hash_of(values: np.ndarray) -> str:
    """The start of the SHA-256 of type, shape and bytes."""
    kind = f"{values.dtype.str}{values.shape}".encode()
    return hashlib.sha256(kind + np.ascontiguousarray(values).tobytes()).hexdigest()[:16]


def differences(own: Values, other: Values) -> list[str]:
    """A line for each stage that differs, in the order in which they are computed."""
    lines = []
    for name, values in own.items():
        there = other.get(name)
        if there is None or there.shape != values.shape or there.dtype != values.dtype:
            lines.append(f"{name}: {'missing' if there is None else 'another shape or type'}")
        elif there.tobytes() != values.tobytes():
            here = np.asarray(values, np.float64)
            with np.errstate(invalid="ignore"):
                apart = np.abs(here - np.asarray(there, np.float64))
            # Infinite in both, as the depth of the sky.
            apart = np.nan_to_num(apart, nan=0.0)
            size = f"{np.count_nonzero(apart)} of {apart.size} values by at most {apart.max():.3g}"
            lines.append(f"{name}: {size} (largest value {np.nanmax(np.abs(here[np.isfinite(here)])):.3g})")
    return lines


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--compare", type=Path, help="same_bytes.npz of another machine")
    parser.add_argument("--out", type=Path, default=Path("runs/bench"), help="folder for same_bytes.json and .npz")
    given = parser.parse_args()
    found = stages()
    features = get_host_cpu_features()
    print(f"processor {get_host_cpu_name()}: {', '.join(name for name in FEATURES if features.get(name))}")
    if not perilune_render.provenance.processor.IN_FORCE:
        print("NumPy was loaded before the settings of perilune_render.provenance.processor")
    for name, values in found.items():
        print(f"{hash_of(values)}  {name}")
    stream = io.BytesIO()
    np.savez_compressed(stream, **{name: np.asarray(values) for name, values in found.items()})
    write_bytes(given.out / "same_bytes.npz", stream.getvalue())
    figures: dict[str, object] = {"features": [name for name in FEATURES if features.get(name)]}
    figures["stages"] = {name: hash_of(values) for name, values in found.items()}
    if given.compare is not None:
        with np.load(given.compare, allow_pickle=False) as stored:
            figures["differences"] = differences(found, dict(stored))
    write_figures(given.out / "same_bytes.json", figures)


if __name__ == "__main__":
    main()
