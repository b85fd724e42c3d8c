"""Tables II and III: the paper's figures, ours, and ours on the locked benchmark."""

from perilune_train.evaluation.markdown import number, table
from perilune_train.evaluation.metrics_file import Metrics
from perilune_train.evaluation.spread import read_spread
from perilune_train.navigate.evaluate.floors import FLOORS
from perilune_train.paper.claimed import DETECTION, NAVIGATION
from perilune_train.paper.runs import PaperRuns

_DETECTION = {"precision": "precision", "recall": "recall", "ap50_paper": "AP", "f1": "F1"}
_POSITION, _VECTOR = "position_rmse_per_component_m", "position_rmse_vector_m"
_ORIENTATION = "orientation_rmse_per_component_deg"

_WITHOUT_NETWORK = {
    "klt": "KLT tracks, without training",
    "alignment": "direct alignment, without training",
    "nominal": "nominal motion, without images",
    "mean_at_step": "mean motion of the training at that step, without images",
    "mean": "mean motion of the training, without images",
}
"""Names of the methods beside the networks."""


def table_2(runs: PaperRuns) -> list[str]:
    """Table II as lines of Markdown: the paper, here, and the locked benchmark by the paper's rule of labels."""
    rows = []
    for network, metrics in runs.detection().items():
        rows.append([network, "paper", *[f"{DETECTION[network][key]:.4f}" for key in _DETECTION]])
        rows.append([network, "here", *_cells(metrics, "test", _DETECTION)])
        scored = runs.scored(network)
        if scored is not None:
            rows.append([network, "here, locked benchmark", *_cells(scored, "paper", _DETECTION)])
    return table(["network", "measured by", *_DETECTION.values()], rows)


def table_3(runs: PaperRuns) -> list[str]:
    """Table III as lines of Markdown, with the RMSE of the vector's length beside that of the components."""
    rows = []
    for network, metrics in runs.navigation().items():
        claimed = NAVIGATION[network]
        given = [f"{claimed['position_m']:g}", "-", f"{claimed['orientation_deg']:g}", f"{claimed['seconds']:g}"]
        rows.append([network, "paper", *given])
        here = (
            f"here, worse than {metrics['evaluation/worse_than']}" if metrics.get("evaluation/worse_than") else "here"
        )
        rows.append([network, here, *_navigation(metrics, "test"), _seconds(metrics)])
        scored = runs.scored(network)
        if scored is not None:
            rows.append([network, "here, locked benchmark", *_navigation(scored, "stack"), _seconds(scored)])
    rows += _floors(runs)
    return table(
        [
            "network",
            "measured by",
            "position RMSE, per component (m)",
            "vector (m)",
            "orientation RMSE, per component (deg)",
            "seconds per pair, CPU",
        ],
        rows,
    )


def _floors(runs: PaperRuns) -> list[list[str]]:
    """Rows of the methods beside the networks; ridge regression of each network's features, the others once."""
    rows: dict[str, list[str]] = {}
    for network, metrics in runs.navigation().items():
        for method, name in (_WITHOUT_NETWORK | FLOORS).items():
            if f"baseline/{method}/{_VECTOR}" in metrics:
                title = f"{name} of {network}" if method == "ridge" else name
                rows.setdefault(title, [title, "here", *_navigation(metrics, f"baseline/{method}"), "-"])
    return list(rows.values())


def _navigation(metrics: Metrics, prefix: str) -> list[str]:
    return [_text(metrics, f"{prefix}/{key}", f"{{:.{places}f}}") for key, places in _PLACES.items()]


_PLACES = {_POSITION: 3, _VECTOR: 3, _ORIENTATION: 5}


def _seconds(metrics: Metrics) -> str:
    found = metrics.get("test/ms_per_single_pair")
    return f"{found / 1e3:.3f}" if isinstance(found, int | float) else "-"


def _text(metrics: Metrics, key: str, form: str) -> str:
    """A value with its interval, in a number format."""
    value = metrics.get(key)
    if not isinstance(value, int | float):
        return "-"
    spread = read_spread(metrics, key)
    limits = f" ({form.format(spread.interval[0])} to {form.format(spread.interval[1])})" if spread.interval else ""
    return form.format(value) + limits


def _cells(metrics: Metrics, prefix: str, columns: dict[str, str]) -> list[str]:
    found = []
    for key in columns:
        value = metrics.get(f"{prefix}/{key}")
        spread = read_spread(metrics, f"{prefix}/{key}")
        found.append(spread.text(float(value)) if isinstance(value, int | float) else number(None))
    return found
