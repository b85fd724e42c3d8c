"""Read the header of a PNG without decompressing the image."""

import struct
from dataclasses import dataclass

_SIGNATURE = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True, slots=True)
class PngHeader:
    """Size and bit depth from the header chunk of a PNG file."""

    width_px: int
    """Image width, pixels."""
    height_px: int
    """Image height, pixels."""
    bits: int
    """Bits per grey value, 8 or 16."""


def png_header(content: bytes) -> PngHeader:
    """Read the header of a grey PNG of 8 or 16 bits. Raises ValueError on any other file.

    A small file may decompress to any size: check the header before decoding.
    """
    if len(content) < 33 or content[:8] != _SIGNATURE or content[12:16] != b"IHDR":
        raise ValueError("not a PNG file")
    width, height, bits, colour = struct.unpack(">IIBB", content[16:26])
    if colour != 0 or bits not in (8, 16):
        raise ValueError(f"a PNG of colour type {colour} with {bits} bits, not grey with 8 or 16")
    return PngHeader(width, height, bits)
