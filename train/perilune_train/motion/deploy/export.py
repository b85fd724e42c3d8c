"""Export of a trained navigator for flight: an ONNX file with explicit state, checked against torch."""

import json
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from perilune_shared.dataset.manifest import open_single
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.storage.files import new_folder, sha256_of, write_text
from perilune_shared.storage.store import Address
from perilune_train.detect.deploy.engines import package
from perilune_train.motion.data.sequences import pair_sequence
from perilune_train.motion.data.trajectories import load_split
from perilune_train.motion.deploy.flight_navigator import INPUTS, OUTPUTS, FlightNavigator
from perilune_train.motion.deploy.readme import readme
from perilune_train.motion.evaluate_runs import fusion_of
from perilune_train.motion.network import Fusion, check_motion, load_navigator
from perilune_train.records.markdown import write_markdown
from perilune_train.records.provenance import read_provenance
from perilune_train.training.runs import RunFolder, load_weights

ONNX, METADATA, README = "navigator.onnx", "navigator.json", "README.md"
MAX_DIFFERENCE = 1e-5
"""Largest accepted difference from torch, divided by the larger of 1 and the largest value of that output."""
_OPSET = 17
_PAIRS = 12


@dataclass(frozen=True, slots=True)
class Pairs:
    """Consecutive pairs of one descent as network input, for the comparison with torch."""

    first: Tensor
    """Earlier frames, normalised (n, height, width)."""
    second: Tensor
    """Later frames, for warp resampled onto the earlier ones (n, height, width)."""
    nominal_translation_m: Tensor
    """Nominal translations (n, 3), metres."""
    altitude_m: Tensor
    """Nominal altitudes (n,), metres."""

    def inputs(self, pair: int, fusion: Fusion) -> list[Tensor]:
        """The inputs of one pair, without the state."""
        rows = slice(pair, pair + 1)
        known = [self.nominal_translation_m[rows], self.altitude_m[rows]] if fusion == "warp" else []
        return [self.first[rows], self.second[rows], *known]


def export_navigator(root: Path, out: Path, dataset: Address | None = None) -> float:
    """Export a run's navigator to the new folder `out`; returns its largest relative difference from torch.

    Writes navigator.onnx, navigator.json (metadata) and README.md. The ONNX graph is for the camera of the dataset, or
    without a dataset for the camera of the training. For the comparison, ONNX Runtime runs pair by pair and passes the
    state on; torch runs over the whole sequence at once. The input is the first validation descent of the dataset, or
    noise. Raises UserError, and writes nothing, if the outputs differ by more than MAX_DIFFERENCE.
    """
    for name in ("onnx", "onnxruntime"):
        package(name)
    best = RunFolder(root).best
    content = load_weights(best)
    fusion = fusion_of(best, content["architecture"])
    check_motion(best, content["architecture"])
    network, architecture = load_navigator(best, fusion)
    pairs, camera = _pairs(architecture, fusion, dataset)
    focal = camera.fx_px / camera.width_px
    flight = FlightNavigator(network, architecture, focal)
    hidden = architecture["hidden"]
    metadata = {
        "fusion": fusion,
        "height_px": camera.height_px,
        "width_px": camera.width_px,
        "camera_matrix": camera.matrix.tolist(),
        "hidden": hidden,
        "normalisation": "grey levels minus their mean over the image, divided by the larger of 1 and their "
        "standard deviation",
        "inputs": list(INPUTS[fusion]),
        "outputs": list(OUTPUTS),
        "scales": architecture["scales"],
        "compared_on": "noise" if dataset is None else "the first validation descent",
        "compared_pairs": len(pairs.first),
        "checkpoint_sha256": sha256_of(best),
        "terrain": read_provenance(content, best).plain(),
    }
    with new_folder(out) as folder:
        path = folder / ONNX
        _write_onnx(flight, path, pairs.inputs(0, fusion), fusion, hidden, metadata)
        largest = _largest_difference(path, network, architecture, pairs, fusion, focal)
        if not largest <= MAX_DIFFERENCE:
            raise UserError(path, "difference from torch", f"{largest:.2g}", f"at most {MAX_DIFFERENCE:g}")
        metadata["largest_difference_from_torch"] = largest
        metadata["sha256"] = sha256_of(path)
        write_text(folder / METADATA, json.dumps(metadata, indent=2) + "\n")
        write_markdown(folder / README, readme(metadata))
    return largest


def _pairs(architecture: dict[str, Any], fusion: Fusion, dataset: Address | None) -> tuple[Pairs, Camera]:
    """Input for the comparison, and its camera."""
    side = architecture["size_px"]
    if dataset is None:
        first, second = torch.from_numpy(np.random.default_rng(0).normal(size=(2, _PAIRS, side, side))).float()
        falling = torch.tensor([0.0, 0.0, 36.0]).expand(_PAIRS, 3)
        focal_px = side * architecture.get("focal_over_width", 1.0)
        camera = Camera(side, side, focal_px, focal_px, side / 2, side / 2)
        return Pairs(first, second, falling, torch.linspace(1500, 300, _PAIRS)), camera
    descents = load_split(open_single(dataset), "val")
    if not descents:
        raise UserError(dataset, "split val", "no descent", "at least one, to compare the file with torch")
    trajectory = descents[0].shrunk(side)
    sequence = pair_sequence(trajectory, 0, min(trajectory.n_pairs, _PAIRS), warp=fusion == "warp")
    parts = sequence.first, sequence.second, sequence.nominal_translation_m, sequence.altitude_m
    return Pairs(*(torch.from_numpy(np.ascontiguousarray(part)).float() for part in parts)), trajectory.camera


def _write_onnx(
    flight: FlightNavigator,
    path: Path,
    inputs: list[Tensor],
    fusion: Fusion,
    hidden: int,
    metadata: dict[str, Any],
) -> None:
    onnx = package("onnx")
    state = torch.zeros(2, 1, hidden)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        # Use the tracing exporter, as for the detector.
        torch.onnx.export(
            flight,
            (*inputs, state, state),
            str(path),
            input_names=list(INPUTS[fusion]),
            output_names=list(OUTPUTS),
            opset_version=_OPSET,
            dynamo=False,
        )
    model = onnx.load(str(path))
    onnx.helper.set_model_props(model, {key: json.dumps(value) for key, value in metadata.items()})
    onnx.checker.check_model(model)
    onnx.save(model, str(path))


def _largest_difference(
    path: Path, network: nn.Module, architecture: dict[str, Any], pairs: Pairs, fusion: Fusion, focal: float
) -> float:
    """Largest relative difference between the file, run pair by pair, and torch, run over the whole sequence."""
    session = package("onnxruntime").InferenceSession(str(path), providers=["CPUExecutionProvider"])
    names, state = INPUTS[fusion], [np.zeros((2, 1, architecture["hidden"]), np.float32)] * 2
    streamed = []
    for pair in range(len(pairs.first)):
        inputs = [part.numpy() for part in pairs.inputs(pair, fusion)]
        translation, rotation, *state = session.run(list(OUTPUTS), dict(zip(names, [*inputs, *state], strict=True)))
        streamed.append(np.concatenate([translation[0], rotation[0].ravel()]))
    whole = FlightNavigator(network, architecture, focal)
    with torch.no_grad():
        translation, rotation = _at_once(whole, network, pairs, fusion, focal)
    expected = np.concatenate([translation.numpy(), rotation.flatten(1).numpy()], axis=1)
    scale = np.array([max(1.0, float(np.abs(expected[:, :3]).max()))] * 3 + [1.0] * 9)
    return float((np.abs(np.array(streamed) - expected) / scale).max())


def _at_once(
    flight: FlightNavigator, network: nn.Module, pairs: Pairs, fusion: Fusion, focal: float
) -> tuple[Tensor, Tensor]:
    """Translations (n, 3) and rotations (n, 3, 3) of all pairs in one pass of the torch network."""
    if fusion == "warp":
        network.focal_over_width = focal  # type: ignore[assignment]
        output, _, _ = network(pairs.first[None], pairs.second[None], pairs.altitude_m[None])
    else:
        output, _ = network(pairs.first[None], pairs.second[None])
    return flight.motion(output[0], pairs.nominal_translation_m)
