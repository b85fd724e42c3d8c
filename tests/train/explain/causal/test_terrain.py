import shutil

import pandas as pd
import pytest
import torch
from tests.helpers.stored_run import store_run
from tests.helpers.terrain_record import store_record, uses_of

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_train.explain.causal.causal_run import CausalInputs, PoseInputs, causal_run
from perilune_train.explain.config import ExplainConfig
from perilune_train.models.navigator import StackNavigator
from perilune_train.records.provenance import training_provenance
from perilune_train.training.runs import NamedRun, save_weights

_STACK = {
    "fusion": "stack",
    "size_px": 64,
    "in_channels": 1,
    "width": 0.125,
    "attention": "cbam_centred",
    "hidden": 8,
    "focal_over_width": 1.4,
    "scales": {"mean_m": [0.0] * 3, "spread_m": [1.0] * 3, "rotation_rad": 0.01},
}


def test_a_navigator_that_was_fitted_to_the_test_terrain_is_refused(dataset_detect, dataset_nav, tmp_path):
    torch.manual_seed(0)
    stack = tmp_path / "stack.ckpt"
    save_weights(stack, _STACK, StackNavigator(1, 0.125, "cbam_centred", 8))
    detector = store_run(tmp_path, "attention=cbam") / "checkpoints" / "best.ckpt"
    store_record(detector, training_provenance(open_dataset(dataset_detect)).uses)
    store_record(stack, uses_of(dataset_nav, "test"))
    without = tmp_path / "without"
    shutil.copytree(dataset_detect, without)
    removed = pd.DataFrame({"scene_id": ["s000"], "crater_id": [0], "depth_ratio": [0.1]})
    removed.to_parquet(tmp_path / "without.removed.parquet")
    runs = tmp_path / "runs"
    with pytest.raises(UserError, match=r"s000 = elsewhere/s000"):
        inputs = CausalInputs(dataset_detect, str(without), pose=PoseInputs(dataset_nav, dataset_nav, stack))
        causal_run(ExplainConfig(device="cpu"), NamedRun(runs, "t"), detector, "B_11", inputs)
    assert not runs.exists()
