"""The description of a dataset to render, which every process of a run receives."""

from dataclasses import dataclass, replace

from perilune_render.config.dataset import DatasetConfig
from perilune_render.dataset.begin import new_info
from perilune_render.flight.plan import Plan, ScenePlan, TrajectoryPlan, make_plan
from perilune_render.provenance.recipe import recipe_of
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.dataset.names import Kind
from perilune_shared.threads import usable_cores


@dataclass(frozen=True, slots=True)
class Job:
    """Description of a dataset to render. Trajectories are identified by their index in `plan.trajectories`."""

    plan: Plan
    """Scenes, trajectories and frames."""
    config: DatasetConfig
    """Settings."""
    info: DatasetInfo
    """The initial dataset.json."""
    where: str
    """Source of the plan (configuration or manifest), for error messages about poses."""

    @classmethod
    def planned(cls, config: DatasetConfig, kind: Kind, preset: str) -> "Job":
        """The job to render the dataset `detect` or `nav` of a configuration.

        `preset` is the preset on which the settings are based, for the recipe. Raises UserError on impossible settings.
        """
        plan = make_plan(config, kind)
        return cls(
            plan, config, new_info(config, plan, recipe_of(config, kind, preset)), f"configuration: dataset.{kind}"
        )

    def with_threads(self, n_threads: int | None, n_workers: int) -> "Job":
        """The job with `n_threads` threads in each process.

        None keeps the configured number. If the configured number is 0 (all cores), several workers share the cores.
        """
        if n_threads is None and (self.config.render.threads or n_workers <= 1):
            return self
        n_threads = n_threads or max(usable_cores() // n_workers, 1)
        render = self.config.render.model_copy(update={"threads": n_threads})
        return replace(self, config=self.config.model_copy(update={"render": render}))

    def scene(self, scene_id: str) -> ScenePlan:
        """The plan of a scene."""
        return next(scene for scene in self.plan.scenes if scene.scene_id == scene_id)

    def n_frames(self, index: int) -> int:
        """Number of frames of a trajectory."""
        return len(self.plan.trajectories[index].splits)

    def name(self, index: int) -> str:
        """Name of a trajectory, such as scene-0000/trajectory-0000."""
        return trajectory_name(self.plan.trajectories[index])


def trajectory_name(trajectory: TrajectoryPlan) -> str:
    """Name of a trajectory in messages, such as scene-0000/trajectory-0000."""
    return f"{trajectory.scene_id}/{trajectory.trajectory_id}"
