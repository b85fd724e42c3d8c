"""Poses and settings that cannot give a picture are refused before anything is rendered."""

import sys
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation
from tests.helpers.scenes import config_with, flat_scene

from perilune_render.cli.main import main
from perilune_render.config.dataset import KindConfig
from perilune_render.engines.heightfield.query import heights_m
from perilune_render.engines.heightfield.surface import surface_of
from perilune_render.flight import pose_checks
from perilune_render.flight.plan import make_plan
from perilune_render.flight.pose_checks import Poses, check_plan, check_poses
from perilune_render.flight.trajectories import fly
from perilune_render.terrain.boulders import Boulders, tops_m
from perilune_shared.editing.writer import with_column
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import quaternion_from_matrix

NADIR = np.diag([1.0, -1.0, -1.0])
"""rotation_camera_from_site of a camera that looks straight down."""
COARSE = [f"--set=dataset.camera.{side}_px=16" for side in ("width", "height")] + ["--set=dataset.terrain.spacing_px=4"]


def pose(x_m, y_m, z_m, tilt_deg=0.0):
    """One sound pose and one of interest, the camera's axis tilted about its own x."""
    tilted = Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix() @ NADIR
    rotations = np.stack([quaternion_from_matrix(NADIR), quaternion_from_matrix(tilted)])
    return Poses(["s/t/000000", "s/t/000001"], np.array([[0.0, 0.0, 500.0], [x_m, y_m, z_m]]), rotations)


def mountain(x, y):
    return 300 * np.exp(-((x - 400) ** 2 + y**2) / 2 / 60**2)


@pytest.fixture(scope="module")
def ground():
    """2 km of flat ground with a mountain of 300 m at x 400 m."""
    side = np.linspace(-1000, 1000, 201)
    return flat_scene(2000.0, 201, height_m=mountain(*np.meshgrid(side, side)))


@pytest.mark.parametrize(
    ("where", "found"),
    [
        ((0, 0, -3.0), "a camera -3.0 m above the ground"),
        ((0, 0, 0.5), "a camera 0.5 m above the ground"),
        ((400, 0, 250), "a camera -50.0 m above the ground"),
        ((5000, 0, 500), "a camera at x 5000 m"),
        ((0, 0, 500, 75), "75 degrees from straight down, with the horizon in view"),
        ((0, 0, 500, 45), "of the image's edge is beyond the terrain's edge"),
        ((0, 0, 2500), "100% of the image's edge is beyond the terrain's edge"),
        ((0, np.nan, 500), "position"),
    ],
)
def test_an_impossible_pose_is_named(ground, camera, where, found):
    with pytest.raises(UserError, match=f"plan: frame s/t/000001: got .*{found}"):
        check_poses(pose(*where), camera, ground, "plan")


@pytest.mark.parametrize("where", [(0, 0, 1.5), (400, 0, 302), (0, 0, 500, 25), (-900, 900, 100), (0, 0, 2100)])
def test_a_sound_pose_passes(ground, camera, where):
    check_poses(pose(*where), camera, ground, "plan")


def test_a_mountain_at_the_edge_hides_what_lies_behind(camera):
    side = np.linspace(-1000, 1000, 201)
    _, y = np.meshgrid(side, side)
    tilted = pose(0, 0, 200, 54)
    with pytest.raises(UserError, match="beyond the terrain's edge"):
        check_poses(tilted, camera, flat_scene(2000.0, 201), "plan")
    check_poses(tilted, camera, flat_scene(2000.0, 201, height_m=np.where(np.abs(y) > 900, 190.0, 0.0)), "plan")


def test_the_flights_of_a_configuration_pass(scene, small_config, camera):
    flights = [fly(small_config.detect.flight, 100, seed) for seed in range(30)]
    position, rotation = (np.concatenate([getattr(f, n) for f in flights]) for n in ("position_m", "rotation_wxyz"))
    check_poses(Poses([f"f{i}" for i in range(3000)], position, rotation), camera, scene, "plan")


def test_a_plan_is_checked_before_its_ground_is_grown(scene):
    plan = make_plan(config_with(), "detect")
    check_plan(plan, scene.grid, "plan")
    (trajectory,) = plan.trajectories
    far = replace(trajectory.flight, position_m=trajectory.flight.position_m + np.array([5000.0, 0, 0]))
    with pytest.raises(UserError, match=f"plan: frame {trajectory.frame_id(0)}: got a camera at x"):
        check_plan(replace(plan, trajectories=(replace(trajectory, draw_flight=lambda: far),)), scene.grid, "plan")
    night = replace(plan.scenes[0], sun_elevation_deg=-2.0)
    with pytest.raises(UserError, match="plan: scene-0000: sun_elevation_deg: got -2 degrees"):
        check_plan(replace(plan, scenes=(night,)), scene.grid, "plan")


def test_the_first_scenes_of_a_large_plan_are_checked(scene, monkeypatch):
    kind = KindConfig(n_scenes=3, trajectories_per_scene=1, n_frames=4, split_by="scene")
    plan = make_plan(config_with(detect=kind), "detect")
    far = replace(plan.trajectories[0].flight, position_m=np.full((4, 3), 5000.0))
    trajectories = (*plan.trajectories[:2], replace(plan.trajectories[2], draw_flight=lambda: far))
    monkeypatch.setattr(pose_checks, "_CHECKED_FRAMES", 8)
    check_plan(replace(plan, trajectories=trajectories), scene.grid, "plan")
    monkeypatch.setattr(pose_checks, "_CHECKED_FRAMES", 9)
    with pytest.raises(UserError, match="plan: frame scene-0002/trajectory-0000/000000"):
        check_plan(replace(plan, trajectories=trajectories), scene.grid, "plan")


@pytest.mark.parametrize("command", ["dataset", "plan"])
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["dataset.detect.sun.elevation_deg=-5"], "dataset.detect.sun"),
        (["dataset.labels.min_radius_px=60", "dataset.labels.max_radius_px=60"], "dataset.labels"),
        (["dataset.terrain.relief.longest_wavelength_m=0.5"], "dataset.terrain.relief.longest_wavelength_m"),
        (
            [
                "dataset.detect.flight.end_altitude_m=0.9",
                "dataset.detect.flight.start_altitude_m=5",
                "dataset.detect.flight.downrange_m=1",
                "dataset.detect.flight.position_sigma_m=0",
            ],
            "dataset.detect: frame scene-0000/trajectory-0000/000007: got a camera 0.9 m above the ground",
        ),
    ],
)
def test_an_impossible_configuration_ends_the_command_with_one_line(
    command, settings, message, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    chosen = [*COARSE, *(f"--set={setting}" for setting in settings)]
    argv = ["perilune-render", command, "--preset", "tiny", "--kind", "detect", "--out", str(out), *chosen]
    assert message in refusal(argv, monkeypatch, capsys)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_an_edited_pose_of_a_manifest_is_refused(quick_detect, tmp_path, monkeypatch, capsys):
    part = quick_detect / "manifest" / "frames" / "all.parquet"
    rows = pq.read_table(part)
    positions = rows["position_m"].to_pylist()
    positions[3] = [positions[3][0], positions[3][1], -500.0]
    pq.write_table(with_column(rows, "position_m", positions), part)
    frame_id, out = "scene-0000/trajectory-0000/000003", tmp_path / "out"
    for command in (["dataset"], ["regenerate", "--frames", frame_id]):
        argv = ["perilune-render", *command, "--manifest", str(quick_detect), "--out", str(out)]
        line = refusal(argv, monkeypatch, capsys)
        assert f"frame {frame_id}: got a camera -" in line and "m above the ground, expected at least 1 m" in line
    assert not out.exists()


def refusal(argv, monkeypatch, capsys):
    """The one line of a command that ends with exit code 2."""
    monkeypatch.setattr(sys, "argv", argv)
    with pytest.raises(SystemExit) as stop:
        main()
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error")]
    assert stop.value.code == 2
    return line


def rocky_scene():
    """Flat ground with a boulder of 4 m at x 20 m, and small ones."""
    scene = flat_scene(2000.0, 201)
    rng = np.random.default_rng(3)
    rotation = rng.normal(size=(12, 4))
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    x, y = np.append(20.0, rng.uniform(-8, 8, 11)), np.append(0.0, rng.uniform(-8, 8, 11))
    boulders = Boulders(x, y, np.append(4.0, rng.uniform(1, 3, 11)), np.arange(12), rotation)
    return replace(scene, boulders=boulders, boulder_z_m=boulders.centre_height_m(np.zeros(12)))


def test_the_tops_of_boulders_are_those_that_rays_hit():
    scene = rocky_scene()
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-10, 24, 60), np.linspace(-10, 10, 60)))
    tops = tops_m(scene.boulders, scene.boulder_z_m, scene.grid, scene.seed, x, y)
    rays = heights_m(surface_of(scene), x, y)
    assert (rays > 0.01).sum() > 100
    assert np.allclose(np.maximum(tops, 0), rays, rtol=0, atol=1e-4)


def test_a_camera_just_above_a_boulder_is_refused(camera):
    scene = rocky_scene()
    top = float(tops_m(scene.boulders, scene.boulder_z_m, scene.grid, scene.seed, np.array([20.0]), np.zeros(1))[0])
    assert 1.5 < top < 4
    check_poses(pose(20.0, 0.0, top + 1.01), camera, scene, "plan")
    with pytest.raises(UserError, match=r"s/t/000001: got a camera 0.9 m above the boulder below it"):
        check_poses(pose(20.0, 0.0, top + 0.9), camera, scene, "plan")
