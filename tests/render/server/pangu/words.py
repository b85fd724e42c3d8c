"""Words of PANGU's protocol in hexadecimal, by its definition and without our encoder."""

import struct

import numpy as np

DOWN_1000 = "00000000 00000000 f4000088 00000000 68000185 00000000"
"""Position (0, 0, 1000) and angles (0, -90, 0) as floats."""
FLOATS = {0: "00000000", 1: "0000007f", -1: "0000017f", -2.5: "40000180", 0.1: "99999a7b", 1000: "f4000088"}
FLOATS |= {-90: "68000185"}
DOUBLES = {0: "0" * 16, 1: "000003ff00000000", -1: "00000bff00000000", -2.5: "00000c0040000000"}
DOUBLES |= {0.1: "9999a3fb99999999", 1000: "00000408f4000000", np.pi: "42d18400921fb544"}


def floats(*values):
    """Floats by the definition: fraction, sign, exponent from the top."""
    words = []
    for value in values:
        word = struct.unpack(">I", struct.pack(">f", value))[0]
        sign, exponent, fraction = word >> 31, (word >> 23) & 0xFF, word & 0x7FFFFF
        words.append(f"{(fraction << 9) | (sign << 8) | exponent:08x}")
    return "".join(words)


def doubles(*values):
    """Doubles by the definition: fraction, sign, exponent from the top; the low half first."""
    words = []
    for value in values:
        word = struct.unpack(">Q", struct.pack(">d", value))[0]
        sign, exponent, fraction = word >> 63, (word >> 52) & 0x7FF, word & ((1 << 52) - 1)
        turned = f"{(fraction << 12) | (sign << 11) | exponent:016x}"
        words.append(turned[8:] + turned[:8])
    return "".join(words)


def as_float(data):
    word = int.from_bytes(data, "big")
    return struct.unpack(">f", struct.pack(">I", ((word >> 8 & 1) << 31) | ((word & 0xFF) << 23) | (word >> 9)))[0]


def as_doubles(data):
    """Doubles from the wire, by the definition."""
    found = []
    for at in range(0, len(data), 8):
        word = int.from_bytes(data[at + 4 : at + 8] + data[at : at + 4], "big")
        plain = ((word >> 11 & 1) << 63) | ((word & 0x7FF) << 52) | (word >> 12)
        found.append(struct.unpack(">d", struct.pack(">Q", plain))[0])
    return found
