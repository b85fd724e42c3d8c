"""`make bench-same-bytes`: hashes of stages, and the list of those that differ."""

import numpy as np

from benchmarks.dataset import same_bytes


def test_operations_have_one_hash_in_one_process() -> None:
    first, second = same_bytes.operations(), same_bytes.operations()
    assert list(first) == list(second) and len(first) > 20
    assert [same_bytes.hash_of(values) for values in first.values()] == list(map(same_bytes.hash_of, second.values()))
    assert same_bytes.differences(first, second) == []
    assert len(set(map(same_bytes.hash_of, first.values()))) == len(first)


def test_the_first_stage_that_differs_comes_first() -> None:
    values = np.array([1.0, np.inf, 3.0], np.float32)
    changed = values.copy()
    changed[2] = np.nextafter(changed[2], np.float32(4))
    own = {"same": values, "rounded": values, "gone": values, "flag": np.array([True]), "wider": values}
    other = {"same": values, "rounded": changed, "flag": np.array([False]), "wider": values.astype(float)}
    lines = same_bytes.differences(own, other)
    assert [line.partition(":")[0] for line in lines] == ["rounded", "gone", "flag", "wider"]
    assert "1 of 3 values by at most 2.38e-07 (largest value 3)" in lines[0]


def test_a_hash_covers_type_and_shape() -> None:
    values = np.zeros((2, 3), np.float32)
    others = [values.reshape(3, 2), values.view(np.int32), values + np.float32(1e-30)]
    assert len({same_bytes.hash_of(each) for each in (values, *others)}) == 4


def test_arrays_of_nested_records() -> None:
    from perilune_render.imaging.radiance import Radiance

    names = [name for name, _ in same_bytes.arrays("frame", Radiance.empty((2, 2)))]
    assert names == ["frame radiance_factor", "frame depth_m", "frame normal", "frame sunlit"]
