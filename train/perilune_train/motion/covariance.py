"""Calibrated covariance of the motions that a warp network estimates.

The network fits a motion to flows, with learnt weights and a prior, so the fit gives a covariance. This covariance is
wrong without a correction: flows of neighbouring cells are not independent, the ground is not a plane, and the
recurrent part changes the fitted motion. Five numbers correct it; they are fitted to the errors on validation
descents by maximum likelihood.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize

from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array
from perilune_shared.storage.files import write_text
from perilune_train.models.navigator import WarpNavigator
from perilune_train.motion.data.sequences import pair_sequence
from perilune_train.motion.data.trajectories import Motion, Trajectory
from perilune_train.motion.metrics.errors import signed_errors
from perilune_train.motion.network import Collate, Scales, predict

FILE = "covariance.json"
NAMES = ("flow", "flow_by_altitude", "prior", "turn", "along")
"""Names of the five numbers. flow: logarithm of the factor on the information of the flows, at an altitude of 1000 m.
flow_by_altitude: exponent of altitude / 1000 m in this factor. prior: logarithm of the factor on the inverse variances
of the prior. turn, along: logarithms of the factors on the standard deviations of the rotation about z and of the
translation along z."""
_ALTITUDE_M, _LARGEST = 1000.0, 20.0


@dataclass(frozen=True, slots=True)
class MotionInformation:
    """Inverse covariances of the motions of one trajectory of n frames, from a network's flows and prior.

    All are for turn (radians) and shift (metres), as in `EstimatedMotion`.
    """

    information: Array
    """Inverse covariances (n - 1, 6, 6) from the flows, before correction."""
    prior: Array
    """Inverse variances (6,) of the network's prior."""
    altitude_m: Array
    """Nominal altitudes (n - 1,), metres."""

    def covariance(self, numbers: Sequence[float] | Array) -> Array:
        """Covariances (n - 1, 6, 6), corrected by the five numbers of `NAMES`."""
        flow, by_altitude, prior, turn, along = numbers
        factor = np.exp(flow + by_altitude * np.log(self.altitude_m / _ALTITUDE_M))
        inverse = factor[:, None, None] * self.information + np.exp(prior) * np.diag(self.prior)
        spread = np.exp([0.0, 0.0, turn, 0.0, 0.0, along])
        return np.asarray(np.linalg.inv(inverse) * spread[:, None] * spread)


def information_of(network: WarpNavigator, architecture: dict[str, Any], trajectory: Trajectory) -> MotionInformation:
    """Compute the inverse covariances of a trajectory's motions from the flows and the prior of a warp network."""
    shrunk, scales = trajectory.shrunk(architecture["size_px"]), Scales(**architecture["scales"])
    network.focal_over_width = shrunk.camera.fx_px / shrunk.camera.width_px
    sequence = pair_sequence(shrunk, 0, shrunk.n_pairs, warp=True)
    batch = Collate(scales, "warp")([sequence]).to(next(network.parameters()).device)
    with torch.no_grad():
        information = network.information(batch.first, batch.second, batch.altitude_m)[0].cpu().double().numpy()
        prior = network.log_prior.exp().cpu().double().numpy()
    # The signs differ: the turn is from the estimate to the truth, the shift from the truth to the estimate
    # (`EstimatedMotion`).
    unit = np.array([*scales.spread_m, *[-scales.rotation_rad] * 3])
    order = np.r_[3:6, 0:3]
    arranged = (information / unit[:, None] / unit)[:, order][:, :, order]
    return MotionInformation(arranged, (prior / unit**2)[order], shrunk.altitude_m)


def fit_numbers(known: list[MotionInformation], trajectories: list[Trajectory], motions: list[Motion]) -> list[float]:
    """Fit the five numbers of `NAMES` to the errors of motions by maximum likelihood; the errors are Gaussian."""
    errors = np.concatenate(
        [signed_errors(trajectory, motion) for trajectory, motion in zip(trajectories, motions, strict=True)]
    )

    def cost(numbers: Array) -> float:
        stated = np.concatenate([item.covariance(numbers) for item in known])
        squared = np.einsum("ni,ni->n", errors, np.linalg.solve(stated, errors[:, :, None])[:, :, 0])
        return float(np.mean(np.linalg.slogdet(stated)[1] + squared))

    # Bound the numbers, since the flows of a barely trained network carry no information.
    start, bounds = np.array([-4.0, 0.0, 0.0, 0.0, 0.0]), [(-_LARGEST, _LARGEST)] * len(NAMES)
    options = {"maxfev": 4000, "maxiter": 4000}
    return minimize(cost, start, method="Nelder-Mead", bounds=bounds, options=options).x.tolist()


def calibrate(
    folder: Path, network: WarpNavigator, architecture: dict[str, Any], trajectories: list[Trajectory]
) -> None:
    """Fit the five numbers to validation trajectories and write covariance.json into a run's folder."""
    motions = [predict(network, architecture, trajectory) for trajectory in trajectories]
    numbers = fit_numbers(
        [information_of(network, architecture, trajectory) for trajectory in trajectories], trajectories, motions
    )
    write_numbers(folder, numbers, sum(trajectory.n_pairs for trajectory in trajectories))


def write_numbers(folder: Path, numbers: list[float], n_pairs: int) -> None:
    """Write covariance.json: the five numbers, and the number of pairs that they were fitted to."""
    content = {"numbers": dict(zip(NAMES, numbers, strict=True)), "pairs": n_pairs}
    write_text(folder / FILE, json.dumps(content, indent=2) + "\n")


def read_numbers(folder: Path) -> list[float] | None:
    """The five numbers of a run; None if it has no covariance.json. Raises UserError if the file is damaged."""
    path = folder / FILE
    if not path.is_file():
        return None
    try:
        numbers = [float(json.loads(path.read_text(encoding="utf-8"))["numbers"][name]) for name in NAMES]
        if not all(abs(number) <= _LARGEST for number in numbers):
            raise ValueError(f"numbers {numbers}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(path, "numbers", repr(error), f"-{_LARGEST:g} to {_LARGEST:g}: {', '.join(NAMES)}") from None
    return numbers


def stated_covariances(
    folder: Path, network: Any, architecture: dict[str, Any], trajectories: list[Trajectory]
) -> list[Array] | None:
    """Covariances of a run's motions in each trajectory, as in `EstimatedMotion`.

    None if the run has no covariance.json or its network is not a warp network.
    """
    numbers = read_numbers(folder)
    if numbers is None or not isinstance(network, WarpNavigator):
        return None
    return [information_of(network, architecture, trajectory).covariance(numbers) for trajectory in trajectories]
