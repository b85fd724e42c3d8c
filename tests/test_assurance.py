"""docs/reference/assurance.md has the figures of the records, and says what is open."""

import re

import pytest
from scripts import assurance, results

from tests.test_command_lines import COMMANDS

ASSURANCE, HEADLINE, RECORDS = assurance.read_requirements(), results.read_headline(), results.read_records()
ROWS = {row.metric: row for table in HEADLINE.table for row in table.row}
REQUIREMENTS = [one for topic in ASSURANCE.topic for one in topic.requirement]
EVIDENCE = [(each.row or ROWS[each.headline], each) for one in REQUIREMENTS for each in one.evidence]


def text_with(records):
    return assurance.assurance_text(ASSURANCE, HEADLINE, records)


def line_of(text, row):
    """The line of the table with the figure of a row."""
    (line,) = [line for line in text.splitlines() if f"| {row.metric} |" in line]
    return line


def test_the_page_agrees_with_the_records():
    page = assurance.PAGE.read_text(encoding="utf-8")
    assert assurance.with_text(page, text_with(RECORDS)) == page, "run `make assurance`"


def test_most_requirements_have_a_figure_and_some_are_missed_or_open():
    lines = [line_of(text_with(RECORDS), row) for row, _ in EVIDENCE]
    assert sum("results/" in line for line in lines) > 30
    assert any("**missed**" in line for line in lines) and any("**open**" in line for line in lines)


@pytest.mark.parametrize("row", [row for row, _ in EVIDENCE], ids=lambda row: row.metric)
def test_a_changed_record_changes_the_page_and_a_missing_record_is_open(row):
    text = text_with(RECORDS)
    if "**open**" in line_of(text, row):
        return
    records = {name: record.model_copy(deep=True) for name, record in RECORDS.items()}
    keys = results.keys_of_figure(row, records)
    near = results.enclosing_table(row.record, keys, records)
    # Less favourable, so that it is also the figure of a row of groups; 1 in place of 0.
    near[keys[-1]] = near[keys[-1]] * (0.5 if row.at_least is not None else 2) or 1
    assert line_of(text_with(records), row) != line_of(text, row)
    del near[keys[-1]]
    assert "**open**" in line_of(text_with(records), row)
    del records[row.record]
    line = line_of(text_with(records), row)
    assert "**open**" in line and "results/" not in line


def test_a_new_record_closes_an_open_row():
    row = next(row for row, _ in EVIDENCE if row.record == "robust")
    assert "**open**" in line_of(text_with(RECORDS), row)
    figures = {"frames": 224, "variations": {row.keys[1]: {"ap50_paper": 0.5}}}
    robust = RECORDS["labels"].model_copy(update={"figures": figures})
    line = line_of(text_with(RECORDS | {"robust": robust}), row)
    assert "[0.500](../../results/robust.json)" in line and "**missed**" in line and "224 frames" in line


@pytest.mark.parametrize("command", sorted({each.command for _, each in EVIDENCE}))
def test_every_figure_has_a_command_that_exists(command):
    if command.startswith("make "):
        makefile = (results.ROOT / "Makefile").read_text(encoding="utf-8")
        assert re.search(rf"^{re.escape(command.removeprefix('make '))}:", makefile, re.MULTILINE)
    else:
        assert command in dict(COMMANDS)


def test_measured_figures_are_in_records_only():
    for one in REQUIREMENTS:
        for text in (one.text, one.open, one.described):
            assert not re.search(r"\d\.\d|\d\s*%", re.sub(r"\]\([^)]*\)", "]", text)), one.id


def test_every_requirement_says_what_is_open_and_has_its_own_id():
    assert all(one.open for one in REQUIREMENTS)
    assert len({one.id for one in REQUIREMENTS}) == len(REQUIREMENTS)
    text = text_with(RECORDS)
    assert all(f"- **{one.id}**: {one.open}" in text and f"| {one.id} {one.text} |" in text for one in REQUIREMENTS)


def test_evidence_needs_one_source():
    with pytest.raises(ValueError, match="make x: got headline '' and row None, expected one of them"):
        assurance.Evidence(command="make x")
