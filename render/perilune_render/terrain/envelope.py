"""The view envelope: the lowest height from which ground is seen, by distance from the site."""

from dataclasses import dataclass

import numpy as np

from perilune_shared.geometry.frames import Array


@dataclass(frozen=True, slots=True)
class SeenGround:
    """The ground that frames show at each of N camera heights.

    `perilune_render.terrain.levels` makes meshes for this ground.
    """

    z_m: Array
    """Height of the camera above O_L's plane, ascending, metres (N,)."""
    height_m: Array
    """Lowest height of a camera at `z_m` above the ground in view, metres (N,)."""
    nearest_m: Array
    """Smallest distance of the nominal trajectory from the site, metres (N,)."""
    farthest_m: Array
    """Largest distance of the nominal trajectory from the site, metres (N,)."""
    margin_m: Array
    """Largest distance in x or in y between the nominal trajectory and ground in view, metres (N,)."""

    def box_m(self, approach_deg: int) -> tuple[Array, Array]:
        """Smallest and largest x and y, (N, 2) each, metres, of the ground that a trajectory's frames show.

        The trajectory comes from the direction `approach_deg`, clockwise from north, to within half a degree.
        """
        azimuth = np.radians(approach_deg + np.array([-0.5, 0.0, 0.5]))
        towards = -np.stack([np.sin(azimuth), np.cos(azimuth)], axis=-1)
        points = np.concatenate([d[:, None, None] * towards for d in (self.nearest_m, self.farthest_m)], axis=1)
        margin = self.margin_m[:, None]
        return points.min(axis=1) - margin, points.max(axis=1) + margin


@dataclass(frozen=True, slots=True)
class ViewEnvelope:
    """The views for which a scene's mesh is made. They determine its extent and vertex spacing.

    Ground at the distance `reach_m[i]` from the site is never seen from less than `height_m[i]` away; between the
    reaches, the height is interpolated linearly. Ground beyond the last reach is never seen. For a flight, use
    `perilune_render.flight.view.view_envelope`.

    Raises ValueError unless `height_m` and `reach_m` are finite, positive and non-decreasing.
    """

    height_m: Array
    """Smallest distance of the camera from the ground in view, non-decreasing, metres (N,); usually the camera's
    height."""
    reach_m: Array
    """Distance max(|x|, |y|) of that ground from the site, non-decreasing, metres (N,)."""
    focal_px: float
    """Largest focal length of the camera, pixels: a pixel shows at least height / focal_px metres of ground."""
    seen: SeenGround | None = None
    """The ground in view by the camera's height, from which levels are cut; None allows one mesh only."""
    horizon: bool = False
    """Whether views may show the sky: the ground is then curved (`perilune_shared.geometry.curvature`)."""

    def __post_init__(self) -> None:
        columns = np.array([self.height_m, self.reach_m])
        good = columns.size > 0 and np.isfinite(columns).all() and (columns > 0).all() and self.focal_px > 0
        if not good or (np.diff(columns) < 0).any():
            raise ValueError(f"height_m and reach_m of a view envelope: got {columns}, expected positive and ascending")
