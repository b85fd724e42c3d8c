"""The runs of the paper's experiment: the names of their folders, and which runs are finished.

A ground is the terrain under the frames of one dataset. Grounds differ in `equilibrium_share`, the density of small
craters as a share of the equilibrium density. The headline ground is the ground on which networks are compared. Our
usual ground, `lunar`, has the craters and the relief of the preset `paper`.

Folders and files below the root of the runs:

    detect/curve-<share>            YOLOv3 without attention on grounds of increasing crater density; <share> is the
                                    equilibrium_share as text, or `lunar`
    detect/<network>                headline ground, full width; networks are the keys of `ATTENTION`
    detect/<network>-half-<seed>    headline ground, half width, seeds `SEEDS`
    detect/sparse-<network>         sparse ground, full width
    detect/lunar-<network>          our usual ground, with labels by the paper's rule
    detect/long-<network>           headline ground, full width, more epochs
    detect/transfer-<network>       headline ground, started from our own network; the backbone, except its attention
                                    gates, is frozen in the first epochs
    navigate/<navigator>-stack, navigate/<navigator>-attitude-stack, navigate/<navigator>-motion-stack
                                    pose in O_L (as we read the paper), pose in O_L with attitude noise, and motion
                                    between frames
    explain/attention
    benchmark/<network>, benchmark/<navigator>
                                    scores on the locked benchmark; only the navigator for motion is scored, because
                                    the landing frame of other ground is unknown
    paper-causes.json               ablations (`read_causes` in tables.py)

Each of these may be missing.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from perilune_train.records.metrics_file import METRICS_FILE, Metrics, read_metrics
from perilune_train.report.paper.claimed import TARGET_AP

DETECTORS = {"YOLOv3": "yolov3", "attention-YOLOv3": "attention-yolov3"}
"""Folder of each detector of the paper, by the paper's name."""
ATTENTION = {"yolov3": "none", "attention-yolov3": "cbam", "attention-identity": "cbam_identity"}
"""Value of detect.attention, by the folder of the detector."""
NAMES = {
    "yolov3": "YOLOv3",
    "attention-yolov3": "attention-YOLOv3, plain CBAM",
    "attention-identity": "attention-YOLOv3, gates from identity",
}
"""Names of the detectors on the page."""
SEEDS = (0, 1, 2)
"""Random seeds of the training runs at half width."""
HEADLINE, SPARSE, USUAL, TRANSFER, LONG = "", "sparse", "lunar", "transfer", "long"
"""First parts of the names of runs. HEADLINE, SPARSE and USUAL are grounds. TRANSFER and LONG are variants of training
on the headline ground: started from our own network, and with more epochs."""
SPARSE_SHARE = "0.1"
"""equilibrium_share of the sparse ground."""
CURVE = "curve"
"""First part of the names of the runs on grounds of increasing crater density."""
NAVIGATORS = {"Darknet53-LSTM": "darknet53-lstm", "attention-Darknet53-LSTM": "attention-darknet53-lstm"}
"""First part of the names of the navigate runs, by the paper's name of the network."""
READINGS = {"pose": "", "attitude": "-attitude", "motion": "-motion"}
"""What a navigator estimates, by our two readings of the paper: the pose in O_L (without and with attitude noise), or
the motion between frames. The values are the last parts of the names of the navigate runs. Folders have these names
followed by -stack."""
EXPLAINED = "attention"
"""Name of the explain run."""
CAUSES = "paper-causes.json"
"""File with the ablations of three possible causes of a low AP: loss, gates and ground."""
BENCHMARK_FILE = "benchmark.json"


def detect_name(network: str, ground: str = HEADLINE, seed: int | None = None) -> str:
    """Name of a detector's training run. `network` is a key of `ATTENTION`; with a seed, the run is at half width."""
    half = [] if seed is None else ["half", str(seed)]
    return "-".join([*([ground] if ground else []), network, *half])


def navigate_name(navigator: str, reading: str = "pose") -> str:
    """Name of a navigator's training run. `navigator` is a value of `NAVIGATORS`, `reading` a key of `READINGS`."""
    return navigator + READINGS[reading]


def nearest_share(curve: Mapping[str, Metrics], prefix: str = "") -> str | None:
    """The equilibrium_share at which the validation AP is nearest to the AP of the paper's YOLOv3.

    The point `lunar` of the curve is not considered. `prefix` selects the scoring rule: "" (usual) or "strict/".
    Returns None if no point has an AP.
    """
    ap_of_share = {share: metrics.get(f"val/{prefix}ap50_paper") for share, metrics in curve.items() if share != USUAL}
    known = {share: abs(ap - TARGET_AP) for share, ap in ap_of_share.items() if isinstance(ap, int | float)}
    return min(known, key=lambda share: known[share], default=None)


@dataclass(frozen=True)
class PaperRuns:
    """Folders and metrics of the experiment's runs. Methods raise UserError only if metrics are damaged."""

    root: Path
    """The folder of all these runs, such as runs/paper."""

    def detector(self, name: str) -> Path:
        """Folder of the detect run with this name."""
        return self.root / "detect" / name

    def navigator(self, name: str) -> Path:
        """Folder of the navigate run with this name."""
        return self.root / "navigate" / f"{name}-stack"

    @property
    def explained(self) -> Path:
        """Folder of the explain run."""
        return self.root / "explain" / EXPLAINED

    def benchmark(self, name: str) -> Path:
        """Folder with the benchmark score of the detector or navigator whose run folder has this name."""
        return self.root / "benchmark" / name

    def detections(self, ground: str = HEADLINE) -> dict[str, list[Metrics]]:
        """Metrics of the finished training runs at full width on a ground, at most one per network."""
        return {network: self._detect(detect_name(network, ground)) for network in ATTENTION}

    def halves(self) -> dict[str, list[Metrics]]:
        """Metrics of the finished training runs at half width on the headline ground, by network."""
        names = {network: [detect_name(network, seed=seed) for seed in SEEDS] for network in ATTENTION}
        return {network: self._detect(*run_names) for network, run_names in names.items()}

    def curve(self, headline: str | None = None) -> dict[str, Metrics]:
        """Metrics of YOLOv3 without attention by equilibrium_share, from sparse to `lunar`.

        Runs on the sparse, the headline and our usual ground are also points of the curve if their network size and
        epochs equal those of the curve's runs. `headline` is the equilibrium_share of the headline ground.
        """
        name_of_share = {path.name.removeprefix(f"{CURVE}-"): path.name for path in self.root.glob(f"detect/{CURVE}-*")}
        read = {share: finished(self.detector(name)) for share, name in name_of_share.items()}
        plain = next(iter(ATTENTION))
        sizes = {_size(metrics) for metrics in read.values() if metrics is not None}
        others = [(SPARSE_SHARE, detect_name(plain, SPARSE)), (USUAL, detect_name(plain, USUAL))]
        others += [(headline, detect_name(plain, seed=seed)) for seed in (None, SEEDS[0]) if headline is not None]
        for share, name in others:
            metrics = finished(self.detector(name))
            if metrics is not None and read.get(share) is None and _size(metrics) in sizes:
                read[share] = metrics
        shares = sorted((share for share in read if _is_number(share)), key=float)
        ordered = {share: read[share] for share in [*shares, *({USUAL} & set(read))]}
        return {share: metrics for share, metrics in ordered.items() if metrics is not None}

    def navigation(self, reading: str) -> dict[str, Metrics]:
        """Metrics of the finished navigate runs for one reading, a key of `READINGS`, by the paper's names."""
        folders = {name: self.navigator(navigate_name(network, reading)) for name, network in NAVIGATORS.items()}
        read = {name: finished(folder) for name, folder in folders.items()}
        return {name: metrics for name, metrics in read.items() if metrics is not None}

    def explanation(self) -> Metrics | None:
        """Metrics of the explain run; None if it is missing or not finished."""
        return finished(self.explained)

    def scored(self, name: str) -> Metrics | None:
        """Metrics of a detector or navigator on the locked benchmark; None if they are missing."""
        return finished(self.benchmark(name), BENCHMARK_FILE)

    def all_finished(self) -> dict[str, Metrics]:
        """Metrics of every finished run, by the folder relative to the root, such as detect/yolov3."""
        files = sorted(path for kind in ("detect", "navigate") for path in self.root.glob(f"{kind}/*/{METRICS_FILE}"))
        files += [self.explained / METRICS_FILE, *sorted(self.root.glob(f"benchmark/*/{BENCHMARK_FILE}"))]
        read = {path.parent.relative_to(self.root).as_posix(): finished(path.parent, path.name) for path in files}
        return {name: metrics for name, metrics in read.items() if metrics is not None}

    def _detect(self, *names: str) -> list[Metrics]:
        read = [finished(self.detector(name)) for name in names]
        return [metrics for metrics in read if metrics is not None]


def finished(folder: Path, file: str = METRICS_FILE) -> Metrics | None:
    """Metrics of a run; None if it is missing or not finished."""
    return read_metrics(folder, file) if (folder / file).is_file() else None


def _size(metrics: Metrics) -> tuple[object, object]:
    """Network size of a detector, and the epochs of its training."""
    return metrics.get("parameters"), metrics.get("train/epochs")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
