"""Craters and filter over the descents of a split: errors of single fixes and of the filter, with their stated sizes.

The installed detector finds the craters. Catalogue, start and the prior of the fixes are drawn with one seed:

- fixes: exact catalogue and one with errors, each from a prior that is off by 100 m and 1 degree on every axis;
- filter: inertial unit of grade `tactical`, ranges, catalogue with errors, start off by 60 m, 1 m/s and 0.5 degrees (or
  0.02 degrees, as a star tracker has it) on every axis.

python -m benchmarks.train.landing DATASET [SPLIT]; frames of the locked benchmark are not for choosing anything.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, matrix_from_quaternion, rotation_vectors
from perilune_shared.geometry.inertial_grades import GRADES, HOUR_S, STANDARD_GRAVITY_MPS2
from perilune_train.data.frames import load_frames
from perilune_train.detect.finished_run import chosen_threshold, config_of_run
from perilune_train.detect.inference.detector import open_detector
from perilune_train.detect.inference.scales import detect_at_scales
from perilune_train.navigate.craters.catalogue import Catalogue, CatalogueErrors, exact_catalogue, with_errors
from perilune_train.navigate.craters.fix import PosePrior
from perilune_train.navigate.craters.locate import locate
from perilune_train.navigate.craters.projection import Pose
from perilune_train.navigate.craters.sightings import Sightings
from perilune_train.navigate.filter.flight import Instruments, fly
from perilune_train.navigate.filter.lander import Lander, Surroundings
from perilune_train.navigate.filter.propagate import InertialNoise
from perilune_train.navigate.filter.state import ATTITUDE, POSITION, State
from perilune_train.shipped.models import shipped_run
from perilune_train.training.runs import RunFolder

LEAST_DIAMETER_M, RELIEF_M, RANGE_SIGMA_M = 5.0, 10.0, 1.0
GRADE = GRADES["tactical"]
PRIOR = np.repeat([100.0, np.radians(1.0)], 3)
BAND = (1.24, 14.45)
"""Where a sum of six squares lies in 95 % of cases."""


def sightings_of(dataset: Dataset, split: str) -> tuple[pd.DataFrame, list[Sightings], float]:
    """Frames of a split, the craters that the installed detector finds in each, and its seconds per frame."""
    run = shipped_run("detect")
    detector, threshold = open_detector(RunFolder(run).best, config_of_run(run)), chosen_threshold(run)
    frames = load_frames(dataset, split)
    columns = ["frame_id", "time_s", "position_m", "velocity_mps", "rotation_wxyz"]
    poses = dataset.table("frames", columns, split=split).to_pandas().set_index("frame_id")
    seen, start = [], time.perf_counter()
    for k in range(0, len(frames), 4):
        for found in detect_at_scales(detector, frames.images[k : k + 4]):
            kept = found.scores >= threshold
            seen.append(Sightings.of_boxes(found.boxes[kept], found.scores[kept]))
    seconds = (time.perf_counter() - start) / max(len(frames), 1)
    names = ["frame_id", "scene_id", "trajectory_id", "frame_index"]
    return frames.table[names].join(poses, on="frame_id").reset_index(drop=True), seen, seconds


def pose_of(row: Any) -> Pose:
    """True pose of a frame."""
    return Pose(np.asarray(row.position_m), matrix_from_quaternion(np.asarray(row.rotation_wxyz)))


def error_of(pose: Pose, true: Pose) -> Array:
    """The step (6,) from a pose to the true one."""
    turn = rotation_vectors(true.rotation_camera_from_site @ pose.rotation_camera_from_site.T)
    return np.concatenate([true.position_m - pose.position_m, turn])


def squared(error: Array, covariance: Array) -> float:
    """Normalised error squared."""
    return float(error @ np.linalg.solve(covariance, error))


def fixes(frames: pd.DataFrame, seen: list[Sightings], camera: Camera, catalogues: dict[str, Catalogue]) -> dict:
    """Errors of the fixes of single frames."""
    rng, rows = np.random.default_rng(0), []
    for row, sightings in zip(frames.itertuples(), seen, strict=True):
        true = pose_of(row)
        prior = PosePrior(true.changed(PRIOR * rng.normal(size=6)), np.diag(PRIOR**2))
        start = time.process_time()
        found = locate(sightings, catalogues[str(row.scene_id)], camera, prior)
        seconds = time.process_time() - start
        if found is None:
            rows.append((np.nan, np.nan, np.nan, np.nan, seconds))
            continue
        error = error_of(found.fix.pose, true)
        length_m = float(np.linalg.norm(error[:3]))
        pixels = float(length_m * camera.fx_px / true.position_m[2])
        degrees = float(np.degrees(np.linalg.norm(error[3:])))
        rows.append((length_m, pixels, degrees, squared(error, found.fix.covariance), seconds))
    table = pd.DataFrame(rows, columns=["metres", "pixels", "degrees", "squared", "seconds"])
    right = table[table["pixels"] < 5]
    return {
        "n_frames": len(table),
        "none_share": float(table["pixels"].isna().mean()),
        "wrong_share": float((table["pixels"] >= 5).mean()),
        "rms_m": _rms(right["metres"]),
        "rms_ground_px": _rms(right["pixels"]),
        "rms_deg": _rms(right["degrees"]),
        "normalised_error_squared": float(right["squared"].mean()),
        "seconds": float(table["seconds"].mean()),
    }


def flights(
    dataset: Dataset, frames: pd.DataFrame, seen: list[Sightings], catalogues: dict[str, Catalogue], attitude_deg: float
) -> list[dict]:
    """Errors of the filter, by trajectory."""
    camera = dataset.info.camera.intrinsics()
    mounting = np.array(dataset.info.camera.rotation_camera_from_body)
    biases = np.radians(GRADE.gyro_bias_deg_per_h) / HOUR_S, GRADE.accelerometer_bias_mg * STANDARD_GRAVITY_MPS2 / 1000
    sigmas = np.repeat([60.0, 1.0, np.radians(attitude_deg), *biases], 3)
    results = []
    for n, (both, rows) in enumerate(frames.groupby(["scene_id", "trajectory_id"])):
        ids = (str(both[0]), str(both[1]))
        rng, order = np.random.default_rng(n), rows.sort_values("frame_index")
        true = [pose_of(row) for row in order.itertuples()]
        body = [pose.rotation_camera_from_site.T @ mounting for pose in true]
        off = sigmas[:9] * rng.normal(size=9)
        velocity = np.asarray(order["velocity_mps"].iloc[0]) + off[3:6]
        turned = true[0].changed(np.concatenate([off[:3], mounting @ off[6:]]))
        attitude = turned.rotation_camera_from_site.T @ mounting
        start = State.starting(turned.position_m, velocity, attitude, sigmas, RELIEF_M)
        around = Surroundings(camera, mounting, catalogues[ids[0]], RANGE_SIGMA_M, RELIEF_M)
        lander, begun = Lander(start, InertialNoise.of(GRADE), around), time.process_time()
        instruments = Instruments.of_trajectory(dataset, ids, "tactical")
        errors, squares, status = [], [], []
        own = np.r_[POSITION, ATTITUDE]
        for one in fly(lander, instruments, order["time_s"].to_numpy(), [seen[k] for k in order.index]):
            error = one.state.pose_error(true[one.frame].position_m, body[one.frame])
            errors.append(error)
            squares.append(squared(error, one.state.covariance[np.ix_(own, own)]))
            status.append(one.status)
        distance = np.linalg.norm(np.array(errors)[:, :3], axis=1)
        turn = np.degrees(np.linalg.norm(np.array(errors)[:, 3:], axis=1))
        results.append(
            {
                "scene_id": ids[0],
                "trajectory_id": ids[1],
                "n_frames": len(order),
                "position_rms_m": _rms(distance),
                "position_end_m": float(distance[-1]),
                "attitude_rms_deg": _rms(turn),
                "normalised_error_squared": float(np.mean(squares)),
                "in_band_share": float(np.mean([BAND[0] < value < BAND[1] for value in squares])),
                "tracking_share": float(np.mean([one == "tracking" for one in status])),
                "seconds_per_frame": (time.process_time() - begun) / len(order),
            }
        )
    return results


def _rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def main() -> None:
    """Print and write the figures."""
    if len(sys.argv) < 2:
        sys.exit("usage: python -m benchmarks.train.landing DATASET [SPLIT]")
    dataset, split = open_dataset(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else "val"
    frames, seen, seconds = sightings_of(dataset, split)
    scenes = sorted(frames["scene_id"].unique())
    exact = {scene: exact_catalogue(dataset, scene, LEAST_DIAMETER_M) for scene in scenes}
    rough = {
        scene: with_errors(exact[scene], CatalogueErrors(), np.random.default_rng(k)) for k, scene in enumerate(scenes)
    }
    camera = dataset.info.camera.intrinsics()
    report = {
        "split": split,
        "detection_seconds": seconds,
        "sightings_per_frame": float(np.mean([len(one) for one in seen])),
        "fix, exact catalogue": fixes(frames, seen, camera, exact),
        "fix, catalogue with errors": fixes(frames, seen, camera, rough),
        "filter": flights(dataset, frames, seen, rough, 0.5),
        "filter, star tracker": flights(dataset, frames, seen, rough, 0.02),
    }
    out = Path("runs/bench/landing.json")
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
