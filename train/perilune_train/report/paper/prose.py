"""Texts of the page: the first paragraph, the rule for verdicts, the three causes, the deviations."""

from perilune_train.records.markdown import number
from perilune_train.report.paper.claimed import DETECTION, TARGET_AP
from perilune_train.report.paper.rule import AS_FAST, MIN_TRAININGS
from perilune_train.report.paper.runs import PaperRuns, nearest_share
from perilune_train.report.paper.tables import numbers

CAUSES = {
    "loss": "**Loss.** In common YOLO implementations, the weights 0.05 and 1 apply to means over boxes and cells. "
    "With plain sums, cells far outnumber boxes, and the boxes are hardly trained.",
    "gates": "**Gates.** At the start of training, each of the 23 plain CBAM modules scales its input by about 0.25. "
    "In a frozen backbone that was trained without gates, they leave almost no signal for the later layers. Gates "
    "from identity start at 1.",
    "ground": "**Ground.** perilune's usual ground has many craters, and many of them are too faint to see. The "
    "paper's rule labels them all. The curve above shows the network on sparser ground.",
}
"""Text on each cause, by the first part of its keys in paper-causes.json."""

DEVIATIONS = (
    "Frames are rendered by perilune instead of PANGU. The paper does not publish its data, camera or Sun. The "
    "headline ground is chosen only by its difficulty for YOLOv3 without attention.",
    "The grey frame is repeated in three channels, as in PANGU's images of grey ground.",
    "Loss: `detect.loss.reduction=means` instead of the paper's sums over cells and boxes. Sums are tested in an "
    "ablation.",
    "YOLOv3 ignores predictors that overlap a label by an IoU above 0.5 but are not its best predictor. Here they are "
    "negative.",
    "COCO is not used. In the rows after transfer, one of perilune's networks replaces YOLOv3 trained on COCO.",
    "Gates: the paper uses plain CBAM. Gates from identity are CBAM with twice the sigmoid, and their last weights "
    "start at zero.",
    "Optimiser (AdamW with warm-up and one cosine for detection), learning rate, batch and epochs of detection, and "
    "the weight of empty cells in the objectness loss (1) are perilune's choices; the paper does not state them.",
    "Craters with a radius just outside 2 to 50 px, or with their centre off the frame, are neither positive nor "
    "negative in training. The usual scoring rule ignores detections on them; the strict rule counts these as false "
    "positives.",
    "A cell can predict a centre up to half a cell outside the cell. There is no class output. The initial objectness "
    "is 0.01 in every cell.",
    "Navigation: in the paper, the network estimates the pose in the landing frame; motion between frames is another "
    "possible reading of the paper. The backbone starts from the weights of the detector. It is frozen in the coarse "
    "stage, and its features are stored.",
    "Rotations are output in units of their r.m.s. in training. Without attitude noise the camera does not rotate, so "
    "the orientation error carries no information. With ATTITUDE=1, it is measured on descents with attitude noise.",
    "The navigators' errors are standardised before they enter the loss, and means replace sums over pairs. For the "
    "pose, the weight of each axis lies between the weight for errors in metres and the weight for standardised "
    "errors. The coarse stage has a higher learning rate. In the fine stage, the learning rate of the backbone is a "
    "hundredth of the paper's 1e-4. Training sequences include further views, warped over the ground plane.",
    "Features of the backbone are standardised before the LSTM, and the backbone keeps the batch statistics of the "
    "detector. Poses are evaluated in causal windows as long as the training sequences; the LSTM's state is not "
    "carried over the descent.",
    "The weights of the epoch with the best validation result are tested.",
)


def lead(runs: PaperRuns, share: str | None, *, given: bool) -> str:
    """The first paragraph of the page.

    `share` is the equilibrium_share of the headline ground; `given` says whether the caller chose it.
    """
    return " ".join([_ground(runs, share, given), _scoring(runs), _trainings(runs)])


def verdict_note() -> str:
    """The rule for verdicts, in words."""
    return (
        f"Better and worse are treated alike. With at least {MIN_TRAININGS} training runs of each network, a claim "
        "*holds* if every run with attention is better than every run without it, and *does not hold* if every run "
        "with attention is worse. With one training run of each network, a claim holds or does not hold only if the "
        "95 % intervals over trajectories do not overlap; these intervals do not cover differences between training "
        "runs. Otherwise the claim is *open*. Times that differ by at most "
        f"{100 * (AS_FAST - 1):.0f} % count as equal. A claim on gates holds if it is true for all of its gates, and "
        "does not hold if it is true for none. It is open over fewer than five scenes; the experiment has one scene."
    )


def _ground(runs: PaperRuns, share: str | None, given: bool) -> str:
    curve = runs.curve(share)
    reason = (
        "ground as difficult as the paper's, chosen only by YOLOv3 without attention, so that it favours neither "
        "network"
    )
    if share is None:
        return f"**Ground.** The headline is {reason}. The curve that chooses it was not run."
    nearest = nearest_share(curve)
    text = f"**Ground.** The headline ground has `equilibrium_share` {share}: {reason}."
    if share == nearest:
        ap = number(curve[share].get("val/ap50_paper"))
        text += f" Of {len(curve)} grounds it has the validation AP ({ap}) nearest to the paper's {TARGET_AP:.3f}."
    elif given:
        better = "the curve was not run" if nearest is None else f"on the curve {nearest} is nearer to {TARGET_AP:.3f}"
        text += f" The share was set by the user; {better}."
    strict = nearest_share(curve, "strict/")
    if strict is not None and strict != share:
        ap = number(curve[strict].get("val/strict/ap50_paper"))
        text += f" By the strict scoring rule, the nearest share would be {strict} ({ap})."
    return text


def _scoring(runs: PaperRuns) -> str:
    paper = DETECTION["YOLOv3"]
    text = (
        "**Scoring.** Labels follow the paper's rule, radii of 2 to 50 px. Headline figures use the usual scoring "
        "rule, which ignores detections that the labels cannot decide. The strict rule counts a detected crater just "
        "below 2 px as a false positive. The paper mentions no ignored detections, so either its rule was strict, or "
        "its images had few craters just below 2 px"
    )
    trainings = runs.detections()["yolov3"] or runs.halves()["yolov3"][:1]
    usual, strict, recall = (numbers(trainings, f"test/{key}") for key in ("precision", "strict/precision", "recall"))
    if usual and strict and recall:
        text += (
            f" (precision {paper['precision']:.3f} at recall {paper['recall']:.3f}; here {usual[0]:.3f} usual and "
            f"{strict[0]:.3f} strict at recall {recall[0]:.3f})"
        )
    return f"{text}. Headline figures use the usual rule because a crater just below 2 px is not a false detection."


def _trainings(runs: PaperRuns) -> str:
    halves = [len(trainings) for trainings in runs.halves().values() if trainings]
    if max(halves, default=0) < 2:
        return "**Training runs.** Every figure comes from one training run of each network."
    counted = f"{min(halves)}" if len(set(halves)) == 1 else f"{min(halves)} to {max(halves)}"
    return (
        f"**Training runs.** At half width, there are {counted} training runs of each network. All other figures, "
        "including full width and navigation, come from one training run of each network."
    )
