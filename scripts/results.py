"""Write the headline figures of runs and benchmarks into docs/results.md and README.md.

    python scripts/results.py record runs/bench/labels.json runs/detect/small/metrics.json
    python scripts/results.py write

`record` keeps the JSON of a run or a benchmark as results/<name>.json, with the commit, hardware and command that the
run recorded itself, and with hashes of that commit's sources: they stay valid in a shallow clone and after a squash of
the history, when nobody can look the commit up. `write` (`make results`) puts the rows of results/headline.toml, with
their figures from these records, into the pages. tests/test_results.py fails if they do not agree.
"""

import json
import re
import subprocess
import tomllib
from pathlib import Path
from typing import Annotated, Any

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # Not where another module imports this one.
    end_at_interrupt()

import typer
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from perilune_shared.console.command_line import run_command_line
from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_text

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "results"
PAGES = {ROOT / "docs/results.md": False, ROOT / "README.md": True}
"""Pages with a table between BEGIN and END, and whether it has only the rows for the README."""
BEGIN, END = "<!-- results: written by `make results` -->", "<!-- end of results -->"
SOURCES = ("shared", "render", "train", "benchmarks", "scripts")
"""Folders with the code that makes figures."""
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
    """Hash of each folder with code in this commit, as `git rev-parse COMMIT:FOLDER` prints it: it depends on the names
    and bytes of the files alone, so it also identifies the code in a history that lacks the commit."""
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
    """For a transcribed record, the text of the page with the figures."""

    @field_validator("sources")
    @classmethod
    def _all_sources(cls, sources: dict[str, str]) -> dict[str, str]:
        if tuple(sources) != SOURCES:
            raise ValueError(f"got hashes of {', '.join(sources)}, expected those of {', '.join(SOURCES)}")
        return sources

    @property
    def transcribed(self) -> bool:
        """Whether the figures were copied from a page, since the file of the run was not kept."""
        return self.source.startswith("transcribed from ")


class Row(BaseModel):
    """One headline figure as results/headline.toml describes it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    metric: str
    """What was measured, with any caveat that changes how the figure reads."""
    unit: str = ""
    """Unit of value, interval and goal."""
    record: str = ""
    """Name of the record in results/, without .json."""
    keys: tuple[str, ...] = ()
    """The figure in the record, from the outermost key inwards; <key>_low and <key>_high beside it are its interval."""
    digits: int = 2
    """Significant digits."""
    at_most: float | None = None
    """Goal: the figure is at most this."""
    at_least: float | None = None
    """Goal: the figure is at least this."""
    not_measured: str = ""
    """Why there is no valid figure, in place of record and key."""
    readme: bool = False
    """Whether the README has this row."""

    @model_validator(mode="after")
    def _figure_or_reason(self) -> "Row":
        if bool(self.record and self.keys) == bool(self.not_measured):
            raise ValueError(f"{self.metric}: got both or neither, expected record and keys, or not_measured")
        return self


class Headline(BaseModel):
    """results/headline.toml."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    row: list[Row]
    """The rows of the table, in order."""


@app.command()
def record(
    files: Annotated[list[Path], typer.Argument(help="JSON files that runs or benchmarks wrote.")],
    results: Annotated[Path, typer.Option(help="Folder of the records.")] = RESULTS,
) -> None:
    """Keep the figures of runs or benchmarks as records."""
    for file in files:
        found = _record_of(file)
        path = results / f"{record_name(file)}.json"
        write_text(path, json.dumps(found.model_dump(exclude_defaults=True), indent=1) + "\n")
        print(path)


@app.command()
def write() -> None:
    """Write the tables of the pages from the records."""
    rows, records = read_rows(), read_records()
    for page, for_readme in PAGES.items():
        write_text(page, with_table(page.read_text(encoding="utf-8"), table(for_readme, rows, records)))
        print(page.relative_to(ROOT))


def record_name(file: Path) -> str:
    """Name of a file's record: `labels` of bench/labels.json, `detect-small` of detect/small/metrics.json.

    `benchmark-small` of benchmark/small/benchmark.json.
    """
    parts = file.resolve().parts
    if file.name == "benchmark.json":
        return f"benchmark-{parts[-2]}"
    return f"{parts[-3]}-{parts[-2]}" if file.name == "metrics.json" else file.stem


def _record_of(file: Path) -> Record:
    """The record of a file. Raises UserError if it does not record how it was made, or was made by uncommitted code."""
    try:
        figures = json.loads(file.read_text(encoding="utf-8"))
        # Benchmarks write a table `run`, runs write keys that begin with run/.
        made = figures.pop("run", None) or {
            key.removeprefix("run/"): figures.pop(key) for key in list(figures) if key.startswith("run/")
        }
        commit, hardware, command = (made[key] for key in ("commit", "hardware", "command"))
        if made.get("gpu"):
            hardware = f"{hardware}, {made['gpu']}"
        name = f"{file.parent.name}/{file.name}"
        found = Record(
            source=name,
            commit=commit,
            sources=_sources_of_run(file, commit),
            date=made["date"],
            hardware=hardware,
            load=made["load"],
            # A run of a second working tree names this one by its absolute path.
            command=command.replace(f"{ROOT}/", ""),
            figures=figures,
        )
    except ValidationError as error:
        raise UserError(file, "run", str(made), f"{_NEEDED}, with committed code: {error.errors()[0]['msg']}") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise UserError(file, "run", "no commit, hardware and command", _NEEDED) from None
    if re.search(r"(^|[\s=])/", found.command):
        raise UserError(file, "run/command", command, "paths relative to the repository, so that others can run it")
    return found


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


def read_rows() -> list[Row]:
    """The rows of the headline table."""
    return Headline.model_validate(tomllib.loads((RESULTS / "headline.toml").read_text(encoding="utf-8"))).row


def with_table(page: str, text: str) -> str:
    """A page with the text between its marks replaced."""
    before, rest = page.split(BEGIN)
    return f"{before}{BEGIN}\n\n{text}\n{END}{rest.split(END)[1]}"


def table(for_readme: bool, rows: list[Row], records: dict[str, Record]) -> str:
    """The Markdown table of all rows, or the short one of the README."""
    heads = (
        ["Metric", "Value", "Goal"]
        if for_readme
        else ["Metric", "Value", "Interval", "Goal", "Commit", "Hardware", "Command"]
    )
    lines = [heads, ["---"] * len(heads)]
    for row in rows:
        if for_readme and row.readme:
            lines.append([row.metric, value(row, records), goal(row, records)])
        elif not for_readme:
            figures = [value(row, records), interval(row, records), goal(row, records)]
            lines.append([row.metric, *figures, *made_cells(row, records)])
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def value(row: Row, records: dict[str, Record]) -> str:
    """The cell of the value."""
    if row.not_measured:
        return f"not measured since {row.not_measured}"
    mark = " (transcribed)" if records[row.record].transcribed else ""
    return f"{formatted(row, figure(row, records))}{mark}"


def interval(row: Row, records: dict[str, Record]) -> str:
    """The cell of the interval: a dash where the record has none."""
    if row.not_measured:
        return "—"
    near = enclosing_table(row, records)
    low, high = (near.get(f"{row.keys[-1]}_{end}") for end in ("low", "high"))
    return "—" if low is None or high is None else f"{formatted(row, low)} to {formatted(row, high)}"


def goal(row: Row, records: dict[str, Record]) -> str:
    """The cell of the goal, which also says if the figure misses it."""
    limit = row.at_most if row.at_most is not None else row.at_least
    if limit is None:
        return "—"
    text = f"{'≤' if row.at_most is not None else '≥'} {limit:g} {row.unit}".strip()
    if row.not_measured:
        return text
    found = figure(row, records)
    met = found <= limit if row.at_most is not None else found >= limit
    return text if met else f"{text}, missed"


def made_cells(row: Row, records: dict[str, Record]) -> list[str]:
    """The cells of commit, hardware and command."""
    if row.not_measured:
        return ["—", "—", "—"]
    found = records[row.record]
    load = "" if found.load is None else f", load {found.load:g}"
    return [found.commit[:7], f"{found.hardware}{load}", f"`{found.command}`"]


def enclosing_table(row: Row, records: dict[str, Record]) -> dict[str, Any]:
    """The innermost table of a record that contains the figure of a row."""
    found: Any = records[row.record].figures
    for key in row.keys[:-1]:
        found = found[int(key)] if isinstance(found, list) else found[key]
    return found


def figure(row: Row, records: dict[str, Record]) -> float:
    """The figure of a row."""
    return float(enclosing_table(row, records)[row.keys[-1]])


def formatted(row: Row, number: float) -> str:
    """A number with the row's digits and unit."""
    text = f"{number:.{row.digits}g}"
    return f"{float(text):,.15g} {row.unit}".strip()


if __name__ == "__main__":
    run_command_line(app)
