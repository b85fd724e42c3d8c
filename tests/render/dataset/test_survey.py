"""The command `survey`: images of a dataset's scenes from orbit, over the same ground."""

import numpy as np
import pytest
from tests.helpers import in_process

from perilune_render.cli.main import main
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.geometry.camera import camera_from_site
from perilune_shared.geometry.ellipse import project_circles
from perilune_shared.geometry.frames import matrix_from_quaternion


def survey(*arguments):
    return in_process.call(main, "survey", *arguments)


def test_the_ground_is_that_of_the_descents_under_another_sun(quick, quick_survey):
    descents, made = open_dataset(quick / "nav"), open_dataset(quick_survey)
    columns = ["content_sha256", "extent_m", "seed"]
    assert made.table("scenes", columns) == descents.table("scenes", columns)
    before, after = (
        one.table("scenes", ["sun_azimuth_deg", "sun_elevation_deg"]).to_pylist()[0] for one in (descents, made)
    )
    assert after["sun_elevation_deg"] == 30.0
    assert (after["sun_azimuth_deg"] - before["sun_azimuth_deg"]) % 360 == pytest.approx(90.0)
    assert made.table("craters") == descents.table("craters")


def test_both_images_show_the_site_from_either_side(quick_survey):
    made = open_dataset(quick_survey)
    camera, frames = made.info.camera.intrinsics(), made.table("frames").sort_by("frame_id").to_pylist()
    assert len(frames) == 2
    sides = [np.sign(row["position_m"][0]) for row in frames]
    assert sides == [-1, 1]
    axes = []
    for row in frames:
        rotation = matrix_from_quaternion(row["rotation_wxyz"])
        site = camera_from_site([[0.0, 0.0, 0.0]], row["position_m"], rotation)
        assert camera.inside(camera.project(site)).all()
        assert row["position_m"][2] == 4500
        axes.append(rotation[2])
    assert np.degrees(np.arccos(axes[0] @ axes[1])) == pytest.approx(30.0)


def test_labels_are_the_craters_as_the_camera_sees_them(quick_survey):
    made = open_dataset(quick_survey)
    row = made.table("frames").sort_by("frame_id").to_pylist()[1]
    labels = made.table("labels").to_pandas()
    labels = labels[labels["frame_id"] == row["frame_id"]]
    craters = made.table("craters").to_pandas().set_index("crater_id").loc[labels["crater_id"]]
    rotation = matrix_from_quaternion(row["rotation_wxyz"])
    centres = camera_from_site(craters[["x_m", "y_m", "z_m"]].to_numpy(), row["position_m"], rotation)
    normals = craters[["normal_x", "normal_y", "normal_z"]].to_numpy() @ rotation.T
    expected = project_circles(made.info.camera.intrinsics(), centres, normals, craters["diameter_m"].to_numpy() / 2)
    assert len(labels) > 100
    assert np.allclose(labels["ellipse_cx_px"], expected.cx_px, atol=1e-6)
    assert np.allclose(labels["ellipse_cy_px"], expected.cy_px, atol=1e-6)


def test_a_survey_is_resumed_and_rendered_again_from_its_manifest(quick, quick_survey, tmp_path):
    again = survey("--manifest", quick / "nav", "--out", quick_survey, "--pixel-m", 3, "--workers", 0)
    assert again.returncode == 0, again.stderr
    done = in_process.call(main, "dataset", "--manifest", quick_survey, "--out", tmp_path / "again", "--workers", 0)
    assert done.returncode == 0, done.stderr
    assert "2 of 2 frames are byte-identical" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--altitude-m", 40000], ["altitude_m", "40000", "at most"]),
        (["--pixel-m", 0.01], ["pixel_m", "0.01", "8192"]),
        (["--pixel-m", -1], ["pixel_m", "-1", "above 0"]),
        (["--sun-elevation-deg", 0], ["sun_elevation_deg", "0", "above 0"]),
        (["--convergence-deg", "nan"], ["convergence_deg", "nan"]),
    ],
)
def test_settings_that_cannot_be(quick, tmp_path, arguments, words):
    done = survey("--manifest", quick / "nav", "--out", tmp_path / "out", *arguments)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert all(word in done.stderr for word in words), done.stderr
    assert not (tmp_path / "out").exists()


def test_a_survey_of_a_survey_is_refused(quick_survey, tmp_path):
    done = survey("--manifest", quick_survey, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert "a survey" in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_preset_cannot_have_a_survey(tmp_path):
    done = in_process.call(
        main, "dataset", "--preset", "tiny", "--set", "dataset.survey.pixel_m=2", "--out", tmp_path / "out"
    )
    assert done.returncode == 2
    assert "perilune-render survey" in done.stderr
    assert not (tmp_path / "out").exists()
