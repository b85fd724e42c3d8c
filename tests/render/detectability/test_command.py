"""The command `detectability`: a table of d', resumable, with one-line errors."""

import json

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from tests.helpers import in_process

from perilune_render.cli.main import main
from perilune_render.detectability import measure
from perilune_shared.dataset.manifest import open_dataset


def detectability(dataset, out, *more):
    arguments = ["--dataset", dataset, "--split", "test", "--out", out, "--frames-per-trajectory", 2]
    return in_process.call(main, "detectability", *arguments, *more)


@pytest.fixture(scope="module")
def table(quick, tmp_path_factory):
    out = tmp_path_factory.mktemp("detectability") / "d.parquet"
    done = detectability(quick / "detect", out)
    assert done.returncode == 0, done.stderr
    assert "labels in 2 frames" in done.stdout
    assert [path.name for path in out.parent.iterdir()] == ["d.parquet"]
    return out


def test_the_table_has_a_row_for_each_label(quick, table):
    rows = pd.read_parquet(table)
    labels = open_dataset(quick / "detect").labels
    names = sorted(rows["frame_id"].unique())
    labels = labels[labels["frame_id"].isin(names)]
    assert len(names) == 2
    assert len(rows) == len(labels) > 50
    joined = rows.merge(labels, on=["frame_id", "crater_id"], validate="one_to_one")
    assert len(joined) == len(rows)
    assert np.isfinite(rows[["d_prime", "signal_energy", "clutter_sigma", "noise_sigma"]]).all(axis=None)
    assert (rows["noise_sigma"] > 0.28).all()
    # Both describe how distinct a crater is in the same frame.
    assert joined[["d_prime", "contrast"]].corr("spearman").iloc[0, 1] > 0.5


def test_a_stopped_measurement_resumes_with_its_parts(quick, table, tmp_path, monkeypatch):
    out, work = tmp_path / "d.parquet", measure._SceneWork.measured
    calls = []

    def stop_at_the_third(self, batch, rows):
        calls.append(len(batch))
        if len(calls) == 3:
            raise KeyboardInterrupt
        return work(self, batch, rows)

    monkeypatch.setattr(measure._SceneWork, "measured", stop_at_the_third)
    assert detectability(quick / "detect", out).returncode != 0
    assert not out.exists()
    parts = tmp_path / "d.parquet.parts"
    assert len(list(parts.glob("*.parquet"))) == 2
    monkeypatch.setattr(measure._SceneWork, "measured", work)
    done = detectability(quick / "detect", out)
    assert done.returncode == 0, done.stderr
    assert pq.read_table(out).equals(pq.read_table(table))
    assert not parts.exists()


def test_parts_of_another_measurement_are_refused(quick, tmp_path):
    parts = tmp_path / "d.parquet.parts"
    parts.mkdir()
    (parts / "work.json").write_text(json.dumps({"version": 0}))
    done = detectability(quick / "detect", tmp_path / "d.parquet")
    assert done.returncode == 2
    assert "parts of another measurement" in done.stderr


@pytest.mark.parametrize(("name", "found"), [("d.csv", ".csv"), ("d", "none")])
def test_another_format_is_refused(quick, tmp_path, name, found):
    done = detectability(quick / "detect", tmp_path / name)
    assert done.returncode == 2
    assert f"format: got {found}, expected .parquet" in done.stderr


def test_an_existing_file_is_not_replaced(quick, tmp_path):
    (tmp_path / "d.parquet").write_text("mine")
    done = detectability(quick / "detect", tmp_path / "d.parquet")
    assert done.returncode == 2
    assert (tmp_path / "d.parquet").read_text() == "mine"


def change_labels(dataset, change):
    """Change the rows of the labels of the test scene."""
    for path in (dataset / "manifest" / "labels").glob("*.parquet"):
        rows = pq.read_table(path)
        if "test" in rows["split"].to_pylist():
            pq.write_table(change(rows), path)


def replaced(rows, name, values):
    at = rows.schema.get_field_index(name)
    return rows.set_column(at, rows.schema.field(at), pa.array(values, rows.schema.field(at).type))


def test_an_ellipse_that_is_not_finite_is_refused(quick_detect, tmp_path):
    def spoil(rows):
        return replaced(rows, "ellipse_a_px", [float("nan")] * len(rows))

    change_labels(quick_detect, spoil)
    done = detectability(quick_detect, tmp_path / "d.parquet")
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.glob("d.parquet*"))


def test_another_ground_is_refused(quick_detect, tmp_path):
    path = next((quick_detect / "manifest" / "scenes").glob("*.parquet"))
    for path in (quick_detect / "manifest" / "scenes").glob("*.parquet"):
        rows = pq.read_table(path)
        pq.write_table(replaced(rows, "content_sha256", ["0" * 64] * len(rows)), path)
    done = detectability(quick_detect, tmp_path / "d.parquet")
    assert done.returncode == 2
    assert "the terrain hash in the dataset" in done.stderr.replace("\n", " ")
    assert not list(tmp_path.glob("d.parquet*"))
