"""Covariances of the filter become covariances about the axes of the site; unfit files are refused in one line."""

import numpy as np
import pandas as pd
import pytest

from perilune_shared.dataset.metadata import CameraRecord
from perilune_shared.errors import UserError
from perilune_shared.export.estimates import read_estimates
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import matrix_from_rotation_vector, quaternion_from_matrix, rotation_vectors

RNG = np.random.default_rng(3)
MOUNTING = matrix_from_rotation_vector([2.0, 0.4, -0.3])
CAMERA = CameraRecord.of(Camera.from_field_of_view(64, 64, 40.0), MOUNTING)
SITE_FROM_BODY = matrix_from_rotation_vector([0.2, -0.5, 1.1])


def covariance_9() -> np.ndarray:
    """A covariance of position (m), velocity (m/s) and attitude (rad), with correlations."""
    mixed = RNG.standard_normal((9, 9)) * np.repeat([2.0, 0.1, 1e-3], 3)[:, None]
    return mixed @ mixed.T


def trace(covariance: np.ndarray, times=(0.0, 1.0)) -> pd.DataFrame:
    """The columns of the table `frames` of a trace that an export reads, and the other elements of the covariance."""
    pose = dict(zip(["x_m", "y_m", "z_m"], (10.0, -20.0, 300.0), strict=True))
    pose |= {f"rotation_{c}": v for c, v in zip("wxyz", quaternion_from_matrix(SITE_FROM_BODY), strict=True)}
    pose |= {f"covariance_{i}_{j}": covariance[i, j] for i in range(9) for j in range(i, 9)}
    return pd.DataFrame([{"time_s": time, "status": "tracking", **pose} for time in times])


def flight(sigmas_deg, times=(0.0, 1.0)) -> pd.DataFrame:
    camera_from_site = MOUNTING @ SITE_FROM_BODY.T
    row = dict(zip(["x_m", "y_m", "z_m"], (10.0, -20.0, 300.0), strict=True))
    row |= {f"rotation_{c}": v for c, v in zip("wxyz", quaternion_from_matrix(camera_from_site), strict=True)}
    row |= {f"sigma_{axis}_m": sigma for axis, sigma in zip("xyz", (1.0, 2.0, 0.5), strict=True)}
    row |= {f"sigma_attitude_{axis}_deg": sigma for axis, sigma in zip("xyz", sigmas_deg, strict=True)}
    return pd.DataFrame([{"time_s": time, **row} for time in times])


def test_the_covariance_of_a_trace_describes_rotations_about_the_axes_of_the_site(tmp_path):
    covariance = covariance_9()
    trace(covariance).to_parquet(tmp_path / "frames.parquet")
    found = read_estimates(tmp_path, CAMERA, 1.0)
    assert np.allclose(found.rotation_site_from_body, SITE_FROM_BODY) and found.time_s.tolist() == [0, 1]
    # The trace's attitude error acts from the right, about the body's axes: R_true = R exp(e).
    errors = RNG.multivariate_normal(np.zeros(9), covariance, size=20_000)
    true = np.array([SITE_FROM_BODY @ matrix_from_rotation_vector(e) for e in errors[:, 6:]])
    about_site = rotation_vectors(true @ SITE_FROM_BODY.T)
    drawn = np.cov(np.column_stack([errors[:, :3], about_site]).T)
    scale = np.sqrt(np.outer(np.diag(drawn), np.diag(drawn)))
    assert np.abs((found.covariance[0] - drawn) / scale).max() < 0.03
    assert np.allclose(found.covariance[0], found.covariance[0].T)


def test_the_standard_deviations_of_a_flight_are_about_the_axes_of_the_camera(tmp_path):
    sigmas = np.array([0.1, 0.3, 0.05])
    flight(sigmas).to_csv(tmp_path / "estimates.csv", index=False)
    found = read_estimates(tmp_path / "estimates.csv", CAMERA, 1.0)
    assert np.allclose(found.rotation_site_from_body, SITE_FROM_BODY)
    assert np.allclose(found.covariance[:, :3, :3], np.diag([1, 4, 0.25]))
    assert not found.covariance[:, :3, 3:].any()
    # R_true = exp(e) R with R = rotation_camera_from_site.
    camera_from_site = MOUNTING @ SITE_FROM_BODY.T
    errors = RNG.standard_normal((20_000, 3)) * np.radians(sigmas)
    true = np.array([(matrix_from_rotation_vector(e) @ camera_from_site).T @ MOUNTING for e in errors])
    drawn = np.cov(rotation_vectors(true @ SITE_FROM_BODY.T).T)
    scale = np.sqrt(np.outer(np.diag(drawn), np.diag(drawn)))
    assert np.abs((found.covariance[0, 3:, 3:] - drawn) / scale).max() < 0.03


def test_a_folder_without_a_table_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"estimates\.parquet: file: got no such file"):
        read_estimates(tmp_path, CAMERA, 1.0)


@pytest.mark.parametrize("share", [0.2, 0.9, 0.999])
def test_a_truncated_table_is_refused(tmp_path, share):
    path = tmp_path / "frames.parquet"
    trace(covariance_9(), np.arange(100.0)).to_parquet(path)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(UserError, match=r"frames\.parquet") as refused:
        read_estimates(path, CAMERA, 100.0)
    assert "\n" not in str(refused.value)


def test_a_truncated_row_of_text_is_refused(tmp_path):
    path = tmp_path / "frames.csv"
    trace(covariance_9(), np.arange(10.0)).to_csv(path, index=False)
    path.write_text(path.read_text()[:-200])
    with pytest.raises(UserError, match=r"frames\.csv:11"):
        read_estimates(path, CAMERA, 10.0)


@pytest.mark.parametrize(
    ("column", "value", "text"),
    [
        ("time_s", 7.0, "another descent"),
        ("time_s", 0.0, "above the time of the row before"),
        ("x_m", np.nan, "a finite number"),
        ("rotation_w", 5.0, "a unit quaternion"),
        ("covariance_0_0", -1.0, "at least 0"),
        ("covariance_0_6", np.inf, "a finite number"),
    ],
)
def test_values_out_of_range_are_refused(tmp_path, column, value, text):
    table = trace(covariance_9())
    table.loc[1, column] = value
    table.to_parquet(tmp_path / "frames.parquet")
    with pytest.raises(UserError, match=text):
        read_estimates(tmp_path, CAMERA, 1.0)


def test_a_table_of_another_kind_and_a_lever_arm_are_refused(tmp_path):
    trace(covariance_9()).drop(columns="covariance_6_8").to_parquet(tmp_path / "frames.parquet")
    with pytest.raises(UserError, match="no covariance_6_8"):
        read_estimates(tmp_path, CAMERA, 1.0)
    away = CAMERA.model_copy(update={"position_in_body_m": (1.0, 0.0, 0.0)})
    with pytest.raises(UserError, match="lever arm"):
        read_estimates(tmp_path, away, 1.0)
