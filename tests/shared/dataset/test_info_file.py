"""dataset.json, as users address it."""

import pytest

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError


def test_the_datasets_of_a_folder_are_named(tmp_path):
    """`perilune-render dataset` writes detect and nav into one folder, which is itself no dataset."""
    for kind in ("detect", "nav"):
        (tmp_path / kind).mkdir()
        (tmp_path / kind / "dataset.json").write_text("{}")
    with pytest.raises(UserError) as caught:
        open_dataset(tmp_path)
    assert str(caught.value).endswith(f"expected {tmp_path / 'detect'} or {tmp_path / 'nav'}")
