"""Runs on frames that a server renders: a lost server, resuming, the record of the terrain, two processes."""

from pathlib import Path

import pytest
import torch
from tests.helpers import forked, in_process
from tests.helpers.served import Served

from perilune_shared.config.resolve import resolve
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_train.cli.main import main
from perilune_train.data.epochs import DataLost
from perilune_train.detect.config import DetectConfig, FreshConfig
from perilune_train.detect.train.detect_run import run_detect
from perilune_train.detect.train.task import DetectTask
from perilune_train.records.provenance import check_terrain, read_provenance

QUICK = (
    "detect.epochs=2",
    "detect.width=0.125",
    "detect.precision=float32",
    "detect.device=cpu",
    "detect.batch_size=2",
)
N_BATCHES = 12


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    server = Served(tmp_path_factory.mktemp("server"))
    yield server
    server.stop()


def settings(address, *more, **changes):
    fresh = {"address": address, "n_scenes": 3, "frames_per_scene": 10, "timeout_s": 20.0} | changes
    config = resolve(DetectConfig, "detect", "perilune_train", "tiny", None, (*QUICK, *more))
    return config.model_copy(update={"fresh": FreshConfig(**fresh)})


def discard_until_error(results):
    """Discard the frames rendered ahead until the error that ends them; put the error back."""
    while not isinstance(found := results.get(timeout=60), BaseException):
        pass
    results.put(found)


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_a_lost_server_ends_with_a_saved_state_that_resumes_to_the_same_weights(
    served, dataset_detect, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("perilune_train.detect.train.detect_run.evaluate", lambda *_: {})
    whole = run_detect(settings(served.address), dataset_detect, tmp_path, "whole")
    lost = Served(tmp_path)
    step, taken = DetectTask.training_step, []

    def stops(self, batch, batch_idx):
        taken.append((self.current_epoch, batch_idx))
        if taken[-1] == (1, 2):
            lost.stop()
            discard_until_error(self.train_split._ahead._results)
        return step(self, batch, batch_idx)

    monkeypatch.setattr(DetectTask, "training_step", stops)
    with pytest.raises(DataLost, match=r"got none in 5 s, expected .*run the same command again to resume") as error:
        run_detect(settings(lost.address, timeout_s=5.0), dataset_detect, tmp_path, "lost")
    assert "\n" not in str(error.value)
    saved = torch.load(tmp_path / "detect/lost/checkpoints/last.ckpt", weights_only=True)
    assert saved["epoch_and_batches"] == [1, len(taken) - N_BATCHES]
    begun = len(taken)
    # The address may change, the share may not.
    with pytest.raises(UserError, match=r"detect\.fresh\.share: got 0\.5, expected 1\.0"):
        run_detect(settings(served.address, share=0.5), dataset_detect, tmp_path, "lost")
    resumed = run_detect(settings(served.address), dataset_detect, tmp_path, "lost")
    assert taken[begun] == (1, begun - N_BATCHES)
    assert "resuming" in capsys.readouterr().err
    first, again = (torch.load(run.last, weights_only=True)["state_dict"] for run in (whole, resumed))
    assert first.keys() == again.keys() and all(torch.equal(first[key], again[key]) for key in first)
    # Six visits of ten frames: two epochs of 24 frames show the scenes 1, 2, 3, 1, 2.
    for run in (whole, resumed):
        record = read_provenance(torch.load(run.best, weights_only=True), run.best)
        rendered = {(use.scene_id, use.use) for use in record.uses if use.dataset == "fresh (served)"}
        assert rendered == {(f"scene-{number:04d}", "trained") for number in (1, 2, 3)}
        assert check_terrain(record, open_dataset(dataset_detect)).status == "disjoint"


def test_the_option_sets_the_address_and_a_missing_server_leaves_no_run(dataset_detect, tmp_path):
    own = ("--preset", "tiny", "--dataset", dataset_detect, "--out", tmp_path, "--set", "detect.fresh.timeout_s=0.3")
    done = in_process.call(main, "detect", "train", *own, "--stream-scenes", "tcp://127.0.0.1:9")
    assert done.returncode == 2
    assert "tcp://127.0.0.1:9: reply: got none in 0.3 s, expected `perilune-render serve`" in done.stderr
    assert "Traceback" not in done.stderr and not (tmp_path / "detect").exists()
    done = in_process.call(main, "detect", "train", *own, "--stream-scenes", "")
    assert done.returncode == 2 and "detect.fresh.address" in done.stderr


@pytest.mark.slow
def test_two_processes_render_their_shares_and_record_all_terrain(served, dataset_detect, tmp_path):
    script, log = Path(__file__).with_name("two_fresh_processes.py"), tmp_path / "log"
    # With two frames of each scene, a process uses scenes that the other one does not.
    config = settings(served.address, n_scenes=4, frames_per_scene=1)
    done = forked.run(script, log, str(dataset_detect), str(tmp_path), config.model_dump_json(), timeout_s=500)
    assert done.returncode == 0, done.stderr
    first, second = (torch.load(tmp_path / f"{process}.pt", weights_only=True) for process in (0, 1))
    assert sorted(first["rendered"] + second["rendered"]) == [(e, position) for e in range(2) for position in range(24)]
    weights = [key for key in first["state"] if key.startswith("network.") and "running" not in key]
    assert len(weights) > 50 and all(torch.equal(first["state"][key], second["state"][key]) for key in weights)
    best = tmp_path / "detect/two/checkpoints/best.ckpt"
    record = read_provenance(torch.load(best, weights_only=True), best)
    assert len({use.scene_id for use in record.uses if use.dataset == "fresh (served)"}) == 4
    assert first["scenes"] == second["scenes"] == [1, 2, 3, 4]
