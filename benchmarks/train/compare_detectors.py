"""YOLOv3 without and with attention, and RT-DETRv2 as a witness, trained on the same frames at the same budget.

    python -m benchmarks.train.compare_detectors DATASET RUN BASELINE

DATASET is the dataset of two finished detect runs: RUN (with attention) and BASELINE (the same network without). The
witness (benchmarks/train/witness.py) is trained twice with the labels, augmentation, batches, seed and evaluation of
RUN:

- `frames`: as many frames seen as RUN
- `time`: the number of epochs whose processor time is nearest to the processor time of RUN

Processor times are measured here: training steps and detections of all networks alternate, since the speed of a machine
changes, and medians are multiplied by the number of frames. costs.json keeps them, so that a resumed comparison has the
same number of epochs. Writes compare_detectors.md and compare_detectors.json; a finished witness is left unchanged, an
interrupted witness is resumed.
"""

import copy
import itertools
import json
import statistics
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, cast

import torch
import typer
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.figures import write_figures
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.console.terminal import answer_page, say
from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_text
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.split import DetectSplit, load_split
from perilune_train.detect.evaluate.bins import RADIUS_BINS_PX
from perilune_train.detect.evaluate.matching import EDGE
from perilune_train.detect.evaluate.report import write_evaluation
from perilune_train.detect.evaluate.split_evaluation import (
    dataset_entries,
    evaluate_split,
    report_head,
    selection_entries,
    write_detections,
)
from perilune_train.detect.finished_run import config_of_run
from perilune_train.detect.inference.detector import Detector
from perilune_train.detect.inference.scales import detect_at_scales, detect_split
from perilune_train.detect.train.detect_run import build_network
from perilune_train.detect.train.task import DetectTask
from perilune_train.detect.train.threshold import threshold_on_validation
from perilune_train.records.markdown import number, table, write_markdown
from perilune_train.records.metrics_file import Metrics, read_metrics, write_metrics
from perilune_train.records.provenance import protocol_of, training_provenance
from perilune_train.training import runs
from perilune_train.training.begin import hashes_of, held, start_run, state_of
from perilune_train.training.fit import Hardware, Schedule, Wording, fit

try:
    from benchmarks.train.witness import (
        Witness,
        WitnessConfig,
        WitnessTask,
        build_witness,
        witness_config,
    )
except ModuleNotFoundError as error:
    _MISSING: str | None = error.name
else:
    _MISSING = None

ATTENTION, PLAIN = "attention-YOLOv3", "YOLOv3"
FRAMES, TIME = "RT-DETRv2, equal frames", "RT-DETRv2, equal processor time"
FIGURES = {"AP": "ap50_paper", "AP, edge": "edge/ap50_paper", "AP, strict": "strict/ap50_paper", "F1": "f1"} | {
    f"AP, {low:g} to {high:g} px radius".replace(" to inf", " or more"): f"radius_{low:g}_{high:g}_px/ap50_paper"
    for low, high in itertools.pairwise(RADIUS_BINS_PX)
}
"""Figures of the table with their keys in metrics.json."""
_TURNS = 7
_WARM_UP = 2


@dataclass(frozen=True, slots=True)
class Cost:
    """Size of a network, and its processor time on this machine."""

    parameters: int
    """Number of weights."""
    multiply_adds: int
    """Multiply-adds of all convolutions and matrix products of a frame."""
    training_s_per_frame: float
    """Processor time of a training step, divided by its number of frames, seconds."""
    detection_s_per_frame: float
    """Processor time of the detection in a frame, suppression included, seconds."""


@dataclass(frozen=True, slots=True)
class Data:
    """The dataset, and its splits in memory."""

    dataset: Dataset
    """The opened dataset."""
    folder: Path
    """Its folder."""
    splits: dict[str, DetectSplit]
    """train, val and test."""

    @classmethod
    def of(cls, folder: Path, config: DetectConfig) -> "Data":
        """Load all splits with the labels of a run."""
        dataset = open_dataset(folder)
        scales = {"train": config.augment.scale, "val": (1.0, 1.0), "test": (1.0, 1 / EDGE)}
        return cls(dataset, folder, {name: load_split(dataset, name, config.labels, scales[name]) for name in scales})


def compared_config(run: Path, baseline: Path, dataset: Path) -> tuple[DetectConfig, DetectConfig]:
    """Settings of both runs. Raises UserError if the runs differ in more than attention, or had other frames."""
    configs = config_of_run(run), config_of_run(baseline)
    expected = "random initial weights and no teacher, as the witness has"
    for root, config in zip((run, baseline), configs, strict=True):
        for name in ("init_from", "teacher"):
            if (value := getattr(config, name)) is not None:
                raise UserError(root / "config.yaml", f"detect.{name}", value, expected)
        read_metrics(root)
        began = json.loads((root / "inputs.json").read_text(encoding="utf-8"))["dataset"]
        if began != hashes_of({"dataset": dataset})["dataset"]:
            raise UserError(root / "inputs.json", "dataset", f"SHA-256 {str(began)[:12]}", f"the dataset {dataset}")
    first, second = (config.model_dump(mode="json") for config in configs)
    for name in first:
        if name not in ("attention", "workers", "checkpoint_minutes") and first[name] != second[name]:
            raise UserError(baseline / "config.yaml", f"detect.{name}", second[name], f"{first[name]}, as in {run}")
    return configs


def multiply_adds_on_cpu(network: "Witness", config: DetectConfig, height_px: int, width_px: int) -> int:
    """Multiply-adds of all convolutions and matrix products for one frame.

    The network cannot run on torch's device `meta`, since it reads values of tensors. Torch does not count fused
    attention, so the count is of the unfused form.
    """
    unfused = copy.deepcopy(network).eval()
    unfused.network.set_attn_implementation("eager")
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        unfused(torch.zeros(1, config.in_channels, height_px, width_px))
    return counter.get_total_flops() // 2


def step_seconds(task: DetectTask, batches: Any, optimizer: Any, number: int) -> float:
    """Processor time in seconds of a training step, loading and augmentation included."""
    began_s = time.process_time()
    batch = task.transfer_batch_to_device(next(batches), task.device, 0)
    optimizer.zero_grad(set_to_none=True)
    with torch.autocast("cpu", torch.bfloat16, runs.choose_bf16(task.config.precision, "cpu")):
        loss = task.training_step(batch, number)
    loss.backward()
    task.configure_gradient_clipping(optimizer)
    optimizer.step()
    return time.process_time() - began_s


def endless(loader: Any) -> Iterator[Any]:
    """Batches of a loader, again and again."""
    return itertools.chain.from_iterable(itertools.repeat(loader))


def measured_costs(tasks: dict[str, DetectTask], sizes: dict[str, int], frames: DetectSplit) -> dict[str, Cost]:
    """Costs of networks with the multiply-adds `sizes`; steps of all networks alternate. Changes their weights."""
    batches = {name: endless(task.train_dataloader()) for name, task in tasks.items()}
    optimizers = {name: task.configure_optimizers()["optimizer"] for name, task in tasks.items()}
    training: dict[str, list[float]] = {name: [] for name in tasks}
    detection: dict[str, list[float]] = {name: [] for name in tasks}
    detectors = {name: detector_of(task.evaluated, task.config, "cpu") for name, task in tasks.items()}
    for turn in range(_WARM_UP + _TURNS):
        for name, task in tasks.items():
            training[name].append(step_seconds(task, batches[name], optimizers[name], turn) / task.config.batch_size)
            began_s = time.process_time()
            detect_at_scales(detectors[name], frames.frames.images[turn % len(frames)][None])
            detection[name].append(time.process_time() - began_s)
    return {
        name: Cost(
            sum(parameter.numel() for parameter in task.network.parameters()),
            sizes[name],
            statistics.median(training[name][_WARM_UP:]),
            statistics.median(detection[name][_WARM_UP:]),
        )
        for name, task in tasks.items()
    }


def detector_of(network: nn.Module, config: DetectConfig, device: str) -> Detector:
    """A network of either kind as a detector; the witness has the methods of YOLOv3 that a detector calls."""
    return Detector(cast(Any, network.eval().to(device)), config, device, runs.choose_bf16(config.precision, device))


def train_witness(run: runs.RunFolder, config: "WitnessConfig", data: Data, overwrite: bool = False) -> None:
    """Train and evaluate the witness, or resume it. `overwrite` replaces an existing witness."""
    inputs = hashes_of({"dataset": data.folder})
    with held(run):
        state = state_of(run, "detect", config, inputs, overwrite)
        if state == "finished":
            return
        splits = data.splits
        task = WitnessTask(build_witness(config), config, splits["train"], splits["val"])
        task.provenance = training_provenance(data.dataset)
        start_run(run, "detect", config, inputs, state)
        schedule = Schedule(
            config.epochs,
            "val/ap50_paper",
            "max",
            config.validate_every,
            config.checkpoint_minutes,
            gradient_clip=config.gradient_clip,
        )
        device = runs.choose_device(config.device)
        hardware = Hardware(device, precision=config.precision)
        seconds = fit(run, task, schedule, hardware, Wording(f"train {run.root.name}"), state == "resume")
        metrics: Metrics = {"train/seconds": round(seconds, 1), "train/epochs": config.epochs}
        write_metrics(run.root, metrics | evaluate_witness(run, config, data, device))


def evaluate_witness(run: runs.RunFolder, config: "WitnessConfig", data: Data, device: str) -> Metrics:
    """Evaluate the best weights as `detect train` does: the threshold is chosen on val, the figures are of test."""
    network, splits = build_witness(config), data.splits
    runs.load_state(network, runs.load_weights(run.best)["state_dict"], run.best)
    detector = detector_of(network, config, device)
    found_val, _ = detect_split(detector, splits["val"], "val")
    threshold, chosen_on = threshold_on_validation(detector, splits["val"], found_val)
    found, _ = detect_split(detector, splits["test"], "test")
    evaluation = evaluate_split(splits["test"], found, config, threshold)
    write_detections(run.root / "detections.parquet", splits["test"], found)
    protocol = protocol_of(data.dataset.info)
    about = report_head(data.dataset, "test", config, protocol, run.root.name, chosen_on)
    write_evaluation(run.root, evaluation, list(splits["test"].frames.images), about)
    metrics = selection_entries(config, splits["test"]) | dataset_entries(data.dataset, "test", config)
    return metrics | {f"test/{key}": value for key, value in evaluation.figures().items()}


def equal_time_epochs(epochs: int, cost: Cost, witness: Cost) -> int:
    """Number of epochs of the witness whose processor time is nearest to that of `epochs` epochs of the detector."""
    return max(1, round(epochs * cost.training_s_per_frame / witness.training_s_per_frame))


def comparison(metrics: dict[str, Metrics], costs: dict[str, Cost], frames_seen: dict[str, int]) -> list[str]:
    """Lines of the table: a row for each figure, a column for each detector."""
    names = list(metrics)
    rows = [
        ["parameters, millions", *(f"{costs[name].parameters / 1e6:.2f}" for name in names)],
        ["multiply-adds of a frame, billions", *(f"{costs[name].multiply_adds / 1e9:.2f}" for name in names)],
        ["frames seen in training", *(str(frames_seen[name]) for name in names)],
        [
            "processor time of training, minutes",
            *(f"{costs[name].training_s_per_frame * frames_seen[name] / 60:.1f}" for name in names),
        ],
        [
            "processor time of detection per frame, ms",
            *(f"{1e3 * costs[name].detection_s_per_frame:.0f}" for name in names),
        ],
    ]
    for words, key in FIGURES.items():
        cells = [metrics[name].get(f"test/{key}") for name in names]
        if any(cell is not None for cell in cells):
            rows.append([words, *map(number, cells)])
    return table(["figure", *names], rows)


def main(
    dataset: Annotated[Path, typer.Argument(help="Folder of the detect dataset of both runs.")],
    run: Annotated[Path, typer.Argument(help="Folder of a finished detect run with attention.")],
    baseline: Annotated[Path, typer.Argument(help="Folder of the same run without attention.")],
    out: Annotated[Path, typer.Option(help="Folder of the comparison and of both witnesses.")] = Path("runs/compare"),
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Measure and train the witness again.")] = False,
) -> None:
    """Train RT-DETRv2 on the frames of two detect runs, and compare the three detectors in one table."""
    if _MISSING is not None:
        raise UserError(_MISSING, "package", "no such package", "the package, which `make setup-dev` installs")
    config, plain = compared_config(run, baseline, dataset)
    data = Data.of(dataset, config)
    train, val = data.splits["train"], data.splits["val"]
    height, width = train.frames.images.shape[1:]
    witness = witness_config(config, train)
    costs_file = out / "costs.json"
    if costs_file.is_file() and not overwrite:
        costs = {name: Cost(**entry) for name, entry in json.loads(costs_file.read_text(encoding="utf-8")).items()}
    else:
        say("measuring processor times")
        own, sizes_px = build_witness(witness), train.label_sizes_px
        tasks: dict[str, DetectTask] = {
            PLAIN: DetectTask(build_network(plain, sizes_px, dataset), plain, train, val, 0),
            ATTENTION: DetectTask(build_network(config, sizes_px, dataset), config, train, val, 0),
            FRAMES: WitnessTask(own, witness, train, val),
        }
        sizes = {PLAIN: _recorded(baseline), ATTENTION: _recorded(run)}
        sizes[FRAMES] = multiply_adds_on_cpu(own, witness, height, width)
        costs = measured_costs(tasks, sizes, val)
        write_text(costs_file, json.dumps({name: asdict(cost) for name, cost in costs.items()}, indent=1) + "\n")
    epochs = {FRAMES: config.epochs, TIME: equal_time_epochs(config.epochs, costs[ATTENTION], costs[FRAMES])}
    costs[TIME] = costs[FRAMES]
    hours = {name: count * len(train) * costs[FRAMES].training_s_per_frame / 3600 for name, count in epochs.items()}
    for name, count in epochs.items():
        say(f"{name}: {count} epochs of {len(train)} frames, about {hours[name]:.1f} hours of processor time")
    metrics = {PLAIN: read_metrics(baseline), ATTENTION: read_metrics(run)}
    for name, folder in ((FRAMES, "frames"), (TIME, "time")):
        changes = {"epochs": epochs[name], "validate_every": 1 if name == TIME else config.validate_every}
        own_config = witness.model_copy(update=changes)
        trained = runs.RunFolder(out / folder)
        train_witness(trained, own_config, data, overwrite)
        metrics[name] = read_metrics(trained.root)
    seen = {name: epochs.get(name, config.epochs) * len(train) for name in metrics}
    lines = comparison(metrics, costs, seen)
    notes = [
        f"Dataset `{data.dataset.info.name}`, split test: {len(data.splits['test'])} frames. One seed each "
        f"(`detect.seed={config.seed}`), {torch.get_num_threads()} threads. Processor times were measured on one "
        "machine, training and detection of all networks in turn.",
    ]
    write_markdown(out / "compare_detectors.md", "\n".join(["# Comparison of detectors", "", *notes, "", *lines, ""]))
    figures = {
        name: {
            "frames_seen": seen[name],
            **asdict(costs[name]),
            **{key: metrics[name].get(f"test/{key}") for key in (*FIGURES.values(), "precision", "recall", "labels")},
        }
        for name in metrics
    }
    write_figures(out / "compare_detectors.json", figures)
    answer_page("\n".join(lines))


def _recorded(run: Path) -> int:
    """Multiply-adds of a frame from the metrics of a run."""
    value = read_metrics(run).get("multiply_adds")
    if not isinstance(value, int):
        raise UserError(run / "metrics.json", "multiply_adds", value, "a whole number")
    return value


if __name__ == "__main__":
    run_command_line(one_command(main))
