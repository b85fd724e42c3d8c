"""Folders that each kind of report reads, and the provenance of runs and datasets."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from perilune_shared.config.resolve import read_config_file
from perilune_shared.dataset.info_file import INFO_NAME
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Address
from perilune_train.records.metrics_file import METRICS_FILE, Metrics, read_metrics
from perilune_train.report.content import Provenance
from perilune_train.report.paper.runs import DETECTORS, EXPLAINED, NAVIGATORS

Kind = Literal["demo", "paper", "benchmark"]
SCORE_FILE = "benchmark.json"
INSTALLED = "-installed"
"""End of the name of a folder with an evaluation of the installed detector. The folder has no settings and no
threshold."""
MAX_JSON_BYTES = 16 * 2**20
"""Largest size of a JSON file that is read, bytes."""


@dataclass(frozen=True)
class Run:
    """A finished run, or a score on the locked benchmark."""

    folder: Path
    """Folder of the run or score."""
    name: str
    """Name in figures: the name of the folder."""
    metrics: Metrics
    """Flat keys of metrics.json, or of benchmark.json."""
    provenance: Provenance
    """Configuration, inputs and commit of the run."""


@dataclass(frozen=True)
class Folders:
    """Folders that a report reads. Any folder may be absent."""

    datasets: tuple[Path, ...]
    """Datasets: detection, then navigation."""
    detect: tuple[Path, ...]
    """Detection runs."""
    navigate: tuple[Path, ...]
    """Navigation runs."""
    methods: tuple[Path, ...]
    """Comparisons of all navigation methods on a split."""
    explain: tuple[Path, ...]
    """Explanation runs, including rendered interventions."""
    scores: tuple[Path, ...] = ()
    """Scores on the locked benchmark."""
    landing: Path | None = None
    """Monte Carlo run of the filter on the test descents."""
    page: Path | None = None
    """Folder with paper.json and the pictures of the paper's experiment."""


@dataclass(frozen=True, slots=True)
class AnswerInputs:
    """For how many detections answers are computed, and the datasets of changed frames."""

    n_detections: int = 0
    """Largest number of detections with an answer."""
    counterfactual: Address | None = None
    """The frames without some craters."""
    shallower: Address | None = None
    """The frames with the depth of some craters reduced."""
    turned: Address | None = None
    """The frames under another Sun."""


NO_ANSWERS = AnswerInputs()
"""No answers on single detections."""


def folders_of(kind: Kind, name: str, dataset: Path, runs: Path) -> Folders:
    """The folders of a report, by the kind of report.

    - demo: `dataset` contains detect and nav. Runs are <runs>/<task>/<name>. <runs>/detect/<name>-installed is the
      evaluation of the installed detector.
    - paper: as demo, but `runs` is the folder of the experiment, and runs have the names of the networks.
    - benchmark: `dataset` contains the datasets of the benchmark. All scores in <runs>/benchmark are shown.
    """
    both = (dataset / "detect", dataset / "nav")
    if kind == "demo":
        navigate = runs / "navigate"
        return Folders(
            both,
            (runs / "detect" / name, runs / "detect" / f"{name}{INSTALLED}"),
            # The preset demo trains no warp network, so its absence is not worth a line in the report.
            (*([navigate / name] if (navigate / name).is_dir() else []), navigate / f"{name}-stack"),
            (navigate / f"{name}-methods",),
            (runs / "explain" / name, runs / "explain" / f"{name}-causal"),
            landing=navigate / f"{name}-landing",
        )
    if kind == "paper":
        return Folders(
            both,
            tuple(runs / "detect" / name for name in DETECTORS.values()),
            tuple(runs / "navigate" / f"{name}-stack" for name in NAVIGATORS.values()),
            (),
            (runs / "explain" / EXPLAINED, runs / "explain" / f"{EXPLAINED}-causal"),
            _scores(runs),
            page=runs,
        )
    folders = sorted(path.parent for path in dataset.glob(f"benchmark-*/{INFO_NAME}"))
    return Folders(tuple(folders), (), (), (), (), _scores(runs))


def _scores(runs: Path) -> tuple[Path, ...]:
    return tuple(sorted(path.parent for path in (runs / "benchmark").glob(f"*/{SCORE_FILE}")))


def read_run(folder: Path, root: Path, file: str = METRICS_FILE) -> Run | None:
    """Read a run; None if it is absent or not finished. Raises UserError if a file of the run is damaged.

    `root` is the folder of all runs; the report shows paths relative to `root`. `file` has the metrics.
    """
    if not (folder / file).is_file():
        return None
    metrics = read_metrics(folder, file)
    provenance = provenance_of(folder, root, metrics)
    return Run(folder, folder.name, metrics, provenance)


def sources_of(runs: Sequence[Run]) -> tuple[Provenance, ...]:
    """Provenance of each run."""
    return tuple(run.provenance for run in runs)


def provenance_of(folder: Path, root: Path, metrics: Mapping[str, Any]) -> Provenance:
    """Provenance of a run, from config.yaml and inputs.json in its folder and the entries run/... of its metrics.

    A part that is not recorded is empty. The random seed comes from config.yaml, or from the metric `seed` if
    config.yaml has no seed. Raises UserError if a file is damaged.
    """
    names = ("commit", "date", "command", "hardware", "versions")
    recorded = {key: str(metrics.get(f"run/{key}") or "") for key in names}
    if metrics.get("run/gpu"):
        recorded["hardware"] += f", {metrics['run/gpu']}"
    inputs: dict[str, str] = {}
    if (folder / "inputs.json").is_file():
        content = read_json(folder / "inputs.json")
        if not isinstance(content, dict):
            raise UserError(folder / "inputs.json", "content", type(content).__name__, "an object of hashes")
        inputs = {str(name): str(sha256) for name, sha256 in content.items() if sha256}
    text, sha256, seed = "", "", str(metrics.get("seed") or "")
    if (folder / "config.yaml").is_file():
        sections = read_config_file(folder / "config.yaml")
        seeds = {
            str(section["seed"]) for section in sections.values() if isinstance(section, dict) and "seed" in section
        }
        content_bytes = (folder / "config.yaml").read_bytes()
        text, sha256 = content_bytes.decode(), hashlib.sha256(content_bytes).hexdigest()
        seed = ", ".join(sorted(seeds)) or seed
    source = folder.relative_to(root).as_posix() if folder.is_relative_to(root) else folder.name
    return Provenance(source, sha256, inputs, seed=seed, settings=text, **recorded)


def provenance_of_dataset(dataset: Dataset) -> Provenance:
    """Provenance of a dataset: the hash of dataset.json, and seeds, versions and settings of its recipes.

    A dataset records no command, commit or date, so that rendering it again gives equal bytes. The versions include
    hashes of the renderer's code.
    """
    recipes = list(dataset.info.recipes.values())
    settings = json.dumps([recipe.config for recipe in recipes], indent=2, sort_keys=True)
    versions = {f"{name} {version}" for recipe in recipes for name, version in recipe.versions.items()}
    return Provenance(
        f"dataset {dataset.info.name} ({dataset.info.kind})",
        hashlib.sha256(settings.encode()).hexdigest(),
        {"dataset.json": dataset.store.sha256(INFO_NAME)},
        seed=", ".join(sorted({str(recipe.seed) for recipe in recipes})),
        versions=", ".join(sorted(versions)),
        settings=settings,
        edits="; ".join(dataset.info.history),
    )


def read_json(path: Path) -> Any:
    """Read a JSON file of a run. Raises UserError if it is damaged or too large."""
    if path.stat().st_size > MAX_JSON_BYTES:
        raise UserError(path, "size", f"{path.stat().st_size} bytes", f"at most {MAX_JSON_BYTES} bytes")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise UserError(path, "content", error, "JSON") from None
