"""Training of the navigation networks, and decoding of their nine outputs."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import lightning
import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from perilune_shared.geometry.frames import Array
from perilune_train.models.navigator import StackNavigator, WarpNavigator
from perilune_train.navigate.config import FusionConfig, NavigateConfig
from perilune_train.navigate.data import Descent, Jitter, Sequence, pair_sequence
from perilune_train.navigate.epochs import EpochBatches
from perilune_train.navigate.geometry import (
    euler_from_rotation,
    rotation_from_sixd,
    rotation_vectors,
)
from perilune_train.navigate.metrics import Motion, motion_errors, summary
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
    """Standard deviation of a motion's rotation about one axis, radians."""

    @classmethod
    def measured(cls, descents: list[Descent], fusion: Fusion) -> "Scales":
        """Compute the scales of a training set."""
        translation = np.concatenate([descent.motion[0] for descent in descents])
        rotation = rotation_vectors(np.concatenate([descent.motion[1] for descent in descents]))
        rotation_rad = max(float(np.sqrt(np.mean(rotation**2))), 1e-6)
        if fusion == "stack":
            return cls(translation.mean(0).tolist(), np.maximum(translation.std(0), 1e-3).tolist(), rotation_rad)
        residual = translation - np.concatenate([descent.nominal_motion[0] for descent in descents])
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


def predict(network: nn.Module, architecture: dict[str, Any], descent: Descent) -> Motion:
    """Motions of a whole trajectory, in one pass of the network in evaluation mode."""
    seen = descent.shrunk(architecture["size_px"])
    sequence = pair_sequence(seen, 0, seen.n_pairs, warp=architecture["fusion"] == "warp")
    device = next(network.parameters()).device
    scales = Scales(**architecture["scales"])
    with torch.no_grad():
        output, _ = estimated(network, [sequence], device)
    output = output[0].cpu()
    reference, unit = translation_units([sequence], scales, architecture["fusion"])
    return (reference[0] + unit * output[:, :3]).double().numpy(), decoded_rotation(output, scales).double().numpy()


def estimated(network: nn.Module, batch: list[Sequence], device: torch.device) -> tuple[Tensor, Tensor | None]:
    """Outputs (batch, pairs, 9) and, for a warp network, its estimated flow."""
    first = torch.from_numpy(np.stack([sequence.first for sequence in batch])).to(device)
    second = torch.from_numpy(np.stack([sequence.second for sequence in batch])).to(device)
    if isinstance(network, WarpNavigator):
        return network(first, second, _stacked([sequence.altitude_m for sequence in batch]).to(device))
    return network(first, second), None


def translation_units(sequences: list[Sequence], scales: Scales, fusion: Fusion) -> tuple[Tensor, Tensor]:
    """Reference (batch, pairs, 3) and unit (3,) in metres: translation = reference + unit * output."""
    nominal = _stacked([sequence.nominal_translation_m for sequence in sequences])
    reference = nominal if fusion == "warp" else torch.tensor(scales.mean_m).expand_as(nominal)
    return reference, torch.tensor(scales.spread_m)


def decoded_rotation(output: Tensor, scales: Scales) -> Tensor:
    """Rotations (..., 3, 3) of outputs (..., 9)."""
    identity = torch.tensor([1.0, 0, 0, 0, 1, 0], device=output.device)
    return rotation_from_sixd(identity + scales.rotation_rad * output[..., 3:].float())


class NavigationTask(lightning.LightningModule):
    """Training of one network: the paper's coarse, then fine stage; AdamW, short warm-up, cosine to zero.

    Errors are standardised: P over the unit of the translation, phi (Euler angles) over the spread of the rotation.
    Coarse: L^(S1) = |dP|^2 + kappa |dphi|^2. Fine: L^(S2) = e^-s_p |dP|^2 + e^-s_phi |dphi|^2 + s_p + s_phi with learnt
    s_p, s_phi. Deviations: means over the pairs instead of sums; one cosine instead of five cycles; warp's pairs are
    mirrored and jittered (see navigate/data.py).
    """

    def __init__(
        self,
        settings: NavigateConfig,
        fusion: Fusion,
        descents: list[Descent],
        pretrained: dict[str, Tensor] | None = None,
    ):
        super().__init__()
        self.settings, self.fusion = settings, fusion
        self.own: FusionConfig = getattr(settings, fusion)
        self.scales = Scales.measured([d for d in descents if d.split == "train"], fusion)
        self.architecture = {
            "fusion": fusion,
            "size_px": self.own.size_px,
            "width": self.own.width,
            "attention": self.own.attention,
            "hidden": self.own.hidden,
            "in_channels": settings.in_channels if fusion == "stack" else WarpNavigator.CHANNELS,
            "focal_over_width": descents[0].camera.fx_px / descents[0].camera.width_px,
            "scales": {
                "mean_m": self.scales.mean_m,
                "spread_m": self.scales.spread_m,
                "rotation_rad": self.scales.rotation_rad,
            },
        }
        network: Any = build(self.architecture)
        self.network = network.to(memory_format=torch.channels_last)
        self.pretrained = frozenset(pretrained or ())
        if pretrained:
            self.network.backbone.load_state_dict(pretrained, strict=False)
        self.terrain: dict[str, Any] | None = None
        self.log_weights = nn.Parameter(torch.zeros(2))
        self.training_descents = [d.shrunk(self.own.size_px) for d in descents if d.split == "train"]
        self.validation_descents = [d.shrunk(self.own.size_px) for d in descents if d.split == "val"]
        jitter, scales = self.own.jitter, self.scales
        self.jitter = Jitter(jitter * np.array(scales.spread_m), jitter * scales.rotation_rad) if jitter else None

    @property
    def evaluated(self) -> nn.Module:
        """The network to evaluate and save."""
        return self.network

    @property
    def coarse(self) -> bool:
        """Whether this epoch belongs to the coarse stage."""
        return self.current_epoch < self.own.coarse_epochs

    def train_dataloader(self) -> EpochBatches:
        return EpochBatches(
            self.training_descents,
            self.own.sequence_pairs,
            self.own.batch_sequences,
            warp=self.fusion == "warp",
            augmented=self.fusion == "warp",
            jitter=self.jitter,
            key=(self.settings.seed, self.current_epoch),
        )

    def val_dataloader(self) -> DataLoader:
        return DataLoader(self.validation_descents, batch_size=None)  # type: ignore[arg-type]

    def transfer_batch_to_device(self, batch: Any, device: torch.device, dataloader_idx: int) -> Any:
        return batch  # Sequences are NumPy arrays; the steps move what they need.

    def on_train_epoch_start(self) -> None:
        for name, parameter in self.network.backbone.named_parameters():
            parameter.requires_grad_(not (self.coarse and name in self.pretrained))
        for name, module in self.network.backbone.named_modules():
            if isinstance(module, nn.BatchNorm2d):
                module.train(not (self.coarse and f"{name}.weight" in self.pretrained))

    def training_step(self, batch: list[Sequence], batch_idx: int) -> Tensor:
        output, flow_px = estimated(self.network, batch, self.device)
        reference, unit = translation_units(batch, self.scales, self.fusion)
        expected = (_stacked([s.translation_m for s in batch]) - reference) / unit
        angles = euler_from_rotation(_stacked([s.rotation_c2_from_c1 for s in batch])) / self.scales.rotation_rad
        found = euler_from_rotation(decoded_rotation(output, self.scales)) / self.scales.rotation_rad
        position = (output[..., :3] - expected.to(self.device)).square().sum(-1).mean()
        orientation = (found - angles.to(self.device)).square().sum(-1).mean()
        if self.coarse:
            loss = position + self.settings.kappa * orientation
        else:
            weighted = torch.stack([position, orientation]) * torch.exp(-self.log_weights)
            loss = (weighted + self.log_weights).sum()
        if flow_px is not None:
            true_px = _stacked([s.flow_px for s in batch if s.flow_px is not None]).to(self.device)
            flow_error = (flow_px - true_px).square().sum(-1).add(1e-4).sqrt().mean()
            self.log("train/flow_px", flow_error, batch_size=len(batch))
            loss = loss + self.settings.flow_weight * flow_error
        self.log_dict(
            {"train/loss": loss, "train/position": position, "train/orientation": orientation}, batch_size=len(batch)
        )
        return loss

    def on_validation_epoch_start(self) -> None:
        self.validation_motions: list[Motion] = []

    def validation_step(self, batch: Descent, batch_idx: int) -> None:
        self.validation_motions.append(predict(self.network, self.architecture, batch))

    def on_validation_epoch_end(self) -> None:
        errors = motion_errors(self.validation_descents, self.validation_motions)
        figures = summary(errors)
        for key in ("position_rmse_vector_m", "orientation_rmse_angle_deg"):
            self.log(f"val/{key}", figures[key], batch_size=1)

    def configure_optimizers(self) -> Any:
        total = max(1, (self.own.coarse_epochs + self.own.fine_epochs) * len(self.train_dataloader()))
        warm = max(1, min(50, total // 10))
        # The two loss weights have to change by about 1 within the run, whatever learning rate suits the network.
        optimizer = torch.optim.AdamW(
            [
                {"params": list(self.network.parameters()), "lr": self.own.learning_rate, "weight_decay": 1e-3},
                {"params": [self.log_weights], "lr": 1e-2, "weight_decay": 0.0},
            ]
        )
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda step: min((step + 1) / warm, 0.5 * (1 + math.cos(math.pi * min(step / total, 1))))
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def _stacked(arrays: list[Array]) -> Tensor:
    return torch.from_numpy(np.stack(arrays)).float()
