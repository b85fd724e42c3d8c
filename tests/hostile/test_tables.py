"""Short tables that state gigabytes, and text that never ends: refused in one line and bounded memory."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from perilune_render.cli.main import main as render
from perilune_shared.storage.tables import parquet  # noqa: F401 (else its import counts as memory)
from perilune_train.cli.main import main as train
from perilune_train.landing.fly import run  # noqa: F401
from tests.helpers.elevation_models import PLACED, POLAR, rough, write
from tests.hostile.measured import accepted, refused
from tests.train.landing.fly.descent_files import options, write_descent

WORD = "x" * 1_000_000
MB = 150.0
"""Most memory beyond the program's own, MB."""


def repeated(path, n_rows, columns, **options):
    """Write a Parquet file whose columns repeat one value: a few kilobytes for any number of rows."""
    arrays = {}
    for name, value in columns.items():
        kind = pa.array([value]).type
        if pa.types.is_string(kind):
            arrays[name] = pa.DictionaryArray.from_arrays(pa.array(np.zeros(n_rows, np.int32)), pa.array([value]))
        else:
            arrays[name] = pa.array(np.full(n_rows, value))
    pq.write_table(pa.table(arrays), path, compression="zstd", row_group_size=n_rows, **options)
    assert path.stat().st_size < 500_000
    return path


def lying(path, n_rows, columns):
    """Like `repeated`, with many row groups, each below the limit of rows."""
    table = pa.table({name: pa.array(np.full(100_000, value)) for name, value in columns.items()})
    with pq.ParquetWriter(path, table.schema, compression="zstd") as writer:
        for _ in range(n_rows // len(table)):
            writer.write_table(table)
    return path


CATALOGUE = {"longitude_deg": 1.0, "latitude_deg": -89.0, "diameter_m": 50.0}
SITE_FRAME = {"x_m": 1.0, "y_m": 1.0, "z_m": 1.0, "diameter_m": 5.0}
CURVE = {"score": 0.5, "precision": 0.5, "recall": 0.5}


def _gigabytes_of_numbers(folder, columns):
    return repeated(folder / "table.parquet", 8_000_000, columns), "rows"


def _many_row_groups(folder, columns):
    return lying(folder / "table.parquet", 6_000_000, columns), "rows"


def _text_for_numbers(folder, columns):
    return repeated(folder / "table.parquet", 150_000, dict.fromkeys(columns, WORD)), "numbers"


def _endless_line(folder, columns):
    path = folder / "table.csv"
    path.write_text(",".join(columns) + "\n" + "1," * 10_000_000)
    return path, "65536"


def _endless_quote(folder, columns):
    path = folder / "table.csv"
    path.write_text(",".join(columns) + '\n"' + "1,2\n" * 5_000_000)
    return path, "a closing quote may be missing"


def _many_columns(folder, columns):
    path = folder / "table.csv"
    path.write_text(",".join([*columns, *("c" * 30_000)]) + "\n")
    return path, "at most 1000"


def _nested_schema(folder, columns):
    """Lists in lists: a reader that builds the type recursively needs a stack for each."""
    kind = pa.float64()
    for _ in range(900):
        kind = pa.list_(kind)
    path = folder / "table.parquet"
    table = pa.table({name: pa.nulls(3, kind) for name in columns})
    pq.write_table(table, path, store_schema=False)
    return path, "table.parquet"


SHORT = [_gigabytes_of_numbers, _many_row_groups, _text_for_numbers, _endless_line, _endless_quote, _many_columns]
SHORT += [_nested_schema]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return write(tmp_path_factory.mktemp("model") / "model.tif", rough(), POLAR, PLACED)


@pytest.fixture(scope="module")
def descent(tmp_path_factory):
    return write_descent(tmp_path_factory.mktemp("files") / "descent")


@pytest.mark.parametrize("make", SHORT, ids=lambda make: make.__name__[1:])
def test_catalogues_of_an_elevation_model(tmp_path, model, make):
    path, naming = make(tmp_path, CATALOGUE)
    words = ("plan", "--preset", "tiny", "--dem", model, "--catalogue", path, "--out", tmp_path / "plan")
    refused(f"catalogue: {make.__name__}", render, *words, naming=naming, folder=tmp_path, memory_mb=MB)


@pytest.mark.parametrize("make", SHORT, ids=lambda make: make.__name__[1:])
def test_catalogues_of_a_descent(tmp_path, descent, make):
    path, naming = make(tmp_path, SITE_FRAME)
    words = ("navigate", "fly", *options(descent), "--catalogue", path, "--out", tmp_path / "flight")
    refused(f"fly: {make.__name__}", train, *words, naming=naming, folder=tmp_path, memory_mb=MB)


@pytest.mark.parametrize("make", [_gigabytes_of_numbers, _many_row_groups, _text_for_numbers, _nested_schema])
def test_curves_of_runs(tmp_path, make):
    path, naming = make(tmp_path, CURVE)
    folder = tmp_path / "run"
    folder.mkdir()
    path.rename(folder / "precision_recall.parquet")
    (folder / "metrics.json").write_text('{"ap50_paper": 0.5, "terrain/status": "disjoint", "terrain/mark": ""}')
    words = ("detect", "compare", folder, folder, "--out", tmp_path / "out")
    naming = naming.replace("table.parquet", "precision_recall.parquet")
    refused(f"compare: {make.__name__}", train, *words, naming=naming, folder=tmp_path, memory_mb=MB)


def test_columns_that_no_command_knows_may_contain_anything(tmp_path, descent):
    """A catalogue with a column of 150 GB of text is read without it."""
    rng = np.random.default_rng(1)
    table = pa.table({name: rng.uniform(1, 400, 150_000) for name in SITE_FRAME})
    word = pa.DictionaryArray.from_arrays(pa.array(np.zeros(len(table), np.int32)), pa.array([WORD]))
    path = tmp_path / "catalogue.parquet"
    pq.write_table(table.append_column("name", word), path, compression="zstd")
    words = (*options(descent), "--catalogue", path, "--out", tmp_path / "flight")
    accepted("a column of text beside", train, "navigate", "fly", *words, folder=tmp_path, memory_mb=1500)
