"""Read, validate, edit and export datasets of labelled lunar landing trajectories.

Use:

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
    """Import the names of `__all__` on first use, so that `--help` starts without importing pandas."""
    if name in __all__:
        from perilune_shared.dataset import manifest

        return getattr(manifest, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
