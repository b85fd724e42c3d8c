"""Grey and RGB images of a PDF that Chromium printed."""

import re
import zlib

import numpy as np
from numpy.typing import NDArray

_OBJECT = re.compile(rb"<<([^<>]*?/Subtype\s*/Image[^<>]*)>>\s*stream\r?\n", re.S)


def images_of(pdf: bytes) -> list[NDArray[np.uint8]]:
    """Return the uncompressed pixels (height, width) of all images that are grey, or RGB with equal channels."""
    found = []
    for match in _OBJECT.finditer(pdf):
        width, height, length = (
            int(re.search(rb"/%s\s+(\d+)" % name, match[1])[1]) for name in (b"Width", b"Height", b"Length")
        )
        if b"/FlateDecode" not in match[1] or b"/SMask" in match[1]:
            continue
        content = zlib.decompress(pdf[match.end() : match.end() + length])
        pixels = np.frombuffer(content, np.uint8).reshape(height, width, -1)
        if (pixels == pixels[..., :1]).all():
            found.append(pixels[..., 0])
    return found
