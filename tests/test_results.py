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
def test_the_sources_of_a_record_are_those_of_its_commit(name):
    """Where this clone has the commit: a shallow or squashed one has the hashes alone."""
    record = RECORDS[name]
    assert results.sources_of(record.commit) in (record.sources, None)
    if record.transcribed:
        page, commit = record.source.removeprefix("transcribed from ").split(" at ")
        assert record.quotes
        if results.sources_of(commit) is not None:
            text = git("show", f"{commit}:{page}")
            assert all(quote in text for quote in record.quotes)


def test_hashes_of_sources_outlive_a_squash(tmp_path):
    """The commit is gone from the squashed clone; the same files have the same hashes there."""
    whole, squashed = tmp_path / "whole", tmp_path / "squashed"
    for folder in results.SOURCES:
        (whole / folder).mkdir(parents=True)
        (whole / folder / "code.py").write_text(f"# {folder}\n")

    def run(repository: Path, *arguments: str) -> str:
        identity = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
        command = ["git", "-C", str(repository), *identity, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    run(tmp_path, "init", "-q", str(whole))
    commits = []
    for message in ("first", "second"):
        (whole / "page.md").write_text(message)
        run(whole, "add", ".")
        run(whole, "commit", "-q", "-m", message)
        commits.append(run(whole, "rev-parse", "HEAD"))
    run(tmp_path, "clone", "-q", "--depth", "1", whole.as_uri(), str(squashed))
    sources = results.sources_of(commits[0], whole)
    assert sources is not None and len(set(sources.values())) == len(results.SOURCES)
    assert results.sources_of(commits[0], squashed) is None
    assert results.sources_of("HEAD", squashed) == sources
    (whole / "render/code.py").write_text("other")
    run(whole, "commit", "-q", "-a", "-m", "third")
    assert results.sources_of("HEAD", whole) == {**sources, "render": results.sources_of("HEAD", whole)["render"]}
    assert results.sources_of("HEAD", whole) != sources


def test_a_record_without_the_hash_of_a_folder_is_refused():
    content = RECORDS["train"].model_dump()
    del content["sources"]["render"]
    with pytest.raises(ValueError, match="got hashes of shared, train"):
        results.Record.model_validate(content)


def test_a_benchmark_becomes_a_record(tmp_path):
    path = written(tmp_path)
    results.record([path], tmp_path)
    found = results.Record.model_validate_json((tmp_path / "sizes.json").read_text())
    assert found.figures == FIGURES and found.command == "make it" and not found.transcribed
    assert found.source == "bench/sizes.json" and found.commit == git("rev-parse", "HEAD").strip()
    assert found.sources["render"] == git("rev-parse", "HEAD:render").strip()


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
        ({"commit": "0" * 40}, "expected a commit of this repository"),
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
