"""Run the navigation filter over a descent with your own detector.

    perilune-train navigate descent --dataset data/small/nav --trajectory scene-0000/trajectory-0000 --out descent
    python examples/own_detector.py descent

The detector here is a blob detector of OpenCV, which finds far fewer craters than the installed network.
"""

import sys

import cv2
import numpy as np

import perilune

BLOBS = cv2.SimpleBlobDetector.create()


def detect(image: np.ndarray) -> np.ndarray:
    """Find dark discs in a grey image; return x, y, width, height and score of each disc (N, 5)."""
    rows = [(*blob.pt, blob.size, blob.size, 0.8) for blob in BLOBS.detect(image)]
    return np.array(rows, np.float64).reshape(-1, 5)


estimates = perilune.fly(sys.argv[1], detector=detect)
print(estimates[["time_s", "status", "x_m", "y_m", "z_m", "n_matched"]].to_string(index=False))
