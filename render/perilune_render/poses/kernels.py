"""Load SPICE kernels, after checking them and all files that meta-kernels name."""

import contextlib
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from perilune_shared.errors import UserError

_LISTED = "KERNELS_TO_LOAD"
_VALUES, _SYMBOLS = "PATH_VALUES", "PATH_SYMBOLS"
_MAX_LISTED = 1000
"""Largest number of texts in a variable of a meta-kernel."""
_MAX_CHARACTERS = 1000
"""Maximum length of a path in a meta-kernel; SPICE itself allows 255."""


def library() -> Any:
    """The module spiceypy. Raises UserError if it is not installed."""
    try:
        import spiceypy
    except ImportError:
        raise UserError("spice", "spiceypy", "not installed", "pip install 'perilune-render[spice]'") from None
    return spiceypy


@contextlib.contextmanager
def loaded(spice: Any, kernels: Sequence[Path]) -> Iterator[None]:
    """Load kernels, and the kernels that meta-kernels name, into a pool that is cleared before and after.

    Each file is checked before SPICE opens it, since opening a pipe or a device can block for ever. Raises UserError
    for a file that is missing or is not a regular file, and for a meta-kernel within a meta-kernel.
    """
    spice.kclear()
    try:
        named = {path: _named_by(spice, path) for path in kernels}
        for path in kernels:
            with reported(spice, str(path)):
                if not named[path]:
                    spice.furnsh(str(path))
                    continue
                # Load the files that were checked, not the files that SPICE would find.
                spice.ldpool(str(path))
                for name in (_LISTED, _VALUES, _SYMBOLS):
                    spice.dvpool(name)
            for each in named[path]:
                with reported(spice, f"{path} names {each}"):
                    spice.furnsh(str(each))
        yield
    finally:
        spice.kclear()


def _named_by(spice: Any, path: Path) -> list[Path]:
    """The files that a kernel names, checked; empty unless it is a meta-kernel."""
    _check_regular(path, path, "a SPICE kernel or meta-kernel")
    named = []
    for name in _listed(spice, path):
        each = Path(name)
        _check_regular(path, each, "a local file; paths in a meta-kernel are relative to the current folder")
        if _listed(spice, each):
            expected = "a kernel that names no others: repeat --kernels for each meta-kernel"
            raise UserError(path, _LISTED, f"the meta-kernel {name}", expected)
        named.append(each)
    return named


def _check_regular(where: Path, path: Path, expected: str) -> None:
    """Raise UserError about `where` for a path that is not a regular file."""
    field = "kernel" if where == path else _LISTED
    prefix = "" if where == path else f"{path}: "
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        raise UserError(where, field, f"{prefix}no such file", expected) from None
    if not stat.S_ISREG(mode):
        found = "a folder" if stat.S_ISDIR(mode) else "a pipe or a device"
        raise UserError(where, field, f"{prefix}{found}", expected)


def _listed(spice: Any, path: Path) -> list[str]:
    """Paths in KERNELS_TO_LOAD of a text kernel, with path symbols replaced. Leaves the pool empty."""
    with reported(spice, str(path)):
        architecture, _ = spice.getfat(str(path))
    if architecture not in ("KPL", "?"):
        return []
    spice.clpool()
    try:
        try:
            spice.ldpool(str(path))
        except spice.exceptions.SpiceyError:
            # Loading the kernel will report this error with its location.
            return []
        names, values, symbols = (_texts(spice, path, name) for name in (_LISTED, _VALUES, _SYMBOLS))
    finally:
        spice.clpool()
    if len(values) != len(symbols):
        found = f"{len(values)} values for {len(symbols)} symbols"
        raise UserError(path, f"{_VALUES} and {_SYMBOLS}", found, "as many of each")
    # The longest first, since a symbol may begin with another symbol.
    for symbol, value in sorted(zip(symbols, values, strict=True), key=lambda pair: -len(pair[0])):
        names = [name.replace(f"${symbol}", value) for name in names]
    return names


def _texts(spice: Any, path: Path, name: str) -> list[str]:
    """Texts of a variable of the pool; a text that ends with + continues in the next text."""
    try:
        n_parts, kind = spice.dtpool(name)
    except spice.exceptions.NotFoundError:
        return []
    if kind != "C":
        raise UserError(path, name, "numbers", "texts in quotes")
    if n_parts > _MAX_LISTED:
        raise UserError(path, name, f"{n_parts} texts", f"at most {_MAX_LISTED}")
    texts: list[str] = []
    with contextlib.suppress(spice.exceptions.NotFoundError):
        while len(texts) < n_parts:
            text, _ = spice.stpool(name, len(texts), "+", _MAX_CHARACTERS)
            texts.append(text)
    return texts


@contextlib.contextmanager
def reported(spice: Any, where: str) -> Iterator[None]:
    """Turn an error of SPICE into a UserError with its text."""
    try:
        yield
    except spice.exceptions.SpiceyError as error:
        short, text = (" ".join(str(part).split()) for part in (error.short, error.long))
        raise UserError(
            f"SPICE: {where}", short or "error", text or error, _EXPECTED.get(short, "valid kernels")
        ) from None


_EXPECTED = {
    "SPICE(SPKINSUFFDATA)": "kernels (SPK) that cover this time and body, and Moon and Sun",
    "SPICE(NOFRAMECONNECT)": "kernels (FK, CK with SCLK, PCK) that cover this time and frame",
    "SPICE(CKINSUFFDATA)": "kernels (CK) that cover this time",
    "SPICE(FRAMEDATANOTFOUND)": "kernels (PCK, or CK) of this frame",
    "SPICE(KERNELVARNOTFOUND)": "kernels (PCK, SCLK) with these values",
    "SPICE(NOLEAPSECONDS)": "a kernel of leap seconds (LSK)",
}
"""What is missing, by SPICE's short error message."""
