"""Which score tells frames on which the detector fails? Candidates for the alarm `novelty`.

    python -m benchmarks.train.alarms DATASET [--oblique DATASET] [--other DATASET] [--out FOLDER]

DATASET has the frames on which the detector was trained (train) and validated (val). Candidates are distances as in
detect/novelty.py, from different features, all fitted on the same training frames. A candidate is chosen on validation
frames as rendered and under the variations `CHOICE`, on oblique frames, and on the textures `other_bodies.CHOICE`. The
test has the variations `TEST`, other textures and the datasets --other. A kind of frames fails if the detector's AP
over the kind is below 0.6; frames without craters fail. Prints tables; writes alarms.json and alarms.png. The folder
`parts` keeps the features of each kind: run the command again to resume.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import cv2
import matplotlib
import numpy as np
import torch
import typer
from numpy.typing import NDArray

from benchmarks.figures import write_figures
from benchmarks.train import other_bodies
from benchmarks.train.robust import (
    VARIATIONS,
    Image,
    Variation,
    blur,
    every_nth,
    gamma,
    jpeg,
    noise,
    rounded,
    unchanged,
    varied,
)
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.console.terminal import answer
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.names import SPLITS
from perilune_train.data.frames import frame_table, load_images
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.split import DetectSplit, load_split
from perilune_train.detect.evaluate.matching import match_split
from perilune_train.detect.evaluate.metrics import curve
from perilune_train.detect.finished_run import config_of_run
from perilune_train.detect.images.suspect import suspicion_of
from perilune_train.detect.inference.detector import Detector, open_run
from perilune_train.detect.inference.scales import detect_at_scales
from perilune_train.detect.novelty import fit_training_features
from perilune_train.shipped.models import shipped_run

matplotlib.use("Agg")
import matplotlib.pyplot as plt

Array = NDArray[np.float64]
MIN_AP = 0.6
"""A kind of frames with a lower AP fails."""
CANDIDATES: dict[str, tuple[str, ...]] = {
    "backbone 2 and 4, neck": ("stage2", "stage4", "neck16", "neck8", "neck4"),
    "neck": ("neck4", "neck8", "neck16"),
    "backbone 2": ("stage2",),
    "backbone 2, 4 and 8": ("stage2", "stage4", "stage8"),
    "backbone 16 and 32": ("stage16", "stage32"),
    "energy of the objectness": ("energy",),
}
"""Features of each candidate: means of feature maps, by stride. The first is that of `YOLOv3.detect_with_features`."""
INSTALLED = "as in the run"
"""The first candidate as `detect calibrate` fitted it, on more frames."""


def motion_blur(length_px: int) -> Variation:
    """Blur along the rows."""
    kernel = np.full((1, length_px), 1 / length_px, np.float32)
    return lambda image, rng: rounded(cv2.filter2D(image.astype(np.float32), -1, kernel))


def gain(factor: float) -> Variation:
    """Longer exposure: brighter, and white where it exceeds the range."""
    return lambda image, rng: rounded(factor * image.astype(np.float32))


def contrast(factor: float) -> Variation:
    """Less contrast about a grey level of 100, as behind dust."""
    return lambda image, rng: rounded(100 + factor * (image - 100.0))


def spikes(share: float) -> Variation:
    """Black and white pixels at random, as from radiation."""

    def change(image: Image, rng: np.random.Generator) -> Image:
        hit = rng.random(image.shape) < share
        return np.where(hit, rng.choice(np.array([0, 255], np.uint8), image.shape), image)

    return change


def white_columns(image: Image, rng: np.random.Generator) -> Image:
    """Every eighth column is saturated."""
    return np.where(np.arange(image.shape[1]) % 8 == 0, np.uint8(255), image)


def shifted_rows(image: Image, rng: np.random.Generator) -> Image:
    """Every second row is 5 px too far right."""
    changed = image.copy()
    changed[1::2] = np.roll(image[1::2], 5, axis=1)
    return changed


CHOICE: dict[str, Variation] = {name: change for name, change in VARIATIONS.items() if change is not unchanged} | {
    "noise, 16 levels": noise(16),
    "noise, 30 levels": noise(30),
    "blur, 2.5 px": blur(2.5),
    "JPEG, quality 10": jpeg(10),
    "gamma 4": gamma(4),
    "negative": lambda image, rng: 255 - image,
}
TEST: dict[str, Variation] = {
    "gain 2": gain(2),
    "gain 4": gain(4),
    "gain 8": gain(8),
    "motion blur, 5 px": motion_blur(5),
    "motion blur, 11 px": motion_blur(11),
    "contrast 0.1": contrast(0.1),
    "contrast 0.03": contrast(0.03),
    "white columns": white_columns,
    "shifted rows": shifted_rows,
    "spikes, 1 %": spikes(0.01),
    "spikes, 5 %": spikes(0.05),
}


class Recorder:
    """Means of the detector's feature maps, of the images that it looks at in full size."""

    def __init__(self, detector: Detector):
        self.detector, self.side_px = detector, 0
        self.means: dict[str, list[Array]] = {}
        self._is_full_size = False
        network = detector.network
        network.backbone.register_forward_hook(self._see_stages)
        for stride, branch in network.branches.items():
            branch.register_forward_hook(lambda _m, _i, output, name=f"neck{stride}": self._keep(name, output))
        for head in network.heads.values():
            head.register_forward_hook(lambda _m, _i, output: self._see_objectness(output))

    def _see_stages(self, _module: object, _inputs: object, output: list[torch.Tensor]) -> None:
        self._is_full_size = 2 * output[0].shape[3] == self.side_px
        for number, stage in enumerate(output):
            self._keep(f"stage{2 ** (number + 1)}", stage)

    def _see_objectness(self, output: torch.Tensor) -> None:
        logits = output.unflatten(1, (3, 5))[:, :, 4].flatten(1)
        # The negative free energy of a predictor with the classes crater (logit) and none (0).
        energy = torch.nn.functional.softplus(logits).mean(1)
        self._keep("energy", energy[:, None, None, None])

    def _keep(self, name: str, maps: torch.Tensor) -> None:
        if self._is_full_size:
            self.means.setdefault(name, []).append(maps.float().mean((2, 3)).double().numpy())

    def features(self, images: NDArray[np.uint8]) -> dict[str, Array]:
        """Features (N, F) of frames (N, height, width) by name, without detection at other scales."""
        return self._look(images, lambda part: [self.detector.predict(part)])[1]

    def look(self, images: NDArray[np.uint8]) -> tuple[list[Any], dict[str, Array]]:
        """Detections of frames (N, height, width), and features (N, F) by name."""
        return self._look(images, lambda part: detect_at_scales(self.detector, part))

    def _look(
        self, images: NDArray[np.uint8], run: Callable[[NDArray[np.uint8]], list[Any]]
    ) -> tuple[list[Any], dict[str, Array]]:
        self.side_px, batch = images.shape[2], self.detector.config.batch_size
        detections, parts = [], []
        for start in range(0, len(images), batch):
            self.means = {}
            detections += run(images[start : start + batch])
            parts.append({name: np.concatenate(seen, axis=1) for name, seen in self.means.items()})
        return detections, {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


@dataclass(frozen=True)
class Kind:
    """Frames of one kind, as the detector sees them."""

    name: str
    """Name of the kind."""
    ap: float
    """AP over all frames; 0 without labels."""
    ap_of_frame: Array
    """AP of each frame (N,); 0 without labels."""
    suspected: NDArray[np.bool_]
    """Whether `detect predict` suspects each frame not to show the Moon (N,)."""
    features: dict[str, Array]
    """Features (N, F) by name."""


def of_candidate(features: dict[str, Array], candidate: str) -> Array:
    """Features (N, F) of a candidate, or of the run."""
    names = CANDIDATES.get(candidate) or next(iter(CANDIDATES.values()))
    return np.concatenate([features[name] for name in names], axis=1)


def kind_of(recorder: Recorder, folder: Path, name: str, make: Callable[[], DetectSplit | NDArray[np.uint8]]) -> Kind:
    """Look at the frames of a kind, or read what an earlier command saw."""
    path = folder / "parts" / f"{''.join(c if c.isalnum() else '_' for c in name)}.npz"

    def measured() -> dict[str, Any]:
        frames, started = make(), time.process_time()
        images = frames.frames.images if isinstance(frames, DetectSplit) else frames
        detections, features = recorder.look(images)
        ap, of_frame = 0.0, np.zeros(len(images))
        if isinstance(frames, DetectSplit):
            size = images.shape[2], images.shape[1]
            matches = match_split(detections, frames.labels, size, 0.5, frames.radius_px)
            ap, numbers = curve(matches).ap_paper(), np.arange(len(images))
            of_frame = np.array([curve(matches.of_frames(numbers == k)).ap_paper() for k in numbers])
        is_calibrated = recorder.detector.calibration is not None
        suspicions = [suspicion_of(*pair, is_calibrated) for pair in zip(images, detections, strict=True)]
        answer(f"{name}: {len(images)} frames, AP {ap:.3f}, {time.process_time() - started:.1f} s")
        suspected = np.array([reason is not None for reason in suspicions])
        return {"ap": np.array(ap), "of_frame": np.nan_to_num(of_frame), "suspected": suspected, **features}

    known = _kept(path, measured)
    ap, of_frame, suspected = float(known.pop("ap")), known.pop("of_frame"), known.pop("suspected").astype(bool)
    return Kind(name, ap, of_frame, suspected, known)


def area_under_roc(familiar: Array, novel: Array) -> float:
    """Probability that a novel frame has a higher score than a familiar one."""
    order = np.sort(familiar)
    below, up_to = (np.searchsorted(order, novel, side) for side in ("left", "right"))
    return float((below + up_to).mean() / 2 / len(order))


def compared(novelty: dict[str, Array], kinds: list[Kind]) -> dict[str, float]:
    """Figures of a score on kinds of frames: AUC by kind and by frame, shares of alarms."""
    fails = np.concatenate([np.full(len(kind.ap_of_frame), kind.ap < MIN_AP) for kind in kinds])
    frame_fails = np.concatenate([kind.ap_of_frame < MIN_AP for kind in kinds])
    suspected = np.concatenate([kind.suspected for kind in kinds])
    score = np.concatenate([novelty[kind.name] for kind in kinds])
    return {
        "frames": len(score),
        "failing": int(fails.sum()),
        "auc": area_under_roc(score[~fails], score[fails]),
        "auc_by_frame": area_under_roc(score[~frame_fails], score[frame_fails]),
        "alarms_failing": float((score > 1)[fails].mean()),
        "alarms_working": float((score > 1)[~fails].mean()),
        "suspected_failing": float(suspected[fails].mean()),
        "suspected_working": float(suspected[~fails].mean()),
        "either_failing": float(((score > 1) | suspected)[fails].mean()),
    }


def draw(path: Path, novelty: dict[str, Array], kinds: list[Kind]) -> None:
    """Novelty of every frame by kind, sorted by the AP of the kinds."""
    ordered = sorted(kinds, key=lambda kind: -kind.ap)
    figure, axes = plt.subplots(figsize=(9, 0.23 * len(ordered) + 1.4), layout="constrained")
    for row, kind in enumerate(ordered):
        values = novelty[kind.name]
        colour = "#b2182b" if kind.ap < MIN_AP else "#2166ac"
        axes.scatter(values, np.full(len(values), row), s=9, color=colour, alpha=0.5, linewidths=0)
    axes.axvline(1, color="black", linewidth=1)
    axes.set_yticks(range(len(ordered)), [f"{kind.name}: AP {kind.ap:.2f}" for kind in ordered], fontsize=7)
    axes.set(xscale="log", xlabel="novelty of a frame; the line is the limit of the alarm", ylim=(len(ordered), -1))
    axes.set_title("blue: kinds on which the detector works (AP from 0.6); red: on which it fails", fontsize=9)
    axes.grid(axis="x", alpha=0.3, which="both")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def overhead(detector: Detector, images: NDArray[np.uint8], repeats: int = 5) -> float:
    """Processor time of detection with novelty divided by that without, both in turn."""
    spent = {True: 0.0, False: 0.0}
    for _ in range(repeats):
        for with_novelty in spent:
            started = time.process_time()
            (detector.predict_with_novelty if with_novelty else detector.predict)(images)
            spent[with_novelty] += time.process_time() - started
    return spent[True] / spent[False]


def main(
    dataset: Path,
    oblique: Annotated[Path | None, typer.Option(help="Dataset whose val split has oblique frames.")] = None,
    other: Annotated[list[Path] | None, typer.Option(help="Dataset of the test: its first split. Repeatable.")] = None,
    run: Annotated[Path | None, typer.Option(help="Detect run. [default: the installed detector]")] = None,
    fit_every: Annotated[int, typer.Option(min=1, help="Fit on every n-th training frame.")] = 8,
    every: Annotated[int, typer.Option(min=1, help="Change every n-th validation frame.")] = 16,
    out: Path = Path("runs/bench/alarms"),
) -> None:
    """Compare the candidates."""
    run = run or shipped_run("detect")
    config = config_of_run(run, ("detect.device=cpu",))
    detector = open_run(run, config)
    recorder = Recorder(detector)

    def look(name: str, make: Callable[[], DetectSplit | NDArray[np.uint8]]) -> Kind:
        return kind_of(recorder, out, name, make)

    data = open_dataset(dataset)
    rows = frame_table(data, "train").iloc[::fit_every].reset_index(drop=True)
    fitted = _kept(out / "parts/training.npz", lambda: recorder.features(load_images(data, rows, "train")))
    val = load_split(data, "val", config.labels)
    small = every_nth(val, every)
    plain = look("validation", lambda: every_nth(val, 2))
    choice = [plain, *(look(name, partial(varied, small, change)) for name, change in CHOICE.items())]
    choice += [look(n, partial(other_bodies.frames_of, d, 14)) for n, d in other_bodies.CHOICE.items()]
    if oblique is not None:
        views = load_split(open_dataset(oblique), "val", config.labels)
        choice.append(look("oblique views", lambda: every_nth(views, 6)))
    test = [look(name, partial(varied, small, change)) for name, change in TEST.items()]
    test += [look(name, partial(other_bodies.frames_of, draw, 14)) for name, draw in other_bodies.TEST.items()]
    test += [look(_name_of(path), partial(_all_frames, path, config)) for path in other or []]
    result: dict[str, Any] = {"candidates": {}, "kinds": {}}
    fits = {name: fit_training_features(of_candidate(fitted, name), rows["scene_id"].to_numpy()) for name in CANDIDATES}
    novelty: dict[str, Array] = {}
    for candidate, fit in {INSTALLED: detector.training_features, **fits}.items():
        if fit is None:
            continue
        scores = {kind.name: fit.novelty(of_candidate(kind.features, candidate)) for kind in [*choice, *test]}
        novelty = novelty or scores
        figures = {"choice": compared(scores, choice), "test": compared(scores, [plain, *test])}
        figures["validation"] = {
            "alarms": float((scores[plain.name] > 1).mean()),
            "highest": float(scores[plain.name].max()),
        }
        result["candidates"][candidate] = figures
        for part, values in figures.items():
            answer(f"{candidate}, {part}: " + ", ".join(f"{key} {value:.3f}" for key, value in values.items()))
    for kind in [*choice, *test]:
        found = novelty[kind.name]
        row: dict[str, float] = {
            "ap": kind.ap,
            "alarms": float((found > 1).mean()),
            "suspected": float(kind.suspected.mean()),
        }
        row |= {"median": float(np.median(found)), "highest": float(found.max()), "frames": len(found)}
        result["kinds"][kind.name] = row
        answer(f"| {kind.name} | " + " | ".join(f"{value:.2f}" for value in row.values()) + " |")
    draw(out / "alarms.png", novelty, [*choice, *test])
    result["overhead"] = overhead(detector, small.frames.images[:4])
    write_figures(out / "alarms.json", result)


def _kept(path: Path, compute: Callable[[], dict[str, Array]]) -> dict[str, Array]:
    """Arrays by name, from a file or computed and then stored in it."""
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **compute())
    with np.load(path) as stored:
        return {name: stored[name] for name in stored.files}


def _name_of(path: Path) -> str:
    return open_dataset(path).info.name.removeprefix("perilune-")


def _all_frames(path: Path, config: DetectConfig) -> DetectSplit:
    """Frames of the first split of a dataset that has frames."""
    dataset = open_dataset(path)
    split = next(name for name in SPLITS if dataset.table("frames", ["frame_id"], split=name).num_rows)
    return load_split(dataset, split, config.labels)


if __name__ == "__main__":
    run_command_line(one_command(main))
