"""Datasets of perilune_shared, with the frames of a split for PyTorch."""

from typing import TYPE_CHECKING

from perilune.parts import part
from perilune_shared.dataset import manifest
from perilune_shared.storage.store import Address

if TYPE_CHECKING:
    from perilune_train.data.labelled_frames import LabelledFrames


class Dataset(manifest.Dataset):
    """A dataset, open for reading: tables as pandas and Arrow, frames by number, id or slice, and for PyTorch.

    dataset = perilune.open_dataset("data/small/detect")
    dataset[0].image, dataset[:10], dataset.labels["radius_px"]
    """

    def torch(self, split: str = "train", selection: str = "visible") -> "LabelledFrames":
        """Return the frames of a split with their labels, in memory, as a Dataset of PyTorch with `collate`.

        `split` is train, val or test; `selection` is all, paper or visible. Raises UserError on other names, and if the
        frames do not fit into memory; MissingPart without the extra `train`.

            frames = dataset.torch(split="train")
            DataLoader(frames, batch_size=8, collate_fn=frames.collate)
        """
        return part("perilune_train.data.labelled_frames", "torch").LabelledFrames(self, split, selection)


def open_dataset(address: Address) -> Dataset:
    """Open a dataset in a local folder or at an address such as s3://bucket/moon.

    Raises UserError if it is missing, damaged or of another schema version.

        dataset = perilune.open_dataset("data/small/detect")
    """
    opened = manifest.open_dataset(address)
    return Dataset(opened.store, opened.info)
