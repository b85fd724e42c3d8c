"""Write the headline figures of runs and benchmarks into docs/results.md and README.md.

    python scripts/results.py record runs/bench/labels.json runs/detect/small/metrics.json
    python scripts/results.py write

`record` stores the JSON of a run or a benchmark as results/<name>.json, with the commit, hardware and command that the
run recorded itself, and with hashes of the commit's sources. The hashes identify the code even in a shallow clone or
after a squash of the history, where the commit is missing. `write` (`make results`) writes the tables and sentences of
results/headline.toml into the pages, with their figures from these records. tests/test_results.py fails if pages and
records do not agree.
"""

import json
import math
import re
import subprocess
import tomllib
from pathlib import Path
from typing import Annotated, Any

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # An import by another module must not change how Ctrl-C works.
    end_at_interrupt()

import typer
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from perilune_shared.console.command_line import run_command_line
from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_text

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "results"
RESULTS_PAGE, README = ROOT / "docs/results.md", ROOT / "README.md"
"""Pages with generated text between BEGIN and END."""
BEGIN, END = "<!-- results: written by `make results` -->", "<!-- end of results -->"
SOURCES = ("shared", "render", "train", "benchmarks", "scripts")
"""Folders with the code that computes the figures."""
_COMMIT = re.compile(r"[0-9a-f]{7,40}")
_TREE = re.compile(r"[0-9a-f]{40}")
_NEEDED = "a file that a run or a benchmark of this version wrote"

app = typer.Typer(add_completion=False, no_args_is_help=True)


class Record(BaseModel):
    """One file of results/: the figures of one run or benchmark, and how they were made."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: str
    """The file that the run wrote; or "transcribed from ..." if that file was not kept."""
    commit: str = Field(pattern=f"^{_COMMIT.pattern}$")
    """Commit of the code that made the figures; for a transcribed record, the commit that added them to the page."""
    sources: dict[str, Annotated[str, Field(pattern=f"^{_TREE.pattern}$")]]
    """Hash of each folder with code in this commit, as `git rev-parse COMMIT:FOLDER` prints it. The hash depends only
    on the names and bytes of the files, so it identifies the code even in a history that lacks the commit."""
    date: str = Field(pattern=r"^\d{4}-\d\d-\d\d$")
    """UTC day of the run."""
    hardware: str
    """Cores, processor, memory; GPU if used."""
    load: float | None
    """Load average of the machine when the run started; null if not recorded."""
    command: str
    """The command that made the figures."""
    figures: dict[str, Any]
    """What the run wrote, unchanged."""
    quotes: tuple[str, ...] = ()
    """For a transcribed record, the passages of the page that state the figures."""

    @field_validator("sources")
    @classmethod
    def _all_sources(cls, sources: dict[str, str]) -> dict[str, str]:
        if tuple(sources) != SOURCES:
            raise ValueError(f"got hashes of {', '.join(sources)}, expected hashes of {', '.join(SOURCES)}")
        return sources

    @property
    def transcribed(self) -> bool:
        """Whether the figures were copied from a page, since the file of the run was not kept."""
        return self.source.startswith("transcribed from ")


class Figure(BaseModel):
    """One figure of a record, as results/headline.toml describes it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    record: str
    """Name of the record in results/, without .json."""
    keys: tuple[str, ...] = Field(min_length=1)
    """Keys of the figure in the record, the outermost key first. If the record also has <last key>_low and
    <last key>_high, they are the interval."""
    unit: str = ""
    """Unit of value, interval and goal."""
    digits: int = 2
    """Significant digits."""


class Strength(Figure):
    """One sentence of the README with a figure."""

    text: str = Field(pattern=r"^[^{}]*\{\}[^{}]*$")
    """The sentence, with {} in place of the figure."""


class Row(Figure):
    """One row of a table of docs/results.md."""

    metric: str
    """What was measured, with any caveat that changes how the figure reads."""
    groups: tuple[str, ...] = ()
    """Names that replace {group} in the keys. The row then shows the least favourable figure of all groups, which an
    average would hide. A row with groups needs a goal, since the goal says which figure is the least favourable."""
    at_most: float | None = None
    """Goal: the figure is at most this."""
    at_least: float | None = None
    """Goal: the figure is at least this."""

    @model_validator(mode="after")
    def _one_goal(self) -> "Row":
        if self.at_most is not None and self.at_least is not None:
            raise ValueError(f"{self.metric}: got at_most and at_least, expected one goal at most")
        if self.groups and self.at_most is None and self.at_least is None:
            raise ValueError(f"{self.metric}: got groups without a goal, expected at_most or at_least")
        return self


class Table(BaseModel):
    """One table of docs/results.md."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str
    """The heading above the table."""
    terms: str
    """The paragraph above the table, which defines the terms of its rows."""
    row: list[Row]
    """The rows, in order."""


class Headline(BaseModel):
    """Content of results/headline.toml."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    strength: list[Strength]
    """Sentences of the README, in order."""
    table: list[Table]
    """Tables of docs/results.md, in order."""


@app.command()
def record(
    files: Annotated[list[Path], typer.Argument(help="JSON files that runs or benchmarks wrote.")],
    results: Annotated[Path, typer.Option(help="Folder of the records.")] = RESULTS,
) -> None:
    """Store the figures of runs or benchmarks as records."""
    for file in files:
        record = _record_of(file)
        path = results / f"{record_name(file)}.json"
        write_text(path, json.dumps(record.model_dump(exclude_defaults=True), indent=1) + "\n")
        print(path)


@app.command()
def write() -> None:
    """Write the tables and sentences of the pages from the records."""
    for page, text in generated_texts(read_headline(), read_records()).items():
        write_text(page, with_text(page.read_text(encoding="utf-8"), text))
        print(page.relative_to(ROOT))


def record_name(file: Path) -> str:
    """Name of a file's record.

    Examples: `labels` for bench/labels.json, `detect-small` for detect/small/metrics.json, `benchmark-small` for
    benchmark/small/benchmark.json.
    """
    parts = file.resolve().parts
    if file.name == "benchmark.json":
        return f"benchmark-{parts[-2]}"
    return f"{parts[-3]}-{parts[-2]}" if file.name == "metrics.json" else file.stem


def _record_of(file: Path) -> Record:
    """The record of a file.

    Raises UserError if the file does not state how it was made, or was made by uncommitted code.
    """
    try:
        figures = json.loads(file.read_text(encoding="utf-8"))
        # Benchmarks write a table `run`, runs write keys that begin with run/.
        run = figures.pop("run", None) or {
            key.removeprefix("run/"): figures.pop(key) for key in list(figures) if key.startswith("run/")
        }
        commit, hardware, command = (run[key] for key in ("commit", "hardware", "command"))
        if run.get("gpu"):
            hardware = f"{hardware}, {run['gpu']}"
        name = f"{file.parent.name}/{file.name}"
        record = Record(
            source=name,
            commit=commit,
            sources=_sources_of_run(file, commit),
            date=run["date"],
            hardware=hardware,
            load=run["load"],
            # A run in another working tree may name files of this working tree by absolute paths.
            command=command.replace(f"{ROOT}/", ""),
            figures=figures,
        )
    except ValidationError as error:
        raise UserError(file, "run", str(run), f"{_NEEDED}, with committed code: {error.errors()[0]['msg']}") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise UserError(file, "run", "no commit, hardware and command", _NEEDED) from None
    if re.search(r"(^|[\s=])/", record.command):
        raise UserError(file, "run/command", command, "paths relative to the repository, so that others can run it")
    return record


def _sources_of_run(file: Path, commit: str) -> dict[str, str]:
    """Hashes of the sources that made a file. Raises UserError if they cannot be looked up."""
    if not _TREE.fullmatch(commit):
        raise UserError(file, "run/commit", commit, f"{_NEEDED}, with committed code")
    sources = sources_of(commit)
    if sources is None:
        raise UserError(file, "run/commit", commit, "a commit of this repository")
    return sources


def sources_of(commit: str, repository: Path = ROOT) -> dict[str, str] | None:
    """Hash of each folder of `SOURCES` in a commit; None if this clone lacks the commit."""
    names = [f"{commit}:{folder}" for folder in SOURCES]
    command = ["git", "-C", str(repository), "rev-parse", *names]
    done = subprocess.run(command, capture_output=True, text=True)
    return dict(zip(SOURCES, done.stdout.split(), strict=True)) if done.returncode == 0 else None


def read_records() -> dict[str, Record]:
    """All records by name."""
    return {
        path.stem: Record.model_validate_json(path.read_text(encoding="utf-8"))
        for path in sorted(RESULTS.glob("*.json"))
    }


def read_headline() -> Headline:
    """The rows and sentences of results/headline.toml."""
    return Headline.model_validate(tomllib.loads((RESULTS / "headline.toml").read_text(encoding="utf-8")))


def generated_texts(headline: Headline, records: dict[str, Record]) -> dict[Path, str]:
    """The text that each page has between the marks BEGIN and END."""
    strengths = [f"- {each.text.format(value(each, records))}\n" for each in headline.strength]
    return {RESULTS_PAGE: "\n".join(section(each, records) for each in headline.table), README: "".join(strengths)}


def with_text(page: str, text: str) -> str:
    """Return a page with the text between its marks BEGIN and END replaced."""
    before, rest = page.split(BEGIN)
    return f"{before}{BEGIN}\n\n{text}\n{END}{rest.split(END)[1]}"


def section(table: Table, records: dict[str, Record]) -> str:
    """A section in Markdown: the heading, the terms, and the table, whose figures link to their records."""
    lines = [["Quantity", "Measured", "Goal", "Status"], ["---"] * 4]
    for row in table.row:
        bounds = interval(row, records)
        measured = f"[{value(row, records)}](../results/{row.record}.json){f' ({bounds})' if bounds else ''}"
        lines.append([row.metric, measured, *goal_and_status(row, records)])
    return f"## {table.title}\n\n{table.terms.strip()}\n\n" + "".join(f"| {' | '.join(each)} |\n" for each in lines)


def value(row: Figure, records: dict[str, Record]) -> str:
    """A figure with its unit, as text."""
    mark = " (transcribed)" if records[row.record].transcribed else ""
    return _unbroken(f"{formatted(figure(row, records), row.digits)} {row.unit}".strip()) + mark


def interval(row: Figure, records: dict[str, Record]) -> str:
    """The 95 % interval of a figure, as text: empty if the record has none."""
    keys = keys_of_figure(row, records)
    near = enclosing_table(row.record, keys, records)
    low, high = (near.get(f"{keys[-1]}_{end}") for end in ("low", "high"))
    return "" if low is None or high is None else f"{formatted(low, row.digits)} to {formatted(high, row.digits)}"


def goal_and_status(row: Row, records: dict[str, Record]) -> tuple[str, str]:
    """Two cells: the goal, and whether the figure meets the goal."""
    limit = row.at_most if row.at_most is not None else row.at_least
    if limit is None:
        return "—", "no goal"
    measured = figure(row, records)
    met = measured <= limit if row.at_most is not None else measured >= limit
    sign = "≤" if row.at_most is not None else "≥"
    return _unbroken(f"{sign} {limit:g} {row.unit}".strip()), "met" if met else "**missed**"


def _unbroken(text: str) -> str:
    """Replace spaces by no-break spaces, so that a figure stays on one line in a narrow cell."""
    return text.replace(" ", "\u00a0")


def figure(row: Figure, records: dict[str, Record]) -> float:
    """The figure of a row."""
    keys = keys_of_figure(row, records)
    return float(enclosing_table(row.record, keys, records)[keys[-1]])


def keys_of_figure(row: Figure, records: dict[str, Record]) -> tuple[str, ...]:
    """The keys of a figure in its record; if the row has groups, the keys of its least favourable figure."""
    if not isinstance(row, Row) or not row.groups:
        return row.keys
    candidates = [tuple(key.replace("{group}", group) for key in row.keys) for group in row.groups]
    least_favourable = max if row.at_most is not None else min
    return least_favourable(candidates, key=lambda keys: enclosing_table(row.record, keys, records)[keys[-1]])


def enclosing_table(record: str, keys: tuple[str, ...], records: dict[str, Record]) -> dict[str, Any]:
    """The innermost table of a record that contains a figure."""
    table: Any = records[record].figures
    for key in keys[:-1]:
        table = table[int(key)] if isinstance(table, list) else table[key]
    return table


def formatted(number: float, digits: int) -> str:
    """A number with this many significant digits."""
    rounded = float(f"{number:.{digits}g}")
    decimals = digits - 1 - math.floor(math.log10(abs(rounded))) if rounded else 0
    return f"{rounded:,.{max(decimals, 0)}f}"


if __name__ == "__main__":
    run_command_line(app)
