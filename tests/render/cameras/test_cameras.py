"""Several cameras on one body: the extrinsics agree with labels and depth, and the manifest gives the same bytes."""

import json
import shutil

import numpy as np
import pytest
from tests.helpers import in_process

from perilune_render.cli.main import main
from perilune_render.imaging.exr import read_exr
from perilune_shared.cli.main import main as manifest_main
from perilune_shared.dataset.manifest import check_single, open_dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_shared.validation.validate import validate

FLIGHT = {"start_altitude_m": 400, "end_altitude_m": 200, "downrange_m": 50}
KIND = {"n_scenes": 1, "trajectories_per_scene": 1, "n_frames": 2, "split_by": "trajectory", "flight": FLIGHT}
WIDE = {"position_in_body_m": [8.0, 0.5, -0.3], "turned_deg": [15, 3, 10]}
CONFIG = {
    "name": "stereo-test",
    "terrain": {"spacing_px": 2.0, "boulders": {"density": 0.0}},
    "render": {"exr": True, "engine": "heightfield", "samples": 1},
    "detect": KIND,
    "nav": {**KIND, "instruments": {"inertial_grades": [], "range_rate_hz": 2.0}},
    "cameras": {
        "nav": {"width_px": 96, "height_px": 96},
        "wide": {"width_px": 96, "height_px": 64, "horizontal_fov_deg": 70, "mounting": WIDE},
    },
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cameras")
    (folder / "own.yaml").write_text(json.dumps({"dataset": CONFIG}))
    options = ["--preset", "tiny", "--config", folder / "own.yaml", "--kind", "nav", "--workers", 0]
    done = in_process.call(main, "dataset", *options, "--out", folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def stereo(folder):
    return open_dataset(folder / "nav")


def extrinsics(dataset, name):
    record = dataset.info.cameras[name]
    return np.array(record.rotation_camera_from_body), np.array(record.position_in_body_m), record.intrinsics()


def instants(dataset):
    """The rows of both cameras for each instant."""
    frames = dataset.frames
    for index in sorted(set(frames["frame_index"])):
        own = frames[frames["frame_index"] == index].set_index("camera", drop=False)
        yield own.loc["nav"], own.loc["wide"]


def test_it_is_valid_and_each_frame_has_its_camera(stereo):
    assert validate(stereo) == []
    assert list(stereo.info.cameras) == ["nav", "wide"] and stereo.info.counts.frames == 4
    assert sorted(set(stereo.frames["trajectory_id"])) == ["nav-trajectory-0000", "wide-trajectory-0000"]
    assert dict(stereo.frames.groupby("camera")["height_px"].first()) == {"nav": 96, "wide": 64}
    assert set(stereo.table("ranges")["trajectory_id"].to_pylist()) == set(stereo.frames["trajectory_id"])


def test_depth_of_one_camera_projects_onto_the_same_ground_in_the_other(stereo):
    """Through the extrinsics alone: a point of the EXR of `nav` has the depth that the EXR of `wide` has there."""
    to_nav, at_nav, nav = extrinsics(stereo, "nav")
    to_wide, at_wide, wide = extrinsics(stereo, "wide")
    for first, second in instants(stereo):
        depth = read_exr(stereo.file(first["exr_path"]))["Z"]
        other = read_exr(stereo.file(second["exr_path"]))["Z"]
        points = (nav.rays(nav.pixel_centres()) * depth[..., None]).reshape(-1, 3)
        in_wide = ((points @ to_nav + at_nav) - at_wide) @ to_wide.T
        pixels = wide.project(in_wide)
        seen = wide.inside(pixels)
        assert seen.mean() > 0.5
        column, row = np.floor(pixels[seen]).astype(int).T
        # Half a pixel beside the place, ground of moderate slope differs little in depth.
        off = np.abs(other[row, column] - in_wide[seen, 2]) / in_wide[seen, 2]
        assert np.median(off) < 0.003 and np.quantile(off, 0.95) < 0.02


def test_label_centres_of_both_cameras_triangulate_the_crater(stereo):
    """An ellipse's centre is not the image of the circle's centre: the difference bounds the error."""
    labels, craters = stereo.labels, stereo.craters.set_index("crater_id")
    n_found = 0
    for first, second in instants(stereo):
        pair = [labels[labels["frame_id"] == row["frame_id"]].set_index("crater_id") for row in (first, second)]
        for crater in pair[0].index.intersection(pair[1].index):
            normal, moment = np.zeros((3, 3)), np.zeros(3)
            for row, own in zip((first, second), pair, strict=True):
                camera: Camera = stereo.camera_of(row)
                ray = camera.rays(own.loc[crater, ["ellipse_cx_px", "ellipse_cy_px"]].to_numpy(float))
                direction = matrix_from_quaternion(row["rotation_wxyz"]).T @ (ray / np.linalg.norm(ray))
                across = np.eye(3) - np.outer(direction, direction)
                normal, moment = normal + across, moment + across @ np.asarray(row["position_m"])
            place = np.linalg.solve(normal, moment)
            true = craters.loc[crater, ["x_m", "y_m", "z_m"]].to_numpy(float)
            height = first["position_m"][2]
            # A baseline of 8 m at 200 to 400 m: the depth is 25 to 50 times less exact than the place.
            assert np.abs(place - true)[:2].max() < 0.1 * craters.loc[crater, "diameter_m"] + 0.02 * height
            assert abs(place[2] - true[2]) < 0.15 * height
            n_found += 1
    assert n_found > 10


def test_noise_is_independent_and_the_manifest_gives_the_same_bytes(folder, stereo):
    done = in_process.call(main, "regenerate", "--manifest", folder / "nav", "--verify", "--all")
    assert done.returncode == 0 and "4 frames: 4 identical" in done.stdout
    again = folder / "again"
    done = in_process.call(main, "dataset", "--manifest", folder / "nav", "--out", again, "--workers", 0)
    assert done.returncode == 0 and "4 of 4 frames are byte-identical" in done.stdout
    for path in (folder / "nav").rglob("*"):
        if path.is_file():
            assert (again / path.relative_to(folder / "nav")).read_bytes() == path.read_bytes(), path


def test_a_subset_of_one_camera_is_an_ordinary_dataset(folder, stereo):
    with pytest.raises(UserError, match=r"subset .* --where .camera == 'nav'"):
        check_single(stereo)
    out = folder / "wide"
    done = in_process.call(manifest_main, "subset", folder / "nav", "--where", "camera == 'wide'", "--out", out)
    assert done.returncode == 0
    made = open_dataset(out)
    check_single(made)
    assert validate(made) == []
    assert made.info.cameras is None and made.info.camera == stereo.info.cameras["wide"]
    done = in_process.call(main, "regenerate", "--manifest", out, "--verify", "--all")
    assert "2 frames: 2 identical" in done.stdout


def test_wrong_extrinsics_are_a_fault(folder, tmp_path):
    shutil.copytree(folder / "nav", tmp_path / "odd")
    path = tmp_path / "odd/dataset.json"
    content = json.loads(path.read_text())
    content["cameras"]["wide"]["position_in_body_m"][0] += 1e-4
    path.write_text(json.dumps(content))
    faults = [fault for fault in validate(open_dataset(tmp_path / "odd")) if fault.column.startswith("position_m")]
    assert len(faults) == 1 and "mountings" in faults[0].expected


def test_developed_frames_of_both_cameras_keep_their_bytes(folder, stereo):
    done = in_process.call(main, "develop", "--dataset", folder / "nav", "--out", folder / "developed")
    assert done.returncode == 0, done.stderr
    made = open_dataset(folder / "developed")
    assert validate(made) == []
    assert made.frames["png_sha256"].tolist() == stereo.frames["png_sha256"].tolist()
