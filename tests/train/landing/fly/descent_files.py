"""Files of a short descent over level ground, as `navigate fly` reads them."""

import json

import numpy as np
import pandas as pd
from PIL import Image

from perilune_shared.geometry.gravity import gravity_mps2

TIMES_S = (10.0, 11.0, 12.0)
START_M, VELOCITY_MPS = np.array([20.0, -30.0, 900.0]), np.array([8.0, -3.0, -30.0])
DOWN_WXYZ = (0.0, 1.0, 0.0, 0.0)
"""A camera on a level body."""


def write_descent(folder, size_px=64, rate_hz=20):
    """Write frames of noise with frames.csv, camera.yaml, catalogue.csv, imu.csv, ranges.csv, prior.yaml, truth.csv."""
    frames = folder / "frames"
    frames.mkdir(parents=True)
    rng = np.random.default_rng(0)
    names = [f"{place}.png" for place in range(len(TIMES_S))]
    for name in names:
        Image.fromarray(rng.integers(0, 255, (size_px, size_px), np.uint8)).save(frames / name)
    pd.DataFrame({"file": names, "time_s": TIMES_S}).to_csv(frames / "frames.csv", index=False)
    camera = {"width_px": size_px, "height_px": size_px, "fx_px": 70.0, "fy_px": 70.0, "cx_px": 32.0, "cy_px": 32.0}
    write_yaml(folder / "camera.yaml", camera)
    craters = {"x_m": rng.uniform(-400, 400, 50), "y_m": rng.uniform(-400, 400, 50), "z_m": 0.0, "diameter_m": 30.0}
    pd.DataFrame(craters).to_csv(folder / "catalogue.csv", index=False)
    # Measurements begin before the first frame, as they do on a lander.
    ends = np.arange(5, TIMES_S[-1] + 0.5, 1 / rate_hz)
    imu = {"time_s": ends, "interval_s": 1 / rate_hz}
    imu |= {f"angular_rate_{axis}_radps": 0.0 for axis in "xyz"}
    height = START_M[2] + VELOCITY_MPS[2] * (ends - TIMES_S[0])
    force = -np.stack([gravity_mps2(one) for one in height])
    imu |= {f"specific_force_{axis}_mps2": force[:, place] for place, axis in enumerate("xyz")}
    pd.DataFrame(imu).to_csv(folder / "imu.csv", index=False)
    at = np.arange(5, TIMES_S[-1], 0.5)
    ranges = {"time_s": at, "range_m": START_M[2] + VELOCITY_MPS[2] * (at - TIMES_S[0])}
    pd.DataFrame(ranges).to_csv(folder / "ranges.csv", index=False)
    prior = {
        "position_m": (START_M + 1.0).tolist(),
        "velocity_mps": VELOCITY_MPS.tolist(),
        "rotation_wxyz": list(DOWN_WXYZ),
        "position_sigma_m": 2.0,
        "velocity_sigma_mps": 0.1,
        "attitude_sigma_deg": 0.1,
    }
    write_yaml(folder / "prior.yaml", prior)
    position = START_M + VELOCITY_MPS * (np.array(TIMES_S)[:, None] - TIMES_S[0])
    truth = {"time_s": TIMES_S} | {f"{axis}_m": position[:, place] for place, axis in enumerate("xyz")}
    truth |= {f"rotation_{axis}": value for axis, value in zip("wxyz", DOWN_WXYZ, strict=True)}
    pd.DataFrame(truth).to_csv(folder / "truth.csv", index=False)
    return folder


def write_yaml(path, content):
    """Write plain data as YAML, of which JSON is a part."""
    path.write_text(json.dumps(content), encoding="utf-8")


def options(folder, catalogue="catalogue.csv"):
    """The options of `navigate fly` for the files of a folder."""
    files = {"camera": "camera.yaml", "catalogue": catalogue, "imu": "imu.csv", "prior": "prior.yaml"}
    files |= {"frames": "frames", "ranges": "ranges.csv", "truth": "truth.csv"}
    return [word for name, file in files.items() for word in (f"--{name}", str(folder / file))]
