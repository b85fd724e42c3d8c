"""Monte Carlo over a rendered dataset, from the command to its page."""

import shutil

import pandas as pd
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from tests.helpers import in_process

from perilune_train.cli.main import main


def monte_carlo(*arguments):
    return in_process.call(main, "navigate", "monte-carlo", *arguments)


@pytest.fixture(scope="module")
def drawn(quick, tmp_path_factory):
    """Folder of three draws of each descent, in this process."""
    out = tmp_path_factory.mktemp("draws") / "draws"
    done = monte_carlo("--dataset", quick / "nav", "--out", out, "--draws", 3, "--workers", 1)
    assert done.returncode == 0, done.stderr
    return out


@pytest.mark.slow
def test_two_workers_give_the_same_draws(drawn, quick, tmp_path):
    done = monte_carlo("--dataset", quick / "nav", "--out", tmp_path / "two", "--draws", 3, "--workers", 2)
    assert done.returncode == 0, done.stderr
    tables = [pd.read_parquet(out / "draws.parquet") for out in (drawn, tmp_path / "two")]
    pd.testing.assert_frame_equal(*tables)


def test_a_page_of_all_flights(drawn, quick):
    out = drawn
    rows = pd.read_parquet(out / "draws.parquet")
    assert sorted(rows["draw"].unique()) == [0, 1, 2]
    starts = rows.groupby(["trajectory_id", "draw"])["error_m"].first()
    assert starts.is_unique
    page = (out / "monte_carlo.md").read_text(encoding="utf-8")
    assert f"{len(starts)} flights, {len(rows)} frames" in page
    for name in ("errors.png", "consistency.png"):
        assert (out / name).stat().st_size > 10_000
        assert f"]({name})" in page
    again = monte_carlo("--dataset", quick / "nav", "--out", out)
    assert again.returncode == 2
    assert len(again.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--dataset", "nowhere"], ["nowhere", "no such file"]),
        (["--dataset", "nowhere", "--split", "tset"], ["--split", "tset", "one of train, val, test"]),
        (["--dataset", "nowhere", "--scenario", "outige"], ["--scenario", "outige", "outage"]),
    ],
)
def test_mistakes_get_one_line(tmp_path, arguments, words):
    done = monte_carlo(*arguments, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert all(word in done.stderr for word in words)
    assert not (tmp_path / "out").exists()


def test_descents_without_inertial_measurements_are_refused(quick, tmp_path):
    bare = shutil.copytree(quick / "nav", tmp_path / "nav")
    for part in (bare / "manifest" / "inertial").glob("*.parquet"):
        table = pq.read_table(part)
        pq.write_table(table.filter(pc.equal(table["grade"], "tactical")), part)
    done = monte_carlo("--dataset", bare, "--out", tmp_path / "out")
    assert done.returncode == 2
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("error")]
    assert "inertial" in line and "grade navigation" in line
    assert not (tmp_path / "out").exists()
