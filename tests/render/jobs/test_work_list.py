"""The order in which trajectories are handed out, and what happens to one that fails."""

import pytest
from tests.helpers.scenes import config_with

from perilune_render.config.dataset import KindConfig
from perilune_render.flight.plan import make_plan
from perilune_render.jobs.work_list import N_ATTEMPTS, WorkList


@pytest.fixture(scope="module")
def plan():
    kind = KindConfig(n_scenes=3, trajectories_per_scene=3, n_frames=2, split_by="scene")
    return make_plan(config_with(detect=kind), "detect")


def test_a_process_keeps_its_scene_and_changes_to_one_that_nobody_has_begun(plan):
    work = WorkList(plan, range(9))
    first, second = work.take(None), work.take(None)
    assert (first, second) == (0, 3)
    assert [work.take("scene-0000") for _ in range(3)] == [1, 2, 6]
    assert [work.take("scene-0001") for _ in range(2)] == [4, 5]
    assert [work.take("scene-0001") for _ in range(3)] == [7, 8, None]


def test_the_scene_that_the_fewest_processes_render_is_shared(plan):
    work = WorkList(plan, [0, 1, 2, 3, 4, 5])
    assert [work.take(scene) for scene in (None, None, "scene-0000")] == [0, 3, 1]
    assert work.take("scene-0002") == 4
    work.done(0)
    work.done(1)
    assert work.take("scene-0002") == 2


def test_a_failing_trajectory_is_tried_four_times_and_all_others_are_handed_out(plan):
    work, taken = WorkList(plan, [0, 1, 4]), []
    while (place := work.take(None)) is not None:
        taken.append(place)
        if place == 1:
            work.failed(place, f"attempt {taken.count(1)}")
        else:
            work.done(place)
    assert sorted(taken) == [0, *[1] * N_ATTEMPTS, 4] and N_ATTEMPTS == 4
    assert work.failures == {1: "attempt 4"} and work.n_waiting == 0


def test_only_what_is_left_is_handed_out(plan):
    assert WorkList(plan, []).take(None) is None
    work = WorkList(plan, [8])
    assert (work.take("scene-0000"), work.take("scene-0000")) == (8, None)
