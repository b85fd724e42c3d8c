"""Read the rows of a part that belong to a scene, trajectory or split; skip other row groups."""

from collections.abc import Sequence

import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.dataset.expression import Condition
from perilune_shared.dataset.names import is_whole
from perilune_shared.dataset.parts import Part
from perilune_shared.errors import UserError


def may_contain(stem: str, scene_id: str | None, trajectory_id: str | None) -> bool:
    """Whether a part with the name `stem` may contain rows of a scene, or of one of its trajectories."""
    scene, _, trajectory = stem.partition(".")
    if is_whole(stem) or scene_id is None:
        return True
    return scene == scene_id and (trajectory_id is None or trajectory in ("", trajectory_id))


def rows_of_part(
    part: Part,
    names: Sequence[str],
    scene_id: str | None,
    trajectory_id: str | None,
    split: str | None,
    where: Condition | None,
) -> pa.Table:
    """Read the columns `names` of the rows of a part that fulfil all given restrictions.

    The restrictions are scene, trajectory, split and the condition `where`; None means no restriction. Statistics show
    which row groups cannot contain such rows; these groups are not read.
    """
    columns = part.schema.names
    equal = {"scene_id": scene_id, "trajectory_id": trajectory_id, "split": split}
    equal = {name: value for name, value in equal.items() if value is not None and name in columns}
    # The table `labels` has no trajectory_id.
    by_frame = trajectory_id is not None and "trajectory_id" not in columns and "frame_id" in columns
    prefix = f"{scene_id}/{trajectory_id}/" if trajectory_id is not None else f"{scene_id}/"
    groups = None
    if is_whole(part.stem) and scene_id is not None:
        # In sorted order the frame ids "S/..." are in ["S/", "S0"), since "0" is the character after "/".
        if "frame_id" in columns:
            groups = part.groups_within("frame_id", prefix, prefix[:-1] + "0")
        else:
            groups = part.groups_within("scene_id", scene_id, scene_id + "\x00")
    needed = [*names, *equal, *(["frame_id"] if by_frame else [])]
    expression = None
    if split is not None and "split" in columns:
        chosen = set(part.groups_within("split", split, split + "\x00"))
        groups = [group for group in (range(part.n_groups) if groups is None else groups) if group in chosen]
    if where is not None:
        expression = where.within_table()
        needed += [name for _, name in sorted(where.columns)]
        possible = set(part.groups_where(expression))
        groups = [group for group in (range(part.n_groups) if groups is None else groups) if group in possible]
    rows = part.read(list(dict.fromkeys(needed)), groups)
    if expression is not None:
        try:
            rows = rows.filter(expression)
        except pa.ArrowException as error:
            raise UserError(part.address, "condition", error, "numbers within the range of their columns") from None
    for name, value in equal.items():
        rows = rows.filter(pc.equal(rows[name], value))
    if by_frame and (is_whole(part.stem) or part.stem == scene_id):
        rows = rows.filter(pc.starts_with(rows["frame_id"], prefix))
    return rows.select(list(names))
