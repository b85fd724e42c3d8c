"""Architecture settings stored with a network's weights; they are checked before the network is rebuilt."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import Field, ValidationError, model_validator
from torch import nn

from perilune_shared.config.errors import user_error_of
from perilune_shared.config.resolve import Section
from perilune_shared.errors import UserError
from perilune_train.config import Attention

_Stride = Annotated[int, Field(ge=1, le=1024)]
_Metres = Annotated[float, Field(ge=-1e9, le=1e9)]
_Spread = Annotated[float, Field(ge=1e-9, le=1e9)]
_Cosine = Annotated[float, Field(ge=-1.001, le=1.001)]
_Row = tuple[_Cosine, _Cosine, _Cosine]


class DetectorArchitecture(Section):
    """Architecture of a detector. Settings with a default are missing from weights of older versions."""

    in_channels: Literal[1, 3]
    width: Annotated[float, Field(ge=0.125, le=2)]
    attention: Attention
    strides: tuple[_Stride, _Stride, _Stride]
    ellipses: bool = False

    @model_validator(mode="after")
    def _known_strides(self) -> "DetectorArchitecture":
        if self.strides not in ((8, 16, 32), (4, 8, 16)):
            raise ValueError("strides [8, 16, 32] or [4, 8, 16]")
        return self


class _Scales(Section):
    mean_m: tuple[_Metres, _Metres, _Metres]
    spread_m: tuple[_Spread, _Spread, _Spread]
    rotation_rad: Annotated[float, Field(ge=1e-9, le=7)]
    mean_rotation: tuple[_Row, _Row, _Row] | None = None


class NavigatorArchitecture(Section):
    """Architecture of a navigator. Settings with a default are missing from weights of older versions."""

    fusion: Literal["warp", "stack"]
    size_px: Annotated[int, Field(ge=32, le=4096, multiple_of=32)]
    width: Annotated[float, Field(gt=0, le=2)]
    attention: Attention
    hidden: Annotated[int, Field(ge=1, le=4096)]
    in_channels: Literal[1, 3, 8]
    focal_over_width: Annotated[float, Field(ge=0.01, le=10_000)] | None = None
    scales: _Scales
    target: Literal["motion", "pose"] = "motion"
    pool: Literal[1, 2, 4] = 1
    stages: Literal[4, 5] = 5
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.0
    sequence_pairs: Annotated[int, Field(ge=1, le=4096)] = 16

    @model_validator(mode="after")
    def _warp_has_a_camera(self) -> "NavigatorArchitecture":
        if self.fusion == "warp" and self.focal_over_width is None:
            raise ValueError("focal_over_width, since fusion is warp")
        return self

    @model_validator(mode="after")
    def _pose_has_an_attitude(self) -> "NavigatorArchitecture":
        if self.target == "pose" and (self.scales.mean_rotation is None or self.fusion != "stack"):
            raise ValueError("fusion stack and scales.mean_rotation, since target is pose")
        return self


def check_architecture_of(model: type[Section], architecture: Mapping[str, Any], path: Path) -> None:
    """Raise UserError if a setting of an architecture is missing, unknown or out of range; it names the first one."""
    try:
        model.model_validate_json(json.dumps(architecture))
    except ValidationError as error:
        raise user_error_of(error, model, "architecture", [(str(path), dict(architecture))]) from None
    except (TypeError, ValueError) as error:
        raise UserError(path, "architecture", error, "numbers, text, lists and mappings") from None


def without_memory(build: Callable[[], nn.Module]) -> nn.Module:
    """Build a network whose tensors have shapes but no memory, so that their shapes can be compared with a file."""
    with torch.device("meta"):
        return build()
