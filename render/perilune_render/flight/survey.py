"""Plan of a survey: a stereo pair of images from orbit of every scene of a plan, with another Sun."""

from dataclasses import replace
from functools import partial

import numpy as np

from perilune_render.config.dataset import DatasetConfig
from perilune_render.config.derived import SurveyConfig
from perilune_render.flight.plan import Plan, ScenePlan, TrajectoryPlan
from perilune_render.flight.rig import mounted
from perilune_render.flight.trajectories import Flight
from perilune_render.terrain.grid import graded_grid
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, quaternion_from_matrix
from perilune_shared.geometry.nominal_trajectory import NominalTrajectory

_SHARE_OF_GROUND = 0.95
"""Distance from the site that the images cover, as a share of the distance to the edge of the ground. Beyond the edge
there may be no relief."""
_TILE_PX = 32
_LARGEST_SIDE_PX = 8192
_BETWEEN_S = 100.0
"""Time between the two images, seconds. It is so long that the camera moves far less than a pixel during an exposure;
on a real orbiter, motion compensation has this effect."""
_CAMERA_FROM_SITE_LEVEL = np.diag([1.0, -1.0, -1.0])


def survey_plan(descents: Plan, config: DatasetConfig) -> Plan:
    """The survey of the scenes of a plan: one trajectory with two frames for each scene.

    `config.survey` states camera and Sun. The ground equals the ground of the descents byte for byte. The camera is at
    y = 0, first at negative x (east) and then at positive x (west), and looks towards the site. Raises UserError if the
    ground is made of several meshes, or if the camera would be too large or not above the ground.
    """
    survey = config.survey
    if survey is None:
        raise ValueError("no survey in the configuration")
    if config.cameras:
        raise UserError("survey", "dataset.cameras", ", ".join(config.cameras), "descents with a single dataset.camera")
    if graded_grid(config.terrain, descents.view).n_vertices > config.terrain.max_vertices:
        found = "ground in several meshes"
        raise UserError("survey", "dataset.terrain.max_vertices", found, "a scene that fits one mesh")
    camera = survey_camera(survey, float(descents.view.reach_m[-1]))
    scenes = tuple(_lit(scene, survey) for scene in descents.scenes)
    trajectories = tuple(_pair(descents, scene.scene_id, survey) for scene in scenes)
    ranges = {scene.scene_id: range(index, index + 1) for index, scene in enumerate(scenes)}
    return replace(descents, rig={None: mounted(camera)}, scenes=scenes, trajectories=trajectories, ranges=ranges)


def survey_camera(survey: SurveyConfig, reach_m: float) -> Camera:
    """A square pinhole that shows the ground up to _SHARE_OF_GROUND of `reach_m` beyond the site.

    Raises UserError if the camera would not be over the ground, or if a side of the image would have fewer than
    _TILE_PX or more than _LARGEST_SIDE_PX pixels.
    """
    tilt = np.radians(survey.convergence_deg / 2)
    beside_m = survey.altitude_m * np.tan(tilt)
    if beside_m >= reach_m:
        expected = f"a camera over the ground: at most {reach_m / np.tan(tilt):.0f}, or a smaller convergence_deg"
        raise UserError("survey", "altitude_m", survey.altitude_m, expected)
    half = np.arctan((_SHARE_OF_GROUND * reach_m + beside_m) / survey.altitude_m) - tilt
    focal_px = survey.altitude_m / survey.pixel_m
    side_px = int(2 * focal_px * np.tan(half) / _TILE_PX) * _TILE_PX
    if not _TILE_PX <= side_px <= _LARGEST_SIDE_PX:
        found = f"{survey.pixel_m:g}, images of {side_px} px"
        raise UserError("survey", "pixel_m", found, f"images of {_TILE_PX} to {_LARGEST_SIDE_PX} px")
    return Camera(side_px, side_px, focal_px, focal_px, side_px / 2, side_px / 2)


def _lit(scene: ScenePlan, survey: SurveyConfig) -> ScenePlan:
    azimuth = (scene.sun_azimuth_deg + survey.sun_azimuth_offset_deg) % 360
    return replace(scene, sun_azimuth_deg=azimuth, sun_elevation_deg=survey.sun_elevation_deg)


def _pair(descents: Plan, scene_id: str, survey: SurveyConfig) -> TrajectoryPlan:
    """The two images of a scene, in the split of the scene's first descent."""
    first = descents.of_scene(scene_id)[0]
    splits = (first.splits[0],) * 2
    return TrajectoryPlan(scene_id, "survey", first.seed, range(2), splits, partial(_flight, survey), is_drawn=False)


def _flight(survey: SurveyConfig) -> Flight:
    """Poses of the two cameras."""
    tilt = np.radians(survey.convergence_deg / 2)
    beside_m = survey.altitude_m * np.tan(tilt)
    velocity = (2 * beside_m / _BETWEEN_S, 0.0, 0.0)
    nominal = NominalTrajectory((-beside_m, 0.0, survey.altitude_m), velocity, (0.0, 0.0, 0.0), _BETWEEN_S)
    position = np.array([[side * beside_m, 0.0, survey.altitude_m] for side in (-1, 1)])
    rotation = [quaternion_from_matrix(_turned(side * tilt) @ _CAMERA_FROM_SITE_LEVEL) for side in (-1, 1)]
    return Flight(nominal, np.array([0.0, _BETWEEN_S]), position, np.tile(velocity, (2, 1)), np.stack(rotation))


def _turned(angle_rad: float) -> Array:
    """Rotation (3, 3) about the camera's y.

    A positive angle moves the optical axis from straight down towards -x.
    """
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
