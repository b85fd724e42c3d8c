"""Datasets of labelled descents: geometry, manifest, validation, editing, export. Use::

import perilune_shared as ps

dataset = ps.open_dataset("data/small/detect")
frame = dataset[0]
frame.image, frame.labels["radius_px"], frame.row["position_m"]
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from perilune_shared.dataset.manifest import Dataset as Dataset
    from perilune_shared.dataset.manifest import open_dataset as open_dataset

__version__ = "0.1.0"
__all__ = ["Dataset", "open_dataset"]


def __getattr__(name: str) -> Any:
    """The names of `__all__`, imported on first use, so that a command line's --help need not read pandas."""
    if name in __all__:
        from perilune_shared.dataset import manifest

        return getattr(manifest, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
