"""docs/results.md and README.md have the figures of the records in results/, and each record says how it was made."""

import fnmatch
import json
import re
import subprocess
from dataclasses import asdict
from pathlib import Path

import pytest
from scripts import results

from perilune_shared.errors import UserError
from perilune_shared.run_record import run_record

HEADLINE, RECORDS = results.read_headline(), results.read_records()
ROWS = [row for table in HEADLINE.table for row in table.row]
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


@pytest.mark.parametrize("page", [results.RESULTS_PAGE, results.README], ids=lambda page: page.name)
def test_the_pages_agree_with_the_records(page):
    text = page.read_text(encoding="utf-8")
    assert results.with_text(text, results.generated_texts(HEADLINE, RECORDS)[page]) == text, "run `make results`"


@pytest.mark.parametrize("row", [*ROWS, *HEADLINE.strength], ids=lambda row: getattr(row, "metric", "strength"))
def test_a_changed_figure_changes_the_pages(row):
    """Of every row and sentence, so that the test above would notice."""
    records = {name: record.model_copy(deep=True) for name, record in RECORDS.items()}
    keys = results.keys_of_figure(row, records)
    near = results.enclosing_table(row.record, keys, records)
    # Less favourable, so that it is also the figure of a row of groups; 1 in place of 0.
    near[keys[-1]] *= 0.5 if getattr(row, "at_least", None) is not None else 2
    near[keys[-1]] = near[keys[-1]] or 1
    page = results.README if isinstance(row, results.Strength) else results.RESULTS_PAGE
    assert results.generated_texts(HEADLINE, records)[page] != results.generated_texts(HEADLINE, RECORDS)[page]


def test_every_record_is_in_a_table_or_described_on_a_page():
    """A record that nobody can find is deleted, or gets its place."""
    pages = "".join(page.read_text(encoding="utf-8") for page in (results.ROOT / "docs").rglob("*.md"))
    described = {re.sub(r"^results/|\.json$", "", name) for name in re.findall(r"`([\w./*-]+\.json)`", pages)}
    shown = {row.record for row in (*ROWS, *HEADLINE.strength)}
    lost = [n for n in RECORDS if n not in shown and not any(fnmatch.fnmatch(n, each) for each in described if each)]
    assert lost == []


def test_the_readme_has_three_strengths_and_no_table():
    assert len(HEADLINE.strength) == 3
    assert not re.search(r"^\|", results.README.read_text(encoding="utf-8"), re.MULTILINE)


def test_a_row_stands_alone():
    """Its name can be read without the row above and without a scoring rule's private name."""
    wrong = [row.metric for row in ROWS if re.search(r"\b(the same|account)\b", row.metric, re.IGNORECASE)]
    assert wrong == []


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


@pytest.mark.parametrize(
    ("goals", "message"),
    [
        ({"at_most": 1, "at_least": 0}, "expected one goal at most"),
        ({"groups": ["a", "b"]}, "got groups without a goal"),
    ],
)
def test_a_row_has_one_goal_at_most_and_groups_need_one(goals, message):
    with pytest.raises(ValueError, match=message):
        results.Row(metric="m", record="r", keys=("x",), **goals)


def record_of(**figures: object) -> dict[str, results.Record]:
    return {"r": RECORDS["train"].model_copy(update={"figures": figures})}


@pytest.mark.parametrize(
    ("bound", "cells"),
    [("at_most", ("≤\u00a00.45\u00a0px", "**missed**")), ("at_least", ("≥\u00a00.45\u00a0px", "met"))],
)
def test_goals_and_intervals(bound, cells):
    records = record_of(x=0.5, x_low=0.4, x_high=0.6)
    row = results.Row(metric="m", record="r", keys=("x",), unit="px", **{bound: 0.45})
    assert results.goal_and_status(row, records) == cells
    assert results.interval(row, records) == "0.40 to 0.60" and results.value(row, records) == "0.50\u00a0px"


def test_a_row_without_a_goal_says_so():
    row = results.Row(metric="m", record="r", keys=("x",))
    assert results.goal_and_status(row, record_of(x=1)) == ("—", "no goal")


@pytest.mark.parametrize(("bound", "expected"), [("at_most", 0.9), ("at_least", 0.2)])
def test_a_row_of_groups_has_the_least_favourable_one(bound, expected):
    records = record_of(**{"region/a/x": 0.9, "region/b/x": 0.5, "region/c/x": 0.2})
    row = results.Row(metric="m", record="r", keys=("region/{group}/x",), groups=("a", "b", "c"), **{bound: 0.5})
    assert results.figure(row, records) == expected
    assert results.goal_and_status(row, records)[1] == "**missed**"


@pytest.mark.parametrize(
    ("number", "digits", "text"),
    [
        (0.00476, 1, "0.005"),
        (0.87044, 3, "0.870"),
        (597.5, 2, "600"),
        (0.9999, 2, "1.0"),
        (30.0, 2, "30"),
        (0.0, 2, "0"),
    ],
)
def test_significant_digits(number, digits, text):
    assert results.formatted(number, digits) == text
