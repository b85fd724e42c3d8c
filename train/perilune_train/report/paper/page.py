"""Write the page of the paper's experiment from the finished runs: verdicts, tables, pictures, deviations."""

import shutil
from collections.abc import Sequence
from pathlib import Path

from perilune_shared.errors import UserError
from perilune_shared.storage.store import Address
from perilune_train.detect.finished_run import config_of_run
from perilune_train.records.markdown import table, write_markdown
from perilune_train.records.metrics_file import Metrics, write_metrics
from perilune_train.report.paper.curves import (
    AP_KEY,
    POSITION_KEY,
    draw_curve,
    draw_learning,
    draw_trajectory_errors,
)
from perilune_train.report.paper.detections import Detected, draw_detections, read_detections, width_ratio
from perilune_train.report.paper.gates import gate_table
from perilune_train.report.paper.prose import CAUSES, DEVIATIONS, lead, verdict_note
from perilune_train.report.paper.rule import Verdict
from perilune_train.report.paper.runs import (
    ATTENTION,
    HEADLINE,
    NAMES,
    NAVIGATORS,
    READINGS,
    SPARSE,
    TRANSFER,
    USUAL,
    PaperRuns,
    detect_name,
    navigate_name,
    nearest_share,
)
from perilune_train.report.paper.tables import curve_table, read_causes, table_2, table_3
from perilune_train.report.paper.verdicts import verdicts

PAGE, FIGURES = "paper.md", "paper.json"
NOT_RUN = "Not run."
_EXPLAINED = ("masks_detect.png", "masks_navigate.png", "pcc_detect.png", "pcc_navigate.png")
_READINGS = {
    "pose": "Pose in O_L: position and attitude in the landing frame (our reading of the paper)",
    "attitude": "Pose in O_L over descents with attitude noise, with the backbones trained on descents without it",
    "motion": "Motion between consecutive frames",
}


def write_page(root: Path, dataset: Address, about: Sequence[str] = (), headline_share: str | None = None) -> Path:
    """Write paper.md, paper.json and pictures into the folder of the experiment's runs; return the page's path.

    `dataset` is the detection dataset of the headline ground, the ground on which networks are compared. `about` has
    lines on how the experiment was run and what was left out. `headline_share` is the equilibrium_share (crater
    density) of the headline ground. By default, it is the equilibrium_share at which the validation AP of our YOLOv3
    without attention is nearest to the paper's AP.

    A section without finished runs contains only a note. Raises UserError if no run is finished.
    """
    runs = PaperRuns(root)
    if not root.is_dir():
        raise UserError(root, "runs", "no such folder", "the folder of the experiment: make paper")
    read = runs.all_finished()
    if not read:
        raise UserError(root, "runs", "no finished run", "at least one: make paper")
    share = headline_share or nearest_share(runs.curve())
    detected = _detected(runs, dataset)
    attended = detected.get("attention-yolov3")
    answers = verdicts(runs, None if attended is None else width_ratio(attended))
    sections = {
        "Claims": _claims(answers),
        "Table II: crater detection": _table_2(runs),
        "Density of craters": _curve(runs, share),
        "Detections": _detections(root, detected),
        "Table III: navigation": _table_3(runs),
        "Three causes": _causes(runs),
        "Learning curves": _learning(runs),
        "Attention": _attention(runs),
        "Deviations that remain": [f"- {line}" for line in DEVIATIONS],
    }
    lines = ["# The paper's experiment", "", lead(runs, share, given=headline_share is not None)]
    if settings := [f"- {line}" for line in (*about, *_settings(runs))]:
        lines += ["", *settings]
    for title, content in sections.items():
        lines += ["", f"## {title}", "", *content]
    write_markdown(root / PAGE, "\n".join([*lines, ""]))
    write_metrics(root, _figures(read, answers), FIGURES)
    return root / PAGE


def _detected(runs: PaperRuns, dataset: Address) -> dict[str, Detected]:
    """Detections of the finished detectors on the headline ground, by network."""
    folders = {
        network: runs.detector(detect_name(network)) for network, trainings in runs.detections().items() if trainings
    }
    return {
        network: read_detections(folder, dataset)
        for network, folder in folders.items()
        if (folder / "detections.parquet").is_file()
    }


def _settings(runs: PaperRuns) -> list[str]:
    """A line with the settings of the detectors on the headline ground; empty if no detector is finished."""
    folders = [runs.detector(detect_name(network)) for network, trainings in runs.detections().items() if trainings]
    known = [folder for folder in folders if (folder / "config.yaml").is_file()]
    if not known:
        return []
    config = config_of_run(known[0])
    loss = config.loss
    return [
        f"detectors: width {config.width:g}, {config.in_channels} channels, strides "
        f"{' '.join(map(str, config.strides))}, labels `{config.labels.selection}`, loss of {loss.reduction}, CIoU "
        f"({loss.aspect} prior) x {loss.lambda_iou:g}, objectness ({loss.objectness}) x {loss.lambda_obj:g}, "
        f"{config.assignment} predictor{'s' * (config.assignment != 'one')} per label, {config.epochs} epochs, batch "
        f"{config.batch_size}"
    ]


def _claims(answered: list[Verdict]) -> list[str]:
    answers = [verdict.answer for verdict in answered]
    counted = ", ".join(f"{answer}: {answers.count(answer)}" for answer in dict.fromkeys(answers))
    rows = [
        [verdict.claim, verdict.claimed, verdict.measured, verdict.trainings, f"**{verdict.answer}**"]
        for verdict in answered
    ]
    head = ["claim", "the paper", "measured here: with attention against without", "training runs", "verdict"]
    return [f"{len(answered)} claims of the paper: {counted}.", "", *table(head, rows), "", verdict_note()]


def _table_2(runs: PaperRuns) -> list[str]:
    if not any(trainings for trainings in (*runs.detections().values(), *runs.halves().values())) and not _elsewhere(
        runs
    ):
        return [NOT_RUN]
    note = (
        "*In brackets: for one training run, the 95 % interval over trajectories; for several, the range of the runs. "
        "Test frames show the terrain of the training frames, as in the paper; the locked benchmark has other "
        f"terrain.{_starts(runs)}*"
    )
    return [note, "", *table_2(runs)]


def _elsewhere(runs: PaperRuns) -> bool:
    """Whether a finished detector exists for the benchmark or for a ground other than the headline ground."""
    trainings = [
        some_trainings for ground in (SPARSE, USUAL, TRANSFER) for some_trainings in runs.detections(ground).values()
    ]
    return any(trainings) or any(runs.scored(network) for network in ATTENTION)


def _starts(runs: PaperRuns) -> str:
    """A sentence on the initial weights of the headline rows and the transfer rows; empty if unknown."""
    parts = []
    for ground, title in ((HEADLINE, "the headline rows"), (TRANSFER, "rows after transfer")):
        starts = {
            str(metrics["train/start"])
            for trainings in runs.detections(ground).values()
            for metrics in trainings
            if "train/start" in metrics
        }
        parts += [f"{title} from {' or '.join(map(_start, sorted(starts)))}"] if starts else []
    return f" Weights: {', '.join(parts)}." if parts else ""


def _start(start: str) -> str:
    """Initial weights in words, from train/start of metrics.json."""
    path = Path(start)
    if path.suffix == ".ckpt":
        return f"our own network `{path.parent.parent.name}`, in place of YOLOv3 trained on COCO"
    return start if start == "random weights" else f"`{path.name}`"


def _curve(runs: PaperRuns, share: str | None) -> list[str]:
    curve = runs.curve(share)
    if not curve:
        return [NOT_RUN]
    draw_curve(runs.root / "curve.png", curve, share)
    picture = "![AP of YOLOv3 against the density of craters](curve.png)"
    return [picture, "", *curve_table(curve, share)]


def _detections(root: Path, detected: dict[str, Detected]) -> list[str]:
    if not detected:
        return [NOT_RUN]
    draw_detections(root / "detections.png", {NAMES[network]: detections for network, detections in detected.items()})
    return ["![Detections on the headline ground](detections.png)", "", "*Red: ground truth. Cyan: detections.*"]


def _table_3(runs: PaperRuns) -> list[str]:
    lines = []
    for reading, title in _READINGS.items():
        lines += [f"**{title}**", "", *(table_3(runs, reading) if runs.navigation(reading) else [NOT_RUN]), ""]
    files = {
        reading: {
            name: runs.navigator(navigate_name(network, reading)) / "errors.parquet"
            for name, network in NAVIGATORS.items()
        }
        for reading in READINGS
    }
    if draw_trajectory_errors(runs.root / "trajectory.png", files):
        lines += ["![Errors along a test trajectory](trajectory.png)", ""]
    if any(runs.scored(name) for name in NAVIGATORS.values()):
        lines += [
            "*The locked benchmark has 40 frames per descent. If the experiment has more frames per descent, steps of "
            "the benchmark are longer than in training, so its errors are not caused by new ground alone.*",
            "",
        ]
    return lines[:-1]


def _causes(runs: PaperRuns) -> list[str]:
    causes = read_causes(runs)
    lines = []
    for cause in dict.fromkeys([*CAUSES, *causes]):
        measured = causes.get(cause, ["Ablation: not run."])
        lines += [CAUSES.get(cause, f"**{cause}**"), "", *measured, ""]
    return lines[:-1]


def _learning(runs: PaperRuns) -> list[str]:
    navigators = {
        reading: {name: runs.navigator(navigate_name(network, reading)) for name, network in NAVIGATORS.items()}
        for reading in READINGS
    }
    panels = {
        "detectors, headline ground": (
            AP_KEY,
            {NAMES[network]: runs.detector(detect_name(network)) for network in ATTENTION},
        ),
        **{
            f"navigators, {reading}": (POSITION_KEY, runs_of_network) for reading, runs_of_network in navigators.items()
        },
    }
    drawn = draw_learning(runs.root / "learning.png", panels)
    return ["![Learning curves](learning.png)"] if drawn else [NOT_RUN]


def _attention(runs: PaperRuns) -> list[str]:
    explained = runs.explanation()
    if explained is None:
        return [NOT_RUN]
    lines = [
        "Correlations do not depend on the range of a mask, and some masks may be nearly constant. Therefore look at "
        "the masks too. A gate beats a null if, by a test over scenes, the gate's mean is above the null's mean; one "
        "scene is too few for this test.",
        "",
        *gate_table(explained),
    ]
    for name in _EXPLAINED:
        if (runs.explained / name).is_file():
            shutil.copyfile(runs.explained / name, runs.root / name)
            lines += ["", f"![{name[:-4].replace('_', ' ')}]({name})"]
    return lines


def _figures(read: dict[str, Metrics], answered: list[Verdict]) -> Metrics:
    """Numbers and verdicts of the page by flat keys: <folder of a run>/<metric> and verdict/<number>/<part>."""
    figures: Metrics = {}
    for folder, metrics in read.items():
        figures |= {f"{folder}/{key}": value for key, value in metrics.items() if not key.startswith("run/")}
    parts = ("claim", "measured", "trainings", "answer")
    for number, verdict in enumerate(answered, 1):
        figures |= {f"verdict/{number}/{part}": getattr(verdict, part) for part in parts}
    return figures
