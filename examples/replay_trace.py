"""Replay a propagation and an update by a range of a reference trace of the landing filter, by its equations.

python examples/replay_trace.py examples/traces/nominal
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

trace = Path(sys.argv[1] if len(sys.argv) > 1 else "examples/traces/nominal")
steps, imu, craters, ranges = (pd.read_parquet(trace / f"{name}.parquet") for name in (
    "steps", "inputs/imu", "inputs/catalogue", "inputs/ranges"))  # fmt: skip
pairs = (steps.kind == "range") & (steps.kind.shift() == "propagate") & (steps.kind.shift(2) == "range")
at = int(steps.index[pairs][0])  # rows at - 2 (range), at - 1 (propagate), at (range)


def state(row):
    """Position, velocity, attitude, biases, GROUND and the covariance of the core in one row of `steps`."""
    vectors = ("{}_m", "velocity_{}_mps", "gyro_bias_{}_radps", "force_bias_{}_mps2")
    p, v, gyro, force = (row[[form.format(axis) for axis in "xyz"]].to_numpy(float) for form in vectors)
    rotation = Rotation.from_quat(row[[f"rotation_{axis}" for axis in "xyzw"]].to_numpy(float)).as_matrix()
    upper = np.zeros((16, 16))
    upper[np.triu_indices(16)] = row.filter(regex=r"^covariance_").to_numpy(float)
    return p, v, rotation, gyro, force, float(row.ground_m), upper + np.triu(upper, 1).T


def cross(a):
    """The matrix whose product with u is the cross product a x u."""
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


# Propagate from row at - 2 to row at - 1.
p, v, R, gyro, force, ground, C = state(steps.loc[at - 2])
time = start = steps.time_s[at - 2]
F, Q = np.eye(15), np.zeros((15, 15))
per_s = np.repeat([0, 0.06, np.radians(0.1), np.radians(10 / 3600), 9.80665e-3], 3)  # of grade `tactical`
for row in imu[(imu.time_s > time) & (imu.time_s <= steps.time_s[at - 1] + 1e-9)].to_numpy():
    h, w, f = row[0] - time, row[2:5] - gyro, row[5:8] - force
    D = Rotation.from_rotvec(w * h / 2).as_matrix()
    M, step = R @ D, np.eye(15)
    a = M @ f + [0, 0, -4.902800118e12 / (1_737_400.0 + p[2]) ** 2]
    step[3:6, 6:15] = np.hstack([-M @ cross(f) * h, M @ cross(f) * h**2 / 2, -M * h])
    step[:3, 3:6], step[:3, 6:15] = h * np.eye(3), step[3:6, 6:15] * h / 2
    step[6:9, 6:9], step[6:9, 9:12] = (D @ D).T, -h * np.eye(3)
    p, v, R, time = p + v * h + a * h**2 / 2, v + a * h, M @ D, row[0]
    F, Q = step @ F, step @ Q @ step.T + np.diag(per_s**2 / 3600 * h)
k = np.exp(-(time - start) / 10)
whole, added = np.zeros((16, 16)), np.zeros((16, 16))
whole[:15, :15], whole[15, 15], added[:15, :15], added[15, 15] = F, k, Q, 10.0**2 * (1 - k**2)
C, ground = whole @ C @ whole.T + added, k * ground
expected = state(steps.loc[at - 1])
errors = [np.abs(p - expected[0]).max(), np.abs(v - expected[1]).max(), np.abs(R - expected[2]).max()]
sigmas = np.sqrt(np.diag(expected[6]))
errors.append((np.abs(C - expected[6]) / np.outer(sigmas, sigmas)).max())

# Update by the range of row at.
nearest = np.argsort(np.hypot(craters.x_m - p[0], craters.y_m - p[1]), kind="stable")[:10]
cosine, height = R[2, 2], p[2] - np.median(craters.z_m[nearest]) - ground
H = np.zeros(16)
H[2], H[15], H[6:9] = 1 / cosine, -1 / cosine, height / cosine**2 * np.cross([0, 0, -1], R[2])
y = float(ranges.range_m[np.abs(ranges.time_s - time) < 1e-9].iloc[0]) - height / cosine
c, S = C @ H, H @ C @ H + 1.0**2
p, v, C = p + (c * y / S)[:3], v + (c * y / S)[3:6], C - np.outer(c, c) / S
expected = state(steps.loc[at])
sigmas = np.sqrt(np.diag(expected[6]))
errors += [np.abs(p - expected[0]).max(), np.abs(v - expected[1]).max()]
errors += [abs(y - steps.innovation_0[at]) / np.sqrt(S), (np.abs(C - expected[6]) / np.outer(sigmas, sigmas)).max()]
print(f"largest difference: {max(errors):.1e}")
assert max(errors) < 1e-9
