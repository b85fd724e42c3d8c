"""The report's sections on attention gates and on the paper's claims: verdicts, tables and pictures.

An explain run is a run of `perilune-train explain` or `perilune-train causal`; its folder contains claims.json,
captions.json and pictures.
"""

import re
from collections.abc import Mapping
from pathlib import Path

from markupsafe import Markup

from perilune_shared.errors import UserError, one_line
from perilune_train.report.content import Figure, Provenance, Section, Table
from perilune_train.report.pictures import picture_of
from perilune_train.report.sources import Run, read_json

CLAIMS_FILE, CAPTIONS_FILE = "claims.json", "captions.json"
_COLUMNS = ("claim", "figure", "interval", "nulls", "verdict")
_CAPTIONS = {
    "masks_detect.png": "Attention masks of the detector over test frames.",
    "masks_navigate.png": "Attention masks of the navigator over pairs of test frames.",
    "pcc_detect.png": "Correlations of the detector's masks, gate by gate.",
    "pcc_navigate.png": "Correlations of the navigator's masks, gate by gate.",
}
_ORDER = ("gates_", "removal_", "before_after_", "masks_", "pcc_")
"""Starts of the names of the first pictures: what the network uses, then what its masks look like."""


def explanation_section(run: Run, key: str, title: str) -> Section:
    """The section on an explain run: headline, table of claims, and all pictures with captions."""
    claims = read_claims(run.folder / CLAIMS_FILE)
    captions = _captions(run.folder / CAPTIONS_FILE)
    pictures = {path.name: f"{key}-picture-{number}" for number, path in enumerate(_ordered(run.folder))}
    tables = [_claims_table(claims, pictures, run.provenance)] if claims else []
    figures = [
        Figure(picture_of(path, caption), caption, (run.provenance,), wide=True, key=pictures[path.name])
        for path in _ordered(run.folder)
        for caption in [captions.get(path.name) or _CAPTIONS.get(path.name) or _words(path)]
    ]
    lead = [text for text in [headline_of(run)] if text]
    lead += [f"Claims: {_counted([claim['verdict'] for claim in claims])}."] if claims else []
    return Section(key, title, tuple(lead), tuple(tables), tuple(figures))


def headline_of(run: Run) -> str:
    """The headline of an explain run on one line; empty if the run has no headline.

    Runs of `perilune-train causal` have no headline. If no verdict of the headline is decided, the text is one sentence
    with the first undecided verdict, which includes its reason.
    """
    headline = run.metrics.get("headline")
    if not isinstance(headline, str):
        return ""
    verdicts = [claim["verdict"] for claim in read_claims(run.folder / CLAIMS_FILE)]
    undecided = next((verdict for verdict in verdicts if verdict.startswith("undecided")), None)
    if undecided is not None and not re.search(r"\b(holds|does not)\b", headline):
        return one_line(f"What the attention masks show is {undecided}.")
    return one_line(headline)


def paper_section(folder: Path, run: Run) -> Section:
    """The section on the paper's claims, with verdicts and pictures.

    `folder` is the folder of the experiment. `run.metrics` is the content of paper.json in this folder.
    """
    rows, number = [], 1
    while f"verdict/{number}/claim" in run.metrics:
        rows.append(tuple(str(run.metrics.get(f"verdict/{number}/{part}")) for part in ("claim", "measured", "answer")))
        number += 1
    lead = (f"Claims of the paper: {_counted([answer for _, _, answer in rows])}.",)
    table = Table("Claims of the paper", ("claim", "measured here", "verdict"), tuple(rows), (run.provenance,))
    captions = {
        "detections.png": "Detections of the networks. Red: ground truth. Cyan: detections.",
        "curve.png": "AP of YOLOv3 without attention against the density of craters.",
        "learning.png": "Learning curves.",
        "trajectory.png": "Errors along a test trajectory.",
    }
    figures = [
        Figure(picture_of(folder / name, caption), caption, (run.provenance,), wide=True)
        for name, caption in captions.items()
        if (folder / name).is_file()
    ]
    return Section("paper", "The paper's experiment", lead, (table,), tuple(figures))


def _counted(verdicts: list[str]) -> str:
    """The number of claims, and the number of claims with each verdict, as text."""
    counts = {verdict: verdicts.count(verdict) for verdict in dict.fromkeys(verdicts)}
    return f"{len(verdicts)}; {', '.join(f'{verdict}: {count}' for verdict, count in counts.items())}"


def read_claims(path: Path) -> list[dict[str, str]]:
    """Read claims.json, a list of objects whose values are strings; an empty list if there is no such file.

    The keys are the fields of `explain.page.claims.Claim`: claim, figure (the measured number), interval, nulls (the
    numbers for null maps or controls), verdict, picture (a file name). A missing value becomes "-". Raises UserError on
    other content.
    """
    if not path.is_file():
        return []
    content = read_json(path)
    if not isinstance(content, list) or not all(isinstance(claim, dict) for claim in content):
        raise UserError(path, "claims", type(content).__name__, "a list of objects")
    return [{key: str(claim.get(key) or "-") for key in (*_COLUMNS, "picture")} for claim in content]


def _captions(path: Path) -> dict[str, str]:
    if not path.is_file():
        return {}
    content = read_json(path)
    if not isinstance(content, dict):
        raise UserError(path, "captions", type(content).__name__, "an object of captions by file name")
    return {str(name): str(caption) for name, caption in content.items()}


def _claims_table(claims: list[dict[str, str]], pictures: Mapping[str, str], provenance: Provenance) -> Table:
    rows = tuple((*(claim[key] for key in _COLUMNS), _link(claim["picture"], pictures)) for claim in claims)
    return Table("Claims", ("claim", "figure", "95 % interval", "nulls", "verdict", "picture"), rows, (provenance,))


def _link(name: str, pictures: Mapping[str, str]) -> str:
    """A link to the picture of a claim; only the picture's name if the run has no such picture."""
    return Markup('<a href="#{}">{}</a>').format(pictures[name], name) if name in pictures else name


def _ordered(folder: Path) -> list[Path]:
    """All pictures of the folder, in the order of `_ORDER` and then by name; other pictures follow."""

    def rank(path: Path) -> tuple[int, str]:
        return next((k for k, start in enumerate(_ORDER) if path.name.startswith(start)), len(_ORDER)), path.name

    return sorted(folder.glob("*.png"), key=rank)


def _words(path: Path) -> str:
    return path.stem.replace("_", " ").capitalize() + "."
