"""The guidance of the example in closed loop, with perfect knowledge of the state."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from perilune_shared.geometry.frames import rotation_vectors
from perilune_shared.geometry.gravity import gravity_mps2


@pytest.fixture(scope="module")
def example():
    path = Path(__file__).parent.parent / "examples" / "closed_loop.py"
    spec = importlib.util.spec_from_file_location("closed_loop", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_guidance_leads_to_the_gate(example):
    position, velocity, thrust = example.START_M.copy(), example.START_MPS.copy(), np.zeros(3)
    most = 0.0
    for left_s in np.arange(example.DURATION_S, 0, -example.STEP_S):
        if left_s > example.LAST_S:
            thrust = example.guidance(position, velocity, left_s)
        most = max(most, float(np.linalg.norm(thrust)))
        acceleration = thrust + gravity_mps2(position[2])
        position = position + velocity * example.STEP_S + acceleration * example.STEP_S**2 / 2
        velocity = velocity + acceleration * example.STEP_S
    assert np.linalg.norm(position - example.GATE_M) < 1.0
    assert np.linalg.norm(velocity - example.GATE_MPS) < 1.0
    assert most < example.MAX_THRUST_MPS2


def test_thrust_is_limited(example):
    assert np.isclose(
        np.linalg.norm(example.guidance(np.array([5e3, 0, 900.0]), np.zeros(3), 5.0)), example.MAX_THRUST_MPS2
    )


def test_the_sway_is_small_and_smooth(example):
    turns = rotation_vectors(np.stack([example.sway(t) for t in np.arange(0, 60, 0.02)]))
    assert np.degrees(np.abs(turns).max()) < 0.6
    assert np.degrees(np.abs(np.diff(turns, axis=0)).max() / 0.02) < 0.3
