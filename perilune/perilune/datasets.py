"""Open datasets, and load the frames of a split for PyTorch."""

from typing import TYPE_CHECKING

from perilune.parts import part
from perilune_shared.dataset import manifest
from perilune_shared.storage.store import Address

if TYPE_CHECKING:
    from perilune_train.data.labelled_frames import LabelledFrames


class Dataset(manifest.Dataset):
    """An open dataset: tables as pandas or Arrow; frames by number, id or slice, or as a PyTorch dataset.

    dataset = perilune.open_dataset("data/small/detect")
    dataset[0].image, dataset[:10], dataset.labels["radius_px"]
    """

    def torch(self, split: str = "train", selection: str = "visible") -> "LabelledFrames":
        """Load the frames and labels of a split into memory, and return them as a PyTorch Dataset.

        `split` is train, val or test; `selection` is all, paper or visible. Pass the method `collate` of the result to
        a DataLoader. Raises UserError if the split or the selection is unknown, or if the frames do not fit into
        memory. Raises MissingPart if the extra `train` is not installed.

            frames = dataset.torch(split="train")
            DataLoader(frames, batch_size=8, collate_fn=frames.collate)
        """
        return part("perilune_train.data.labelled_frames", "torch").LabelledFrames(self, split, selection)


def open_dataset(address: Address) -> Dataset:
    """Open a dataset in a local folder or at an address such as s3://bucket/moon.

    Raises UserError if the dataset is missing or damaged, or if it has another schema version.

        dataset = perilune.open_dataset("data/small/detect")
    """
    opened = manifest.open_dataset(address)
    return Dataset(opened.store, opened.info)
