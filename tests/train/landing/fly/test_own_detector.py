"""The filter with the craters of another detector: from a table, and from a function."""

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image
from tests.helpers import in_process
from tests.train.landing.fly.descent_files import TIMES_S, options, write_descent

import perilune
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_train.cli.main import main
from perilune_train.landing.fly.detections import by_function, by_table
from perilune_train.landing.fly.run import sightings_of

BOX = ["x0_px", "y0_px", "x1_px", "y1_px"]
RESULT = ["time_s", "status", "x_m", "y_m", "z_m", "n_matched"]


@pytest.fixture(scope="module")
def descent(quick, tmp_path_factory):
    """A descent of a dataset as files, and the boxes of its labels by frame, as a perfect detector would find them."""
    dataset = open_dataset(quick / "nav")
    row = dataset.trajectories.iloc[-1]
    ids, out = (row["scene_id"], row["trajectory_id"]), tmp_path_factory.mktemp("own") / "descent"
    words = ("--dataset", quick / "nav", "--trajectory", "/".join(ids), "--out", out, "--exact")
    done = in_process.call(main, "navigate", "descent", *words)
    assert done.returncode == 0, done.stderr
    frames = dataset.table("frames", ["frame_id", "time_s"], *ids).sort_by("time_s")["frame_id"].to_pylist()
    labels = dataset.table("labels", None, *ids).to_pandas()
    boxes = labels[[f"bbox_{name}" for name in BOX]].set_axis(BOX, axis=1).assign(score=0.9)
    boxes["image"] = [f"{frames.index(frame_id):04d}.png" for frame_id in labels["frame_id"]]
    assert len(boxes) > 20
    return out, boxes


def flown(descent, table, out, *more):
    words = [*options(descent, "catalogue.parquet"), "--detections", table, "--out", out, *more]
    return in_process.call(main, "navigate", "fly", *words)


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_table_and_a_function_that_find_the_labels_give_one_flight(descent, tmp_path, suffix):
    folder, boxes = descent
    table = tmp_path / f"found.{suffix}"
    # Columns that no one asked for are left aside.
    own = boxes.assign(radius_px=1.0).sample(frac=1, random_state=0)
    own.to_csv(table, index=False) if suffix == "csv" else own.to_parquet(table, index=False)
    done = flown(folder, table, tmp_path / "flight")
    assert done.returncode == 0, done.stderr
    by_file = pd.read_parquet(tmp_path / "flight" / "estimates.parquet")
    assert by_file["n_matched"].max() > 5 and "tracking" in set(by_file["status"])
    error = np.linalg.norm(by_file[["error_x_m", "error_y_m", "error_z_m"]], axis=1)
    sigma = np.linalg.norm(by_file[["sigma_x_m", "sigma_y_m", "sigma_z_m"]], axis=1)
    assert (error < 5 * sigma).all()

    seen = []

    def detect(image):
        assert image.dtype == np.uint8 and image.ndim == 2
        own = boxes[boxes["image"] == f"{len(seen):04d}.png"]
        seen.append(image.shape)
        x0, y0, x1, y1 = own[BOX].to_numpy().T
        return np.column_stack([(x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0, own["score"]])

    by_call = perilune.fly(folder, detector=detect, out=tmp_path / "again")
    assert len(seen) == len(by_call) == len(by_file)
    pd.testing.assert_frame_equal(by_call[RESULT], by_file[RESULT], atol=1e-3)
    assert sorted(path.name for path in (tmp_path / "again").iterdir()) == [
        "estimates.csv", "estimates.parquet", "flight.png",
    ]  # fmt: skip


def test_the_installed_detector_as_a_function_and_by_default(tmp_path):
    folder = write_descent(tmp_path / "descent")
    names = ("camera.yaml", "catalogue.csv", "imu.csv", "prior.yaml", "ranges.csv", "truth.csv")
    files = perilune.DescentFiles(str(folder / "frames"), *(str(folder / name) for name in names))
    by_default = perilune.fly(files)
    assert by_default["time_s"].tolist() == list(TIMES_S)
    by_call = perilune.fly(files, detector=perilune.load_detector())
    # The scores of a user's function are not checked, since they can mean anything, and it states no novelty.
    unlike = ["suspect", "novelty"]
    pd.testing.assert_frame_equal(by_call.drop(columns=unlike), by_default.drop(columns=unlike))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["descent"]


def test_a_table_and_a_run_exclude_each_other(descent, tmp_path):
    done = flown(descent[0], tmp_path / "found.csv", tmp_path / "flight", "--run", tmp_path)
    assert done.returncode == 2 and "--detections: options: got together with --run" in done.stderr


GOOD = {"image": ["0.png", "1.png"], "x0_px": 1.0, "y0_px": 2.0, "x1_px": 5.0, "y1_px": 6.0, "score": 0.5}
FRAMES = ["0.png", "1.png", "2.png"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": ["0.png", "other.png"]}, "image: row 1: got 'other.png', expected a frame of the descent"),
        ({"image": ["0.png", None]}, "image: row 1: got nothing"),
        ({"x0_px": [1.0, np.nan]}, "x0_px: row 1: got nothing, expected a number from"),
        ({"x0_px": [1.0, np.inf]}, "x0_px: row 1: got inf"),
        ({"y1_px": [6.0, 1e300]}, "y1_px: row 1: got 1e+300"),
        ({"x1_px": [5.0, -5.0]}, "x1_px: row 1: got -5.0, expected a number above x0_px"),
        ({"y1_px": [2.0, 6.0]}, "y1_px: row 0: got 2.0, expected a number above y0_px"),
        ({"score": [0.5, 1.5]}, "score: row 1: got 1.5, expected a number from 0 to 1"),
        (
            {"sigma_x_px": [0.2, 0.0], "sigma_y_px": 0.2},
            "sigma_x_px: row 1: got 0.0, expected a number above 0, up to 100",
        ),
        ({"sigma_x_px": 0.2, "sigma_y_px": [0.2, np.inf]}, "sigma_y_px: row 1: got inf"),
        ({"sigma_x_px": [0.2, np.nan], "sigma_y_px": 0.2}, "sigma_x_px: row 1: got nothing, expected both"),
        ({"sigma_y_px": 0.2}, "columns: got sigma_y_px alone, expected both of sigma_x_px, sigma_y_px, or neither"),
    ],
)
def test_a_wrong_value_in_a_table_is_refused(tmp_path, change, message):
    check_refused(tmp_path, pd.DataFrame(GOOD | change), message)


def test_predicted_deviations_of_a_table_reach_the_filter(tmp_path):
    path, frames = tmp_path / "found.parquet", [tmp_path / name for name in FRAMES]
    camera = Camera.from_field_of_view(64, 64, 45.0)
    table = pd.DataFrame(GOOD | {"sigma_x_px": [0.3, np.nan], "sigma_y_px": [0.4, np.nan]})
    table.to_parquet(path, index=False)
    detect = by_table(path, frames)
    first, second, none = (sightings_of(detect(frame), camera) for frame in frames)
    assert np.isclose(first.sigma_px[0], np.sqrt(0.125)) and len(none) == 0
    plain = sightings_of(by_function(lambda image: GOOD_ROW)(write_grey(tmp_path)), camera)
    assert plain.sigma_px is None
    # A row without a prediction has the deviations that follow from its radius and score.
    assert second.noise_px[0] == plain.noise_px[0] != first.noise_px[0]
    by_call = by_function(lambda image: table.head(1))(write_grey(tmp_path))
    np.testing.assert_array_equal(by_call.shapes[:, 1:3], [[0.3, 0.4]])
    # As `detect predict` writes it for a detector that predicts boxes only.
    table.assign(sigma_x_px=np.nan, sigma_y_px=np.nan).to_parquet(path, index=False)
    assert by_table(path, frames)(frames[0]).shapes is None


GOOD_ROW = [[3.0, 4.0, 4.0, 4.0, 0.5]]


def write_grey(folder):
    path = folder / "grey.png"
    Image.fromarray(np.zeros((64, 64), np.uint8)).save(path)
    return path


@pytest.mark.parametrize("name", ["image", "y0_px", "score"])
def test_a_table_without_a_column_or_without_rows_is_refused(tmp_path, name):
    table = pd.DataFrame(GOOD)
    check_refused(tmp_path, table.drop(columns=name), f"columns: got no {name}")
    check_refused(tmp_path, table.astype({"image": "string"})[:0], "rows: got 0")


def check_refused(folder, table, message):
    table.to_parquet(folder / "found.parquet", index=False)
    with pytest.raises(UserError) as raised:
        by_table(folder / "found.parquet", [folder / name for name in FRAMES])
    assert message in str(raised.value) and "\n" not in str(raised.value)


def test_frames_of_one_name_are_refused(tmp_path):
    pd.DataFrame(GOOD).to_parquet(tmp_path / "found.parquet", index=False)
    frames = [tmp_path / "a" / "0.png", tmp_path / "b" / "0.png"]
    with pytest.raises(UserError, match=r"got two frames named 0.png"):
        by_table(tmp_path / "found.parquet", frames)


@pytest.mark.slow
def test_too_many_rows_are_refused(tmp_path):
    many = 10_000_001
    column = pa.array(np.zeros(many, np.float32))
    arrays = {"image": pa.array(["0.png"]).take(pa.array(np.zeros(many, np.int32))).dictionary_encode()}
    arrays |= {name: column for name in ("x0_px", "y0_px", "score")}
    arrays |= {name: pa.array(np.ones(many, np.float32)) for name in ("x1_px", "y1_px")}
    pq.write_table(pa.table(arrays), tmp_path / "many.parquet", use_dictionary=False, compression="none")
    with pytest.raises(UserError, match=r"0.png: got 10000001 craters, expected at most 10000 in a frame"):
        by_table(tmp_path / "many.parquet", [tmp_path / "0.png"])


@pytest.mark.parametrize(
    ("found", "message"),
    [
        (None, "got a NoneType, expected an array (N, 5) of x, y, width, height, score, or a table"),
        ("craters", "got a str"),
        ([[1, 2, 3, 4]], "got an array of shape (1, 4)"),
        ([1.0, 2.0, 3.0, 4.0, 0.5], "got an array of shape (5,)"),
        ([[1, 2, 3, 4, 0.5], [1, 2, 3]], "got a list"),
        ([[1, 2, np.nan, 4, 0.5]], "row 0: got x 1, y 2, width nan, height 4, score 0.5, expected finite numbers"),
        ([[1e9, 2, 3, 4, 0.5]], "expected finite numbers up to 1000000"),
        ([[1, 2, 3, 4, 0.5], [1, 2, -3, 4, 0.5]], "row 1: got x 1, y 2, width -3, height 4, score 0.5, expected a box"),
        ([[1, 2, 3, 4, 7]], "expected a score from 0 to 1"),
        (np.ones((10_001, 5)), "got 10001 craters, expected at most 10000 in a frame"),
        (pd.DataFrame({"x0_px": [1.0]}), "got a table without y0_px"),
        (
            pd.DataFrame([[1, 2, 5, 6, 0.5, 0.2, -1]], columns=[*BOX, "score", "sigma_x_px", "sigma_y_px"]),
            "row 0: got sigma_x_px 0.2, sigma_y_px -1, expected both empty, or each a number above 0, up to 100",
        ),
        (pd.DataFrame([["a"] * 5], columns=[*BOX, "score"]), "got a DataFrame"),
    ],
)
def test_a_wrong_answer_of_a_function_is_refused(tmp_path, found, message):
    folder = write_descent(tmp_path / "descent")
    (folder / "catalogue.csv").rename(folder / "catalogue.parquet")
    with pytest.raises(UserError) as raised:
        perilune.fly(folder, detector=lambda image: found, out=tmp_path / "flight")
    assert str(raised.value).startswith("detector: 0.png") and message in str(raised.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["descent"]


@pytest.mark.parametrize("found", [[], np.zeros((0, 5)), np.zeros((0, 4)), pd.DataFrame(columns=[*BOX, "score"])])
def test_no_crater_in_an_image(tmp_path, found):
    image = write_descent(tmp_path / "descent") / "frames" / "0.png"
    assert len(by_function(lambda image: found)(image).scores) == 0


def test_a_function_is_needed_and_its_own_errors_are_not_hidden(tmp_path):
    folder = write_descent(tmp_path / "descent")
    (folder / "catalogue.csv").rename(folder / "catalogue.parquet")
    with pytest.raises(UserError, match="fly: detector: got str, expected a function of an image"):
        perilune.fly(folder, detector="yolo")
    with pytest.raises(ZeroDivisionError):
        perilune.fly(folder, detector=lambda image: 1 / 0)


def test_a_frame_that_cannot_be_decoded_is_flown_over_without_a_call(tmp_path):
    folder = write_descent(tmp_path / "descent")
    (folder / "catalogue.csv").rename(folder / "catalogue.parquet")
    image = folder / "frames" / "1.png"
    image.write_bytes(image.read_bytes()[:2000])
    calls = []
    table = perilune.fly(folder, detector=lambda image: calls.append(image) or [])
    assert len(calls) == 2 and "1.png" in table["fault"][1]
