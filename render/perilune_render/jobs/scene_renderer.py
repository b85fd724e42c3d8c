"""Render single trajectories of a job, in any process that has the job and the store."""

import contextlib
from collections.abc import Callable
from types import TracebackType

from perilune_render.dataset import tables
from perilune_render.dataset.begin import check_code
from perilune_render.dataset.frame_files import file_columns
from perilune_render.dataset.trajectory import SceneSetting, render_trajectory
from perilune_render.dataset.work import FOLDER, write_scene
from perilune_render.engines.frame_source import FrameSource
from perilune_render.engines.open_engine import open_engine
from perilune_render.flight.pose_checks import check_trajectories
from perilune_render.jobs.job import Job
from perilune_render.jobs.records import RunningRecord
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.outputs.hazard import hazard_tiff
from perilune_render.outputs.of_scene import SceneOutputs
from perilune_render.preview.site_horizon import shadow_warnings
from perilune_render.terrain.cache import cached_scene
from perilune_render.terrain.scene import Scene
from perilune_shared.console.interrupts import interrupts_held
from perilune_shared.dataset.names import scene_file_path
from perilune_shared.storage.store import Store


class SceneRenderer:
    """Renders trajectories of a job, one at a time, and keeps the current scene for the next trajectory.

    Use it as a context manager. A process may have only one at a time, since Blender holds only one scene. Raises
    UserError if this process has other code or libraries than the job's recipe.
    """

    def __init__(self, job: Job, out: Store):
        check_code(job.info.recipe(), with_dem=job.config.terrain.dem is not None)
        self._job, self._out = job, out
        self._record = RunningRecord(out)
        self._shared = None if out.is_local else out.sub(f"{FOLDER}/scenes")
        self._grown: tuple[str, Scene] | None = None
        self._outputs: tuple[str, SceneOutputs] | None = None
        self._opened: tuple[tuple[str, str | None], Scene, FrameSource, SceneOutputs] | None = None
        self._closing = contextlib.ExitStack()

    @property
    def scene_id(self) -> str | None:
        """Id of the scene in memory, if any."""
        if self._opened is not None:
            return self._opened[0][0]
        return self._grown[0] if self._grown is not None else None

    def grow(self, scene_id: str) -> Scene:
        """Generate the ground of a scene and check its poses. Raises UserError if a pose fails `check_poses`."""
        if self._grown is None or self._grown[0] != scene_id:
            self.close()  # frees the ground of the previous scene first
            job = self._job
            with interrupts_held():
                scene = cached_scene(job.config, job.plan.view, job.scene(scene_id).seed, self._shared)
            trajectories = job.plan.of_scene(scene_id)
            check_trajectories(job.plan, trajectories, scene, job.where)
            self._grown = scene_id, scene
        return self._grown[1]

    def check(self, scene_id: str) -> list[str]:
        """Generate a scene and check its poses (`grow`).

        Returns warnings about directions of the Sun that leave the site in shadow, if the job has `dataset.scene`.
        """
        scene, job = self.grow(scene_id), self._job
        return [] if job.config.scene is None else shadow_warnings(scene, job.plan.scenes)

    def render(self, index: int, advance: Callable[[], object], note: Callable[[str], object]) -> list[str]:
        """Render a trajectory and write its files and rows; return the ids of its dark frames.

        `advance` is called after each frame, `note` with a text about the current step.
        """
        trajectory = self._job.plan.trajectories[index]

        def counted() -> None:
            self._record.frame()
            advance()

        try:
            self._record.begin(self._job.name(index))
            scene, source, outputs = self._open(trajectory.scene_id, trajectory.camera, note)
            config = self._job.config
            of_scene = SceneSetting(scene, config, config.kind(self._job.info.kind).instruments, outputs)
            return render_trajectory(self._out, source, trajectory, of_scene, counted)
        except BaseException:
            self.close()  # Blender's scene may be half changed
            raise

    def _open(
        self, scene_id: str, camera: str | None, note: Callable[[str], object]
    ) -> tuple[Scene, FrameSource, SceneOutputs]:
        if self._opened is None or self._opened[0] != (scene_id, camera):
            note(f"{scene_id}: generating ground")
            self._opened = None
            self._closing.close()  # closes the engine of the previous camera
            scene, plan, config = self.grow(scene_id), self._job.scene(scene_id), self._job.config
            outputs = self._outputs_of(scene_id, scene, note)
            files = self._write_hazard(scene_id, scene, outputs)
            rows = tables.scene_tables(plan, scene, config, self._job.info.recipe().key, files)
            trajectories = tables.trajectory_table(self._job.plan.of_scene(scene_id))
            write_scene(self._out, scene_id, {**rows, "trajectories": trajectories})
            mounted = self._job.plan.rig[camera]
            engine = self._closing.enter_context(
                open_engine(scene, config, mounted.exr_camera, plan.sun, outputs.surface)
            )
            source = FrameSource.of(engine, config, mounted.camera, RimCircles.of_scene(scene), camera)
            self._opened = (scene_id, camera), scene, source, outputs
            note(scene_id if camera is None else f"{scene_id} {camera}")
        return self._opened[1:]

    def _outputs_of(self, scene_id: str, scene: Scene, note: Callable[[str], object]) -> SceneOutputs:
        """Additional outputs of a scene, shared by all its cameras."""
        if self._outputs is None or self._outputs[0] != scene_id:
            if self._job.config.hazard is not None:
                note(f"{scene_id}: making the hazard map")
            self._outputs = scene_id, SceneOutputs.of(scene, self._job.config, self._job.scene(scene_id).sun)
        return self._outputs[1]

    def _write_hazard(self, scene_id: str, scene: Scene, outputs: SceneOutputs) -> dict[str, str | int]:
        """Write the hazard map of a scene if there is one; return the columns hazard_* of the table `scenes`."""
        if outputs.hazard is None:
            return {}
        path = scene_file_path(scene_id, "hazard")
        content = hazard_tiff(outputs.hazard, scene.latitude_deg, scene.longitude_deg)
        self._out.replace(path, content)
        return file_columns("hazard", path, content)

    def __enter__(self) -> "SceneRenderer":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
        self._record.remove()

    def close(self) -> None:
        """Release Blender and the memory of the scene."""
        self._opened = self._grown = self._outputs = None
        self._closing.close()
