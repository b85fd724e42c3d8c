"""Refuse datasets whose cameras have a lens model, which navigators and the landing filter cannot use."""

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError


def check_pinhole(dataset: Dataset) -> None:
    """Raise UserError if the dataset's camera has a lens model, such as a fisheye."""
    model = dataset.info.camera.model
    if model != "pinhole":
        expected = "pinhole, with or without distortion: navigators, maps and the landing filter use no lens models"
        raise UserError(dataset.store.at("dataset.json"), "camera.model", model, expected)
