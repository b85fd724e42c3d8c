"""Make a crater catalogue of each scene of a survey from two orbiter images."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from perilune_shared.console.terminal import progress_bar
from perilune_shared.dataset.manifest import Dataset, open_single
from perilune_shared.errors import UserError
from perilune_shared.export.foreign_text import code_span, for_markdown
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_shared.storage.files import new_folder
from perilune_shared.storage.store import Address
from perilune_train.data.frames import decode
from perilune_train.data.pinhole import check_pinhole
from perilune_train.detect.finished_run import config_of_run, raw_threshold
from perilune_train.detect.images.predict import above
from perilune_train.detect.inference.detector import Detector, open_detector
from perilune_train.detect.inference.tiles import count_tiles, detect_image
from perilune_train.detect.inference.tiling import Tiling
from perilune_train.landing.craters.catalogue import Catalogue, exact_catalogue
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.map.files import SceneMap, write_maps
from perilune_train.landing.map.measure import DIAMETERS_M, measured
from perilune_train.landing.map.stereo import Matched, View, matched
from perilune_train.records.markdown import number, table, write_markdown
from perilune_train.records.marks import mark_files
from perilune_train.records.pictures import save_image
from perilune_train.records.provenance import check_terrain, read_provenance
from perilune_train.training.runs import RunFolder, load_weights

PAGE, ERRORS = "map.md", "errors.parquet"
TILING = Tiling(scales=(1.0, 0.5, 0.25, 0.125))
"""Detect large craters in reduced images, because the network detects craters of 2 to 50 px only."""
_DIAMETER_SIGMA_SHARE = 0.12
"""Standard deviation of a mapped diameter as a share of the diameter, measured on validation scenes of `shipped-nav`
for craters of 3 to 20 m."""
_MIN_SIGMA_M = 0.05
_WINDOW_PX = 1000
_BOTH, _ONE = (227, 211, 25), (60, 60, 230)
"""Cyan and red, in OpenCV's channel order (blue, green, red)."""
PICTURE = "map.png"


def map_scenes(address: Address, detector: Path, out: Path, allow_overlap: bool = False) -> pd.DataFrame:
    """Make a catalogue of every scene of a survey; returns the errors of the catalogues by diameter.

    Writes <scene_id>.parquet for each scene, map.json (stated errors, Sun), errors.parquet, map.md and a picture to the
    new folder `out`; writes nothing if it fails. Raises UserError if a scene does not have exactly two frames, or if
    the detector was fitted to the terrain (unless `allow_overlap`).
    """
    dataset = open_single(address)
    frames = dataset.table("frames").to_pandas().sort_values("frame_id")
    if frames.empty:
        expected = "two per scene: run `perilune-render survey` again to finish the survey"
        raise UserError(dataset.store, "frames", 0, expected)
    for scene_id, scene_frames in frames.groupby("scene_id"):
        if len(scene_frames) != 2:
            expected = "2, as `perilune-render survey` makes them"
            raise UserError(dataset.store, f"{scene_id}: frames", len(scene_frames), expected)
    camera = dataset.info.camera.intrinsics()
    check_pinhole(dataset)
    if any(camera.distortion):
        raise UserError(dataset.store, "camera.distortion", camera.distortion, "no distortion")
    best = RunFolder(detector).best
    provenance = read_provenance(load_weights(best), best)
    checks = [check_terrain(provenance, dataset, split, allow_overlap) for split in frames["split"].unique()]
    network, threshold = open_detector(best, config_of_run(detector)), raw_threshold(detector)
    maps = []
    with new_folder(out) as folder:
        with progress_bar() as progress:
            n_tiles = len(frames) * count_tiles(camera.height_px, camera.width_px, TILING)
            bar = progress.add_task("detect", total=n_tiles, unit="tiles", note="")
            for scene_id, scene_frames in frames.groupby("scene_id"):
                progress.update(bar, note=str(scene_id))
                maps.append(
                    _scene_map(
                        dataset, str(scene_id), scene_frames, network, threshold, lambda n: progress.advance(bar, n)
                    )
                )
        errors = pd.concat([map_.errors.assign(scene_id=map_.scene_id) for map_ in maps], ignore_index=True)
        write_maps(folder, dataset, maps)
        errors.to_parquet(folder / ERRORS, index=False)
        save_image(folder / PICTURE, maps[0].picture)
        write_markdown(folder / PAGE, page_of(dataset, maps))
        for check in checks:
            mark_files(folder, (PAGE, ERRORS, PICTURE), str(check.metrics()["terrain/mark"]))
    return errors


def _scene_map(
    dataset: Dataset,
    scene_id: str,
    frames: pd.DataFrame,
    network: Detector,
    threshold: float,
    advance: Callable[[int], object],
) -> SceneMap:
    camera, views, images = dataset.info.camera.intrinsics(), [], []
    rows = pa.table({column: frames[column].tolist() for column in ("frame_id", "png_path")})
    pngs = dict(dataset.pngs(rows, str(frames["split"].iloc[0])))
    for row in frames.to_dict("records"):
        where = f"{dataset.store}/{row['png_path']}"
        png = pngs[row["frame_id"]]
        images.append(decode(png, where, camera.height_px, camera.width_px, row["png_bytes"]))
        detections = above(detect_image(network, images[-1], TILING, advance), threshold)
        pose = Pose(np.array(row["position_m"]), matrix_from_quaternion(row["rotation_wxyz"]))
        views.append(View(camera, pose, Sightings.of_boxes(detections.boxes, detections.scores)))
    both = matched(views[0], views[1])
    chosen = np.flatnonzero(2 * both.radius_m >= DIAMETERS_M[0])
    if not len(chosen):
        raise UserError(dataset.store, f"{scene_id}: craters in both images", 0, "at least one")
    chosen = chosen[np.argsort(-both.radius_m[chosen], kind="stable")]
    level = np.tile([0.0, 0.0, 1.0], (len(chosen), 1))
    sigma = max(_MIN_SIGMA_M, float(np.median(np.abs(both.apart_m[chosen]))) * 1.4826 / 2)
    catalogue = Catalogue(both.centre_m[chosen], level, both.radius_m[chosen], sigma, _DIAMETER_SIGMA_SHARE)
    covered = np.abs(catalogue.centre_m[:, :2]).max(axis=0)
    errors = measured(catalogue, exact_catalogue(dataset, scene_id, DIAMETERS_M[0] / 2), covered)
    return SceneMap(scene_id, catalogue, both.score[chosen], errors, _picture(images[0], views[0], both))


def _picture(image: NDArray[np.uint8], view: View, both: Matched) -> NDArray[np.uint8]:
    """The centre of an image, with craters detected in both images (cyan) and in this image only (red)."""
    first = max((image.shape[0] - _WINDOW_PX) // 2, 0)
    canvas = cv2.cvtColor(image[first : first + _WINDOW_PX, first : first + _WINDOW_PX], cv2.COLOR_GRAY2BGR)
    in_both = np.zeros(len(view.sightings), bool)
    in_both[both.first] = True
    centres = view.sightings.centre_px - first
    for centre, radius, twice in zip(
        centres.tolist(), view.sightings.radius_px.tolist(), in_both.tolist(), strict=True
    ):
        if all(-radius < coordinate < _WINDOW_PX + radius for coordinate in centre):
            spot = (round(8 * (centre[0] - 0.5)), round(8 * (centre[1] - 0.5)))
            cv2.circle(canvas, spot, round(8 * radius), _BOTH if twice else _ONE, 1, cv2.LINE_AA, 3)
    return np.asarray(canvas, np.uint8)


def page_of(dataset: Dataset, maps: list[SceneMap]) -> str:
    """The results page as Markdown."""
    lines = ["# Crater map", "", f"Dataset {code_span(dataset.info.name)}, {len(maps)} scenes, two images of each.", ""]
    lines += [
        "Poses of the images are exact. A crater of the map is true if one of the terrain is near: distance in radii,",
        "plus twice the difference of the logarithms of both radii, is below 0.8. Errors are those of true craters.",
        "Craters of an elevation model itself are not known, so their detections count as false here.",
        "",
    ]
    for scene_map in maps:
        share = scene_map.catalogue.radius_sigma_share
        stated = f"position {number(scene_map.catalogue.position_sigma_m)} m, diameter {100 * share:.0f} %"
        lines += [
            f"## {for_markdown(scene_map.scene_id)}: {len(scene_map.catalogue)} craters",
            "",
            f"Stated errors: {stated}.",
            "",
        ]
        head = ["diameter (m)", "mapped", "true", "found", "position RMSE per axis (m)", "height RMSE (m)"]
        rows = [
            [
                str(row["diameter_m"]),
                str(row["mapped"]),
                *(f"{100 * row[key]:.1f} %" for key in ("true_share", "found_share")),
                *(number(row[key]) for key in ("position_rmse_m", "height_rmse_m")),
                f"{100 * row['diameter_bias_share']:+.1f} %, {100 * row['diameter_sigma_share']:.1f} %",
            ]
            for row in scene_map.errors.to_dict("records")
        ]
        lines += [*table([*head, "diameter: mean error, standard deviation"], rows), ""]
    caption = "Middle of the first image: craters found in both images (cyan) and in this one alone (red)"
    return "\n".join([*lines, f"![{caption}]({PICTURE})", "", f"*{caption}.*", ""])
