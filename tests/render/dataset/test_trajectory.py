"""One trajectory: a frame is developed and written while the next one is rendered; errors of both end it."""

import threading

import pyarrow.parquet as pq
import pytest
from tests.helpers.flat_engine import FlatEngine
from tests.helpers.scenes import config_with, flat_scene, round_craters

from perilune_render.config.dataset import CameraConfig, KindConfig
from perilune_render.dataset.trajectory import SceneSetting, render_trajectory
from perilune_render.dataset.work import committed
from perilune_render.engines.frame_source import FrameSource
from perilune_render.flight.plan import make_plan
from perilune_render.labels.frame_labels import RimCircles
from perilune_shared.storage.store import open_store

N_FRAMES = 6
KIND = KindConfig(n_scenes=1, trajectories_per_scene=1, n_frames=N_FRAMES, split_by="scene")
CONFIG = config_with(camera=CameraConfig(width_px=512, height_px=512), detect=KIND)


class WatchingEngine(FlatEngine):
    """Records which files exist when each rendering starts; fails at a frame if asked to."""

    def __init__(self, plan, out, fails_at=None):
        super().__init__("lommel_seeliger", plan.camera, plan.scenes[0].sun)
        self.out, self.fails_at, self.n_files = out, fails_at, []

    def render(self, position_m, rotation_camera_from_site, seed, approach_deg):
        if len(self.n_files) == self.fails_at:
            raise OSError("no frame")
        self.n_files.append(len(list(self.out.rglob("[!.]*.png"))))
        return super().render(position_m, rotation_camera_from_site, seed, approach_deg)


def render(out, fails_at=None, advance=lambda: None):
    """Render the trajectory into `out`; returns the engine."""
    plan, scene = make_plan(CONFIG, "detect"), flat_scene(3000, 41, round_craters([(10, 0, 60, 0.1)]))
    engine = WatchingEngine(plan, out, fails_at)
    source = FrameSource.of(engine, CONFIG, plan.camera, RimCircles.of_scene(scene))
    of_scene = SceneSetting(scene, CONFIG, CONFIG.detect.instruments)
    assert render_trajectory(open_store(out), source, plan.trajectories[0], of_scene, advance) == []
    return engine


def frames_part(out):
    return out / "work/frames/scene-0000.trajectory-0000.parquet"


def test_a_frame_is_written_while_the_next_one_is_rendered(tmp_path):
    done = []
    engine = render(tmp_path, advance=lambda: done.append(len(list(tmp_path.rglob("[!.]*.png")))))
    assert all(n_files in (place, max(place - 1, 0)) for place, n_files in enumerate(engine.n_files))
    # In turn, each rendering would find the files of all frames before it.
    assert any(n_files < place for place, n_files in enumerate(engine.n_files))
    assert len(done) == N_FRAMES and all(n_files > place for place, n_files in enumerate(done))
    assert committed(open_store(tmp_path)) == {"scene-0000.trajectory-0000"}
    rows = pq.read_table(frames_part(tmp_path))
    assert rows["frame_index"].to_pylist() == list(range(N_FRAMES))
    assert rows["png_bytes"].to_pylist() == [(tmp_path / path).stat().st_size for path in rows["png_path"].to_pylist()]


def test_a_failed_rendering_ends_the_trajectory(tmp_path):
    with pytest.raises(OSError, match="no frame"):
        render(tmp_path, fails_at=3)
    assert len(list(tmp_path.rglob("*.png"))) == 3 and not committed(open_store(tmp_path))
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("develop")]


def test_a_failed_write_ends_the_trajectory(tmp_path):
    blocked = tmp_path / "frames/scene-0000/trajectory-0000/000002.png"
    blocked.mkdir(parents=True)
    with pytest.raises(OSError, match=r"000002\.png"):
        render(tmp_path)
    assert len([path for path in tmp_path.rglob("*.png") if path.is_file()]) == 2
    assert not committed(open_store(tmp_path))


def test_ctrl_c_between_frames_ends_the_trajectory(tmp_path):
    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render(tmp_path, advance=interrupt)
    assert not committed(open_store(tmp_path))
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("develop")]
