"""Write the table for a mission's reviewer, docs/reference/assurance.md, from the records.

    python -m scripts.assurance

`make assurance` runs this program. results/assurance.toml has the requirements by topic. It names a record and a key
for each figure, or a row of results/headline.toml. Figures, intervals, numbers of units and commits come from the
records. A figure whose record or key does not exist is shown as open. tests/test_assurance.py fails if the page and the
records do not agree.
"""

import tomllib
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # An import by another module must not change how Ctrl-C works.
    end_at_interrupt()

from pydantic import BaseModel, ConfigDict, Field, model_validator
from scripts import results

from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.storage.files import write_text

PAGE = results.ROOT / "docs/reference/assurance.md"
"""The page, with the generated text between BEGIN and END."""
REQUIREMENTS = results.RESULTS / "assurance.toml"
BEGIN, END = "<!-- assurance: written by `make assurance` -->", "<!-- end of assurance -->"
_COLUMNS = ("Requirement", "Measured", "Figure", "Limit", "Status", "Units", "Command", "Commit")
Status = Literal["met", "missed", "no limit", "open", "described"]
"""missed: the figure violates the limit. open: there is no figure yet. described: a document, without a figure."""


class Evidence(BaseModel):
    """One figure for or against a requirement."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    headline: str = ""
    """Metric of a row of results/headline.toml, which has record, keys and limit. Empty if `row` has them."""
    row: results.Row | None = None
    """Record, keys and limit of a figure that results/headline.toml does not have. The record need not exist yet."""
    counted: tuple[str, ...] = ()
    """Keys of the numbers of units, which are added up; {group} stands for the group that is shown. "a|b" is nested."""
    counted_as: str = ""
    """Name of these units, for example scenes."""
    command: str
    """The make target or the command that measures the figure."""

    @model_validator(mode="after")
    def _one_source(self) -> "Evidence":
        if bool(self.headline) == (self.row is not None):
            raise ValueError(f"{self.command}: got headline {self.headline!r} and row {self.row}, expected one of them")
        return self


class Requirement(BaseModel):
    """What a mission would write down, the evidence for it, and what is open."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    id: str = Field(pattern=r"^[A-Z]\d$")
    """Letter of the topic and number."""
    text: str
    """The requirement."""
    described: str = ""
    """Evidence without a figure: Markdown links to documents."""
    open: str
    """What the evidence does not show. It has no measured figures, because figures belong to records."""
    evidence: list[Evidence] = []
    """Figures, in order."""


class Topic(BaseModel):
    """A topic of the assurance of machine learning."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str
    """Heading."""
    terms: str
    """Paragraph above the table."""
    requirement: Annotated[list[Requirement], Field(min_length=1)]
    """Requirements, in order."""


class Assurance(BaseModel):
    """Content of results/assurance.toml."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    topic: Annotated[list[Topic], Field(min_length=1)]
    """Topics, in order."""


def write() -> None:
    """Write the table for a mission's reviewer from the records."""
    text = assurance_text(read_requirements(), results.read_headline(), results.read_records())
    write_text(PAGE, with_text(PAGE.read_text(encoding="utf-8"), text))
    print(PAGE.relative_to(results.ROOT))


def read_requirements() -> Assurance:
    """The requirements of results/assurance.toml."""
    return Assurance.model_validate(tomllib.loads(REQUIREMENTS.read_text(encoding="utf-8")))


def with_text(page: str, text: str) -> str:
    """Return the page with the text between BEGIN and END replaced."""
    before, rest = page.split(BEGIN)
    return f"{before}{BEGIN}\n\n{text}\n{END}{rest.split(END)[1]}"


def assurance_text(assurance: Assurance, headline: results.Headline, records: Mapping[str, results.Record]) -> str:
    """The generated text of the page: a sentence with counts, then a table and a list of open points for each topic."""
    rows = {row.metric: row for table in headline.table for row in table.row}
    parts, statuses = [], []
    for topic in assurance.topic:
        lines = [list(_COLUMNS), ["---"] * len(_COLUMNS)]
        for requirement in topic.requirement:
            for cells in _rows_of(requirement, rows, dict(records)):
                statuses.append(cells[3].strip("*"))
                # The text of a requirement is in its first row only.
                first = not any(line[0].startswith(f"{requirement.id} ") for line in lines)
                lines.append([f"{requirement.id} {requirement.text}" if first else requirement.id, *cells])
        table = "".join(f"| {' | '.join(each)} |\n" for each in lines)
        points = "".join(f"- **{one.id}**: {one.open}\n" for one in topic.requirement)
        parts.append(f"## {topic.title}\n\n{topic.terms.strip()}\n\n{table}\nOpen:\n\n{points}")
    names = {
        "met": "met",
        "missed": "**missed**",
        "no limit": "without a limit",
        "open": "open",
        "described": "described",
    }
    counts = ", ".join(f"{statuses.count(status)} {name}" for status, name in names.items())
    return f"{len(statuses)} rows: {counts}.\n\n" + "\n".join(parts)


def _rows_of(
    requirement: Requirement, headline: Mapping[str, results.Row], records: dict[str, results.Record]
) -> list[list[str]]:
    """Cells of the rows of a requirement, without the first column."""
    rows = [_cells(each, headline, records) for each in requirement.evidence]
    if requirement.described:
        rows.append([requirement.described, "—", "—", "described", "—", "—", "—"])
    return rows or [["—", "—", "—", "**open**", "—", "—", "—"]]


def _cells(evidence: Evidence, headline: Mapping[str, results.Row], records: dict[str, results.Record]) -> list[str]:
    row = evidence.row or headline[evidence.headline]
    if not _is_measured(row, records):
        limit = row.at_most if row.at_most is not None else row.at_least
        sign = "≤" if row.at_most is not None else "≥"
        shown = "—" if limit is None else f"{sign} {limit:g} {row.unit}".strip()
        return [row.metric, "—", shown, "**open**", "—", f"`{evidence.command}`", "—"]
    bounds = results.interval(row, records)
    figure = f"[{results.value(row, records)}](../../results/{row.record}.json){f' ({bounds})' if bounds else ''}"
    limit_text, status = results.goal_and_status(row, records)
    record = records[row.record]
    made = f"{record.commit[:8]}, {record.date}"
    status = "no limit" if status == "no goal" else status
    return [row.metric, figure, limit_text, status, _units(evidence, row, records), f"`{evidence.command}`", made]


def _is_measured(row: results.Row, records: dict[str, results.Record]) -> bool:
    """Whether the record of a row exists and has its figures, those of all groups."""
    groups = row.groups or ("",)
    keys = [tuple(key.replace("{group}", group) for key in row.keys) for group in groups]
    return row.record in records and all(_number(records[row.record].figures, each) is not None for each in keys)


def _units(evidence: Evidence, row: results.Row, records: dict[str, results.Record]) -> str:
    """Number of units of a figure; a dash if the record does not state it."""
    shown = results.keys_of_figure(row, records)
    group = next((one for one in row.groups if tuple(key.replace("{group}", one) for key in row.keys) == shown), "")
    keys = [key.replace("{group}", group) for key in evidence.counted]
    numbers = [_number(records[row.record].figures, tuple(key.split("|"))) for key in keys]
    known = [number for number in numbers if number is not None]
    return f"{sum(known):,.0f} {evidence.counted_as}" if known and len(known) == len(numbers) else "—"


def _number(figures: Mapping[str, Any], keys: tuple[str, ...]) -> float | None:
    """The number at `keys` of nested figures; None if there is none."""
    found: Any = figures
    for key in keys:
        if isinstance(found, list) and key.isdigit() and int(key) < len(found):
            found = found[int(key)]
        else:
            found = found.get(key) if isinstance(found, dict) else None
    return float(found) if isinstance(found, int | float) and not isinstance(found, bool) else None


if __name__ == "__main__":
    run_command_line(one_command(write))
