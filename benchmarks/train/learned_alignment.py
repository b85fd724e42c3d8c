"""Learned features and confidences in direct alignment: training, and validation against alignment on the same pairs.

A small network computes eight features and a confidence for each pixel (`FeatureNetwork`). Alignment compares these
features in place of the local contrast. The unknowns, priors, Tukey's weights and levels stay
(motion/classical/alignment.py). The network is trained through one Gauss-Newton step from the state to which alignment
converges (`step_errors`). A control runs the same code with the contrast of alignment and confidence 1.

    python -m benchmarks.train.learned_alignment --train data/shipped/nav --validate data/shipped/nav
    python -m benchmarks.train.learned_alignment --weights runs/bench/learned-alignment.ckpt --validate FOLDER

Writes runs/bench/learned-alignment.json and, after a training, the weights into runs/bench/learned-alignment.ckpt.
Results: docs/notebook/2026-11-28-alignment.md.
"""

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import torch
import typer
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.figures import write_figures
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.console.terminal import answer, progress_bar
from perilune_shared.dataset.manifest import open_single
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array
from perilune_train.motion.classical.alignment import (
    DEPENDENT_PIXELS,
    MARGIN_PX,
    TUKEY,
    Prior,
    State,
    align,
    aligned_trajectory,
    tilt_axes,
)
from perilune_train.motion.classical.contrast import Level, local_contrast
from perilune_train.motion.classical.estimate import EstimatedMotion
from perilune_train.motion.classical.ground import node_weights
from perilune_train.motion.data.trajectories import Motion, Trajectory, load_split
from perilune_train.motion.metrics.errors import motion_errors, summary
from perilune_train.training.runs import check_architecture, load_state, load_weights, save_weights

_BLURS_PX = ((0.5, 2.0), (1.0, 4.0), (2.0, 8.0))
"""Standard deviations of the fine and the coarse blur of each input, pixels; the first pair is the one of alignment."""
_ARCHITECTURE = {"features": 8, "width": 16}
_POSITION_UNIT_M = 0.5
_ROTATION_UNIT_RAD = float(np.radians(0.03))
_ROTATION_SHARE = 0.1
"""Weight of the squared rotation error, in units of _ROTATION_UNIT_RAD, against the squared position error, in units of
_POSITION_UNIT_M."""
_ROBUST = 10.0
"""Value of the weighted sum of both squared errors from which the loss grows logarithmically."""
_BATCH = 4
"""Pairs of a step."""
_PEAK_RATE = 1e-3
_WARM_UP_SHARE = 0.1
_MAX_GRADIENT_NORM = 5.0
_REPORTED_PAIRS = 60
"""Number of training pairs of which errors are averaged for the record."""


class FeatureNetwork(nn.Module):
    """Eight features and a confidence for each pixel of an image; starts near the local contrast and confidence 1."""

    def __init__(self) -> None:
        super().__init__()
        self.n_features, width = _ARCHITECTURE["features"], _ARCHITECTURE["width"]
        channels = (len(_BLURS_PX), width, width, width, self.n_features + 1)
        layers: list[nn.Module] = []
        for inputs, outputs in itertools.pairwise(channels):
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1, padding_mode="replicate"), nn.ReLU()]
        self.body = nn.Sequential(*layers[:-1])
        last = self.body[-1]
        assert isinstance(last, nn.Conv2d) and last.bias is not None
        with torch.no_grad():
            last.weight.mul_(0.1)
            last.bias.zero_()
        self.log_scale = nn.Parameter(torch.zeros(()))
        """Logarithm of a factor of all weights of pixels, against the priors."""

    def forward(self, contrasts: Tensor) -> tuple[Tensor, Tensor]:
        """Features (n_features, height, width) and confidences (height, width) from contrasts (3, height, width)."""
        inputs = contrasts / (1.4826 * contrasts[0].abs().median() + 1e-4)
        outputs = self.body(inputs.clamp(-8, 8)[None])[0]
        features = torch.cat([outputs[:1] + inputs[:1], outputs[1 : self.n_features]])
        return features, torch.exp(outputs[self.n_features].clamp(-4, 4))


class ContrastOnly(nn.Module):
    """The control: the contrast of alignment as the only feature, with confidence 1."""

    def __init__(self) -> None:
        super().__init__()
        self.log_scale = torch.zeros(())

    def forward(self, contrasts: Tensor) -> tuple[Tensor, Tensor]:
        """Features (1, height, width) and confidences (height, width) from contrasts (3, height, width)."""
        return contrasts[:1], torch.ones_like(contrasts[0])


Network = FeatureNetwork | ContrastOnly


def feature_maps(network: Network, image: np.ndarray) -> Tensor:
    """Maps (3 n_features + 1, height, width) of an 8-bit image.

    The maps are features, their derivatives along columns, their derivatives along rows, and the confidence.
    """
    contrasts = np.stack([local_contrast(image, fine_px, coarse_px) for fine_px, coarse_px in _BLURS_PX])
    features, confidence = network(torch.from_numpy(contrasts))
    by_row, by_column = torch.gradient(features, dim=(1, 2))
    return torch.cat([features, by_column, by_row, confidence[None]])


@cache
def _inner_pixels(camera: Camera) -> tuple[Tensor, Tensor]:
    """Rays (n, 3), O_C, and weights of the ground's nodes (n, N_NODES) of the pixels inside the margin."""
    pixels = camera.pixel_centres()[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX].reshape(-1, 2)
    return torch.from_numpy(camera.rays(pixels)).float(), torch.from_numpy(node_weights(camera, pixels))


class FeatureResiduals:
    """Differences between the features of two images of one level, as a function of the state.

    `Level.contrast` has the maps of `feature_maps`. The weight of a pixel is Tukey's weight times the geometric mean of
    the confidences of both frames, times exp(`log_scale`).
    """

    def __init__(self, log_scale: Tensor, first: Level, second: Level, prior: Prior):
        self._log_scale, self._prior, self._camera = log_scale, prior, second.camera
        self._first = first.contrast[:, MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX].flatten(1)
        self._second = second.contrast
        self._rays, self._nodes = _inner_pixels(first.camera)
        self._tilted = self._rays @ torch.from_numpy(tilt_axes(prior.plane.down_c).T).float()

    def normal_equations(self, state: State) -> tuple[Array, Array]:
        """Weighted normal matrix (n_unknown, n_unknown) and gradient (n_unknown,) of the squared differences."""
        normal, gradient = self.tensors(state)
        return normal.numpy(), gradient.numpy()

    def tensors(self, state: State) -> tuple[Tensor, Tensor]:
        """The normal equations as tensors that can be differentiated with respect to the maps."""
        down_c, translation_m, rotation_c2_from_c1, height_m = (
            torch.from_numpy(values).float()
            for values in (
                state.down_c(self._prior),
                state.translation_m,
                state.rotation_c2_from_c1,
                state.height_m,
            )
        )
        along = self._rays @ down_c
        points = self._rays * ((self._prior.plane.altitude_m - self._nodes @ height_m) / along)[:, None]
        moved = (points - translation_m) @ rotation_c2_from_c1.T
        error, by_u, by_v, weight = self._sampled(moved)

        x, y, z = moved.T
        zero = torch.zeros_like(z)
        fx_px, fy_px = self._camera.fx_px, self._camera.fy_px
        jacobians = []
        # Derivatives of the image coordinates u and v with respect to the unknowns, as in `ContrastResiduals`.
        for by_moved in (
            torch.stack([fx_px / z, zero, -fx_px * x / z**2], dim=1),
            torch.stack([zero, fy_px / z, -fy_px * y / z**2], dim=1),
        ):
            by_first = by_moved @ rotation_c2_from_c1
            by_tilt = -((by_first * points).sum(1) / along)[:, None] * self._tilted
            by_height = -((by_first * self._rays).sum(1) / along)[:, None] * self._nodes
            jacobians.append(torch.cat([torch.linalg.cross(moved, by_moved), by_moved, by_tilt, by_height], dim=1))
        of_u, of_v = jacobians
        # Sums over the features first: a pixel then has 2 x 2 numbers in place of a row for each feature.
        uu, uv, vv = ((weight * (a * b).sum(0))[:, None] for a, b in ((by_u, by_u), (by_u, by_v), (by_v, by_v)))
        normal = of_u.T @ (uu * of_u + uv * of_v) + of_v.T @ (uv * of_u + vv * of_v)
        gradient = of_u.T @ (weight * (by_u * error).sum(0)) + of_v.T @ (weight * (by_v * error).sum(0))
        return normal.double(), gradient.double()

    def _sampled(self, moved: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Differences and their derivatives along u and v (n_features, n), and weights (n,), at points (n, 3).

        The points are in O_C of frame 2.
        """
        camera, n_features = self._camera, len(self._second) // 3
        u = camera.fx_px * moved[:, 0] / moved[:, 2] + camera.cx_px
        v = camera.fy_px * moved[:, 1] / moved[:, 2] + camera.cy_px
        inside = (u >= 0.5) & (v >= 0.5) & (u < camera.width_px - 0.5) & (v < camera.height_px - 0.5)
        grid = torch.stack([2 * u / camera.width_px - 1, 2 * v / camera.height_px - 1], dim=-1)[None, None]
        found = functional.grid_sample(self._second[None], grid, padding_mode="border", align_corners=False)[0, :, 0]
        features, by_u, by_v, confidence = found.split([n_features, n_features, n_features, 1])
        error = features - self._first[:n_features]
        squared = error.square().mean(0)
        # As in alignment, the spread is not differentiated: it only scales the weights.
        spread_2 = 1.4826**2 * squared[inside].median().detach() + 1e-12 if inside.any() else torch.ones(())
        weight = (1 - squared / (TUKEY**2 * spread_2)).clamp(min=0).square() * inside
        weight = weight * (confidence[0] * self._first[-1]).sqrt() * torch.exp(self._log_scale)
        return error, by_u, by_v, weight / (spread_2 * n_features * DEPENDENT_PIXELS)


@torch.no_grad()
def learned_trajectory(network: Network, trajectory: Trajectory) -> EstimatedMotion:
    """Estimate the motions of a whole trajectory like `aligned_trajectory`, with the features of a network."""
    fit = partial(align, residuals_of=partial(FeatureResiduals, network.log_scale))
    return aligned_trajectory(trajectory, contrast=partial(feature_maps, network), fit=fit)


@dataclass(frozen=True)
class TrainingPair:
    """Two consecutive frames with what alignment knew and estimated along the descent, and the truth."""

    images: np.ndarray
    """8-bit grey frames (2, height, width)."""
    camera: Camera
    """Intrinsics of `images`."""
    prior: Prior
    """Prior knowledge of alignment."""
    state: State
    """The state to which alignment converges."""
    motion: Motion
    """True translation_m (3,), O_C of frame 1, and rotation_c2_from_c1 (3, 3)."""

    @property
    def position_error_m(self) -> float:
        """Length of the position error of alignment, metres."""
        return float(np.linalg.norm(self.state.translation_m - self.motion[0]))


def training_pairs(trajectory: Trajectory) -> list[TrainingPair]:
    """All pairs of a trajectory, with the priors and states of alignment along it."""
    found: list[tuple[Prior, State]] = []

    def fit(first: list[Level], second: list[Level], prior: Prior, start: State) -> tuple[State, Array]:
        state, covariance = align(first, second, prior, start)
        found.append((prior, state))
        return state, covariance

    aligned_trajectory(trajectory, fit=fit)
    return [
        TrainingPair(trajectory.images[i : i + 2], trajectory.camera, prior, state, (translation_m, rotation))
        for i, ((prior, state), translation_m, rotation) in enumerate(zip(found, *trajectory.motion, strict=True))
    ]


def step_errors(network: Network, pair: TrainingPair) -> tuple[Tensor, Tensor]:
    """Position error (3,), metres, and rotation error (3,), radians, after a Gauss-Newton step at full resolution.

    The step starts from the state of alignment, since the start does not limit the result of alignment
    (docs/notebook/2026-11-25-map.md). Gradients flow through it to the network.
    """
    first, second = (Level(pair.camera, feature_maps(network, image)) for image in pair.images)
    normal, gradient = FeatureResiduals(network.log_scale, first, second, pair.prior).tensors(pair.state)
    precision = pair.prior.precision()
    normal = normal + torch.from_numpy(precision)
    gradient = gradient + torch.from_numpy(precision @ pair.state.offset(pair.prior))
    # Metres and radians have very different scales, as in `align`.
    unit = normal.diagonal().detach().rsqrt()
    step = -unit * torch.linalg.solve(unit[:, None] * normal * unit, unit * gradient)
    rotation_c2_from_c1 = torch.linalg.matrix_exp(_cross_matrix(step[:3])) @ torch.from_numpy(
        pair.state.rotation_c2_from_c1
    )
    translation_m = torch.from_numpy(pair.state.translation_m) - rotation_c2_from_c1.T @ step[3:6]
    true_translation_m, true_rotation = (torch.from_numpy(part) for part in pair.motion)
    turned = rotation_c2_from_c1 @ true_rotation.T
    # The sine of the angle replaces the angle: below 1 degree, they differ by less than 1e-4 of it.
    turn_rad = torch.stack([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]) / 2
    return translation_m - true_translation_m, turn_rad


def _cross_matrix(vector: Tensor) -> Tensor:
    """The matrix (3, 3) that multiplies a vector as the cross product with `vector` (3,) does."""
    x, y, z = vector
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


def loss_of(position_error_m: Tensor, rotation_error_rad: Tensor) -> Tensor:
    """Loss of the errors (3,) of one pair: their weighted square, which grows logarithmically from _ROBUST on."""
    squared = (position_error_m / _POSITION_UNIT_M).square().sum()
    squared = squared + _ROTATION_SHARE * (rotation_error_rad / _ROTATION_UNIT_RAD).square().sum()
    return _ROBUST * torch.log1p(squared / _ROBUST)


def train(
    network: FeatureNetwork, pairs: list[TrainingPair], steps: int, rng: np.random.Generator
) -> list[dict[str, float]]:
    """Train a network; returns the mean loss and errors over each group of _REPORTED_PAIRS pairs, before their step.

    Each pass takes the pairs in a new random order.
    """
    optimiser = torch.optim.Adam(network.parameters(), _PEAK_RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, _PEAK_RATE, total_steps=max(steps, 2), pct_start=_WARM_UP_SHARE
    )
    order: list[int] = []
    recent: list[tuple[float, float, float]] = []
    history: list[dict[str, float]] = []
    with progress_bar() as progress:
        bar = progress.add_task("training", total=steps * _BATCH, unit="pairs", note="")
        for step in range(steps):
            optimiser.zero_grad()
            for _ in range(_BATCH):
                order = order or rng.permutation(len(pairs)).tolist()
                pair = pairs[order.pop()]
                errors = step_errors(network, pair)
                loss = loss_of(*errors)
                (loss / _BATCH).backward()
                recent.append((loss.item(), errors[0].norm().item(), pair.position_error_m))
                progress.advance(bar)
            # An error here ends a diverged training; its weights would be NaN.
            nn.utils.clip_grad_norm_(network.parameters(), _MAX_GRADIENT_NORM, error_if_nonfinite=True)
            optimiser.step()
            schedule.step()
            if len(recent) >= _REPORTED_PAIRS or step == steps - 1:
                losses, learned_m, aligned_m = np.array(recent).T
                row = {
                    "pairs": float((step + 1) * _BATCH),
                    "loss": float(losses.mean()),
                    "position_rmse_vector_m": float(np.sqrt(np.mean(learned_m**2))),
                    "alignment_position_rmse_vector_m": float(np.sqrt(np.mean(aligned_m**2))),
                }
                history.append(row)
                recent.clear()
                note = f"{row['position_rmse_vector_m']:.3f} m, alignment {row['alignment_position_rmse_vector_m']:.3f}"
                progress.update(bar, note=note)
    return history


def validate(network: FeatureNetwork, trajectories: list[Trajectory]) -> dict[str, dict[str, float]]:
    """Figures of alignment, the control and the network over the same pairs, by method.

    Each has the keys of `summary` and the processor time of a pair, seconds_per_pair.
    """
    methods: dict[str, Callable[[Trajectory], EstimatedMotion]] = {
        "alignment": aligned_trajectory,
        "control": partial(learned_trajectory, ContrastOnly()),
        "learned": partial(learned_trajectory, network),
    }
    n_pairs = sum(one.n_pairs for one in trajectories)
    figures = {}
    with progress_bar() as progress:
        bar = progress.add_task("validation", total=len(methods) * n_pairs, unit="pairs", note="")
        for name, method in methods.items():
            estimates, seconds = [], 0.0
            for one in trajectories:
                began_s = time.process_time()
                estimates.append(method(one))
                seconds += time.process_time() - began_s
                progress.update(bar, advance=one.n_pairs, note=name)
            errors = motion_errors(
                trajectories, [one.motion for one in estimates], [one.covariance for one in estimates]
            )
            figures[name] = summary(errors) | {"seconds_per_pair": seconds / n_pairs}
    return figures


def trained(dataset: Path, steps: int, seed: int, weights: Path) -> tuple[FeatureNetwork, dict[str, object]]:
    """Train on the training descents of a dataset and write the weights; returns the network and its record."""
    trajectories = load_split(open_single(str(dataset)), "train")
    pairs: list[TrainingPair] = []
    with progress_bar() as progress:
        bar = progress.add_task("alignment", total=sum(one.n_pairs for one in trajectories), unit="pairs", note="")
        for one in trajectories:
            pairs += training_pairs(one)
            progress.update(bar, completed=len(pairs))
    torch.manual_seed(seed)
    network = FeatureNetwork()
    history = train(network, pairs, steps, np.random.default_rng(seed))
    weights.parent.mkdir(parents=True, exist_ok=True)
    save_weights(weights, _ARCHITECTURE, network)
    return network, {"train": str(dataset), "pairs": len(pairs), "steps": steps, "seed": seed, "training": history}


def loaded(weights: Path) -> FeatureNetwork:
    """Load weights that an earlier run wrote. Raises UserError if the file has another kind of network."""
    content, network = load_weights(weights), FeatureNetwork()
    check_architecture(weights, content["architecture"], _ARCHITECTURE)
    load_state(network, content["state_dict"], weights)
    return network


def main(
    validate_on: Annotated[
        list[Path], typer.Option("--validate", help="Dataset of descents to validate on. Repeatable.")
    ],
    train_on: Annotated[
        Path | None, typer.Option("--train", help="Dataset whose descents of the split train are trained on.")
    ] = None,
    weights: Annotated[Path | None, typer.Option(help="Validate these weights of an earlier run; no training.")] = None,
    steps: Annotated[int, typer.Option(min=1, help=f"Steps of {_BATCH} training pairs.")] = 110,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the training.")] = 0,
    split: Annotated[str, typer.Option(help="Split of the datasets to validate on: val or test.")] = "val",
    out: Annotated[Path, typer.Option(help="JSON file with the figures; the weights get the suffix .ckpt.")] = Path(
        "runs/bench/learned-alignment.json"
    ),
) -> None:
    """Train a network, or load its weights, and compare it with alignment."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    if (train_on is None) == (weights is None):
        got = "neither" if train_on is None else "both"
        raise UserError("--train, --weights", "", got, "one of them: a dataset to train on, or trained weights")
    opened = [(str(path), load_split(open_single(str(path)), split)) for path in validate_on]
    figures: dict[str, object] = {"split": split}
    if train_on is not None:
        network, record = trained(train_on, steps, seed, out.with_suffix(".ckpt"))
        figures |= record
    elif weights is not None:
        network = loaded(weights)
        figures["weights"] = str(weights)
    for name, trajectories in opened:
        found = validate(network, trajectories)
        cells = [
            f"{method} {row['position_rmse_vector_m']:.3f} m ({row['orientation_rmse_angle_deg']:.3f} deg, "
            f"{row['seconds_per_pair']:.2f} s a pair)"
            for method, row in found.items()
        ]
        answer(f"{name}, {sum(one.n_pairs for one in trajectories)} pairs: {', '.join(cells)}")
        figures[name] = found
    write_figures(out, figures)


if __name__ == "__main__":
    run_command_line(one_command(main))
