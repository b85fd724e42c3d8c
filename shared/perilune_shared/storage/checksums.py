"""SHA256SUMS: the hashes of all files of a dataset except frame files, whose hashes are in the manifest.

The file has the format of `sha256sum`; check it with `sha256sum -c SHA256SUMS`.
"""

import contextlib
import hashlib
import re
from collections.abc import Callable, Iterator, Mapping

from perilune_shared.errors import UserError
from perilune_shared.progress import NO_PROGRESS, Progress
from perilune_shared.storage.store import Address, Store, open_store

SUMS_NAME = "SHA256SUMS"
_LARGEST_BYTES = 20_000_000
_LARGEST_FILE = 2**36
_CHUNK_BYTES = 2**20
_LINE = re.compile(r"([0-9a-f]{64})  (\S+)")
_OWN_FOLDERS = ("manifest", "shards")


def seal(address: Address, progress: Progress = NO_PROGRESS, known: Mapping[str, str] | None = None) -> None:
    """Write SHA256SUMS for all files of the dataset, except links and invalid names, which are faults.

    `known` contains hashes computed earlier in this run; these files are not read again and may not be written yet.
    """
    store = open_store(address)
    hashes = dict(known or {})
    found = {name: size for name, size in _covered(store).items() if name in hashes or _is_plain(store, name)}
    sizes = {name: found.get(name, 0) for name in sorted({*found, *hashes})}
    with _hashing({name: size for name, size in sizes.items() if name not in hashes}, progress) as advance:
        for name in sizes:
            if name not in hashes:
                hashes[name] = sha256_of(store, name, advance)
    store.replace(SUMS_NAME, "".join(f"{hashes[name]}  {name}\n" for name in sizes).encode())


def sha256_of(store: Store, path: str, advance: Callable[[int], object] = lambda n_bytes: None) -> str:
    """Return the SHA-256 of a file (hexadecimal); calls `advance` with the number of bytes read since the last call."""
    digest = hashlib.sha256()
    with store.open(path) as stream:
        while chunk := stream.read(_CHUNK_BYTES):
            digest.update(chunk)
            advance(len(chunk))
    return digest.hexdigest()


def sums_of(store: Store) -> dict[str, str]:
    """Read the SHA-256 of each file in SHA256SUMS; the dataset must have no faults (`faults_of`)."""
    lines = [_LINE.fullmatch(line) for line in store.read(SUMS_NAME).decode().splitlines()]
    return {line[2]: line[1] for line in lines if line is not None}


def faults_of(store: Store, progress: Progress = NO_PROGRESS) -> Iterator[tuple[str, str, str]]:
    """Yield file, value found and value expected for each difference from SHA256SUMS."""
    try:
        store.plain_size(SUMS_NAME)
        text = store.read(SUMS_NAME, most_bytes=_LARGEST_BYTES).decode("utf-8", errors="replace")
    except UserError as error:
        yield SUMS_NAME, error.found, "the hashes of the dataset's files"
        return
    lines = [_LINE.fullmatch(line) for line in text.removesuffix("\n").split("\n")]
    if not text.endswith("\n") or None in lines:
        yield SUMS_NAME, "an invalid line", "64 hexadecimal digits, two spaces, a path"
        return
    listed = {line[2]: line[1] for line in lines if line is not None}
    if list(listed) != sorted(listed) or len(listed) != len(lines):
        yield SUMS_NAME, "repeated or unsorted paths", "each path once, sorted"
    present = _covered(store)
    with _hashing({name: present[name] for name in listed if name in present}, progress) as advance:
        for name, sha256 in listed.items():
            try:
                size = store.size(name)
            except UserError as error:
                yield (SUMS_NAME if error.field == "path" else name), error.found, error.expected
                continue
            if size is None:
                yield name, "no such file", f"the file with SHA-256 {sha256}, as in {SUMS_NAME}"
            elif size > _LARGEST_FILE:
                yield name, f"{size} bytes", f"at most {_LARGEST_FILE}"
            elif sha256_of(store, name, advance) != sha256:
                yield name, "a different SHA-256", f"SHA-256 {sha256}, as in {SUMS_NAME}"
    for name in sorted(set(present) - set(listed)):
        yield name, "not listed in SHA256SUMS", "only the dataset's files"


@contextlib.contextmanager
def _hashing(sizes: Mapping[str, int], progress: Progress) -> Iterator[Callable[[int], object]]:
    """Yield a function that advances the progress bar by a number of bytes read; `sizes` are those of the files."""
    total = sum(sizes.values())
    task = progress.add_task("hashing", total=total / 1e6, unit="MB")
    yield lambda n_bytes: progress.advance(task, n_bytes / 1e6)
    progress.update(task, completed=total / 1e6)


def _covered(store: Store) -> dict[str, int]:
    """Return the sizes of the files directly in the dataset and below manifest/ and shards/, without hidden ones."""
    found = {}
    for item in store.list():
        folder, _, name = item.path.rpartition("/")
        if folder.partition("/")[0] in ("", *_OWN_FOLDERS) and not name.startswith(".") and item.path != SUMS_NAME:
            found[item.path] = item.size_bytes
    return found


def _is_plain(store: Store, path: str) -> bool:
    try:
        store.plain_size(path)
    except UserError:
        return False
    return True
