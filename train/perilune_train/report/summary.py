"""The summary of a report in Markdown: headlines, tables and provenance, without pictures."""

from markupsafe import Markup

from perilune_shared.export.foreign_text import for_markdown
from perilune_train.records.markdown import table
from perilune_train.report.content import Report


def summary_of(report: Report) -> str:
    """The summary as Markdown. Special characters in names from files are escaped."""
    lines = [f"# {for_markdown(report.title)}", "", *[f"- {for_markdown(line)}" for line in report.summary], ""]
    lines += ["The figures and the frames are in `report.html`, beside this file.", ""]
    for section in report.sections:
        lines += [f"## {for_markdown(section.title)}", ""]
        lines += [line for text in section.lead for line in (for_markdown(text), "")]
        for entry in section.tables:
            rows = [[for_markdown(_text(cell)) for cell in row] for row in entry.rows]
            lines += [
                f"{for_markdown(entry.caption)}:",
                "",
                *table([for_markdown(cell) for cell in entry.head], rows),
                "",
            ]
    if report.missing:
        lines += ["## Not in this report", "", *[f"- {for_markdown(part)}" for part in report.missing], ""]
    lines += ["## Provenance", ""]
    for source in report.provenance:
        lines += [f"- {for_markdown(source.source)}"]
        lines += [f"  - {for_markdown(name)}: {for_markdown(value)}" for name, value in source.facts[1:]]
    lines.append("")
    return "\n".join(lines)


def _text(cell: str) -> str:
    return str(cell.striptags()) if isinstance(cell, Markup) else cell
