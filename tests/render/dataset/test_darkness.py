"""Every command that renders warns of frames that almost no sunlight reaches."""

import re

import pytest
from tests.helpers import in_process

from perilune_render.cli.main import main
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.labels.selection import read_labels, selected
from perilune_shared.labels.thresholds import SELECTIONS

DARK = [
    "--preset=tiny",
    "--kind=detect",
    "--set=dataset.camera.width_px=32",
    "--set=dataset.camera.height_px=32",
    "--set=dataset.render.exr=false",
    "--set=dataset.render.engine=heightfield",
    "--set=dataset.terrain.spacing_px=2.0",
    "--set=dataset.detect.sun.elevation_deg=0.05",
    "--set=dataset.detect.n_scenes=1",
    "--set=dataset.detect.n_frames=2",
]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """The finished command and the folder of a dataset under a Sun that hardly rises."""
    out = tmp_path_factory.mktemp("dark")
    done = in_process.call(main, "dataset", "--workers", 0, *DARK, "--out", out)
    assert done.returncode == 0, done.stderr
    return done, out / "detect"


def warning(done, n_frames):
    """Count and first frame of the one warning of dark frames that a command printed."""
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("warning") and " dark (" in line]
    pattern = r"warning: scene-0000: (\d) of (\d) frames are dark \(less than 1% .* first (\S+); the Sun is 0\.1 .*"
    n_dark, n, first = re.fullmatch(pattern, line).groups()
    assert int(n) == n_frames
    return n_dark, first


def test_a_dataset_warns_and_shows_no_crater_in_dark_frames(rendered):
    done, folder = rendered
    count, frame_id = warning(done, 2)
    labels = read_labels(open_dataset(folder))
    labels = labels[(labels["frame_id"] == frame_id) | (count == "2")]
    assert len(labels) and not selected(labels, SELECTIONS["visible"]).any()


def test_regenerate_warns_as_the_dataset_did(rendered):
    done, folder = rendered
    again = in_process.call(main, "regenerate", "--manifest", folder, "--verify", "--sample", 2)
    assert again.returncode == 0 and "2 identical" in again.stdout
    assert warning(again, 2) == warning(done, 2)


def test_preview_warns(rendered, tmp_path):
    done, _ = rendered
    seen = in_process.call(main, "preview", *DARK, "--out", tmp_path / "p.png")
    assert seen.returncode == 0 and (tmp_path / "p.png").exists()
    assert warning(seen, 2) == warning(done, 2)
