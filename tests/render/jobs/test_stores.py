"""Datasets rendered into object stores: equal bytes after a stop at any write, one writer, faults in one line."""

import re
from dataclasses import replace

import pytest
from rich.progress import Progress
from tests.helpers import in_process
from tests.helpers.flat_engine import FlatEngine
from tests.helpers.scenes import config_with, flat_scene, round_craters

from perilune_render.cli.main import main
from perilune_render.config.dataset import CameraConfig, KindConfig
from perilune_render.dataset import tables
from perilune_render.dataset.trajectory import SceneSetting, render_trajectory
from perilune_render.dataset.work import write_scene
from perilune_render.engines.frame_source import FrameSource
from perilune_render.jobs.job import Job
from perilune_render.jobs.local import LocalWorkers
from perilune_render.jobs.run import Shard, finish_job, render_job, render_shard
from perilune_render.labels.frame_labels import RimCircles
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.storage.claims import claimed
from perilune_shared.storage.store import ObjectStore, open_store
from perilune_shared.validation.validate import validate

KIND = KindConfig(n_scenes=1, trajectories_per_scene=2, n_frames=2, split_by="scene")
QUIET = Progress(disable=True)


class Flat:
    """An executor whose engine computes pictures of flat ground with NumPy."""

    scene = flat_scene(3000, 41, round_craters([(10, 0, 60, 0.1)]))

    def __init__(self, job, out):
        self.job, self.out = job, out

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def check_scene(self, scene_id):
        pass

    def render(self, work, report):
        (plan,) = self.job.plan.scenes
        engine = FlatEngine("lommel_seeliger", self.job.plan.camera, plan.sun)
        source = FrameSource.of(engine, self.job.config, self.job.plan.camera, RimCircles.of_scene(self.scene))
        while (place := work.take(None)) is not None:
            rows = tables.scene_tables(plan, self.scene, self.job.config, self.job.info.recipe().key)
            trajectories = tables.trajectory_table(self.job.plan.of_scene(plan.scene_id))
            write_scene(self.out, plan.scene_id, {**rows, "trajectories": trajectories})
            config, trajectory = self.job.config, self.job.plan.trajectories[place]
            of_scene = SceneSetting(self.scene, config, config.nav.instruments)
            render_trajectory(self.out, source, trajectory, of_scene)
            work.done(place)
            report.done(place, [])


class Stopped(BaseException):
    """The process is killed."""


class StoppingStore(ObjectStore):
    """Is killed before its n-th change; nothing is written or deleted after that."""

    def __init__(self, address, n):
        super().__init__(address)
        self.n_left = n

    def _change(self):
        self.n_left -= 1
        if self.n_left < 0:
            raise Stopped

    def write(self, path, content, *, durable=True):
        self._change()
        super().write(path, content, durable=durable)

    def replace(self, path, content, *, durable=True):
        self._change()
        super().replace(path, content, durable=durable)

    def delete(self, path):
        self._change()
        super().delete(path)

    def delete_below(self, prefix):
        for item in [*self.list(prefix)]:
            self.delete(item.path)


@pytest.fixture(scope="module")
def flat_job():
    return Job.planned(config_with(camera=CameraConfig(width_px=64, height_px=64), detect=KIND), "detect", "tiny")


@pytest.fixture(scope="module")
def flat_whole(flat_job, tmp_path_factory):
    out = tmp_path_factory.mktemp("whole")
    assert validate(render_job(flat_job, out, QUIET, Flat)) == []
    return objects(out)


def objects(address):
    store = open_store(address)
    return {item.path: store.read(item.path) for item in store.list()}


@pytest.mark.slow
def test_stopped_before_any_write_and_resumed_gives_the_same_bytes(flat_job, flat_whole):
    n_stops = 0
    while True:
        address = f"memory://stopped-{n_stops}"
        try:
            render_job(flat_job, StoppingStore(address, n_stops), QUIET, Flat)
            break
        except Stopped:
            complete = open_store(address).exists("dataset.json") and open_dataset(address).info.complete
            assert not complete or objects(address).items() >= flat_whole.items()
        render_job(flat_job, address, QUIET, Flat)
        assert objects(address) == flat_whole, n_stops
        n_stops += 1
    assert n_stops > 30 and objects(address) == flat_whole


def test_shards_on_s3_give_the_same_bytes_and_the_state_is_seen_there(flat_job, flat_whole, s3_bucket):
    address = f"{s3_bucket}/moon/detect"
    for number in (2, 1):
        assert render_shard(flat_job, address, Shard(number, 2), QUIET, Flat) == 1
        state = in_process.call(main, "status", f"{s3_bucket}/moon").stdout
        assert re.search(rf"trajectories +{3 - number} of 2 done", state)
    refused = pytest.raises(UserError, match=r"moon/detect: --out: got written by PID 1 on host")
    with claimed_by_another(open_store(address)), refused:
        finish_job(flat_job, address)
    finish_job(flat_job, address)
    assert objects(address) == flat_whole and validate(open_dataset(address)) == []
    assert render_job(flat_job, address, QUIET, Flat).info.complete


class claimed_by_another:
    """A claim on a store by a process that runs."""

    def __init__(self, store):
        self.store = store

    def __enter__(self):
        with claimed(self.store, "work/claims"):
            (claim,) = [item.path for item in self.store.list("work/claims")]
            content = self.store.read(claim)
        self.store.replace(claim, re.sub(rb'"pid": \d+', b'"pid": 1', content))
        self.path = claim

    def __exit__(self, *_):
        self.store.delete(self.path)


def test_an_old_claim_does_not_count(flat_job, flat_whole):
    store = open_store("memory://claims")
    with claimed_by_another(store):
        (claim,) = [item.path for item in store.list("work/claims")]
        with pytest.raises(UserError, match="wait"):
            render_job(flat_job, store, QUIET, Flat)
        store.replace(claim, re.sub(rb'"updated": \d+', b'"updated": 1', store.read(claim)))
        render_job(flat_job, store, QUIET, Flat)
    assert objects(store) == flat_whole


def test_another_dataset_or_other_content_is_refused_and_left_alone(flat_job, tmp_path):
    recipe = flat_job.info.recipe()
    other = recipe.model_copy(update={"config": {**recipe.config, "seed": 77}})
    changed = replace(flat_job, info=flat_job.info.model_copy(update={"recipes": {other.key: other}}))
    address = "memory://others"
    render_job(flat_job, address, QUIET, Flat)
    before = objects(address)
    with pytest.raises(UserError, match="seed"):
        render_job(changed, address, QUIET, Flat)
    assert objects(address) == before
    open_store("memory://thesis").write("chapter-1.txt", b"mine")
    with pytest.raises(UserError, match="other content"):
        render_job(flat_job, "memory://thesis", QUIET, Flat)
    assert objects("memory://thesis") == {"chapter-1.txt": b"mine"}


def test_changed_rows_of_a_finished_trajectory_are_found(flat_job):
    store = open_store("memory://changed-rows")
    render_shard(flat_job, store, Shard(1, 1), QUIET, Flat)
    path = "work/labels/scene-0000.trajectory-0001.parquet"
    store.replace(path, store.read(path)[::-1])
    with pytest.raises(UserError, match=r"trajectory-0001\.parquet: SHA-256: .* delete work/index/scene-0000"):
        finish_job(flat_job, store)


@pytest.mark.parametrize(
    ("variables", "out", "message"),
    [
        ({}, "ftp://host/moon", "expected a path, s3://"),
        ({}, "s3://no-such-bucket-here/moon", "bucket: got no such bucket"),
        ({"AWS_ENDPOINT_URL": "http://127.0.0.1:9", "AWS_MAX_ATTEMPTS": "1"}, "s3://b/moon", "again to resume"),
    ],
)
def test_faults_of_a_store_end_with_one_line(variables, out, message, options, s3_environment, monkeypatch):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    done = in_process.call(main, "dataset", *options, "--workers", "0", "--out", out)
    lines = [line for line in done.stderr.splitlines() if line.startswith("error")]
    assert done.returncode == 2 and len(lines) == 1 and out in lines[0] and message in lines[0], done.stderr


@pytest.mark.usefixtures("no_credentials")
def test_missing_credentials_end_with_one_line(s3_bucket, options):
    done = in_process.call(main, "dataset", *options, "--workers", "0", "--out", f"{s3_bucket}/moon")
    lines = [line for line in done.stderr.splitlines() if line.startswith("error")]
    assert done.returncode == 2 and len(lines) == 1 and f"{s3_bucket}/moon" in lines[0]
    assert "expected credentials with access to it: AWS_ACCESS_KEY_ID" in lines[0]


@pytest.mark.slow
def test_two_workers_on_s3_give_the_same_bytes_as_a_folder(options, whole, s3_bucket):
    done = in_process.call(main, "dataset", *options, "--workers", "2", "--out", f"{s3_bucket}/moon")
    assert done.returncode == 0, done.stderr
    assert objects(f"{s3_bucket}/moon/detect") == whole
    again = in_process.call(main, "dataset", *options, "--out", f"{s3_bucket}/moon", "--dry-run")
    assert again.stdout.startswith(f"{s3_bucket}/moon/detect: 0 frames left"), again.stderr


def test_workers_cannot_share_the_memory_of_a_process(job):
    with pytest.raises(UserError, match="--workers 0"):
        LocalWorkers(job, open_store("memory://moon"), 2)
