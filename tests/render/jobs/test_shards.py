"""Shards rendered by processes of their own, in any order, the state that `status` prints, and the dry run."""

import json
import random
import re
import subprocess
import sys
from pathlib import Path

import pytest
from rich.progress import Progress
from tests.helpers import in_process

from perilune_render.cli.main import main
from perilune_render.jobs.estimate import estimate
from perilune_render.jobs.in_process import InProcess
from perilune_render.jobs.run import Shard

RENDER = str(Path(sys.executable).parent / "perilune-render")


def test_shards_share_out_every_trajectory_once():
    for n_trajectories, count in ((343, 64), (5, 8), (4, 1)):
        places = [place for k in range(count) for place in Shard(k + 1, count).indices(n_trajectories)]
        assert places == list(range(n_trajectories))


@pytest.mark.slow
def test_shards_in_random_order_and_at_the_same_time_give_the_same_bytes(options, whole, files_of, tmp_path):
    command, numbers = ["dataset", *options, "--out", str(tmp_path), "--workers", "0"], [1, 2, 3]
    random.shuffle(numbers)
    started = [
        subprocess.Popen([RENDER, *command, "--shard", f"{number}/3"], stderr=subprocess.PIPE, text=True)
        for number in numbers[:2]
    ]
    assert [(process.communicate()[1], process.returncode)[1] for process in started] == [0, 0]
    early = in_process.call(main, *command, "--finish")
    assert early.returncode == 2 and "trajectories not rendered, first scene-000" in early.stderr
    state = in_process.call(main, "status", tmp_path).stdout
    n_done = int(re.search(r"trajectories +(\d) of 4 done, 0 running, 0 failed", state)[1])
    assert n_done == 4 - len(Shard(numbers[2], 3).indices(4)) and f"{12 * n_done} of 48" in state
    assert in_process.call(main, *command, "--shard", f"{numbers[2]}/3").returncode == 0
    assert in_process.call(main, *command, "--finish").returncode == 0
    assert files_of(tmp_path / "detect") == whole
    assert "detect: complete" in in_process.call(main, "status", tmp_path).stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--shard", "4/3"], "--shard: got 4/3"),
        (["--shard", "0/3"], "--shard: got 0/3"),
        (["--shard", "1/3", "--finish"], "got --shard and --finish, expected one of them"),
        (["--finish"], "--finish: got no dataset"),
    ],
)
def test_faults_of_the_user_end_with_one_line(options, tmp_path, arguments, message):
    done = in_process.call(main, "dataset", *options, "--out", tmp_path, *arguments)
    assert done.returncode == 2 and message in done.stderr and not list(tmp_path.iterdir())


def test_the_state_shows_running_and_failed_trajectories(tmp_path):
    root = tmp_path / "detect"
    (root / "work/running").mkdir(parents=True)
    (root / "work/failed").mkdir()
    (root / "dataset.json").write_text(json.dumps({"complete": False, "counts": {}}))
    (root / "work/plan.json").write_text(json.dumps({"trajectories": 10, "frames": 7200}))
    now = 2e9  # later than any clock, so that the record stays fresh
    record = {"trajectory": "scene-0001/trajectory-0002", "frames": 50, "since": now - 100, "updated": now}
    (root / "work/running/a.json").write_text(json.dumps(record))
    (root / "work/running/b.json").write_text(json.dumps({**record, "since": 0, "updated": 1}))
    (root / "work/running/c.json").write_text("half a rec")
    failure = {"trajectory": "scene-0000/trajectory-0003", "error": "ValueError: x"}
    (root / "work/failed/f.json").write_text(json.dumps(failure))
    lines = in_process.call(main, "status", tmp_path).stdout.splitlines()
    assert "0 of 10 done, 1 running, 1 failed" in lines[1] and "0.5 frames/s, 4.00 hours left" in lines[3]
    assert lines[4].split() == ["running", "scene-0001/trajectory-0002"] and "1 processes" in lines[5]
    assert lines[6].split(maxsplit=1)[1] == "scene-0000/trajectory-0003: ValueError: x"
    nothing = in_process.call(main, "status", tmp_path / "elsewhere")
    assert nothing.returncode == 2 and "no such file" in nothing.stderr


def test_the_dry_run_knows_frames_and_bytes_and_writes_nothing(job, whole, tmp_path):
    found = estimate(job, tmp_path / "out", Progress(disable=True), InProcess, 0)
    assert found.n_frames == 48 and 0 < found.seconds < 600 and not list(tmp_path.iterdir())
    n_bytes = sum(len(content) for path, content in whole.items() if "/" in path)
    assert abs(found.n_bytes / n_bytes - 1) < 0.25
