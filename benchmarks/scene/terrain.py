"""Time and memory of terrain generation on one core.

Measures a 4 km scene, stamping craters, and a second trajectory from the cache. Runs on one core. A small
scene is generated first, so that compilation by numba is not measured. Writes runs/bench/terrain.json.
"""

import os
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.figures import write_figures
from perilune_render.config.dataset import DatasetConfig, FlightConfig
from perilune_render.config.terrain import CratersConfig
from perilune_render.config.values import Span
from perilune_render.engines.blender.renderer import Renderer
from perilune_render.flight.lens import camera_of
from perilune_render.flight.plan import make_plan
from perilune_render.flight.view import view_envelope
from perilune_render.terrain.boulders import boulder_mesh
from perilune_render.terrain.cache import cached_scene
from perilune_render.terrain.craters.population import Craters, draw_craters
from perilune_render.terrain.craters.profile import profile_tables
from perilune_render.terrain.craters.stamp import stamp_craters
from perilune_render.terrain.export import vertices
from perilune_render.terrain.grid import Grid, graded_grid
from perilune_render.terrain.scene import Scene, grow_scene
from perilune_shared.config.resolve import resolve
from perilune_shared.console.terminal import progress_bar
from perilune_shared.geometry.frames import sun_direction

COUNTS = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000)


def mesh_of(scene: Scene) -> int:
    """Build vertices and faces of ground and boulders; returns their number of bytes."""
    ground = vertices(scene.grid, scene.height_m), scene.grid.quads()
    stones = boulder_mesh(scene.boulders, scene.boulder_z_m, scene.grid, scene.seed)
    return sum(array.nbytes for array in (*ground, *stones))


def stamping_s(grid: Grid, craters: Craters) -> float:
    """Time, seconds, to stamp craters on flat ground."""
    height, albedo = np.zeros(grid.n_vertices), np.ones(grid.n_vertices)
    start = time.perf_counter()
    stamp_craters(height, albedo, grid, craters, np.zeros(len(craters)))
    return time.perf_counter() - start


def draw_n_craters(grid: Grid, n: int, seed: int) -> Craters:
    """Draw n craters from the default law, oldest first, with the density adjusted to this number."""
    config = CratersConfig(equilibrium_share=Span(low=1.0, high=1.0))
    drawn = draw_craters(config, grid, seed)
    share = 1.3 * n / len(drawn)
    dense = draw_craters(config.model_copy(update={"equilibrium_share": Span(low=share, high=share)}), grid, seed)
    chosen = np.random.default_rng(seed).choice(len(dense), n, replace=False)
    return dense.chosen(np.sort(chosen))


def main() -> None:
    """Run the benchmark."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    config = resolve(DatasetConfig, "dataset", "perilune_render", "small")
    camera = camera_of(config.camera)
    tiny = resolve(DatasetConfig, "dataset", "perilune_render", "tiny")
    grow_scene(config, view_envelope(camera_of(tiny.camera), FlightConfig()), 1)
    flight = config.detect.flight.model_copy(update={"downrange_m": 1090.0})
    # Computing the profile tables is part of the measurement.
    profile_tables.cache_clear()
    start, cpu_start = time.perf_counter(), time.process_time()
    scene = grow_scene(config, view_envelope(camera, flight), 7)
    grown_s = time.perf_counter() - start
    mesh_bytes = mesh_of(scene)
    scene_s, scene_cpu_s = time.perf_counter() - start, time.process_time() - cpu_start
    peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    grid = graded_grid(config.terrain, view_envelope(camera, config.detect.flight))
    times = []
    with progress_bar() as bar:
        for n in bar.track(COUNTS, description="stamping craters"):
            craters = draw_n_craters(grid, n, 3)
            times.append(min(stamping_s(grid, craters) for _ in range(3)))
    figures = {
        "scene_s": scene_s,
        # CPU time, so without the load of other programs.
        "scene_cpu_s": scene_cpu_s,
        "grown_s": grown_s,
        "extent_m": scene.grid.extent_m,
        "downrange_m": flight.downrange_m,
        "vertices": scene.grid.n_vertices,
        "craters": len(scene.craters),
        "boulders": len(scene.boulders),
        "mesh_gib": mesh_bytes / 2**30,
        "peak_gib": peak_gib,
        "craters_per_s": COUNTS[-2] / times[-2],
        "slope": float(np.polyfit(np.log(COUNTS), np.log(times), 1)[0]),
        "slope_from_30000": float(np.polyfit(np.log(COUNTS[3:]), np.log(times[3:]), 1)[0]),
        "laying_s": dict(zip(map(str, COUNTS), times, strict=True)),
        **first_frame_times(config),
    }
    write_figures(Path("runs/bench/terrain.json"), figures)


def first_frame_times(config: DatasetConfig) -> dict[str, float]:
    """Time in seconds from the settings to the first rendered frame, without and with the scene in the cache."""
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    plan = make_plan(config, "detect")
    times = []
    with tempfile.TemporaryDirectory() as folder:
        os.environ["PERILUNE_CACHE"] = folder
        for trajectory in plan.trajectories[:2]:
            start = time.perf_counter()
            scene = cached_scene(config, plan.view, plan.scenes[0].seed)
            with Renderer(scene, config, plan.exr_camera, sun_direction(90, 30)) as renderer:
                renderer.render(trajectory.flight.position_m[0], trajectory.flight.rotation_camera_from_site[0])
            times.append(time.perf_counter() - start)
    return {"first_descent_s": times[0], "second_descent_s": times[1]}


if __name__ == "__main__":
    main()
