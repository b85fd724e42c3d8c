"""Parts of a trajectory's labels and frames. The part of `frames` comes last and marks the trajectory as finished."""

from pathlib import Path

import pyarrow as pa

from perilune_shared.dataset.label_rows import with_frame_columns
from perilune_shared.dataset.parts import write_part
from perilune_shared.storage import files


def is_finished(root: Path, scene_id: str, trajectory_id: str) -> bool:
    """Whether a trajectory's files, labels and frames are all written."""
    return _path(root, "frames", f"{scene_id}.{trajectory_id}").exists()


def finished_names(root: Path) -> set[tuple[str, str]]:
    """Scene ids and trajectory ids of all finished trajectories."""
    parts = (path.stem.partition(".") for path in root.joinpath("manifest", "frames").glob("[A-Za-z0-9]*.parquet"))
    return {(scene_id, trajectory_id) for scene_id, _, trajectory_id in parts}


def finish_trajectory(root: Path, scene_id: str, trajectory_id: str, labels: list[pa.Table], frames: pa.Table) -> None:
    """Write the parts of a trajectory whose files are written; waits until these are on the disk.

    `labels` holds the labels of each frame, `frames` the rows of all frames.
    """
    name = f"{scene_id}.{trajectory_id}"
    # A run interrupted between the two leaves a labels part without its frames part.
    _path(root, "labels", name).unlink(missing_ok=True)
    write_part(root, "labels", name, with_frame_columns(pa.concat_tables(labels), frames))
    paths = (path for kind in ("png_path", "exr_path") for path in frames[kind].to_pylist() if path is not None)
    files.sync_all(root / path for path in paths)
    write_part(root, "frames", name, frames)


def _path(root: Path, table: str, name: str) -> Path:
    return root / "manifest" / table / f"{name}.parquet"
