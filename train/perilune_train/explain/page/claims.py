"""All statements on the gates of a run, each with its figure, interval, nulls, verdict and picture."""

from collections.abc import Collection

from perilune_train.explain.evidence.tables import Evidence
from perilune_train.explain.page.claim import Claim
from perilune_train.explain.page.correlation_claims import (
    LOCALISATION,
    against_nulls,
    deep_alike,
    located,
    motion,
    shallow,
)
from perilune_train.explain.page.intervention_claims import HARM_RATIO, forced_claim, removal_claim

LEAST_DEVIATION = 0.02
"""A gate whose mask has a smaller standard deviation over pixels and images is called constant."""
_REMOVES = "removing the 20 %"


def detector_claims(found: Evidence, deviations: dict[str, float], guided: Collection[str] = ()) -> list[Claim]:
    """Claims on the detector; `deviations` are the standard deviations of the masks over pixels and images.

    `guided` are gates whose masks were trained to follow labels; the claims say so.
    """
    strongest = found.strongest
    follows = f"Detector: the mask of {strongest} follows craters"
    trained = ", as it was trained to" if strongest in guided else ""
    beyond = f"{follows} beyond brightness and gradient{trained}"
    unit = "AP of a frame"
    return [
        against_nulls(found, "pcc1_craterness", strongest, follows + trained, "pcc_detect.png"),
        against_nulls(found, "pcc1_partial", strongest, beyond, "pcc_detect.png"),
        shallow(found),
        deep_alike(found),
        *(located(found, measure) for measure in LOCALISATION),
        removal_claim(found, "Detector", unit, "removal_detect.png", higher_is_better=True),
        forced_claim(found, "Detector", unit, "gates_detect.png", higher_is_better=True),
        _constant("Detector", deviations, "masks_detect.png"),
    ]


def navigator_claims(found: Evidence, deviations: dict[str, float]) -> list[Claim]:
    """Claims on the stack navigator."""
    strongest, unit = found.strongest, "position error of a pair, m"
    alike = f"Navigator: both halves of the mask of {strongest} mark the same ground (PCC4)"
    return [
        against_nulls(found, "pcc4", strongest, alike, "pcc_navigate.png"),
        motion(found, moving=True),
        motion(found, moving=False),
        removal_claim(found, "Navigator", unit, "removal_navigate.png", higher_is_better=False),
        forced_claim(found, "Navigator", unit, "gates_navigate.png", higher_is_better=False),
        _constant("Navigator", deviations, "masks_navigate.png"),
    ]


def headline(claims: list[Claim]) -> str:
    """One sentence for each task: whether its strongest gate beats every null, and whether removal hurts enough."""
    sentences = []
    for task in ("Detector", "Navigator"):
        own = [one for one in claims if one.claim.startswith(task)]
        if not own:
            continue
        parts = [f"{own[0].claim[len(task) + 2 :]}: {own[0].verdict}"]
        removal = next((one for one in own if _REMOVES in one.claim), None)
        if removal is not None:
            parts.append(
                f"removing what it attends to hurts {HARM_RATIO:g} times as much as controls: {removal.verdict}"
            )
        sentences.append(f"{task}: " + "; ".join(parts) + ".")
    return " ".join(sentences)


def _constant(task: str, deviations: dict[str, float], picture: str) -> Claim:
    least = min(deviations, key=lambda block: deviations[block])
    constant = [block for block, value in deviations.items() if value < LEAST_DEVIATION]
    return Claim(
        f"{task}: no gate is constant (standard deviation over pixels and images at least {LEAST_DEVIATION:g})",
        f"{len(constant)} of {len(deviations)} constant; least {deviations[least]:.3f} ({least})",
        "-",
        "-",
        "does not hold" if constant else "holds",
        picture,
    )
