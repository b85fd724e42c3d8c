"""`perilune-train detect weights`."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.errors import UserError
from perilune_shared.terminal import say


def weights(
    checkpoint: Annotated[Path, typer.Argument(help="best.ckpt of a detect run of width 1 with 3 input channels.")],
    out: Annotated[
        Path, typer.Option(help="File to write: NAME.conv.74 for the backbone, NAME.weights for the whole network.")
    ],
) -> None:
    """Write the weights of a run as a Darknet file, which `detect.init_from` can read.

    NAME.conv.74 has the 52 convolutions of the backbone. NAME.weights has all 75 and needs a network without attention
    and with strides 8 16 32; its output layers have 15 filters: x, y, width, height, objectness of 3 anchors.
    """
    if not out.name.endswith((".conv.74", ".weights")):
        raise UserError(out, "--out", f"the name {out.name}", "a name that ends in .conv.74 or .weights")
    # Importing torch takes seconds; check the name first.
    from perilune_train.detect.inference.detector import load_detector
    from perilune_train.detect.train.transfer import darknet_content
    from perilune_train.models.darknet_weights import write_darknet
    from perilune_train.training import runs

    network = load_detector(checkpoint)
    architecture = runs.load_weights(checkpoint)["architecture"]
    content = darknet_content(network, architecture, checkpoint, whole=out.suffix == ".weights")
    write_darknet(out, content)
    gates = "" if architecture["attention"] == "none" else "; attention gates are not included"
    say(f"{out}: {len(content.values)} floats{gates}")
