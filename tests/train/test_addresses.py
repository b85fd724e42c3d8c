"""Every command of the trainer reads datasets from an object store, a real server on this machine."""

import os

import pandas as pd
import pytest
import torch
from tests.helpers import in_process
from tests.helpers.faulty_proxy import FaultyProxy
from tests.helpers.s3_server import uploaded
from tests.helpers.stored_run import store_run
from tests.helpers.terrain_record import store_record

from perilune_shared.config.resolve import resolve
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing import pack as packing
from perilune_shared.editing.pack import pack
from perilune_shared.errors import UserError
from perilune_train.cli.main import main
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.train.detect_run import run_detect
from perilune_train.detect.train.task import DetectTask
from perilune_train.explain.config import ExplainConfig
from perilune_train.explain.explain_run import NetworkOnData, explain_run
from perilune_train.models.navigator import StackNavigator
from perilune_train.records.provenance import training_provenance
from perilune_train.training.runs import NamedRun, save_weights

_STACK = {
    "fusion": "stack",
    "size_px": 32,
    "in_channels": 1,
    "width": 0.125,
    "attention": "cbam",
    "hidden": 8,
    "focal_over_width": 1.4,
    "scales": {"mean_m": [0.0] * 3, "spread_m": [1.0] * 3, "rotation_rad": 0.01},
}
_NAVIGATE = ("fusion=warp", "device=cpu", "precision=float32", "warp.size_px=32", "warp.width=0.125", "warp.hidden=8")
COMMANDS = {
    "train": "detect train --preset tiny --name a --out {out} --dataset {address}/detect",
    "evaluate": "detect evaluate --run {run} --dataset {address}/detect",
    "export": "detect deploy --run {run} --out {out} --dataset {address}/detect",
    "navigate": "navigate train --preset tiny --name a --out {out} --dataset {address}/nav",
    "explain": "explain --name a --out {out} --detector {run}/checkpoints/best.ckpt --navigator {stack} "
    "--dataset {address}",
}


@pytest.fixture(scope="module")
def networks(few, dataset_nav, tmp_path_factory):
    """The run of a detector and the weights of a navigator, not trained."""
    folder = tmp_path_factory.mktemp("networks")
    run = store_run(folder, "attention=cbam")
    store_record(run / "checkpoints" / "best.ckpt", training_provenance(open_dataset(few)).uses)
    save_weights(folder / "stack.ckpt", _STACK, StackNavigator(1, 0.125, "cbam", 8))
    store_record(folder / "stack.ckpt", training_provenance(open_dataset(dataset_nav)).uses)
    return run, folder / "stack.ckpt"


@pytest.fixture
def bucket(few, dataset_nav, s3_bucket):
    """An address with a dataset `detect` and a dataset `nav`."""
    uploaded(few, f"{s3_bucket}/detect")
    uploaded(dataset_nav, f"{s3_bucket}/nav")
    return s3_bucket


@pytest.mark.usefixtures("no_pictures")
def test_a_detector_is_evaluated_on_a_dataset_at_an_address(networks, few, bucket, tmp_path):
    found = []
    for name, address in (("local", few), ("remote", f"{bucket}/detect")):
        done = in_process.call(
            main, "detect", "evaluate", "--run", networks[0], "--dataset", address, "--out", tmp_path / name
        )
        assert done.returncode == 0, done.stderr
        found.append(pd.read_parquet(tmp_path / name / "detections.parquet"))
    assert len(found[0]) > 0 and found[0].equals(found[1])


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_a_navigator_is_trained_on_a_dataset_at_an_address(bucket, tmp_path):
    epochs = ("warp.coarse_epochs=0", "warp.fine_epochs=1", "warp.sequence_pairs=4")
    settings = [part for value in (*_NAVIGATE, *epochs) for part in ("--set", f"navigate.{value}")]
    given = ("navigate", "train", "--preset", "tiny", "--name", "a", "--out", tmp_path, "--dataset", f"{bucket}/nav")
    done = in_process.call(main, *given, *settings)
    assert done.returncode == 0, done.stderr
    assert len(pd.read_parquet(tmp_path / "navigate" / "a" / "navigation.parquet")) == 8
    inputs = (tmp_path / "navigate" / "a" / "inputs.json").read_text()
    assert "null" not in inputs


@pytest.mark.slow
def test_masks_are_explained_on_datasets_at_an_address(networks, bucket, few, dataset_nav, tmp_path):
    few_images = {
        "n_frames": 2,
        "n_pairs": 2,
        "n_validation": 2,
        "n_changed": 2,
        "n_changed_pairs": 2,
        "n_attributed": 1,
    }
    settings = ExplainConfig(**few_images, n_drawn=1, integration_steps=1, occlusion_px=48, device="cpu")
    checkpoint = networks[0] / "checkpoints"
    found = []
    for name, data in (("local", (few, dataset_nav)), ("remote", (f"{bucket}/detect", f"{bucket}/nav"))):
        given = (checkpoint / "best.ckpt", data[0]), (networks[1], data[1])
        run = explain_run(settings, NamedRun(tmp_path, name), *(NetworkOnData(*network) for network in given))
        found.append(pd.read_parquet(run.root / "summary.parquet"))
    assert len(found[0]) > 0 and found[0].equals(found[1])


@pytest.mark.parametrize("command", COMMANDS)
def test_an_address_without_a_dataset_is_refused_in_one_line(command, networks, s3_bucket, tmp_path):
    run, stack = networks
    out = tmp_path / "out"
    for address, message in (
        (s3_bucket, r"dataset.json: got no such file, expected the folder or address of a dataset"),
        ("s3://no-such-bucket", "bucket: got no such bucket, expected the name of an existing bucket"),
        ("http://host", "address: got http://, expected a path, s3://bucket/prefix"),
    ):
        given = COMMANDS[command].format(run=run, stack=stack, out=out, address=address)
        done = in_process.call(main, *given.split())
        *before, last = done.stderr.splitlines()
        assert done.returncode == 2 and last.startswith("error: ") and address in last and message in last
        assert len(before) <= 1 and "Traceback" not in done.stderr
        assert not out.exists() or not list(out.rglob("*"))


@pytest.mark.usefixtures("no_credentials")
def test_missing_credentials_are_refused_in_one_line(s3_bucket, networks):
    done = in_process.call(main, "detect", "evaluate", "--run", networks[0], "--dataset", f"{s3_bucket}/detect")
    assert done.returncode == 2 and "expected credentials with access to it: AWS_ACCESS_KEY_ID" in done.stderr
    assert done.stderr.strip().count("\n") == 0


@pytest.mark.usefixtures("no_pictures")
def test_a_run_whose_store_vanishes_ends_in_one_line_and_is_resumed(few, s3_bucket, tmp_path, monkeypatch):
    monkeypatch.setattr("perilune_train.detect.train.detect_run.evaluate", lambda *_: {})
    # The libraries' retries would take more than a minute.
    monkeypatch.setattr("s3fs.S3FileSystem.retries", 1)
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    monkeypatch.setattr(packing, "_FRAMES_PER_GROUP", 2)
    pack(open_dataset(few), tmp_path / "packed")
    address = uploaded(tmp_path / "packed", f"{s3_bucket}/packed")
    # A worker process would inherit the proxy's socket, and the store would answer late instead of vanishing.
    stated = ("epochs=2", "width=0.125", "precision=float32", "device=cpu", "stream=true", "batch_size=2")
    stated = (*stated, "workers=0", "checkpoint_minutes=0")
    config = resolve(DetectConfig, "detect", "perilune_train", "tiny", None, tuple(f"detect.{one}" for one in stated))
    whole = run_detect(config, tmp_path / "packed", tmp_path, "whole")
    original, seen = DetectTask.training_step, []

    def watched(self, batch, batch_idx):
        seen.append((self.current_epoch, batch_idx))
        if seen == [(0, 0), (0, 1)]:
            proxy.vanish()
        return original(self, batch, batch_idx)

    with FaultyProxy(os.environ["AWS_ENDPOINT_URL"], seed=1, fault_share=0, late_share=0) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.address)
        monkeypatch.setattr(DetectTask, "training_step", watched)
        with pytest.raises(UserError, match=rf"{address}.*: connection: got .*; run the same command again to resume"):
            run_detect(config, address, tmp_path, "a")
        # The next batch needs the craters of another scene.
        assert seen == [(0, 0), (0, 1)]
        proxy.come_back()
        run = run_detect(config, address, tmp_path, "a")
    assert seen == [(epoch, batch) for epoch in (0, 1) for batch in range(3)]
    first, again = (torch.load(each.last, weights_only=True)["state_dict"] for each in (whole, run))
    assert first.keys() == again.keys() and all(torch.equal(first[key], again[key]) for key in first)
