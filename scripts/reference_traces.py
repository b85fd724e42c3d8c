"""Make the reference traces of the landing filter: their inputs from datasets, and their tables from the inputs.

    python -m scripts.reference_traces inputs --highland data/highland/nav --relief data/relief/nav
    python -m scripts.reference_traces tables

`inputs` unpacks three descents, detects their craters and keeps a part of the measurements, so that the traces are
small. `tables` flies the filter over these inputs again, and writes the tables of docs/reference/landing-filter.md. It
is needed after each change of the filter.
"""

import argparse
import shutil
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # An import by another module must not change how Ctrl-C works.
    end_at_interrupt()
    # Found as a file, too: `python scripts/reference_traces.py`.
    sys.path.insert(0, str(Path(__file__).parent.parent))

import numpy as np
from scripts.trace_page import write_page

from perilune_shared.console.terminal import say
from perilune_shared.dataset.manifest import open_single
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector
from perilune_shared.geometry.inertial_grades import InertialGrade
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.projection import Pose, in_view
from perilune_train.landing.filter.flight import DopplerLidar, Instruments, StarTracker
from perilune_train.landing.filter.lander import Beam
from perilune_train.landing.filter.propagate import Increments
from perilune_train.landing.fly.detections import by_network
from perilune_train.landing.fly.run import Descent, DescentFiles, read_descent
from perilune_train.landing.fly.tables import FrameFiles
from perilune_train.landing.fly.unpack import unpack_descent
from perilune_train.landing.trace.write import INPUTS, trace_of, write_inputs, write_table
from perilune_train.shipped.models import shipped_run

TRACES = Path(__file__).parent.parent / "examples" / "traces"
"""Folder of the reference traces."""
_MARGIN_PX, _LEAST_PX = 48.0, 1.2
"""Craters of the catalogue that are never in view with this margin and at least this radius are left out."""
_MOUNTING_DEG = 30.0
"""Rotation of the body's axes about Z_B in the descent with all sensors. A symmetric mounting matrix would not show a
transposed one."""
_RATE_BITS, _FORCE_BITS = 22, 16
"""Inertial measurements are rounded to multiples of 2^-bits of their unit."""
_NO_CRATERS = 5
"""Frame without detections in the descent with all sensors."""
_DISTORTION = (-0.12, 0.03, 0.001, -0.0007, 0.0)


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a reference descent is made from a descent of a dataset."""

    dataset: str
    """highland or relief."""
    trajectory: tuple[str, str]
    """scene_id and trajectory_id."""
    grade: InertialGrade
    """Grade of the inertial unit."""
    every_frame: int
    """One of this number of frames is kept."""
    every_range: int
    """One of this number of ranges is kept."""
    max_detections: int
    """Largest number of detections of a frame, those with the highest scores."""
    position_sigma_m: float = 60.0
    """Standard deviation of the prior's position on each axis, metres."""
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Further error of the prior's position, metres, O_L."""
    all_sensors: bool = False
    """Whether the descent has all sensors, outages, a lens with distortion and a turned camera."""


RECIPES = {
    "nominal": Recipe("highland", ("scene-0000", "trajectory-0000"), "tactical", 3, 20, 110),
    "sensors": Recipe("highland", ("scene-0001", "trajectory-0001"), "cubesat", 4, 30, 110, all_sensors=True),
    # The shift contradicts the stated deviation, so the filter restarts.
    "restart": Recipe("relief", ("scene-0000", "trajectory-0000"), "tactical", 4, 30, 160, 4.0, (45.0, -30.0, 10.0)),
}


def make_inputs(datasets: dict[str, str]) -> None:
    """Write the inputs of all reference traces."""
    network = by_network(shipped_run("detect"))
    for name, recipe in RECIPES.items():
        folder = TRACES / name / INPUTS
        with tempfile.TemporaryDirectory() as scratch:
            unpacked = Path(scratch) / "descent"
            dataset = open_single(datasets[recipe.dataset])
            offset = recipe.position_sigma_m, 1.0, 0.5
            unpack_descent(dataset, recipe.trajectory, unpacked, recipe.grade, False, offset, 0)
            descent = _with_fewer_rows(read_descent(DescentFiles.of_folder(unpacked)), recipe)
            found = {path.name: _best(network(path), recipe.max_detections) for path in descent.frames.paths}
            if recipe.all_sensors:
                descent, found = _with_faults(descent, found)
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            write_inputs(descent, lambda path, found=found: found[path.name], folder)
        say(f"{folder}: {sum(path.stat().st_size for path in folder.iterdir()) / 1000:.0f} kB")


def make_tables() -> None:
    """Fly the filter over the inputs of all reference traces and write the tables."""
    for name in RECIPES:
        folder = TRACES / name
        tables = trace_of(folder / INPUTS)
        for table, rows in tables.items():
            write_table(rows, folder / f"{table}.parquet")
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        outcomes = ", ".join(f"{count} {each}" for each, count in tables["frames"]["outcome"].value_counts().items())
        say(f"{folder}: {len(tables['steps'])} steps; frames: {outcomes}; {size / 1000:.0f} kB with inputs")
    write_page()


def _best(found: Detections, count: int) -> Detections:
    """The detections with the highest scores, rounded to 1/256 px."""
    kept = np.sort(np.argsort(-found.scores, kind="stable")[:count])
    return Detections(_rounded(found.boxes[kept], 8), _rounded(found.scores[kept], 10))


def _rounded(values: Array, bits: int) -> Array:
    """Values rounded to multiples of 2^-bits, which compress well."""
    return np.round(np.asarray(values, np.float64) * 2.0**bits) / 2.0**bits


def _with_fewer_rows(descent: Descent, recipe: Recipe) -> Descent:
    """The descent with a part of its frames, measurements and craters, and with rounded values."""
    truth, camera = descent.truth, descent.camera.intrinsics()
    assert truth is not None
    kept = slice(None, None, recipe.every_frame)
    poses = [Pose(*pose) for pose in zip(truth.position_m[kept], truth.rotation_camera_from_site[kept], strict=True)]
    seen = [in_view(descent.catalogue, camera, pose, _MARGIN_PX, _LEAST_PX) for pose in poses]
    craters = descent.catalogue.part(np.unique(np.concatenate(seen)))
    normal = _rounded(craters.normal, 12)
    catalogue = Catalogue(
        _rounded(craters.centre_m, 8),
        normal / np.linalg.norm(normal, axis=1, keepdims=True),
        _rounded(craters.radius_m, 9),
        craters.position_sigma_m,
        craters.radius_sigma_share,
    )
    instruments = descent.instruments
    inertial = _halved(instruments.inertial)
    ranges = slice(None, None, recipe.every_range)
    instruments = Instruments(
        inertial, instruments.range_time_s[ranges], _rounded(instruments.range_m[ranges], 10),
        *((_stars(instruments), _lidar(instruments)) if recipe.all_sensors else ()),
    )  # fmt: skip
    frames = FrameFiles(descent.frames.paths[kept], descent.frames.time_s[kept])
    position_m = tuple(np.add(descent.prior.position_m, recipe.shift_m).tolist())
    prior = descent.prior.model_copy(update={"position_m": position_m})
    return replace(descent, catalogue=catalogue, instruments=instruments, frames=frames, prior=prior)


def _halved(measured: Increments) -> Increments:
    """The mean of each two inertial measurements."""
    n = len(measured) // 2 * 2
    rate, force = (
        _rounded(values[:n].reshape(-1, 2, 3).mean(axis=1), bits)
        for values, bits in ((measured.angular_rate_radps, _RATE_BITS), (measured.specific_force_mps2, _FORCE_BITS))
    )
    time_s = measured.time_s[:n][1::2]
    return Increments(time_s, measured.interval_s[:n:2] + measured.interval_s[1:n:2], rate, force)


def _stars(instruments: Instruments) -> StarTracker:
    stars = instruments.star_tracker
    assert stars is not None
    kept = slice(None, None, 5)
    return StarTracker(stars.time_s[kept], stars.rotation_body_from_site[kept], stars.sigmas_rad)


def _lidar(instruments: Instruments) -> DopplerLidar:
    """One measurement of all beams every four seconds."""
    lidar = instruments.doppler_lidar
    assert lidar is not None
    kept = np.flatnonzero(np.isin(lidar.time_s, np.unique(lidar.time_s)[::20]))
    beams = [lidar.beams[k] for k in kept]
    return DopplerLidar(lidar.time_s[kept], beams, replace(lidar.errors, step_s=4.0))


def _with_faults(descent: Descent, found: dict[str, Detections]) -> tuple[Descent, dict[str, Detections]]:
    """The descent with missing and wrong measurements, a lens with distortion, and body axes turned about Z_B."""
    instruments, lidar, stars = descent.instruments, descent.instruments.doppler_lidar, descent.instruments.star_tracker
    assert lidar is not None
    assert stars is not None
    turn = matrix_from_rotation_vector(np.radians([0.0, 0.0, _MOUNTING_DEG]))
    inertial = instruments.inertial
    rate = _rounded(inertial.angular_rate_radps @ turn.T, _RATE_BITS)
    force = _rounded(inertial.specific_force_mps2 @ turn.T, _FORCE_BITS)
    # No measurements for 2 seconds (rows missing) and for 0.4 seconds (values missing).
    kept = (inertial.time_s <= 38.0) | (inertial.time_s > 40.0)
    rate[(inertial.time_s > 20.0) & (inertial.time_s <= 20.4)] = np.nan
    range_m = instruments.range_m.copy()
    range_m[[3, 7]] = np.nan, range_m[7] + 300.0
    beams = [Beam(turn @ beam.direction_in_body, beam.speed_mps, beam.range_m) for beam in lidar.beams]
    beams[4] = replace(beams[4], speed_mps=np.nan)
    beams[8] = replace(beams[8], range_m=np.nan)
    beams[12] = replace(beams[12], speed_mps=beams[12].speed_mps + 20.0)
    rotations = turn @ stars.rotation_body_from_site
    rotations[4] = matrix_from_rotation_vector(np.array([0.0, 0.02, 0.0])) @ rotations[4]
    instruments = Instruments(
        Increments(inertial.time_s, inertial.interval_s, rate, force).part(kept),
        instruments.range_time_s,
        range_m,
        replace(stars, rotation_body_from_site=rotations),
        replace(lidar, beams=beams),
    )
    mounting = np.array(descent.camera.rotation_camera_from_body) @ turn.T
    pinhole = descent.camera.intrinsics()
    lens = replace(pinhole, distortion=_DISTORTION)
    record = descent.camera.model_copy(update={"distortion": _DISTORTION, "rotation_camera_from_body": _rows(mounting)})
    prior = descent.prior.model_copy(update={"camera_mounting_sigma_deg": 0.02, "camera_time_sigma_s": 0.01})
    distorted = {name: _distorted(each, pinhole, lens) for name, each in found.items()}
    distorted[descent.frames.paths[_NO_CRATERS].name] = Detections(np.zeros((0, 4)), np.zeros(0))
    return replace(descent, camera=record, instruments=instruments, prior=prior), distorted


def _rows(matrix: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in matrix.tolist())


def _distorted(found: Detections, pinhole: Camera, lens: Camera) -> Detections:
    """Detections as a lens with distortion shows them; those that leave the image are left out."""
    corners = lens.project(pinhole.rays(found.boxes.reshape(-1, 2, 2)))
    boxes = _rounded(corners.reshape(-1, 4), 8)
    inside = np.isfinite(boxes).all(axis=1) & lens.inside(corners).all(axis=1)
    return Detections(boxes[inside], found.scores[inside])


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("inputs", "tables"))
    parser.add_argument("--highland", default="data/reference-highland/nav")
    parser.add_argument("--relief", default="data/reference-relief/nav")
    given = parser.parse_args()
    if given.part == "inputs":
        make_inputs({"highland": given.highland, "relief": given.relief})
    make_tables()


if __name__ == "__main__":
    main()
