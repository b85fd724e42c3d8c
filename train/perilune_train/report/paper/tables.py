"""Tables of the page: Table II, AP by density of craters, Table III, and the ablations of the causes."""

import json
import math
from collections.abc import Mapping, Sequence

from perilune_shared.errors import UserError
from perilune_train.records.markdown import number, table
from perilune_train.records.metrics_file import Metrics
from perilune_train.records.spread import read_spread
from perilune_train.report.paper.claimed import DETECTION, NAVIGATION
from perilune_train.report.paper.runs import (
    CAUSES,
    HEADLINE,
    LONG,
    NAMES,
    NAVIGATORS,
    SPARSE,
    SPARSE_SHARE,
    TRANSFER,
    USUAL,
    PaperRuns,
)

_DETECTION = {
    "ap50_paper": "AP",
    "precision": "precision",
    "recall": "recall",
    "f1": "F1",
    "ap75_paper": "AP at IoU 0.75",
    "strict/ap50_paper": "AP, strict",
    "strict/precision": "precision, strict",
}
_GROUNDS = {
    HEADLINE: "headline",
    LONG: "headline with more epochs",
    SPARSE: f"sparse ({SPARSE_SHARE})",
    USUAL: "our usual",
    TRANSFER: "headline after transfer",
}
_HALF = "headline at half width"
_PLAIN_ONLY = (_GROUNDS[LONG], _GROUNDS[TRANSFER])
"""Grounds for which no training with identity gates is planned."""
_IDENTITY_ONLY = (_GROUNDS[USUAL],)
"""Grounds for which no training with plain CBAM is planned."""
_POSITION, _VECTOR = "position_rmse_per_component_m", "position_rmse_vector_m"
_ORIENTATION = "orientation_rmse_per_component_deg"
_NAVIGATION = {_POSITION: 3, _VECTOR: 3, _ORIENTATION: 5}
"""Metric of each column of Table III, with its number of decimals."""
FLOORS = {
    "mean_pose": "mean pose of the training",
    "mean_pose_at_frame": "mean pose of the training at that frame",
    "ridge": "ridge regression on the frozen features",
    "mean": "mean motion of the training",
    "mean_at_step": "mean motion of the training at that step",
    "nominal": "nominal motion",
}
"""Names of a navigator's baselines: methods without images, and ridge regression on the frozen features."""
_METHODS = {"klt": "KLT tracks, without training", "alignment": "direct alignment, without training"}


def table_2(runs: PaperRuns) -> list[str]:
    """Table II as lines of Markdown, with a line that names the missing training runs."""
    rows, missing = [], []
    for network, figures in DETECTION.items():
        cells = [f"{figures[key]:.4f}" if key in figures else "-" for key in _DETECTION]
        rows.append(["the paper", network, "-", "-", *cells, "-"])
    groups = {_GROUNDS[HEADLINE]: runs.detections(), _HALF: runs.halves()}
    groups |= {title: runs.detections(ground) for ground, title in _GROUNDS.items() if ground != HEADLINE}
    scored = {network: runs.scored(network) for network in NAMES}
    for title, trainings in groups.items():
        planned = [
            network
            for network in NAMES
            if not (network == "attention-identity" and title in _PLAIN_ONLY)
            and not (network == "attention-yolov3" and title in _IDENTITY_ONLY)
        ]
        absent = [NAMES[network] for network in planned if not trainings[network]]
        missing += [title if len(absent) == len(planned) else f"{title} ({'; '.join(absent)})"] if absent else []
        for network, network_trainings in trainings.items():
            if network_trainings:
                cells = [values(network_trainings, f"test/{key}") for key in _DETECTION]
                rows.append(
                    [
                        title,
                        NAMES[network],
                        str(len(network_trainings)),
                        epochs(network_trainings),
                        *cells,
                        labels_a_frame(network_trainings[0]),
                    ]
                )
    for network, metrics in scored.items():
        if metrics is not None:
            cells = [values([metrics], f"paper/{key}") for key in _DETECTION]
            rows.append(["locked benchmark", NAMES[network], "1", "-", *cells, labels_a_frame(metrics, "paper")])
    lines = table(["ground", "network", "training runs", "epochs", *_DETECTION.values(), "labels per frame"], rows)
    return [*lines, "", f"Not run: {', '.join(missing)}."] if missing else lines


def curve_table(curve: Mapping[str, Metrics], headline: str | None) -> list[str]:
    """Table of AP against equilibrium_share as lines of Markdown; the headline ground is in bold."""
    rows = []
    for share, metrics in curve.items():
        name = "lunar (our usual ground)" if share == USUAL else share
        keys = ("val/ap50_paper", "test/ap50_paper", "test/strict/ap50_paper", "test/precision", "test/recall")
        cells = [values([metrics], key) for key in keys]
        rows.append([f"**{name}, headline**" if share == headline else name, labels_a_frame(metrics), *cells])
    head = ["equilibrium_share", "labels per frame", "AP, validation", "AP, test", "AP, test, strict"]
    return table([*head, "precision", "recall"], rows)


def table_3(runs: PaperRuns, reading: str) -> list[str]:
    """Table III for one reading, a key of `READINGS`, as lines of Markdown: RMSE per component and of the vector."""
    rows = []
    navigation = runs.navigation(reading)
    for network, claimed in NAVIGATION.items():
        cells = [f"{claimed['position_m']:g}", "-", f"{claimed['orientation_deg']:g}", f"{claimed['seconds']:g}"]
        rows.append([network, "the paper", *cells])
        if network in navigation:
            metrics = navigation[network]
            floor = lost_to(metrics)
            here = f"here; **does not beat the {FLOORS[floor]}**" if floor else "here"
            rows.append([network, here, *_errors(metrics, "test"), seconds(metrics)])
        scored = runs.scored(NAVIGATORS[network]) if reading == "motion" else None
        if scored is not None:
            rows.append([network, "here, locked benchmark", *_errors(scored, "stack"), seconds(scored)])
    others: dict[str, list[str]] = {}
    for network, metrics in navigation.items():
        for method, name in (FLOORS | _METHODS).items():
            # Name the network, because the features come from its backbone.
            title = f"{name} of {network}" if method == "ridge" else name
            if f"baseline/{method}/{_POSITION}" in metrics:
                others.setdefault(title, [title, "here", *_errors(metrics, f"baseline/{method}"), "-"])
    head = ["network or method", "measured by", "position RMSE, per component (m)", "vector (m)"]
    return table([*head, "orientation RMSE, per component (deg)", "seconds per pair, CPU"], [*rows, *others.values()])


def floor(metrics: Metrics) -> str | None:
    """The baseline (`FLOORS`) with the lowest position RMSE in a navigate run; None if the run has no baselines."""
    errors = {name: metrics.get(f"baseline/{name}/{_POSITION}") for name in FLOORS}
    known = {name: value for name, value in errors.items() if isinstance(value, int | float)}
    return min(known, key=lambda name: known[name], default=None)


def lost_to(metrics: Metrics) -> str | None:
    """The best baseline (`floor`) if the network of a navigate run is not better than it; otherwise None."""
    best, error = floor(metrics), metrics.get(f"test/{_POSITION}")
    if best is None or not isinstance(error, int | float):
        return None
    value = metrics[f"baseline/{best}/{_POSITION}"]
    return best if isinstance(value, int | float) and error >= value else None


def read_causes(runs: PaperRuns) -> dict[str, list[str]]:
    """Tables of the ablations by cause, as lines of Markdown; empty if there is no paper-causes.json.

    The keys of this file are <cause>/<row>/<column>, where cause is loss, gates or ground. Values are numbers or
    strings. Entries of another form are not shown. Raises UserError if the file is damaged.
    """
    path = runs.root / CAUSES
    if not path.is_file():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise UserError(path, "content", str(error), "the file that make bench-paper-causes writes") from None
    if not isinstance(content, dict):
        raise UserError(path, "content", type(content).__name__, "the file that make bench-paper-causes writes")
    # Leave out the record of the run, which is an object.
    figures = {key: value for key, value in content.items() if isinstance(value, str | int | float)}
    causes: dict[str, dict[str, dict[str, str]]] = {}
    for key, value in figures.items():
        cause, _, rest = key.partition("/")
        row, _, column = rest.rpartition("/")
        if row and cause != "run":
            shown = value if isinstance(value, str) else number(value)
            causes.setdefault(cause, {}).setdefault(row, {})[column] = shown
    table_of_cause = {}
    for cause, rows in causes.items():
        columns = list(dict.fromkeys(column for cells in rows.values() for column in cells))
        lines = [[row, *[cells.get(column, "-") for column in columns]] for row, cells in rows.items()]
        table_of_cause[cause] = table(["changed", *columns], lines)
    return table_of_cause


def values(trainings: Sequence[Metrics], key: str, places: int = 3) -> str:
    """A figure as text: with its interval for one training run, mean and range for several; a dash if undefined."""
    known = numbers(trainings, key)
    if not known:
        return "-"
    if len(known) > 1:
        return f"{sum(known) / len(known):.{places}f} ({min(known):.{places}f} to {max(known):.{places}f})"
    limits = read_spread(trainings[0], key).interval
    return f"{known[0]:.{places}f}" + (f" ({limits[0]:.{places}f} to {limits[1]:.{places}f})" if limits else "")


def numbers(trainings: Sequence[Metrics], key: str) -> list[float]:
    """The finite values of a figure over training runs."""
    values = [metrics.get(key) for metrics in trainings]
    return [float(value) for value in values if isinstance(value, int | float) and math.isfinite(value)]


def epochs(trainings: Sequence[Metrics]) -> str:
    """Epochs of the training runs, as text; a dash if unknown."""
    counts = {str(metrics["train/epochs"]) for metrics in trainings if "train/epochs" in metrics}
    return " or ".join(sorted(counts, key=int)) or "-"


def labels_a_frame(metrics: Metrics, prefix: str = "test") -> str:
    """Mean number of selected labels per frame, as text; a dash if unknown."""
    labels, frames = (metrics.get(f"{prefix}/{key}") for key in ("labels", "frames"))
    return f"{labels / frames:.1f}" if isinstance(labels, int) and isinstance(frames, int) and frames else "-"


def seconds(metrics: Metrics) -> str:
    """Seconds per pair, as text; a dash if unknown."""
    milliseconds = metrics.get("test/ms_per_single_pair")
    return f"{milliseconds / 1e3:.3f}" if isinstance(milliseconds, int | float) else "-"


def _errors(metrics: Metrics, prefix: str) -> list[str]:
    return [values([metrics], f"{prefix}/{key}", places) for key, places in _NAVIGATION.items()]
