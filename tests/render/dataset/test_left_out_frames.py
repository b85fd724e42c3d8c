"""Manifests whose table `frames` was left out: the frames come back, and nothing is rendered without them."""

import shutil

import pytest
from tests.helpers import in_process
from tests.helpers.rendered import QUICK

from perilune_render.cli.main import main
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.metadata import NOT_STATED
from perilune_shared.editing.diff import differences
from perilune_shared.validation.validate import validate


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    out = tmp_path_factory.mktemp("plan") / "plan"
    made = in_process.call(main, "plan", "--preset", "tiny", *QUICK, "--out", out)
    assert made.returncode == 0, made.stderr
    return out


@pytest.fixture
def without_frames(plan, tmp_path):
    copy = tmp_path / "manifest"
    shutil.copytree(plan, copy)
    shutil.rmtree(copy / "manifest/frames")
    return copy


def test_the_frames_come_back(plan, without_frames, tmp_path):
    done = in_process.call(main, "plan", "--manifest", without_frames, "--out", tmp_path / "again")
    assert done.returncode == 0, done.stderr
    made = open_dataset(tmp_path / "again")
    assert validate(made) == [] and list(differences(open_dataset(plan), made)) == []
    assert (tmp_path / "again/dataset.json").read_bytes() == (plan / "dataset.json").read_bytes()


def test_what_a_user_plans_has_no_licence(plan):
    assert open_dataset(plan).info.licence == NOT_STATED


def test_nothing_is_rendered_without_them(without_frames, tmp_path):
    done = in_process.call(main, "dataset", "--manifest", without_frames, "--out", tmp_path / "out")
    assert done.returncode == 2 and "perilune-render plan --manifest" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1 and not (tmp_path / "out").exists()


@pytest.mark.parametrize("options", [("--preset", "tiny"), ("--height-unit", "km"), ("--set", "dataset.seed=3")])
def test_other_options_are_refused_beside_a_manifest(without_frames, tmp_path, options):
    done = in_process.call(main, "plan", "--manifest", without_frames, *options, "--out", tmp_path / "out")
    assert done.returncode == 2 and f"got {options[0]}, expected --out alone" in done.stderr


def test_a_whole_manifest_is_refused(plan, tmp_path):
    done = in_process.call(main, "plan", "--manifest", plan, "--out", tmp_path / "out")
    assert done.returncode == 2 and "expected a manifest whose table `frames` was left out" in done.stderr


def test_trajectories_of_another_plan_are_refused(without_frames, tmp_path):
    other = "--set", "dataset.seed=5"
    made = in_process.call(main, "plan", "--preset", "tiny", *QUICK, *other, "--out", tmp_path / "other")
    assert made.returncode == 0, made.stderr
    shutil.copytree(
        tmp_path / "other/manifest/trajectories", without_frames / "manifest/trajectories", dirs_exist_ok=True
    )
    done = in_process.call(main, "plan", "--manifest", without_frames, "--out", tmp_path / "out")
    assert done.returncode == 2 and "got seeds of another plan" in done.stderr
    assert not (tmp_path / "out").exists()
