"""What limits the navigator of poses in O_L: steps, descents, views of them, features. One change at a time.

Trains the recurrent layers on stored features of a detector's frozen backbone, as the coarse stage does, and reports
the RMSE of the position per component on training and validation descents. Nothing is measured on test descents. One
training each.

    python -m benchmarks.train.pose_limits --detector runs/paper-gpu/detect/yolov3 --dataset data/paper-gpu/headline/nav

Writes runs/bench/pose-limits.json.
"""

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from torch import Tensor, nn

from benchmarks.figures import write_figures
from perilune_shared.console.command_line import run_command_line
from perilune_shared.dataset.manifest import open_single
from perilune_train.models.navigator import Recurrent, StackNavigator, StackOptions, cell_means
from perilune_train.motion.data.trajectories import Trajectory, load_trajectories
from perilune_train.motion.metrics.floors import mean_poses
from perilune_train.motion.pose import causal_outputs
from perilune_train.motion.train.stored import stored_features
from perilune_train.motion.train.views import other_views
from perilune_train.training.runs import RunFolder, choose_device, load_weights

_GRID, _PAIRS, _BATCH, _RATE, _SUMMARY = 4, 16, 8, 5e-3, 512


@dataclass(frozen=True)
class Variant:
    """One training."""

    words: str
    """What it changes, for the table."""
    steps: int
    """Steps of eight sequences."""
    descents: int
    """Number of training descents."""
    views: int
    """Further views of each training descent."""
    pool: int = 1
    """Grid of cells over which the features of each frame are averaged; 1 for the whole pair."""


@dataclass(frozen=True)
class Stored:
    """Features of the descents' pairs over a grid, and the positions at their later frames."""

    features: list[Tensor]
    """Averages (pairs, channels, 8, 4) of each descent, on the device."""
    position_m: list[Tensor]
    """Positions (pairs, 3), metres, O_L."""

    def pooled(self, pool: int) -> list[Tensor]:
        """Features (pairs, inputs) over the pair, or over a coarser grid of each frame."""
        grid = (1, 1) if pool == 1 else (2 * pool, pool)
        return [cell_means(one.float(), *grid).flatten(1) for one in self.features]


def variants(steps: int, descents: int, views: int) -> list[Variant]:
    """The setting of the experiment, and one change at a time."""
    base = Variant("as in the experiment", steps, descents, views)
    return [
        base,
        replace(base, words="a quarter of the steps", steps=steps // 4),
        replace(base, words="twice the steps", steps=2 * steps),
        replace(base, words="no views", views=0),
        replace(base, words="a quarter of the views", views=views // 4),
        replace(base, words="half of the descents", descents=max(1, descents // 2)),
        replace(base, words="a quarter of the descents", descents=max(1, descents // 4)),
        replace(base, words="half of the descents, no views", descents=max(1, descents // 2), views=0),
        replace(base, words="features over 2 x 2 cells of each frame", pool=2),
        replace(base, words="features over 4 x 4 cells of each frame", pool=4),
    ]


def store(detector: Path, trajectories: list[Trajectory], views: list[Trajectory], device: torch.device) -> Stored:
    """Features of trajectories, then of their views, over a grid of 4 x 4 cells of each frame."""
    content = load_weights(RunFolder(detector).best)
    architecture = content["architecture"]
    network: Any = StackNavigator(
        architecture["in_channels"], architecture["width"], architecture["attention"], 8, StackOptions(pool=_GRID)
    )
    prefix = "backbone."
    backbone = {
        key.removeprefix(prefix): value for key, value in content["state_dict"].items() if key.startswith(prefix)
    }
    network.backbone.load_state_dict(backbone)
    network.to(device, memory_format=torch.channels_last)
    found = stored_features(network, trajectories, device, bf16=True, views=views)
    cells = [one.half().unflatten(1, (-1, 2 * _GRID, _GRID)) for one in found]
    positions = [torch.from_numpy(one.pose[0]).float().to(device) for one in (*trajectories, *views)]
    return Stored(cells, positions)


def train(variant: Variant, known: Stored, unseen: Stored, descents: int, hidden: int, seed: int) -> dict[str, float]:
    """Train the recurrent layers; RMSE of the position per component, metres, on training and validation descents.

    `known` has the `descents` training descents first, then all of them in the first view, and so on.
    """
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    versions = [[view * descents + one for view in range(variant.views + 1)] for one in range(variant.descents)]
    features, validation = known.pooled(variant.pool), unseen.pooled(variant.pool)
    every = torch.cat([features[number] for own in versions for number in own])
    mean, spread = every.mean(0), every.std(0)
    spread = torch.maximum(spread.clamp(min=1e-6), 0.1 * spread.mean())
    features, validation = ([(one - mean) / spread for one in own] for own in (features, validation))
    positions = torch.cat([known.position_m[own[0]] for own in versions])
    centre_m, spread_m = positions.mean(0), positions.std(0)
    network = Recurrent(features[0].shape[1], hidden, None if variant.pool == 1 else _SUMMARY).to(mean.device)
    optimiser = torch.optim.AdamW(network.parameters(), lr=_RATE, fused=True)
    # As the experiment weighs the axes, between metres and spreads.
    weights = (spread_m / spread_m.square().mean().sqrt()).sqrt()
    length = min(_PAIRS, *(len(one) for one in features))
    for step in range(variant.steps):
        rate = _RATE * min(1, (step + 1) / 50) * 0.5 * (1 + math.cos(math.pi * step / variant.steps))
        optimiser.param_groups[0]["lr"] = rate
        chosen = [rng.choice(versions[one]) for one in rng.integers(len(versions), size=_BATCH)]
        starts = [int(rng.integers(len(features[one]) - length + 1)) for one in chosen]
        inputs = torch.stack([features[one][start : start + length] for one, start in zip(chosen, starts, strict=True)])
        truth_m = torch.stack(
            [known.position_m[one][start : start + length] for one, start in zip(chosen, starts, strict=True)]
        )
        outputs, _ = network(inputs)
        loss = (weights * (outputs[..., :3] - (truth_m - centre_m) / spread_m)).square().sum(-1).mean()
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 10)
        optimiser.step()
    network.eval()

    @torch.no_grad()
    def rmse_m(own: list[Tensor], truth_m: list[Tensor]) -> float:
        errors = [
            causal_outputs(network, network.summary(one), _PAIRS)[:, :3] * spread_m + centre_m - truth
            for one, truth in zip(own, truth_m, strict=True)
        ]
        return round(float(torch.cat(errors).square().mean().sqrt()), 3)

    own = [versions[one][0] for one in range(variant.descents)]
    return {
        "training, m": rmse_m([features[one] for one in own], [known.position_m[one] for one in own]),
        "validation, m": rmse_m(validation, unseen.position_m),
    }


def main(
    detector: Annotated[Path, typer.Option(help="Folder of the detector's run.")],
    dataset: Annotated[Path, typer.Option(help="Navigation dataset over one landing area.")],
    steps: Annotated[int, typer.Option(help="Steps of the first training.")] = 3000,
    views: Annotated[int, typer.Option(help="Further views of each training descent.")] = 8,
    hidden: Annotated[int, typer.Option(help="Hidden size of the LSTM's layers.")] = 1000,
    size_px: Annotated[int, typer.Option(help="Width to which frames are shrunk, pixels.")] = 256,
    minutes: Annotated[float, typer.Option(help="Start no further training after this time.")] = math.inf,
    only: Annotated[list[str] | None, typer.Option(help="Trainings to make, by their words; all by default.")] = None,
    out: Annotated[Path, typer.Option(help="JSON file with the figures.")] = Path("runs/bench/pose-limits.json"),
) -> None:
    """Store the features, train each variant, and write the figures after each."""
    began, device = time.monotonic(), torch.device(choose_device("auto"))
    trajectories = [one.shrunk(size_px) for one in load_trajectories(open_single(str(dataset)))]
    training, validation = ([one for one in trajectories if one.split == split] for split in ("train", "val"))
    known = store(detector, training, other_views(training, views, 1.0, seed=0), device)
    unseen = store(detector, validation, [], device)
    floor = np.concatenate(
        [
            guess[0] - one.pose[0]
            for guess, one in zip(mean_poses(training, validation)["mean_pose_at_frame"], validation, strict=True)
        ]
    )
    figures: dict[str, object] = {
        "mean pose at that frame/validation, m": round(float(np.sqrt(np.mean(floor**2))), 3),
        "descents": len(training),
        "views": views,
        "hidden": hidden,
    }
    for variant in variants(steps, len(training), views):
        if time.monotonic() - began > 60 * minutes or (only and variant.words not in only):
            continue
        found = train(variant, known, unseen, len(training), hidden, seed=0)
        figures |= {f"{variant.words}/{key}": value for key, value in found.items()}
        figures[f"{variant.words}/steps"] = variant.steps
        write_figures(out, figures)


if __name__ == "__main__":
    app = typer.Typer(pretty_exceptions_enable=False, add_completion=False)
    app.command()(main)
    run_command_line(app)
