"""The finished trajectories of a dataset in progress, below work/.

    work/<table>/<scene>.parquet               scenes, craters, boulders, trajectories: the rows of a scene
    work/<table>/<scene>.<trajectory>.parquet  frames, labels, inertial, ranges: the rows of a trajectory
    work/index/<scene>.<trajectory>.parquet    commit of a trajectory: its files and rows, with sizes and hashes

The commit is written last: a trajectory is finished once its commit exists. A trajectory without a commit is written
again from its start, since a killed run may have left any part of it. `finish` merges these files into the tables of
the dataset.
"""

import hashlib
from collections.abc import Mapping

import pyarrow as pa
import pyarrow.parquet as pq

from perilune_shared.dataset.index import INDEX, frame_rows, index_rows
from perilune_shared.dataset.label_rows import with_frame_columns
from perilune_shared.dataset.names import stem_of
from perilune_shared.dataset.parts import Part, WrittenFile
from perilune_shared.dataset.schema import OPTIONAL_TABLES, TABLES, stored
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Store

FOLDER = "work"
OF_SCENE = ("scenes", "craters", "boulders", "trajectories")
"""Tables with a file for each scene."""
OF_TRAJECTORY = ("frames", "labels", *OPTIONAL_TABLES)
"""Tables with a file for each trajectory; optional tables have a file only if they have rows."""


def committed(store: Store) -> set[str]:
    """Names of all finished trajectories, such as scene-0000.trajectory-0000."""
    listed = (item.path for item in store.list(f"{FOLDER}/index"))
    return {stem_of(path) for path in listed if path.endswith(".parquet") and not stem_of(path).startswith(".")}


def commit(store: Store, labels: list[pa.Table], frames: pa.Table, measurements: Mapping[str, pa.Table]) -> None:
    """Write the table rows of a trajectory, then its commit. The files of its frames must exist already.

    `labels` holds one table of labels for each frame, `frames` the rows of all frames, `measurements` the rows of the
    optional tables `inertial` and `ranges`.
    """
    name = ".".join(frames[key][0].as_py() for key in ("scene_id", "trajectory_id"))
    tables = {"frames": frames, "labels": with_frame_columns(pa.concat_tables(labels), frames), **measurements}
    rows = index_rows(_write(store, table, name, tables[table]) for table in OF_TRAJECTORY if table in tables)
    files = frame_rows(frames)
    store.sync([*files["path"].to_pylist(), *rows["path"].to_pylist()])
    store.replace(_path("index", name), _parquet(pa.concat_tables([rows, files])))


def write_scene(store: Store, scene_id: str, tables: Mapping[str, pa.Table]) -> None:
    """Write the rows of a scene unless they exist; the table `scenes` is written last.

    Raises UserError if the existing rows of this scene have different craters or boulders.
    """
    path = _path("scenes", scene_id)
    if store.exists(path):
        # Compare by content hash, since craters computed on another processor may differ in the last digits.
        recorded, computed = (
            rows["content_sha256"].to_pylist() for rows in (Part(store, path, "scenes").read(), tables["scenes"])
        )
        if recorded != computed:
            expected = "the elevation model and catalogue that the dataset was started with"
            raise UserError(store.at(path), "craters", "other craters or boulders", expected)
        return
    # A row in `scenes` says that a scene is complete, so the other tables must be on disk first.
    store.sync([_write(store, table, scene_id, tables[table]).path for table in OF_SCENE[1:]])
    store.sync([_write(store, OF_SCENE[0], scene_id, tables[OF_SCENE[0]]).path])


def scene_rows(store: Store, scene_id: str) -> dict[str, pa.Table]:
    """The rows of a scene. Raises UserError if they cannot be read."""
    return {table: Part(store, _path(table, scene_id), table).read() for table in OF_SCENE}


def trajectory_rows(store: Store, name: str) -> tuple[dict[str, pa.Table], pa.Table]:
    """The rows of a finished trajectory by table, and the index rows of its frames' files.

    Raises UserError if a hash differs from the commit.
    """
    commit_rows = Part(store, _path("index", name), "index", INDEX).read()
    n_tables = sum(path.startswith(f"{FOLDER}/") for path in commit_rows["path"].to_pylist())
    listed = {row["path"]: row for row in commit_rows.slice(0, n_tables).to_pylist()}
    tables = {}
    for table in OF_TRAJECTORY:
        path = _path(table, name)
        if table in OPTIONAL_TABLES and path not in listed:
            tables[table] = TABLES[table].empty_table()
            continue
        recorded = listed.get(path, {"bytes": 0, "sha256": ""})
        content = store.read(path, most_bytes=recorded["bytes"])
        if hashlib.sha256(content).hexdigest() != recorded["sha256"]:
            expected = f"SHA-256 {recorded['sha256']}; delete {_path('index', name)} to render the trajectory again"
            raise UserError(store.at(path), "SHA-256", "a different SHA-256", expected)
        tables[table] = pq.read_table(pa.BufferReader(content))
    return tables, commit_rows.slice(n_tables)


def _path(table: str, name: str) -> str:
    return f"{FOLDER}/{table}/{name}.parquet"


def _write(store: Store, table: str, name: str, rows: pa.Table) -> WrittenFile:
    """Write rows of a table; does not wait until they are on disk."""
    content = _parquet(stored(table, rows))
    store.replace(_path(table, name), content, durable=False)
    return WrittenFile.of(_path(table, name), content)


def _parquet(rows: pa.Table) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(rows, sink, compression="zstd")
    return sink.getvalue().to_pybytes()
