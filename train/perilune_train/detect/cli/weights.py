"""`perilune-train detect weights`."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.errors import UserError
from perilune_shared.terminal import say


def weights(
    checkpoint: Annotated[
        Path, typer.Argument(help="best.ckpt of a detect run; for a Darknet file of width 1 with 3 input channels.")
    ],
    out: Annotated[
        Path,
        typer.Option(
            help="File to write: NAME.safetensors to share, NAME.conv.74 for Darknet's backbone, NAME.weights for the"
            " whole network."
        ),
    ],
) -> None:
    """Write the weights of a run as a file to share, or as a Darknet file; `detect.init_from` reads both.

    NAME.safetensors has half precision and holds no code; a folder with it as weights.safetensors, config.yaml and
    metrics.json is a run.

    NAME.conv.74 has the 52 convolutions of the backbone. NAME.weights has all 75 and needs a network without attention
    and with strides 8 16 32; its output layers have 15 filters: x, y, width, height, objectness of 3 anchors.
    """
    if not out.name.endswith((".safetensors", ".conv.74", ".weights")):
        expected = "a name that ends in .safetensors, .conv.74 or .weights"
        raise UserError(out, "--out", f"the name {out.name}", expected)
    # Importing torch takes seconds; check the name first.
    from perilune_train.detect.inference.detector import check_detector, load_detector
    from perilune_train.detect.train.transfer import darknet_content
    from perilune_train.models.darknet_weights import write_darknet
    from perilune_train.training import runs
    from perilune_train.training.half_weights import write_half

    if out.suffix == ".safetensors":
        stored = runs.load_weights(checkpoint)
        check_detector(stored, checkpoint)
        write_half(out, stored)
        say(f"{out}: {len(stored['state_dict'])} tensors in half precision")
        return
    network = load_detector(checkpoint)
    architecture = runs.load_weights(checkpoint)["architecture"]
    content = darknet_content(network, architecture, checkpoint, whole=out.suffix == ".weights")
    write_darknet(out, content)
    gates = "" if architecture["attention"] == "none" else "; attention gates are not included"
    say(f"{out}: {len(content.values)} floats{gates}")
