"""A valid request of each kind of PANGU's protocol, with numbers other than 0."""

from tests.render.server.pangu.words import doubles, floats

PLACE, ANGLES = (12.0, -20.0, 400.0), (30.0, -80.0, 10.0)
RADIANS = (0.5, -1.4, 0.2)
TURN = (0.1, 0.98, 0.15, -0.05)
RAY = (0.1, 0.2, -1.0)
SIX = (1.0, 0.5, 0.25)


def words(*values):
    return "".join(f"{value:08x}" for value in values)


_PAYLOADS = {
    1: "",
    2: "",
    3: words(2) + floats(*PLACE, 5, 6, 300),
    4: floats(0.4, 0.6),
    5: words(2) + floats(0.4, 0.6, 0.1, 0.9),
    6: floats(*RAY),
    7: words(2) + floats(*RAY, -0.3, 0.1, -0.5),
    9: floats(200, 0.002),
    10: "",
    11: floats(*PLACE, *ANGLES),
    12: floats(*PLACE, *TURN),
    13: floats(*PLACE, *RAY),
    14: floats(*PLACE, *TURN, *SIX * 6),
    15: words(7, 2, 3, 4) + floats(1, 2, 3, 4, *PLACE, *SIX, *TURN, 5) + words(*[1] * 13),
    16: doubles(*PLACE, *ANGLES),
    17: doubles(*PLACE, *TURN),
    18: words(1),
    19: words(1, 2),
    20: words(1),
    21: words(1, 2),
    22: words(1, 2),
    23: "01" + floats(12, 34),
    24: "01" + words(2) + floats(12, 34, -5, 6),
    25: "01" + floats(12, 34) + words(5, 4) + floats(3, 0.3),
    26: doubles(*PLACE, *RADIANS),
    28: words(1, 2),
    29: words(1),
    30: words(1),
    31: words(1) + "01" + words(5, 4) + floats(2, 3, 100),
    32: doubles(*PLACE, *TURN, *SIX * 6),
    33: "",
    34: floats(*PLACE, *TURN, *SIX * 6),
    35: words(1) + doubles(*PLACE, *TURN),
    256: floats(*PLACE, *ANGLES),
    257: floats(*PLACE, *TURN),
    258: floats(*SIX),
    259: floats(*SIX),
    260: words(2),
    261: floats(35),
    262: floats(1.2),
    263: words(1) + "01",
    264: words(1) + "0101",
    265: floats(*SIX) + words(*range(1, 30)),
    266: words(2, 0, 56) + floats(*range(1, 15)),
    267: floats(*TURN, *SIX * 3),
    268: doubles(*PLACE, *ANGLES),
    269: doubles(*PLACE, *TURN),
    270: words(1) + doubles(*PLACE, *TURN),
    271: doubles(1.5e11, 40, 30),
    272: words(1, 2, 9) + (doubles(0.5) + "01") * 9,
    273: doubles(*TURN),
    274: doubles(2),
    275: doubles(1.5e11, 40, 30),
    276: doubles(12345),
    277: words(1, 1),
    278: doubles(*PLACE, *RADIANS),
    279: floats(0.6),
    280: doubles(1.5e11, 0.7, 0.5),
    281: doubles(1.5e11, 0.7, 0.5),
    282: floats(*SIX),
    283: floats(*SIX),
    284: floats(*SIX * 2),
    285: words(1),
    286: doubles(1000, 0.1, 10, 500),
    287: words(1, 1, 1),
    288: words(1),
    289: words(0, 1) + "01",
    290: words(0) + floats(*SIX, 45, 2, *[0.0] * 10),
    291: words(0) + floats(*SIX, 0.8, 2, *[0.0] * 10),
    292: words(0) + doubles(*SIX, *RAY),
    293: words(1, 0),
    294: words(0),
    295: words(1, 0, 56) + doubles(*range(1, 8)),
    296: words(1, 0),
    297: words(1) + doubles(200, 150),
    298: words(1, 0, 64) + doubles(*range(1, 9)),
    299: words(1) + doubles(20, 5, -40, *[0.01] * 15),
}
VALID = {number: bytes.fromhex(words(number) + payload) for number, payload in _PAYLOADS.items()}
"""Bytes of each request and setting, but Goodbye, Echo and Quit."""
