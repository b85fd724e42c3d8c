"""A trained navigator as one torch module for the export to ONNX.

Its inputs are one pair of frames and the state of the LSTM; its outputs are the motion and the new state.
"""

import copy
from typing import Any

import torch
from torch import Tensor, nn

from perilune_train.models.fold import fold
from perilune_train.models.navigator import WarpNavigator
from perilune_train.motion.network import Scales, decoded_rotation

INPUTS = {
    "warp": ("first", "second", "nominal_translation_m", "altitude_m", "hidden", "cell"),
    "stack": ("first", "second", "hidden", "cell"),
}
"""Names of the inputs of the ONNX graph, by the navigator's setting `fusion` (how it combines both frames)."""
OUTPUTS = ("translation_m", "rotation_c2_from_c1", "hidden_out", "cell_out")


class FlightNavigator(nn.Module):
    """A navigation network together with the scaling of its output.

    Inputs: two frames (1, height, width), normalised; the hidden and the cell state (2, 1, hidden), zero at the start
    of a descent. With fusion `warp` also the nominal (planned) translation (1, 3), O_C of the earlier frame, and the
    nominal altitude (1,), both in metres. Outputs: the translation (1, 3), metres, O_C of the earlier frame; the
    rotation (1, 3, 3) from the earlier to the later camera; the new hidden and cell state.
    """

    def __init__(self, network: nn.Module, architecture: dict[str, Any], focal_over_width: float):
        super().__init__()
        self.network = copy.deepcopy(network).to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
        self.network.eval().requires_grad_(False)
        fold(self.network)
        self.scales = Scales(**architecture["scales"])
        self.is_warp = isinstance(network, WarpNavigator)
        if isinstance(self.network, WarpNavigator):
            self.network.focal_over_width = focal_over_width
            # ONNX has no operator that solves linear equations.
            self.network.solved = solved_by_elimination  # type: ignore[method-assign]
        # The exporter switches all submodules to the mode (training or evaluation) of this module.
        self.eval()

    def forward(self, first: Tensor, second: Tensor, *known: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        state = known[-2], known[-1]
        if self.is_warp:
            output, _, (hidden, cell) = self.network(first[:, None], second[:, None], known[1][:, None], state)
        else:
            output, (hidden, cell) = self.network(first[:, None], second[:, None], state)
        return *self.motion(output[:, 0], known[0]), hidden, cell

    def motion(self, output: Tensor, nominal_translation_m: Tensor) -> tuple[Tensor, Tensor]:
        """Convert outputs (N, 9) to translations (N, 3), metres, and rotations (N, 3, 3)."""
        reference = nominal_translation_m if self.is_warp else torch.tensor(self.scales.mean_m)
        translation_m = reference + torch.tensor(self.scales.spread_m) * output[:, :3]
        return translation_m, decoded_rotation(output, self.scales)


def solved_by_elimination(normal: Tensor, right: Tensor) -> Tensor:
    """Solve equations (N, n, n), (N, n) with positive definite matrices; returns the solutions (N, n).

    Gauss-Jordan elimination without pivoting, which positive definite matrices do not need (Golub & Van Loan, Matrix
    Computations, 4th edition, section 4.2).
    """
    rows = torch.cat([normal, right[..., None]], dim=2)
    n = normal.shape[1]
    for k in range(n):
        pivot = rows[:, k : k + 1] / rows[:, k : k + 1, k : k + 1]
        others = torch.cat([rows[:, :k], rows[:, k + 1 :]], dim=1)
        others = others - others[:, :, k : k + 1] * pivot
        rows = torch.cat([others[:, :k], pivot, others[:, k:]], dim=1)
    return rows[:, :, n]
