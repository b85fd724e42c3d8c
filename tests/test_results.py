"""docs/results.md and README.md have the figures of the records in results/, and each record says how it was made."""

import json
import subprocess
from dataclasses import asdict
from pathlib import Path

import pytest
from scripts import results

from perilune_shared.errors import UserError
from perilune_shared.run_record import run_record

ROWS, RECORDS = results.read_rows(), results.read_records()
FIGURES = {"mean_px": 0.25, "parts": {"a": 1}}


def git(*arguments: str) -> str:
    command = ["git", "-C", str(results.ROOT), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def written(folder: Path, **changes: str) -> Path:
    """A file as a benchmark of the current commit writes it, with changes to the record of its run."""
    made = {**asdict(run_record()), "commit": git("rev-parse", "HEAD").strip(), "command": "make it", **changes}
    path = folder / "bench/sizes.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**FIGURES, "run": made}))
    return path


@pytest.mark.parametrize("page", results.PAGES, ids=lambda page: page.name)
def test_the_pages_agree_with_the_records(page):
    text = page.read_text(encoding="utf-8")
    table = results.table(results.PAGES[page], ROWS, RECORDS)
    assert results.with_table(text, table) == text, "run `make results`"


def test_a_changed_figure_changes_the_tables():
    """Of every row with a figure, so that the test above would notice."""
    before = results.table(False, ROWS, RECORDS)
    for row in ROWS:
        if row.record:
            records = {name: record.model_copy(deep=True) for name, record in RECORDS.items()}
            near = results.enclosing_table(row, records)
            near[row.keys[-1]] = 2 * near[row.keys[-1]] or 1  # also a figure of 0
            assert results.table(False, ROWS, records) != before, row.metric


def test_every_record_is_shown():
    assert set(RECORDS) == {row.record for row in ROWS if row.record}
    assert sum(row.readme for row in ROWS) == 8


@pytest.mark.parametrize("name", RECORDS)
def test_the_commit_of_a_record_is_in_the_history(name):
    if "true" in git("rev-parse", "--is-shallow-repository"):
        pytest.skip("this clone has no history")
    record = RECORDS[name]
    assert results.is_ancestor(record.commit)
    if record.transcribed:
        page, commit = record.source.removeprefix("transcribed from ").split(" at ")
        text = git("show", f"{commit}:{page}")
        assert record.quotes and all(quote in text for quote in record.quotes)


def test_a_benchmark_becomes_a_record(tmp_path):
    path = written(tmp_path)
    results.record([path], tmp_path)
    found = results.Record.model_validate_json((tmp_path / "sizes.json").read_text())
    assert found.figures == FIGURES and found.command == "make it" and not found.transcribed
    assert found.source == "bench/sizes.json" and found.commit == git("rev-parse", "HEAD").strip()


def test_a_run_becomes_a_record(tmp_path):
    path = tmp_path / "detect/small/metrics.json"
    path.parent.mkdir(parents=True)
    made = json.loads(written(tmp_path).read_text())["run"]
    path.write_text(json.dumps({"test/f1": 0.5, **{f"run/{k}": v for k, v in made.items()}, "run/gpu": "A GPU"}))
    results.record([path], tmp_path)
    found = results.Record.model_validate_json((tmp_path / "detect-small.json").read_text())
    assert found.figures == {"test/f1": 0.5} and found.hardware.endswith(", A GPU")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"commit": "0" * 40}, "expected a commit of this branch"),
        ({"commit": "a" * 40 + " modified"}, "with committed code"),
        ({"commit": "unknown"}, "with committed code"),
        ({"command": "make it OUT=/home/me/out"}, "expected paths relative to the repository"),
    ],
)
def test_what_others_cannot_measure_again_is_refused(tmp_path, changes, message):
    with pytest.raises(UserError, match=message):
        results.record([written(tmp_path, **changes)], tmp_path)
    assert not (tmp_path / "sizes.json").exists()


def test_figures_without_a_record_of_the_run_are_refused(tmp_path):
    path = written(tmp_path)
    path.write_text(json.dumps(FIGURES))
    with pytest.raises(UserError, match="got no commit, hardware and command"):
        results.record([path], tmp_path)


def test_a_row_has_a_figure_or_a_reason():
    for fields in ({}, {"record": "a", "keys": ["b"], "not_measured": "it broke"}, {"record": "a"}):
        with pytest.raises(ValueError, match="both or neither"):
            results.Row(metric="m", **fields)


def test_goals_and_intervals():
    record = RECORDS["train"].model_copy(update={"figures": {"x": 0.5, "x_low": 0.4, "x_high": 0.6}})
    for bound, reported in (("at_most", "≤ 0.45 px, missed"), ("at_least", "≥ 0.45 px")):
        row = results.Row(metric="m", record="r", keys=("x",), unit="px", **{bound: 0.45})
        assert results.goal(row, {"r": record}) == reported
        assert results.interval(row, {"r": record}) == "0.4 px to 0.6 px"
