"""Columns of labels that repeat columns of frames, so that labels can be used without frames."""

import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.dataset.schema import TABLES
from perilune_shared.errors import UserError


def with_frame_columns(labels: pa.Table, frames: pa.Table) -> pa.Table:
    """Return labels with the scene_id and split of their frames. Replaces both columns if they exist.

    `frames` has at least frame_id, scene_id and split. Raises UserError if a label's frame is missing.
    """
    index = pc.index_in(labels["frame_id"], frames["frame_id"].combine_chunks())
    if index.null_count:
        missing = labels["frame_id"].filter(pc.is_null(index))[0].as_py()
        raise UserError("labels", "frame_id", missing, "a row of frames; see `perilune-manifest validate`")
    for name in ("scene_id", "split"):
        if name in labels.column_names:
            labels = labels.drop_columns([name])
        labels = labels.append_column(TABLES["labels"].field(name), frames[name].take(index))
    return labels
