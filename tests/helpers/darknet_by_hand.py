"""yolov3.cfg layer by layer, and a reader of weight files that is independent of the code under test."""

import struct

import numpy as np
import torch
import torch.nn.functional as F

HEADER = struct.pack("<3iQ", 0, 2, 0, 32_013_312)


def cfg(filters: int = 255, backbone_only: bool = False) -> list[tuple]:
    """Layers: ("conv", channels, size, stride, norm), ("shortcut",), ("route", layers), ("upsample",), ("yolo",)."""
    layers: list[tuple] = [("conv", 32, 3, 1, True)]
    for channels, units in ((64, 1), (128, 2), (256, 8), (512, 8), (1024, 4)):
        layers.append(("conv", channels, 3, 2, True))
        for _ in range(units):
            layers += [("conv", channels // 2, 1, 1, True), ("conv", channels, 3, 1, True), ("shortcut",)]
    assert len(layers) == 75
    if backbone_only:
        return layers
    for channels, lateral, skip in ((512, 256, 61), (256, 128, 36), (128, 0, 0)):
        for _ in range(3):
            layers += [("conv", channels, 1, 1, True), ("conv", 2 * channels, 3, 1, True)]
        layers += [("conv", filters, 1, 1, False), ("yolo",)]
        if lateral:
            layers += [("route", [-4]), ("conv", lateral, 1, 1, True), ("upsample",), ("route", [-1, skip])]
    assert len(layers) == 107
    return layers


def shapes(layers: list[tuple], width: float, filters: int = 255) -> list[tuple[int, int, int, bool]]:
    """List (out, in, size, norm) of every convolution in the order of the file."""
    out: list[int] = []
    found = []
    for index, (kind, *rest) in enumerate(layers):
        before = out[-1] if out else 3
        if kind == "conv":
            channels = rest[0] if not rest[3] else int(rest[0] * width)
            found.append((channels, before, rest[1], rest[3]))
            out.append(channels)
        elif kind == "route":
            out.append(sum(out[index + k if k < 0 else k] for k in rest[0]))
        else:
            out.append(before)
    return found


def random_values(layers: list[tuple], width: float, seed: int) -> np.ndarray:
    """Return random values of a whole file, scaled so that features neither vanish nor explode."""
    rng = np.random.default_rng(seed)
    parts = []
    for out, inputs, size, norm in shapes(layers, width):
        parts.append(rng.normal(0, 0.1, out))
        if norm:
            parts += [rng.uniform(0.4, 0.8, out), rng.normal(0, 0.1, out), rng.uniform(0.5, 1.5, out)]
        n_weights = out * inputs * size * size
        parts.append(rng.standard_normal(n_weights, np.float32) * np.float32(np.sqrt(2 / (inputs * size * size))))
    return np.concatenate([part.astype("<f4") for part in parts])


def run(layers: list[tuple], raw: bytes, image: torch.Tensor, width: float) -> list[torch.Tensor]:
    """Compute the outputs of all layers; fails if values are missing or left over."""
    major, minor = struct.unpack("<2i", raw[:8])
    values = np.frombuffer(raw, "<f4", offset=20 if major * 10 + minor >= 2 else 16)
    place = 0

    def take(*shape: int) -> torch.Tensor:
        nonlocal place
        n = int(np.prod(shape))
        place += n
        return torch.from_numpy(values[place - n : place].copy()).view(*shape)

    out: list[torch.Tensor] = []
    convolutions = iter(shapes(layers, width))
    for index, (kind, *rest) in enumerate(layers):
        x = out[-1] if out else image
        if kind == "conv":
            channels, inputs, size, norm = next(convolutions)
            bias = take(channels, 1, 1)
            if norm:
                scale, mean, variance = (take(channels, 1, 1) for _ in range(3))
            x = F.conv2d(x, take(channels, inputs, size, size), stride=rest[2], padding=size // 2)
            if norm:
                x = (x - mean) / torch.sqrt(variance + 1e-5) * scale + bias
                x = torch.where(x > 0, x, 0.1 * x)
            else:
                x = x + bias
        elif kind == "shortcut":
            x = x + out[index - 3]
        elif kind == "route":
            x = torch.cat([out[index + k if k < 0 else k] for k in rest[0]], 1)
        elif kind == "upsample":
            x = x.repeat_interleave(2, 2).repeat_interleave(2, 3)
        out.append(x)
    assert place == len(values)
    return out
