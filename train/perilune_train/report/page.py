"""Write a report: read datasets and runs, and write report.html and summary.md."""

import base64
import hashlib
import importlib.metadata
import importlib.resources
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import jinja2
from markupsafe import Markup

from perilune_shared.dataset.info_file import INFO_NAME
from perilune_shared.dataset.manifest import Dataset, open_single
from perilune_shared.errors import UserError
from perilune_shared.storage.files import sha256_of, write_text
from perilune_train.detect.config import LabelSettings
from perilune_train.detect.data.split import DetectSplit, load_split
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.finished_run import calibration_of, raw_threshold, threshold_of_table
from perilune_train.records.markdown import write_markdown
from perilune_train.records.metrics_file import METRICS_FILE, Metrics, read_metrics
from perilune_train.report import detection, explanation, navigation
from perilune_train.report.answers.answers import with_answers
from perilune_train.report.content import Answers, Provenance, Report, Section, Viewer
from perilune_train.report.dataset import dataset_section
from perilune_train.report.frames import MASKS_FILE, LabelledFrames, labelled_frames, viewer_of
from perilune_train.report.paper.detections import read_detections
from perilune_train.report.sources import (
    INSTALLED,
    NO_ANSWERS,
    SCORE_FILE,
    AnswerInputs,
    Folders,
    Kind,
    Run,
    folders_of,
    provenance_of,
    provenance_of_dataset,
    read_run,
)
from perilune_train.report.summary import summary_of
from perilune_train.shipped.models import shipped_run

PAGE, SUMMARY = "report.html", "summary.md"
_TITLES: dict[Kind, str] = {"demo": "Demo", "paper": "The paper's experiment", "benchmark": "Locked benchmark"}
_TRIAL_PRESET = "tiny"
_TRIAL = (
    f"The preset {_TRIAL_PRESET} only shows that all steps work: its networks train for seconds, find almost nothing, "
    "and are no measure of the method."
)
_VERSIONS = ("perilune-train", "numpy", "pandas", "pyarrow", "matplotlib", "jinja2", "torch", "lightning")


@dataclass(frozen=True)
class _Opened:
    """The datasets and runs of a report that exist, and the names of those that are missing."""

    datasets: dict[Path, Dataset]
    """Complete datasets with frames, by folder."""
    detect: list[Run]
    """Finished runs of detection."""
    navigate: list[Run]
    """Finished runs of navigation."""
    explain: list[Run]
    """Finished runs of explanation."""
    scores: list[Run]
    """Scores on the locked benchmark."""
    missing: tuple[str, ...]
    """Names of the datasets and runs that do not exist or are not complete."""


def write_report(
    kind: Kind, name: str, dataset: Path, runs: Path, out: Path, inputs: AnswerInputs = NO_ANSWERS
) -> Path:
    """Write report.html and summary.md of a demo, a paper run or a benchmark into `out`; return the page's path.

    `dataset` is the folder of the datasets, `runs` the folder of all runs; `sources.folders_of` lists what is read from
    them. `inputs` says for how many detections of the viewer the page has answers. Datasets and runs that do not exist
    are left out, and the page names them. Raises UserError and writes nothing if no dataset and no run exists, or if a
    file is damaged.
    """
    report = gather(kind, name, dataset, runs, inputs)
    page, summary = html_of(report), summary_of(report)
    write_markdown(out / SUMMARY, summary)
    write_text(out / PAGE, page)
    return out / PAGE


def gather(kind: Kind, name: str, dataset: Path, runs: Path, inputs: AnswerInputs = NO_ANSWERS) -> Report:
    """Read everything that a report shows. Raises UserError like `write_report`."""
    folders = folders_of(kind, name, dataset, runs)
    opened = _open(folders, runs)
    sections: list[Section] = []
    frames: LabelledFrames | None = None
    shown: Dataset | None = None
    for folder, data in opened.datasets.items():
        split: DetectSplit | None = None
        if data.info.kind == "detect" and "test" in data.table("frames", ["split"])["split"].unique().to_pylist():
            detect = opened.detect[-1] if opened.detect else None
            detections, are_probabilities = None, False
            if detect is not None:
                read = read_detections(detect.folder, str(folder), _trained(detect))
                split, (detections, are_probabilities) = read.split, _calibrated(read.found, detect)
            else:
                split = load_split(data, "test", LabelSettings())
            source = provenance_of_dataset(data) if detect is None else detect.provenance
            if frames is None:
                frames, shown = labelled_frames(split, detections, source, are_probabilities), data
        sections.append(dataset_section(data, f"dataset-{len(sections)}", split))
    # Compute the answers before the figures, so that wrong inputs are found early.
    viewer = _viewer(frames, opened)
    if viewer is not None and frames is not None and shown is not None and opened.detect:
        viewer = with_answers(viewer, frames, _trained(opened.detect[-1]), shown, inputs)
    # Show results first, then descriptions of the datasets.
    sections = [*_run_sections(folders, opened, frames, runs), *sections]
    if not sections:
        raise UserError(dataset, "report", "no dataset and no finished run", f"the datasets and runs of a {kind}")
    return Report(
        f"{_TITLES[kind]}: {name}",
        tuple(_headlines(opened, folders)),
        tuple(sections),
        viewer,
        _provenance(sections, viewer),
        opened.missing,
    )


def _trained(run: Run) -> Path:
    """The folder with the weights and the settings of a run of detection."""
    return shipped_run("detect") if run.name.endswith(INSTALLED) else run.folder


def _calibrated(found: list[Detections], run: Run) -> tuple[list[Detections], bool]:
    """The detections with probabilities as scores, and whether they have them: only if the run has a calibration."""
    trained = _trained(run)
    calibration = calibration_of(trained)
    if calibration is None:
        return found, False
    if trained == run.folder and threshold_of_table(run.folder) == raw_threshold(run.folder):
        # The table is older than the calibration.
        found = [replace(one, scores=calibration.probabilities(one.scores)) for one in found]
    return found, True


def _open(folders: Folders, root: Path) -> _Opened:
    datasets, missing = {}, []
    for folder in folders.datasets:
        if not (folder / INFO_NAME).is_file():
            missing.append(f"dataset {folder.name}")
            continue
        dataset = open_single(str(folder))
        if dataset.info.complete and dataset.info.images in ("files", "packed") and len(dataset):
            datasets[folder] = dataset
        else:
            missing.append(f"dataset {folder.name}: not complete, or without frames")
    runs: dict[str, list[Run]] = {}
    for part in ("detect", "navigate", "explain"):
        paths: Sequence[Path] = getattr(folders, part)
        read = {path: read_run(path, root) for path in paths}
        runs[part] = [run for run in read.values() if run is not None]
        missing += [f"{part} run {path.name}: no finished run" for path, run in read.items() if run is None]
    scores = [read_run(path, root, SCORE_FILE) for path in folders.scores]
    if folders.landing is not None and not (folders.landing / navigation.LANDING_TABLE).is_file():
        missing.append(f"landing {folders.landing.name}")
    missing += [f"methods {path.name}" for path in folders.methods if not (path / "navigation.parquet").is_file()]
    return _Opened(datasets, **runs, scores=[score for score in scores if score is not None], missing=tuple(missing))


def _run_sections(folders: Folders, opened: _Opened, frames: LabelledFrames | None, root: Path) -> list[Section]:
    sections = []
    if folders.page is not None and (page := read_run(folders.page, root, "paper.json")):
        sections.append(explanation.paper_section(folders.page, page))
    if opened.detect:
        sections.append(detection.detection_section(opened.detect, frames))
    scored = [score for score in opened.scores if "visible/ap50_paper" in score.metrics]
    if scored:
        sections.append(detection.scores_section(scored))
    if opened.navigate:
        nav = next((dataset for dataset in opened.datasets.values() if dataset.info.kind == "nav"), None)
        sections.append(navigation.navigation_section(opened.navigate, nav))
    others = [score for score in opened.scores if score not in scored]
    if others:
        sections.append(navigation.scores_section(others))
    if folders.landing is not None and (folders.landing / navigation.LANDING_TABLE).is_file():
        source = provenance_of(folders.landing, root, _metrics_of(folders.landing))
        table = {navigation.LANDING_TABLE: sha256_of(folders.landing / navigation.LANDING_TABLE)}
        source = replace(source, inputs=source.inputs | table)
        sections.append(navigation.landing_section(folders.landing, (source,)))
    for folder in folders.methods:
        if (folder / "navigation.parquet").is_file():
            source = provenance_of(folder, root, _metrics_of(folder))
            table = {"navigation.parquet": sha256_of(folder / "navigation.parquet")}
            source = replace(source, inputs=source.inputs | table)
            sections.append(navigation.methods_section(folder, (source,)))
    for number, run in enumerate(opened.explain):
        title = "Explanation: rendered interventions" if run.name.endswith("-causal") else "Explanation"
        sections.append(explanation.explanation_section(run, f"explanation-{number}", title))
    return sections


def _metrics_of(folder: Path) -> Metrics:
    """Metrics of a folder; empty if an older version wrote the folder without metrics.json."""
    return read_metrics(folder) if (folder / METRICS_FILE).is_file() else {}


def _viewer(frames: LabelledFrames | None, opened: _Opened) -> Viewer | None:
    if frames is None:
        return None
    masked = next((run for run in opened.explain if (run.folder / MASKS_FILE).is_file()), None)
    return viewer_of(
        frames, None if masked is None else masked.folder / MASKS_FILE, None if masked is None else masked.provenance
    )


def _headlines(opened: _Opened, folders: Folders) -> list[str]:
    """Sentences with the results of detection, navigation, landing and explanation.

    The first sentence is shown at the top of the page. With the preset `tiny`, it says that the figures are no measure
    of the method.
    """
    recipes = [recipe for dataset in opened.datasets.values() for recipe in dataset.info.recipes.values()]
    lines = [_TRIAL] if any(recipe.preset == _TRIAL_PRESET for recipe in recipes) else []
    if lines and opened.detect and opened.detect[-1].name.endswith(INSTALLED):
        lines[0] += " The frames show the installed detector."
    # Begin with the last run, because the frames show its detections.
    lines += [detection.headline(run) for run in reversed(opened.detect)]
    lines += [detection.headline(score, "visible/") for score in opened.scores if "visible/ap50_paper" in score.metrics]
    lines += [navigation.headline(run) for run in opened.navigate]
    if folders.landing is not None and (folders.landing / navigation.LANDING_TABLE).is_file():
        lines.append(navigation.landing_headline(navigation.read_landing(folders.landing)))
    return lines + [headline for run in opened.explain if (headline := explanation.headline_of(run))]


def _provenance(sections: Sequence[Section], viewer: Viewer | None) -> tuple[Provenance, ...]:
    by_anchor: dict[str, Provenance] = {}
    for section in sections:
        groups = (section.tables, section.figures, section.frames)
        by_anchor |= {source.anchor: source for group in groups for entry in group for source in entry.sources}
    by_anchor |= {source.anchor: source for source in (viewer.sources if viewer else ())}
    return tuple(by_anchor.values())


def html_of(report: Report) -> str:
    """Render the page as one HTML file that contains all styles, scripts and data.

    A content security policy forbids other styles, other scripts and connections. Names from files are escaped by
    Jinja2 and, in the viewer's data, by `json_block`.
    """
    files = importlib.resources.files("perilune_train.report") / "templates"
    style, script = ((files / name).read_text(encoding="utf-8") for name in ("style.css", "viewer.js"))
    environment = jinja2.Environment(
        loader=jinja2.DictLoader({name: (files / name).read_text(encoding="utf-8") for name in _TEMPLATES}),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    data = None if report.viewer is None else json_block(viewer_data(report.viewer))
    return environment.get_template(_TEMPLATES[0]).render(
        report=report,
        style=Markup(style),
        script=Markup(script),
        style_hash=_hash(style),
        script_hash=_hash(script),
        data=data,
        versions=_versions(),
    )


_TEMPLATES = ("page.html.j2", "parts.html.j2")


def viewer_data(viewer: Viewer) -> dict[str, object]:
    """The viewer's data as plain lists: frames with marks, and masks by gate."""
    frames = [
        {
            "name": frame.name,
            "about": frame.about,
            "image": frame.image,
            "width": frame.width_px,
            "height": frame.height_px,
            "labels": [[mark.kind, *mark.shape] for mark in frame.labels],
            "detections": [[mark.kind, *mark.shape, *mark.ellipse] for mark in frame.detections],
        }
        for frame in viewer.frames
    ]
    answers = None if viewer.answers is None else _answers_data(viewer.answers)
    return {"frames": frames, "masks": [asdict(mask) for mask in viewer.masks], "answers": answers}


def _answers_data(answers: Answers) -> dict[str, object]:
    each = [{name: value for name, value in asdict(answer).items()} for answer in answers.each]
    return {"ofScore": answers.of_score, "chosen": answers.chosen, "each": each}


def json_block(content: object) -> Markup:
    """Content as JSON text that is safe inside a script element."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":"), ensure_ascii=True)
    # These characters could close the element. `ensure_ascii` already escapes the line ends U+2028 and U+2029.
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _versions() -> str:
    versions = []
    for name in _VERSIONS:
        try:
            versions.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    return ", ".join(versions)
