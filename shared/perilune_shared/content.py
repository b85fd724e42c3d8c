"""A hash of what a scene holds, to tell whether the same seed grew the same ground again.

Craters and boulders are measured on the finished ground, so that another ground shows in their heights and depths. The
hash is taken of whole millimetres: processors and libraries may differ in a number's last digits.
"""

import hashlib

import numpy as np
import pyarrow as pa

PROCEDURAL = "procedural"
"""`dem_source` of scenes without an elevation model."""
_CRATER = ("x_m", "y_m", "z_m", "diameter_m", "depth_m")
_BOULDER = ("x_m", "y_m", "z_m", "diameter_m")


def content_sha256(craters: pa.Table, boulders: pa.Table) -> str:
    """SHA-256 in hexadecimal of one scene's rows of `craters` and `boulders`, in the order of their ids."""
    digest = hashlib.sha256()
    for table, key, columns in ((craters, "crater_id", _CRATER), (boulders, "boulder_id", _BOULDER)):
        order = np.argsort(table[key].to_numpy(), kind="stable")
        digest.update(len(table).to_bytes(8, "little"))
        for name in columns:
            millimetres = np.rint(np.nan_to_num(table[name].to_numpy()[order]) * 1000)
            digest.update(millimetres.astype("<i8").tobytes())
    return digest.hexdigest()


def terrain_of(dem_source: str, content_sha256: str) -> str:
    """What scenes of the same ground have in common: their elevation model, else their craters and boulders.

    Scenes over one elevation model differ in the small craters that were added; the ground that it shows is the same.
    """
    return content_sha256 if dem_source == PROCEDURAL else dem_source.rpartition("sha256:")[2]
