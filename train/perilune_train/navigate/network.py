"""The navigation networks: build, load, and convert their nine outputs to motions."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from perilune_shared.geometry.frames import Array
from perilune_train.models.navigator import StackNavigator, WarpNavigator
from perilune_train.navigate.data.sequences import Sequence, pair_sequence
from perilune_train.navigate.data.trajectories import Motion, Trajectory
from perilune_train.navigate.geometry import rotation_from_sixd, rotation_vectors
from perilune_train.training.runs import check_architecture, load_state, load_weights

Fusion = Literal["warp", "stack"]


@dataclass(frozen=True, slots=True)
class Scales:
    """Scales that convert a network's standardised output to a motion.

    stack: translation = mean_m + spread_m * y. warp: translation = nominal + spread_m * y. Both: rotation_c2_from_c1 =
    the rotation whose continuous representation is (1, 0, 0, 0, 1, 0) + rotation_rad * y; the nominal motion has no
    rotation.
    """

    mean_m: list[float]
    """Mean translation of the training set, metres, O_C of the earlier frame (3,); zeros for warp."""
    spread_m: list[float]
    """Standard deviation of the translation about the mean (stack) or the nominal one (warp), metres (3,)."""
    rotation_rad: float
    """Root mean square of a motion's rotation about one axis, radians."""

    @classmethod
    def measured(cls, trajectories: list[Trajectory], fusion: Fusion) -> "Scales":
        """Compute the scales of a training set."""
        translation = np.concatenate([trajectory.motion[0] for trajectory in trajectories])
        rotation = rotation_vectors(np.concatenate([trajectory.motion[1] for trajectory in trajectories]))
        rotation_rad = max(float(np.sqrt(np.mean(rotation**2))), 1e-6)
        if fusion == "stack":
            return cls(translation.mean(0).tolist(), np.maximum(translation.std(0), 1e-3).tolist(), rotation_rad)
        residual = translation - np.concatenate([trajectory.nominal_motion[0] for trajectory in trajectories])
        across, along = np.sqrt(np.mean(residual[:, :2] ** 2)), np.sqrt(np.mean(residual[:, 2] ** 2))
        # One number for x and y, because a mirrored pair may exchange them.
        return cls([0.0] * 3, [max(float(value), 1e-3) for value in (across, across, along)], rotation_rad)


def build(architecture: dict[str, Any]) -> StackNavigator | WarpNavigator:
    """Build the untrained network of an architecture."""
    a = architecture
    if a["fusion"] == "stack":
        return StackNavigator(a["in_channels"], a["width"], a["attention"], a["hidden"])
    scales = a["scales"]
    return WarpNavigator(
        a["width"], a["attention"], a["hidden"], a["focal_over_width"], scales["spread_m"], scales["rotation_rad"]
    )


def load_navigator(path: Path, fusion: Fusion) -> tuple[Any, dict[str, Any]]:
    """Load a trained network and its architecture. Raises UserError if the file is of another network."""
    content = load_weights(path)
    check_architecture(path, content["architecture"], {"fusion": fusion})
    network = build(content["architecture"])
    load_state(network, content["state_dict"], path)
    return network.eval(), content["architecture"]


def predict(network: nn.Module, architecture: dict[str, Any], trajectory: Trajectory) -> Motion:
    """Motions of a whole trajectory, in one pass of the network in evaluation mode."""
    shrunk = trajectory.shrunk(architecture["size_px"])
    sequence = pair_sequence(shrunk, 0, shrunk.n_pairs, warp=architecture["fusion"] == "warp")
    device = next(network.parameters()).device
    scales = Scales(**architecture["scales"])
    with torch.no_grad():
        output, _ = network_output(network, [sequence], device)
    output = output[0].cpu()
    reference, unit = translation_units([sequence], scales, architecture["fusion"])
    return (reference[0] + unit * output[:, :3]).double().numpy(), decoded_rotation(output, scales).double().numpy()


def network_output(network: nn.Module, batch: list[Sequence], device: torch.device) -> tuple[Tensor, Tensor | None]:
    """Outputs (batch, pairs, 9), and of a warp network the flow (batch, pairs, height / 8, width / 8, 2), pixels."""
    first = torch.from_numpy(np.stack([sequence.first for sequence in batch])).to(device)
    second = torch.from_numpy(np.stack([sequence.second for sequence in batch])).to(device)
    if isinstance(network, WarpNavigator):
        return network(first, second, stacked([sequence.altitude_m for sequence in batch]).to(device))
    return network(first, second), None


def translation_units(sequences: list[Sequence], scales: Scales, fusion: Fusion) -> tuple[Tensor, Tensor]:
    """Reference (batch, pairs, 3) and unit (3,) in metres: translation = reference + unit * output."""
    nominal = stacked([sequence.nominal_translation_m for sequence in sequences])
    reference = nominal if fusion == "warp" else torch.tensor(scales.mean_m).expand_as(nominal)
    return reference, torch.tensor(scales.spread_m)


def decoded_rotation(output: Tensor, scales: Scales) -> Tensor:
    """Rotations (..., 3, 3) of outputs (..., 9)."""
    identity = torch.tensor([1.0, 0, 0, 0, 1, 0], device=output.device)
    return rotation_from_sixd(identity + scales.rotation_rad * output[..., 3:].float())


def stacked(arrays: list[Array]) -> Tensor:
    """Arrays of equal shape as one float32 tensor."""
    return torch.from_numpy(np.stack(arrays)).float()
