"""The page of the paper's experiment: tables, figures, verdicts, deviations."""

import shutil
from pathlib import Path

from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_text
from perilune_shared.storage.store import Address
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.finished_run import config_of_run
from perilune_train.evaluation.markdown import table
from perilune_train.evaluation.metrics_file import Metrics, write_metrics
from perilune_train.paper.curves import draw_learning, draw_trajectory_errors
from perilune_train.paper.detections import draw_detections, median_width_ratio, read_detections
from perilune_train.paper.runs import DETECTORS, PaperRuns
from perilune_train.paper.tables import table_2, table_3
from perilune_train.paper.verdicts import Verdict, verdicts

PAGE, FIGURES = "paper.md", "paper.json"
_EXPLAINED = ("masks_detect.png", "masks_navigate.png", "pcc_detect.png", "pcc_navigate.png")
_DEVIATIONS = (
    "Frames are rendered by perilune in place of PANGU. The paper does not publish its data, camera or Sun.",
    "The grey frame is repeated in three channels, as PANGU's images of a grey ground are.",
    "Optimiser (AdamW with warm-up and one cosine for detection), learning rate and batch of detection, and the weight "
    "of empty cells in the objectness loss (1) are ours; the paper does not state them.",
    "Sums of the loss are divided by the number of frames in the batch. Craters with a radius just outside 2 to 50 px, "
    "or with their centre off the frame, are neither positive nor negative.",
    "A cell can place a centre up to half a cell outside itself (models/yolo.py); there is no class output.",
    "The initial objectness is 0.01 in every cell.",
    "Rotations are output in units of their r.m.s. in training. Without attitude noise the camera does not rotate, "
    "this unit is 0, and the orientation error says nothing; the second experiment (ATTITUDE=1) measures it.",
    "The navigators' errors are standardised before they enter the loss, and means replace sums over pairs.",
    "The best epoch on validation is tested.",
)


def write_page(root: Path, dataset: Address, about: tuple[str, ...] = ()) -> Path:
    """Write paper.md, paper.json and pictures into the folder of the experiment's runs; returns the page.

    `dataset` is the detection dataset of the runs; `about` are lines that say how the experiment was made and what was
    cut. Raises UserError if a run is missing or not finished.
    """
    runs = PaperRuns(root)
    if not root.is_dir():
        raise UserError(root, "runs", "no such folder", "the folder of the experiment: make paper")
    runs.detection(), runs.navigation(), runs.explanation()
    detected = {network: read_detections(runs.detector(network), dataset) for network in DETECTORS}
    found = verdicts(runs, median_width_ratio(detected["attention-YOLOv3"]))
    draw_detections(root / "detections.png", detected)
    draw_learning(root / "learning.png", runs)
    draw_trajectory_errors(root / "trajectory.png", runs)
    for name in _EXPLAINED:
        shutil.copyfile(runs.explained / name, root / name)
    write_text(root / PAGE, _text(runs, found, about))
    write_metrics(root, _figures(runs, found), FIGURES)
    return root / PAGE


def _text(runs: PaperRuns, found: list[Verdict], about: tuple[str, ...]) -> str:
    detector = next(iter(runs.detection()))
    config = config_of_run(runs.detector(detector))
    start = "without initial weights" if config.init_from is None else f"from `{Path(config.init_from).name}`"
    if config.init_from is not None and config.init_from.endswith(".ckpt"):
        start = (
            f"from our own network `{Path(config.init_from).parent.parent.name}`, in place of YOLOv3 trained on COCO"
        )
    answers = {answer: sum(one.answer == answer for one in found) for answer in dict.fromkeys(v.answer for v in found)}
    counted = ", ".join(f"{answer}: {count}" for answer, count in answers.items())
    rows = [[one.claim, one.claimed, one.measured, f"**{one.answer}**"] for one in found]
    return "\n".join(
        [
            "# The paper's experiment",
            "",
            f"{len(found)} claims of the paper: {counted}.",
            "",
            *[f"- {line}" for line in (*about, *_settings(config))],
            "",
            "## Claims",
            "",
            *table(["claim", "the paper", "measured here", "verdict"], rows),
            "",
            "In brackets: 95 % intervals over trajectories. *Within the spread*: the sign is the claimed one, but the "
            "intervals overlap, or there are none. One training of each network.",
            "",
            "## Table II: crater detection",
            "",
            f"*Backbones {start}, from the second layer on, frozen in the first {config.frozen_epochs} of "
            f"{config.epochs} epochs. Test frames are frames of the training trajectories' terrain, as in the paper; "
            "the locked benchmark has other terrain.*",
            "",
            *table_2(runs),
            "",
            "![Detections of both networks](detections.png)",
            "",
            "*Truth red, detections cyan.*",
            "",
            "## Table III: navigation",
            "",
            *table_3(runs),
            "",
            "*The locked benchmark has 40 frames a descent. Where the experiment has more, steps of the benchmark are "
            "longer than in training, so the error there is not that of new ground alone.*",
            "",
            "![Errors along a test trajectory](trajectory.png)",
            "",
            "## Learning curves",
            "",
            "![Learning curves](learning.png)",
            "",
            "## Attention",
            "",
            "Correlations do not depend on the range of a mask. Read them beside the masks: some are nearly constant.",
            "",
            *[line for name in _EXPLAINED for line in (f"![{name[:-4].replace('_', ' ')}]({name})", "")],
            "## Deviations that remain",
            "",
            *[f"- {line}" for line in _DEVIATIONS],
            "",
        ]
    )


def _settings(config: DetectConfig) -> list[str]:
    loss = config.loss
    return [
        f"detectors: width {config.width:g}, {config.in_channels} channels, strides "
        f"{' '.join(map(str, config.strides))}, labels `{config.labels.selection}`, CIoU ({loss.aspect} prior) x "
        f"{loss.lambda_iou:g}, objectness ({loss.objectness}) x {loss.lambda_obj:g}, "
        f"{config.assignment} predictor{'s' * (config.assignment != 'one')} per label, batch {config.batch_size}",
    ]


def _figures(runs: PaperRuns, found: list[Verdict]) -> Metrics:
    """Flat keys: <network>/<metric>, <network>/benchmark/<metric>, verdict/<number>/<part>."""
    figures: Metrics = {}
    for network, metrics in (runs.detection() | runs.navigation()).items():
        figures |= {f"{network}/{key}": value for key, value in metrics.items() if not key.startswith("run/")}
        scored = runs.scored(network) or {}
        figures |= {f"{network}/benchmark/{key}": value for key, value in scored.items() if not key.startswith("run/")}
    for number, one in enumerate(found, 1):
        figures |= {f"verdict/{number}/{name}": getattr(one, name) for name in ("claim", "measured", "answer")}
    return figures
