"""The page of a benchmark result."""

from collections.abc import Sequence

from perilune_train.detect.benchmark.score import MATCH_IOU, SCORING_RULES, SELECTIONS, Score
from perilune_train.detect.evaluate.matching import EDGE
from perilune_train.detect.evaluate.report import bin_tables, spread_cell, spread_note
from perilune_train.records.benchmark_parts import APART, part_names
from perilune_train.records.markdown import number, table

_COLUMNS = {"ap50_paper": "AP", "precision": "precision", "recall": "recall", "f1": "F1"}
_SELECTIONS = {
    "visible": "`visible`: craters above a threshold of contrast in the frame",
    "paper": "`paper`: all craters with a radius of 2 to 50 px, however faint",
}


def page_of(score: Score, about: Sequence[str]) -> str:
    """The page as Markdown: headline, all scoring rules, regions, bins.

    The Markdown lines `about` state what was scored.
    """
    ap_selection, ap_rule, ap = score.least("ap50_paper")
    spread = score.evaluations[ap_selection].spreads[f"{SCORING_RULES[ap_rule]}ap50_paper"]
    f1_selection, f1_rule, f1 = score.least("f1")
    lines = [
        "# Locked benchmark of crater detection",
        "",
        f"**AP {spread.text(ap)}, F1 {f1:.3f}** by the least favourable scoring rule "
        f"(AP: labels by `{ap_selection}`, {ap_rule} rule; F1: `{f1_selection}`, {f1_rule}).",
        "",
        *[f"- {line}" for line in about],
        *[f"- {line}" for line in _coverage(score)],
        "",
        "## Scoring rules",
        "",
        *_scoring_rules(score),
        "",
        *[f"- {text}" for text in _SELECTIONS.values()],
        "- usual: unmatched detections on ignored craters, outside the range of radii, or centred off the image are "
        "ignored",
        f"- edge: as usual, but the range of radii of detections starts at {EDGE:g} of the smallest radius",
        "- strict: every unmatched detection is a false positive",
        f"- {spread_note(score.evaluations[SELECTIONS[0]].resamples)}; a match needs an IoU of {MATCH_IOU:g}",
        "",
    ]
    for selection in SELECTIONS:
        lines += [f"## By region, labels by `{selection}`", "", *_regions(score, selection), ""]
        if any(region.name == APART for region in score.regions[selection]):
            lines += [f"All other figures of this page exclude `{APART}`.", ""]
        lines += [f"## By radius, altitude, Sun and freshness, labels by `{selection}`", ""]
        lines += [line.replace("## ", "### ", 1) for line in bin_tables(score.evaluations[selection])]
    return "\n".join(lines)


def _coverage(score: Score) -> list[str]:
    lines = []
    for part, (n_frames, n_locked) in score.frames_of.items():
        whole = "all frames" if n_frames == n_locked else f"**only {n_frames} of {n_locked} frames**"
        lines.append(f"`{part}`: {whole} of the shared manifest")
    return lines + [f"`{part}`: **not scored**" for part in part_names("detect") if part not in score.frames_of]


def _scoring_rules(score: Score) -> list[str]:
    rows = []
    for selection, evaluation in score.evaluations.items():
        figures, spreads = evaluation.figures(), evaluation.spreads
        for rule, prefix in SCORING_RULES.items():
            cells = [spread_cell(figures, spreads, f"{prefix}{key}") for key in _COLUMNS]
            rows.append([f"`{selection}`", rule, *cells, str(figures["labels"])])
    return table(["labels", "scoring rule", *_COLUMNS.values(), "selected labels"], rows)


def _regions(score: Score, selection: str) -> list[str]:
    rows = [
        [
            region.name,
            str(region.scenes),
            str(region.labels),
            region.spread.text(region.ap50_paper),
            number(region.edge_ap50_paper),
            number(region.f1),
        ]
        for region in score.regions[selection]
    ]
    return table(["region", "scenes", "labels", "AP", "edge AP", "F1"], rows)
