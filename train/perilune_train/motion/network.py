"""Build and load navigation networks, make batches of their input, and convert their nine outputs to motions."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array, rotation_vectors
from perilune_train.models.architecture import NavigatorArchitecture, check_architecture_of, without_memory
from perilune_train.models.navigator import StackNavigator, StackOptions, State, WarpNavigator
from perilune_train.motion.config import Target
from perilune_train.motion.data.sequences import Sequence, pair_sequence
from perilune_train.motion.data.trajectories import Motion, Trajectory
from perilune_train.motion.geometry import euler_from_rotation, mean_rotation, rotation_from_sixd
from perilune_train.training.runs import check_architecture, check_tensors, load_state, load_weights

Fusion = Literal["warp", "stack"]


@dataclass(frozen=True, slots=True)
class Scales:
    """Scales that convert a network's standardised output y (9,) to a motion, or to a pose (motion/pose.py).

    Translation of a motion: mean_m + spread_m * y[:3] for stack, nominal translation + spread_m * y[:3] for warp.
    Rotation of a motion: the rotation whose continuous representation is (1, 0, 0, 0, 1, 0) + rotation_rad * y[3:]; the
    nominal motion has no rotation. Position of a pose: mean_m + spread_m * y[:3]. Attitude of a pose: the mean attitude
    followed by a rotation that is computed as for motions.
    """

    mean_m: list[float]
    """Mean translation of the training set, metres, O_C of the earlier frame (3,); zeros for warp. For poses: mean
    position, O_L."""
    spread_m: list[float]
    """Standard deviation of the translation from the mean (stack) or from the nominal translation (warp), metres (3,).
    For poses: standard deviation of the position."""
    rotation_rad: float
    """Root mean square of a motion's rotation about one axis, radians. For poses: root mean square of the rotation from
    the mean attitude, about one axis."""
    mean_rotation: list[list[float]] | None = None
    """For poses: mean rotation_camera_from_site of the training set (3, 3)."""

    @classmethod
    def measured(cls, trajectories: list[Trajectory], fusion: Fusion, target: Target = "motion") -> "Scales":
        """Compute the scales of a training set."""
        if target == "pose":
            position, attitude = (np.concatenate([trajectory.pose[i] for trajectory in trajectories]) for i in range(2))
            mean = mean_rotation(attitude)
            spread_m = np.maximum(position.std(0), 1e-3).tolist()
            turns = rotation_vectors(attitude @ mean.T)
            rotation_rad = max(float(np.sqrt(np.mean(turns**2))), 1e-6)
            return cls(position.mean(0).tolist(), spread_m, rotation_rad, mean.tolist())
        translation = np.concatenate([trajectory.motion[0] for trajectory in trajectories])
        rotation_vectors_rad = rotation_vectors(np.concatenate([trajectory.motion[1] for trajectory in trajectories]))
        rotation_rad = max(float(np.sqrt(np.mean(rotation_vectors_rad**2))), 1e-6)
        if fusion == "stack":
            return cls(translation.mean(0).tolist(), np.maximum(translation.std(0), 1e-3).tolist(), rotation_rad)
        residual = translation - np.concatenate([trajectory.nominal_motion[0] for trajectory in trajectories])
        across, along = np.sqrt(np.mean(residual[:, :2] ** 2)), np.sqrt(np.mean(residual[:, 2] ** 2))
        # x and y share one spread, because mirroring a pair may exchange them.
        return cls([0.0] * 3, [max(float(value), 1e-3) for value in (across, across, along)], rotation_rad)


def build(architecture: dict[str, Any]) -> StackNavigator | WarpNavigator:
    """Build the untrained network of an architecture."""
    a = architecture
    if a["fusion"] == "stack":
        return StackNavigator(
            a["in_channels"],
            a["width"],
            a["attention"],
            a["hidden"],
            # Checkpoints of older versions lack these settings.
            StackOptions(a.get("pool", 1), a.get("stages", 5), a.get("dropout", 0.0), target_of(a) == "pose"),
        )
    scales = a["scales"]
    return WarpNavigator(
        a["width"], a["attention"], a["hidden"], a["focal_over_width"], scales["spread_m"], scales["rotation_rad"]
    )


def target_of(architecture: dict[str, Any]) -> Target:
    """What a network estimates: the motion, or the pose in O_L."""
    return architecture.get("target", "motion")


def check_motion(path: Path, architecture: dict[str, Any]) -> None:
    """Raise UserError unless a checkpoint's network estimates motions."""
    if target_of(architecture) != "motion":
        expected = "a network trained with target=motion; a pose network knows only the landing area of its training"
        raise UserError(path, "target", target_of(architecture), expected)


def load_navigator(path: Path, fusion: Fusion) -> tuple[Any, dict[str, Any]]:
    """Load a trained network and its architecture. Raises UserError if the file has another kind of network."""
    content = load_weights(path)
    architecture = content["architecture"]
    check_architecture(path, architecture, {"fusion": fusion})
    check_architecture_of(NavigatorArchitecture, architecture, path)
    check_tensors(path, content["state_dict"], without_memory(lambda: build(architecture)))
    network = build(architecture)
    load_state(network, content["state_dict"], path)
    return network.eval(), architecture


@dataclass(frozen=True)
class Batch:
    """Sequences of equal length as tensors: the input of the network and the true output."""

    first: Tensor
    """Earlier frames, normalised (batch, pairs, height, width)."""
    second: Tensor
    """Later frames, normalised (batch, pairs, height, width); for warp they are resampled onto the earlier frames."""
    altitude_m: Tensor
    """Nominal altitudes, metres (batch, pairs)."""
    translation: Tensor
    """True translations in the network's units (`Scales`) (batch, pairs, 3)."""
    angles: Tensor
    """True rotations as Euler angles, divided by `rotation_rad` of Scales (batch, pairs, 3)."""
    flow_px: Tensor | None
    """True flow, pixels (batch, pairs, height / 8, width / 8, 2); None for stack."""

    def pin_memory(self) -> "Batch":
        """The batch in page-locked memory; the DataLoader calls this method."""
        return self.each(Tensor.pin_memory)

    def to(self, device: torch.device) -> "Batch":
        """The batch on another device. The copy from page-locked memory is asynchronous."""
        return self.each(lambda part: part.to(device, non_blocking=True))

    def each(self, change: Callable[[Tensor], Tensor]) -> "Batch":
        """The batch with `change` applied to each tensor."""
        return replace(self, **{name: change(part) for name, part in vars(self).items() if part is not None})


@dataclass(frozen=True)
class Collate:
    """Makes a batch from sequences. It is a class so that `spawn` can pickle it."""

    scales: Scales
    """Scales of the network."""
    fusion: Fusion
    """The kind of network."""

    def __call__(self, sequences: list[Sequence]) -> Batch:
        reference, unit = translation_units(sequences, self.scales, self.fusion)
        rotation_c2_from_c1 = stacked([sequence.rotation_c2_from_c1 for sequence in sequences])
        flows = [sequence.flow_px for sequence in sequences if sequence.flow_px is not None]
        return Batch(
            torch.from_numpy(np.stack([sequence.first for sequence in sequences])),
            torch.from_numpy(np.stack([sequence.second for sequence in sequences])),
            stacked([sequence.altitude_m for sequence in sequences]),
            (stacked([sequence.translation_m for sequence in sequences]) - reference) / unit,
            euler_from_rotation(rotation_c2_from_c1) / self.scales.rotation_rad,
            stacked(flows) if flows else None,
        )


def predict(
    network: nn.Module, architecture: dict[str, Any], trajectory: Trajectory, features: Tensor | None = None
) -> Motion:
    """Estimate the motions of a whole trajectory in one pass, with the network in evaluation mode.

    `features` (pairs, channels) are the backbone's features of a stack network, if they are already computed.
    """
    shrunk = trajectory.shrunk(architecture["size_px"])
    motion, _ = _predicted(network, architecture, shrunk, range(shrunk.n_pairs), None, features)
    return motion


def predict_by_pairs(network: nn.Module, architecture: dict[str, Any], trajectory: Trajectory) -> tuple[Motion, float]:
    """Estimate the motions of a trajectory pair by pair, as in flight; return them and the mean seconds per pair.

    The LSTM's state is passed from each pair to the next. The time is from frames in memory to the motion; it does not
    include shrinking the frames.
    """
    shrunk, state = trajectory.shrunk(architecture["size_px"]), None
    translations, rotations = [], []
    started = time.perf_counter()
    for pair in range(shrunk.n_pairs):
        (translation, rotation), state = _predicted(network, architecture, shrunk, range(pair, pair + 1), state)
        translations.append(translation)
        rotations.append(rotation)
    seconds = (time.perf_counter() - started) / shrunk.n_pairs
    return (np.concatenate(translations), np.concatenate(rotations)), seconds


def _predicted(
    network: Any,
    architecture: dict[str, Any],
    shrunk: Trajectory,
    pairs: range,
    state: State | None,
    features: Tensor | None = None,
) -> tuple[Motion, State]:
    """Motions of consecutive pairs of a shrunk trajectory, and the LSTM's state after the last pair."""
    sequence = pair_sequence(shrunk, pairs.start, len(pairs), warp=architecture["fusion"] == "warp")
    scales = Scales(**architecture["scales"])
    if architecture["fusion"] == "warp":
        # Fit the motion with the camera of these frames, which may differ from the camera used in training.
        network.focal_over_width = shrunk.camera.fx_px / shrunk.camera.width_px
    batch = Collate(scales, architecture["fusion"])([sequence]).to(next(network.parameters()).device)
    with torch.no_grad():
        if features is None:
            output, _, state = network_output(network, batch, state)
        else:
            output, state = network.recurrent(features[None].to(batch.first.device), state)
    output = output[0].cpu()
    reference, unit = translation_units([sequence], scales, architecture["fusion"])
    translation_m = (reference[0] + unit * output[:, :3]).double().numpy()
    return (translation_m, decoded_rotation(output, scales).double().numpy()), state


def network_output(network: nn.Module, batch: Batch, state: State | None = None) -> tuple[Tensor, Tensor | None, State]:
    """Outputs (batch, pairs, 9), the flow, and the LSTM's state.

    The flow is (batch, pairs, height / 8, width / 8, 2), pixels, for warp; None for stack.
    """
    if isinstance(network, WarpNavigator):
        return network(batch.first, batch.second, batch.altitude_m, state)
    output, state = network(batch.first, batch.second, state)
    return output, None, state


def translation_units(sequences: list[Sequence], scales: Scales, fusion: Fusion) -> tuple[Tensor, Tensor]:
    """Reference (batch, pairs, 3) and unit (3,) in metres: translation = reference + unit * output."""
    nominal = stacked([sequence.nominal_translation_m for sequence in sequences])
    reference = nominal if fusion == "warp" else torch.tensor(scales.mean_m).expand_as(nominal)
    return reference, torch.tensor(scales.spread_m)


def decoded_rotation(output: Tensor, scales: Scales) -> Tensor:
    """Convert outputs (..., 9) to rotations (..., 3, 3)."""
    # First two columns of the identity. Made on the device, because `torch.tensor` would wait for the GPU.
    identity = torch.eye(2, 3, device=output.device).flatten()
    return rotation_from_sixd(identity + scales.rotation_rad * output[..., 3:].float())


def stacked(arrays: list[Array]) -> Tensor:
    """Stack arrays of equal shape into one float32 tensor."""
    return torch.from_numpy(np.stack(arrays)).float()
