"""Hash the content of a scene, to check whether the same seed reproduced the same terrain.

Craters and boulders are measured on the finished terrain, so a different terrain changes their heights and depths.
Values are rounded to millimetres first, since processors and libraries may differ in the last digits.
"""

import hashlib

import numpy as np
import pyarrow as pa

PROCEDURAL = "procedural"
"""Value of `dem_source` for scenes without an elevation model."""
_CRATER = ("x_m", "y_m", "z_m", "diameter_m", "depth_m")
_BOULDER = ("x_m", "y_m", "z_m", "diameter_m")


def content_sha256(craters: pa.Table, boulders: pa.Table) -> str:
    """Return the SHA-256 (hexadecimal) of the craters and boulders of one scene, sorted by id."""
    digest = hashlib.sha256()
    for table, key, columns in ((craters, "crater_id", _CRATER), (boulders, "boulder_id", _BOULDER)):
        order = np.argsort(table[key].to_numpy(), kind="stable")
        digest.update(len(table).to_bytes(8, "little"))
        for name in columns:
            millimetres = np.rint(np.nan_to_num(table[name].to_numpy()[order]) * 1000)
            digest.update(millimetres.astype("<i8").tobytes())
    return digest.hexdigest()


def terrain_of(dem_source: str, content_sha256: str) -> str:
    """Return a key that is equal for scenes with the same terrain.

    The key is the SHA-256 of the elevation model if there is one, otherwise the hash of craters and boulders. Scenes on
    one elevation model count as the same terrain, although different small craters are added to them.
    """
    return content_sha256 if dem_source == PROCEDURAL else dem_source.rpartition("sha256:")[2]
