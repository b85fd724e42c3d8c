"""The summary of a report in Markdown: headlines, tables and provenance, without pictures."""

from markupsafe import Markup

from perilune_shared.errors import one_line
from perilune_train.evaluation.markdown import table
from perilune_train.report.content import Report

_SPECIAL = str.maketrans({character: f"\\{character}" for character in "\\`*_[]<>#"})


def summary_of(report: Report) -> str:
    """The summary as Markdown. Names from files cannot become markup: special characters are escaped."""
    lines = [f"# {_escaped(report.title)}", "", *[f"- {_escaped(line)}" for line in report.summary], ""]
    lines += ["The figures and the frames are in `report.html`, beside this file.", ""]
    for section in report.sections:
        lines += [f"## {_escaped(section.title)}", ""]
        lines += [line for text in section.lead for line in (_escaped(text), "")]
        for own in section.tables:
            rows = [[_escaped(_text(cell)) for cell in row] for row in own.rows]
            lines += [f"{_escaped(own.caption)}:", "", *table([_escaped(cell) for cell in own.head], rows), ""]
    if report.missing:
        lines += ["## Not in this report", "", *[f"- {_escaped(part)}" for part in report.missing], ""]
    lines += ["## Provenance", ""]
    for source in report.provenance:
        lines += [f"- {_escaped(source.source)}"]
        lines += [f"  - {_escaped(name)}: {_escaped(value)}" for name, value in source.facts[1:]]
    lines.append("")
    return "\n".join(lines)


def _escaped(text: str) -> str:
    return one_line(text).translate(_SPECIAL)


def _text(cell: str) -> str:
    return str(cell.striptags()) if isinstance(cell, Markup) else cell
