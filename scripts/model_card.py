"""Write the card of an installed network from its metrics and its figures on the locked benchmark."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Shipment:
    """The network, figures and notes that a card shows."""

    name: str
    """Name of the installed network."""
    content: dict[str, Any]
    """Content of the checkpoint: architecture and weights."""
    metrics: dict[str, Any]
    """metrics.json of the run."""
    figures: dict[str, Any]
    """benchmark.json of the run."""
    manifests: dict[str, str]
    """Shared manifests of the training data: SHA-256 of dataset.json, by name. The second is only of the ellipses."""
    size_mb: float
    """Size of the weights, MB."""
    precision: str = "half precision"
    """How the weights are stored."""
    others: tuple[dict[str, Any], ...] = ()
    """benchmark.json of training runs with other random seeds, which are not installed."""
    notes: tuple[str, ...] = ()
    """Caveats of this network or of its benchmark, one line for each."""


def model_card(shipment: Shipment) -> str:
    """The card as Markdown."""
    return "\n".join([f"# {shipment.name}", "", *_detector(shipment), *[f"- {note}" for note in shipment.notes], ""])


def _scores(shipment: Shipment) -> tuple[str, str]:
    """Texts on the threshold and on the meaning of a score."""
    metrics, threshold = shipment.metrics, shipment.figures.get("threshold", 0)
    if "calibration/threshold" not in metrics:
        meaning = "of the network, without calibration: a score is no probability"
        return f"{threshold:.3f}, chosen on validation scenes", meaning
    raw, error = metrics["calibration/raw_threshold"], metrics["calibration/ece_after"]
    return (
        f"a probability of {metrics['calibration/threshold']:.3f} ({raw:.3f} before calibration), chosen on validation "
        "scenes",
        f"probabilities of a match with a label `visible`; expected calibration error {error:.3f} on the frames of the "
        f"fit ({metrics['calibration/frames']})",
    )


def _facts(shipment: Shipment, network: str) -> list[str]:
    commit = str(shipment.metrics.get("run/commit", "unknown"))[:7]
    named = [f"`{name}` ({sha256[:16]})" for name, sha256 in shipment.manifests.items()]
    data = f"manifest {named[0]}" + (f"; its ellipses also {named[1]}" if len(named) > 1 else "")
    data += "; in brackets the SHA-256 of dataset.json. Rendered frames only"
    threshold, meaning = _scores(shipment)
    rows = {
        "Network": network,
        "Weights": f"{shipment.size_mb:.1f} MB, {shipment.precision}, safetensors",
        "Training data": data,
        "Trained at": f"commit {commit}, {shipment.metrics.get('run/hardware', 'unknown hardware')}",
        "Ellipses": _ellipses(shipment),
        "Threshold": threshold,
        "Scores": meaning,
        "Licence": "Apache-2.0",
    }
    return ["| | |", "|---|---|", *[f"| {key} | {value} |" for key, value in rows.items() if value]]


def _ellipses(shipment: Shipment) -> str:
    """Text on the ellipses; empty if there are none."""
    if not shipment.content["architecture"].get("ellipses"):
        return ""
    commit = str(shipment.metrics.get("ellipses/run/commit", "unknown"))[:7]
    score = _figure(shipment.figures, "visible/ellipse_score")
    return (
        "centre, semi-axes, direction and standard deviations; the tower was trained alone on top of the other "
        f"weights, commit {commit}. NASA's score on the locked benchmark, labels `visible`: {score} of 100"
    )


def _figure(figures: dict[str, Any], key: str) -> str:
    value, low, high = (figures.get(f"{key}{end}") for end in ("", "_low", "_high"))
    if not isinstance(value, int | float):
        return "not measured"
    limits = f" ({low:.3f} to {high:.3f})" if isinstance(low, float) and isinstance(high, float) else ""
    return f"{value:.3f}{limits}"


def _detector(shipment: Shipment) -> list[str]:
    figures, shape = shipment.figures, shipment.content["architecture"]
    network = (
        f"attention-YOLOv3, width {shape['width']:g}, {shape['in_channels']} channel, attention "
        f"`{shape['attention']}`, strides {' '.join(map(str, shape['strides']))}"
    )
    rows = [
        f"| {selection} | {scoring_rule} | {_figure(figures, f'{selection}/{prefix}ap50_paper')} | "
        f"{_figure(figures, f'{selection}/{prefix}f1')} |"
        for selection in ("visible", "paper")
        for scoring_rule, prefix in (("usual", ""), ("edge", "edge/"), ("strict", "strict/"))
    ]
    bins = [
        f"| {_bin_title(key)} | {value:.3f} |"
        for key, value in figures.items()
        if key.startswith(("visible/radius_", "visible/sun_", "visible/altitude_"))
        and key.endswith("/ap50_paper")
        and isinstance(value, float)
    ]
    return [
        "This detector finds lunar craters in camera images taken from above. `perilune-train detect predict` uses it "
        "if `--run` is not given.",
        "",
        *_facts(shipment, network),
        "",
        "## Locked benchmark",
        "",
        f"**AP {figures['headline/ap50_paper']:.3f}, F1 {figures['headline/f1']:.3f}** by the least favourable "
        "scoring rule.",
        "",
        "| labels | scoring rule | AP | F1 |",
        "|---|---|---|---|",
        *rows,
        "",
        "In brackets: 95 % intervals over scenes.",
        "",
        "- `visible`: craters above the contrast at which an earlier detector found about half",
        "- `paper`: all craters with a radius of 2 to 50 px, even with little contrast",
        "- usual: detections on craters that are not selected are ignored",
        "- edge: detections of 1.5 to 2 px that overlap no crater are false positives",
        "- strict: every unmatched detection is a false positive",
        "",
        "| bin, labels by `visible`, usual scoring rule | AP |",
        "|---|---|",
        *bins,
        "",
        "## Limits",
        "",
        "- It was trained on rendered frames of 256 x 256 pixels over 50 degrees; real images differ from them.",
        "- It finds craters with a radius of about 2 to 80 pixels. Reduce the size of images with larger craters "
        "(`--scale`).",
        _views(shipment),
        *_seeds(shipment),
    ]


def _views(shipment: Shipment) -> str:
    if shipment.content["architecture"].get("ellipses"):
        return "- Boxes and scores were trained on views from straight down; the ellipses up to 60 degrees from it."
    return "- The training data has no views far from straight down."


def _seeds(shipment: Shipment) -> list[str]:
    """Lines with the AP of training runs with other random seeds, the smallest AP first."""
    if not shipment.others:
        return ["- The figures are of one training run."]
    scoring_rules = {"paper/strict/": "labels `paper`, strict", "visible/edge/": "labels `visible`, edge"}
    figures_by_rule = []
    for prefix, title in scoring_rules.items():
        values = sorted(other[f"{prefix}ap50_paper"] for other in shipment.others)
        figures_by_rule.append(f"{', '.join(f'{value:.3f}' for value in values)} ({title})")
    count = len(shipment.others)
    runs = "a run with another random seed" if count == 1 else f"{count} runs with other random seeds"
    return [f"- The figures are of one training run. The AP of {runs}: {' and '.join(figures_by_rule)}."]


def _bin_title(key: str) -> str:
    """Name of a bin: `radius 2-3 px` of `visible/radius_2_3_px/ap50_paper`."""
    kind, low, high, unit = key.split("/")[1].split("_")
    return f"{kind} {low}-{high} {unit}"
