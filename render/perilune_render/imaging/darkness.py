"""Warn of frames in which almost no pixel is sunlit."""

from collections.abc import Sequence

from perilune_render.imaging.radiance import Radiance
from perilune_shared.console.progress import say

_MIN_SUNLIT = 0.01


def is_dark(radiance: Radiance) -> bool:
    """Whether less than 1 % of a frame's pixels are sunlit."""
    return bool(radiance.sunlit.mean() < _MIN_SUNLIT)


def warn_of_dark_frames(scene_id: str, dark: Sequence[str], n_frames: int, sun_elevation_deg: float) -> None:
    """Print a warning if some of a scene's `n_frames` new frames are dark; `dark` holds their ids."""
    if dark:
        line = (
            f"warning: {scene_id}: {len(dark)} of {n_frames} frames are dark (less than {_MIN_SUNLIT:.0%} of the "
            f"picture is sunlit), first {dark[0]}; the Sun is {sun_elevation_deg:.1f} degrees high"
        )
        say(line)
