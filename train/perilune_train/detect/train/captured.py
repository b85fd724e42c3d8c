"""Training steps as a CUDA graph: one launch instead of thousands.

The forward and backward passes of Darknet53 with 23 attention modules have some 2,700 operations. The GPU finishes each
operation before the process can start the next one, so the GPU idles for most of a step. A captured step starts all
operations at once.
"""

from collections.abc import Callable

import torch
from torch import Tensor

Losses = tuple[Tensor, ...]
_WARM_UP = 3
"""Number of steps before the capture; these steps allocate the optimizer's state and choose algorithms."""


class CapturedStep:
    """A training step over a batch of constant size.

    `step` maps the frame numbers of a batch (B,), on the device, to losses; it computes gradients and updates weights.
    Its operations and shapes must not depend on tensor values, and it must use the same tensors in every call. The
    first steps run without a graph; on a CPU, all steps do.
    """

    def __init__(self, step: Callable[[Tensor], Losses], batch_size: int, device: torch.device):
        self.step, self.device = step, device
        self.numbers = torch.zeros(batch_size, dtype=torch.long, device=device)
        self.graph: torch.cuda.CUDAGraph | None = None
        self.losses: Losses = ()
        self.steps = 0

    def __call__(self, numbers: Tensor) -> Losses:
        """Take a step and return the losses, which the next step overwrites."""
        self.numbers.copy_(numbers, non_blocking=True)
        self.steps += 1
        if self.device.type != "cuda":
            return self.step(self.numbers)
        if self.steps <= _WARM_UP:
            return self._aside(lambda: self.step(self.numbers))
        if self.graph is None:
            graph = torch.cuda.CUDAGraph()
            torch.cuda.synchronize()
            with torch.cuda.graph(graph):
                self.losses = self.step(self.numbers)
            self.graph = graph
        self.graph.replay()
        return self.losses

    def _aside(self, run: Callable[[], Losses]) -> Losses:
        """Run on a separate stream, as a capture does."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            losses = run()
        torch.cuda.current_stream().wait_stream(stream)
        return losses
