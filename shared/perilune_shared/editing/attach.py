"""Combine a manifest without frames with the frames rendered from it."""

import pyarrow as pa

from perilune_shared.console.progress import NO_PROGRESS, Progress
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.names import IMAGE_KINDS, SCENE_FILE_KINDS
from perilune_shared.editing.rewrite import check_source
from perilune_shared.editing.writer import new_dataset, with_column
from perilune_shared.errors import UserError
from perilune_shared.storage.png import png_header
from perilune_shared.storage.store import Address


def attach(
    manifest: Dataset,
    frames_root: Address,
    out: Address,
    rehash: bool = False,
    progress: Progress = NO_PROGRESS,
    *,
    link: bool = False,
) -> None:
    """Write a dataset from a manifest without frames and from its frames in the folder `frames_root`.

    Frames are copied, or hard-linked with `link`. Every file must match its hash in the manifest. With `rehash`, the
    hashes of the files replace the hashes in the manifest, for example if frames were rendered on another kind of
    machine. For each scene, EXRs, flash lidar images and the hazard map are each included only if all files of this
    kind exist. Raises UserError if a frame is missing or a file does not match, or if the manifest has frames or is a
    plan without labels.
    """
    check_source(manifest, out, progress)
    if manifest.info.images != "absent":
        expected = "absent: a manifest with labels and without frames"
        raise UserError(manifest.store, "images", manifest.info.images, expected)
    source = Dataset(frames_root, manifest.info.model_copy(update={"images": "files"}))
    line = "frames attached" + (", hashed anew" if rehash else "")
    info = manifest.info.changed(line, images="files")
    scene_ids = manifest.scene_ids()
    task = progress.add_task("attaching", total=manifest.info.counts.frames, unit="frames")
    with new_dataset(out, info) as writer:
        for scene_id in scene_ids:
            tables = manifest.scene(scene_id)
            frames, scenes = (
                _checked(source, tables["frames"], rehash),
                _checked_scene(source, tables["scenes"], rehash),
            )
            writer.add_scene({**tables, "frames": frames, "scenes": scenes})
            writer.add_images(source, frames, {name: name for name in frames["frame_id"].to_pylist()}, link=link)
            writer.add_scene_files(source, scenes, scene_id, link=link)
            progress.advance(task, len(frames))


def _checked(source: Dataset, frames: pa.Table, rehash: bool) -> pa.Table:
    """Return a scene's rows of `frames` with paths, sizes and hashes of the existing files."""
    names = [f"{kind}_{name}" for kind in IMAGE_KINDS for name in ("path", "sha256")]
    rows = frames.select(["frame_id", "camera", *names]).to_pylist()
    columns: dict[str, list] = {f"{kind}_{name}": [] for kind in IMAGE_KINDS for name in ("sha256", "bytes", "path")}
    for row in rows:
        for kind in IMAGE_KINDS:
            file = _file(source, row, kind, rehash)
            if kind == "png" and file["path"] is None:
                raise UserError(source.store, "frame", f"no {row['png_path']}", "every frame of the manifest")
            for name, value in file.items():
                columns[f"{kind}_{name}"].append(value)
        head = source.store.read(row["png_path"], 0, 64)
        try:
            header = png_header(head)
        except ValueError as error:
            raise UserError(source.store.at(row["png_path"]), "frame", error, "a grey PNG") from None
        camera = source.camera_of(row)
        if (header.width_px, header.height_px) != (camera.width_px, camera.height_px):
            found_px = f"{header.width_px} x {header.height_px}"
            raise UserError(row["png_path"], "size", found_px, f"{camera.width_px} x {camera.height_px} pixels")
    for kind in IMAGE_KINDS:
        if None in columns[f"{kind}_path"]:
            columns |= {name: [None] * len(rows) for name in columns if name.startswith(kind)}
    for name, values in columns.items():
        frames = with_column(frames, name, values)
    return frames


def _checked_scene(source: Dataset, scenes: pa.Table, rehash: bool) -> pa.Table:
    """Return a scene's row of `scenes` with paths, sizes and hashes of the existing files."""
    row = scenes.to_pylist()[0]
    for kind in SCENE_FILE_KINDS:
        for name, value in _file(source, row, kind, rehash).items():
            scenes = with_column(scenes, f"{kind}_{name}", [value])
    return scenes


def _file(source: Dataset, row: dict, kind: str, rehash: bool) -> dict[str, str | int | None]:
    """Return path, bytes and sha256 of a row's file, each None for a missing file.

    Raises UserError if the hash differs from the row, unless `rehash` is true.
    """
    path = row[f"{kind}_path"]
    size = source.store.size(path) if path is not None else None
    if size is None:
        return {"sha256": None, "bytes": None, "path": None}
    sha256 = source.store.sha256(path)
    if not rehash and sha256 != row[f"{kind}_sha256"]:
        expected = f"the file with SHA-256 {row[f'{kind}_sha256']}, or --rehash"
        raise UserError(source.store.at(path), f"{kind}_sha256", sha256, expected)
    return {"sha256": sha256, "bytes": size, "path": path}
