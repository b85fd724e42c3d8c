"""The graded grid: a square of uniform spacing around the site, and square rings around it.

The spacing of the rings grows with distance. Every ring has as many vertices as the inner square's border, so a ring of
twice the half-width has twice the spacing; the distance between rings grows in the same proportion. Neighbouring rings
are joined vertex to vertex, so the mesh has no hanging vertices and no gaps. The lowest height from which a camera can
see a place determines its spacing.

Vertices are stored in one list: first the inner square row by row (y, then x), then the rings, each counter-clockwise
from its corner at -x, -y. `lines_in` returns the vertices in a window as straight lines of evenly spaced vertices;
craters and waves are added line by line.
"""

from dataclasses import dataclass

import numpy as np

from perilune_render.config.terrain import TerrainConfig
from perilune_render.provenance.kernels import njit
from perilune_render.terrain.envelope import ViewEnvelope
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array

_MAX_RINGS = 1_000_000
"""Largest number of rings; even the finest ground that fits in memory has fewer."""
FAR_GROWTH = 0.07
"""Growth of the vertex spacing beyond the ground in view, metres per metre. That ground only casts shadows, and a hill
at a distance d casts a shadow into the view only if its height and width are about d tan(elevation of the Sun)."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Positions of the vertices in O_L."""

    n_half: int
    """Number of vertex spacings from the centre of the inner square to its border."""
    half_widths_m: Array
    """Half-widths of the inner square and of the rings, ascending, metres (n_rings + 1,)."""
    centre_x_m: float = 0.0
    """x of the centre, O_L, metres."""
    centre_y_m: float = 0.0
    """y of the centre, O_L, metres."""

    @classmethod
    def even(cls, half_width_m: float, n_half: int) -> "Grid":
        """A grid of uniform spacing, without rings."""
        return cls(n_half, np.array([half_width_m]))

    @property
    def off_site_m(self) -> float:
        """Distance max(|x|, |y|) of the centre from the site, metres."""
        return max(abs(self.centre_x_m), abs(self.centre_y_m))

    @property
    def extent_m(self) -> float:
        """Side of the largest square around the site within the grid, metres."""
        return 2 * (float(self.half_widths_m[-1]) - self.off_site_m)

    @property
    def farthest_m(self) -> float:
        """Depth beyond which nothing is rendered, metres: at least 100 km, and more for wider ground."""
        return max(100_000.0, 2 * float(self.half_widths_m[-1]))

    @property
    def n_vertices(self) -> int:
        """Number of vertices."""
        return (2 * self.n_half + 1) ** 2 + 8 * self.n_half * (len(self.half_widths_m) - 1)

    @property
    def spacings_m(self) -> Array:
        """Vertex spacing of the inner square and each ring, metres (n_rings + 1,).

        This is the larger of the spacings along and across a ring.
        """
        across = np.diff(self.half_widths_m, prepend=self.half_widths_m[0] * (1 - 1 / self.n_half))
        return np.maximum(self.half_widths_m / self.n_half, across)

    @property
    def cell_sides_m(self) -> tuple[Array, Array]:
        """Sides of the cell around a vertex, along and across its ring, metres, (n_rings + 1,) each."""
        around = self.half_widths_m / self.n_half
        across = np.gradient(self.half_widths_m) if len(self.half_widths_m) > 1 else around
        return around, np.append(around[0], across[1:])

    def spacing_at(self, distance_m: Array | float) -> Array:
        """Vertex spacing, metres, at distances max(|x|, |y|) from the centre, metres."""
        ring = np.searchsorted(self.half_widths_m, distance_m)
        return self.spacings_m[np.minimum(ring, len(self.half_widths_m) - 1)]

    def spacing_under(self, x_m: Array, y_m: Array) -> Array:
        """Vertex spacing, metres, at positions in O_L, metres; all arrays have one shape."""
        return self.spacing_at(np.maximum(np.abs(x_m - self.centre_x_m), np.abs(y_m - self.centre_y_m)))

    def half_width_for(self, spacing_m: float) -> float:
        """Half side, metres, of the square in which the spacing is at most `spacing_m`.

        Returns 0 if no such square exists.
        """
        fine = self.spacings_m <= spacing_m * (1 + 1e-9)
        return float(self.half_widths_m[fine].max()) if fine.any() else 0.0

    def vertices_xy(self) -> tuple[Array, Array]:
        """x and y of all vertices, metres, (n_vertices,) each."""
        even = np.linspace(-1, 1, 2 * self.n_half + 1) * self.half_widths_m[0]
        up = -1 + np.arange(2 * self.n_half) / self.n_half
        ones = np.ones_like(up)
        round_x = np.concatenate([up, ones, -up, -ones])
        round_y = np.concatenate([-ones, up, ones, -up])
        rings = self.half_widths_m[1:, None]
        x = np.concatenate([np.tile(even, len(even)), (rings * round_x).ravel()])
        y = np.concatenate([np.repeat(even, len(even)), (rings * round_y).ravel()])
        return x + self.centre_x_m, y + self.centre_y_m

    def quads(self) -> np.ndarray:
        """Vertex indices of the faces (n_faces, 4) int32, counter-clockwise from above."""
        side = 2 * self.n_half + 1
        index = np.arange(side * side, dtype=np.int32).reshape(side, side)
        inner = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1).reshape(-1, 4)
        edge = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
        n_rings = len(self.half_widths_m) - 1
        outer = side * side + np.arange(n_rings * len(edge), dtype=np.int32).reshape(n_rings, len(edge))
        rings = np.concatenate([edge[None], outer])
        following = np.roll(rings, -1, axis=1)
        joined = np.stack([rings[:-1], rings[1:], following[1:], following[:-1]], axis=-1).reshape(-1, 4)
        return np.concatenate([inner, joined])


def graded_grid(terrain: TerrainConfig, view: ViewEnvelope) -> Grid:
    """The grid for all views of an envelope.

    Its spacing is at most `terrain.spacing_px` times the smallest ground pixel. The grid may have more vertices than
    `terrain.max_vertices` (see `perilune_render.terrain.levels`).
    """
    return grid_of(view.reach_m, terrain.spacing_px * view.height_m / view.focal_px, far=view.horizon)


def grid_of(
    reach_m: Array,
    spacing_m: Array,
    centre_m: tuple[float, float] = (0.0, 0.0),
    edge_m: float = 0.0,
    *,
    far: bool = False,
) -> Grid:
    """The grid with a spacing of at most `spacing_m` (N,) within `reach_m` (N,) of its centre.

    Both arrays are ascending, in metres. Beyond the last reach the spacing grows by FAR_GROWTH per metre up to
    `edge_m`. `far` is for a reach of thousands of times the inner square: intermediate distances are then spaced evenly
    in their logarithm.
    """
    n_half = int(np.ceil((reach_m / spacing_m).max()))
    inner = min(n_half * spacing_m[0], reach_m[-1])
    divided = np.geomspace if far else np.linspace
    distance = divided(inner, max(reach_m[-1], inner + spacing_m[0]), 20_000)
    allowed = np.interp(distance, reach_m, spacing_m)
    if edge_m > distance[-1]:
        n_spacings = (edge_m - distance[-1]) / allowed[-1]
        far = allowed[-1] * np.expm1(np.linspace(0, np.log1p(FAR_GROWTH * n_spacings), 2000)[1:]) / FAR_GROWTH
        distance = np.concatenate([distance, distance[-1] + far])
        allowed = np.concatenate([allowed, allowed[-1] + FAR_GROWTH * far])
    steps = np.concatenate([[0], np.cumsum(np.diff(distance) / allowed[:-1])])
    if not steps[-1] <= _MAX_RINGS:
        expected = f"at most {_MAX_RINGS}: raise dataset.terrain.spacing_px or the lowest altitude"
        raise UserError("ground", "vertices along a line", f"about {steps[-1]:.3g}", expected)
    n_rings = int(np.ceil(steps[-1]))
    return Grid(n_half, np.interp(np.linspace(0, steps[-1], n_rings + 1), steps, distance), *centre_m)


@njit(inline="always")
def _put(lines, row, start, step, vertices, ring):
    """Write a line of vertices into `lines`, in the format of `lines_in`."""
    lines[row, 0], lines[row, 1], lines[row, 2], lines[row, 3] = start[0], start[1], step[0], step[1]
    lines[row, 4], lines[row, 5], lines[row, 6] = vertices[0], vertices[1], ring


@njit()
def lines_in(window, n_half, half_widths, lines):
    """Write the vertices in a window as lines into `lines` (2 n_half + 1 + 4 n_rings, 7).

    Returns the number of lines. `window` is (x_low, x_high, y_low, y_high), metres; all coordinates are relative to the
    grid's centre. A line holds x and y of its first vertex, the steps in x and y, the index of the first vertex, the
    number of vertices, and the ring (0 is the inner square).
    """
    x_low, x_high, y_low, y_high = window
    count = 0
    n = n_half
    step = half_widths[0] / n
    i_low, i_high = max(int(np.ceil(x_low / step)), -n), min(int(np.floor(x_high / step)), n)
    j_low, j_high = max(int(np.ceil(y_low / step)), -n), min(int(np.floor(y_high / step)), n)
    if i_low <= i_high:
        for j in range(j_low, j_high + 1):
            first = (j + n) * (2 * n + 1) + i_low + n
            _put(lines, count, (i_low * step, j * step), (step, 0.0), (first, i_high - i_low + 1), 0)
            count += 1
    nearest = max(max(x_low, -x_high), max(y_low, -y_high))
    farthest = max(max(x_high, -x_low), max(y_high, -y_low))
    for ring in range(max(np.searchsorted(half_widths, nearest), 1), len(half_widths)):
        d = half_widths[ring]
        if d > farthest:
            break
        step = d / n
        for side in range(4):
            # The four sides run along +x, +y, -x, -y at y = -d, x = d, y = d, x = -d.
            across = -d if side == 0 or side == 3 else d
            along_x = side == 0 or side == 2
            sign = 1.0 if side < 2 else -1.0
            if not (y_low <= across <= y_high if along_x else x_low <= across <= x_high):
                continue
            low, high = (x_low, x_high) if along_x else (y_low, y_high)
            if side >= 2:
                low, high = -high, -low
            t_low, t_high = max(int(np.ceil((low + d) / step)), 0), min(int(np.floor((high + d) / step)), 2 * n - 1)
            if t_low > t_high:
                continue
            start = sign * (t_low * step - d)
            first = (2 * n + 1) ** 2 + (ring - 1) * 8 * n + side * 2 * n + t_low
            corner = (start, across) if along_x else (across, start)
            steps = (sign * step, 0.0) if along_x else (0.0, sign * step)
            _put(lines, count, corner, steps, (first, t_high - t_low + 1), ring)
            count += 1
    return count


@njit()
def place_in_ring(x, y, n_half):
    """Fractional position along the square ring through (x, y), in vertices from the corner at -x, -y."""
    distance = max(abs(x), abs(y))
    if y <= -distance:
        side, along = 0, x
    elif x >= distance:
        side, along = 1, y
    elif y >= distance:
        side, along = 2, -x
    else:
        side, along = 3, -y
    return (2 * side + along / distance + 1) * n_half


@njit()
def vertex_of_ring(ring, position, n_half):
    """Index of a vertex, from its ring and its position after the corner at -x, -y.

    Ring 0 is the border of the inner square.
    """
    n = n_half
    position %= 8 * n
    if ring > 0:
        return (2 * n + 1) ** 2 + (ring - 1) * 8 * n + position
    side, t = position // (2 * n), position % (2 * n)
    if side == 0:
        i, j = t, 0
    elif side == 1:
        i, j = 2 * n, t
    elif side == 2:
        i, j = 2 * n - t, 2 * n
    else:
        i, j = 0, 2 * n - t
    return j * (2 * n + 1) + i
