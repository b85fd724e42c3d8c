"""Craters in space from two views of a simulated world."""

import numpy as np
import pytest
from tests.train.landing.craters.crater_world import ground_m, world

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import matrix_from_rotation_vector
from perilune_train.landing.craters.projection import Pose, projected
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.map.measure import measured
from perilune_train.landing.map.stereo import Ground, View, matched

ALTITUDE_M, TILT = 4500.0, np.radians(15.0)
CAMERA = Camera(1024, 1024, 2250.0, 2250.0, 512.0, 512.0)
"""Pixels of 2 m."""
LEVEL = np.diag([1.0, -1.0, -1.0])
WORLD = world(side_m=1800.0, per_m2=0.03)


def poses():
    beside = ALTITUDE_M * np.tan(TILT)
    # A camera at positive x looks towards negative x.
    return [
        Pose(np.array([side * beside, 0, ALTITUDE_M]), matrix_from_rotation_vector([0, side * TILT, 0]) @ LEVEL)
        for side in (-1, 1)
    ]


def seen(pose, rng, noise=1.0, found=1.0, false=0.0):
    """A view and the index in WORLD of each sighting, -1 for a false one."""
    there = projected(WORLD, CAMERA, pose, least_radius_px=2.0)
    own = np.flatnonzero(rng.random(len(there.index)) < found)
    centre, radius = there.centre_px[own], there.radius_px[own]
    stated = Sightings(centre, radius, np.full(len(own), 0.8))
    centre = centre + noise * stated.noise_px[:, None] * rng.normal(size=centre.shape)
    radius = radius * np.exp(0.05 * noise * rng.normal(size=len(radius)))
    n_false = round(false * len(own))
    centre = np.concatenate([centre, rng.uniform(0, 1024, (n_false, 2))])
    radius = np.concatenate([radius, rng.choice(radius, n_false)])
    index = np.concatenate([there.index[own], np.full(n_false, -1)])
    order = np.argsort(-radius)
    return View(CAMERA, pose, Sightings(centre[order], radius[order], np.full(len(order), 0.8))), index[order]


def pair(seed=0, **errors):
    rng = np.random.default_rng(seed)
    (first, of_first), (second, of_second) = (seen(pose, rng, **errors) for pose in poses())
    both = matched(first, second)
    return both, of_first[both.first], of_second[both.second]


def test_views_without_errors_give_the_craters():
    both, first, second = pair(noise=0.0)
    assert (first == second).mean() > 0.99
    own = first == second
    true = WORLD.part(first[own])
    # The middle of an ellipse is not the image of the circle's middle, and heights are medians of neighbours.
    assert np.median(np.abs(both.centre_m[own, :2] - true.centre_m[:, :2])) < 0.05
    assert np.sqrt(np.mean((both.centre_m[own, 2] - true.centre_m[:, 2]) ** 2)) < 0.8
    assert np.allclose(both.radius_m[own], true.radius_m, rtol=0.01)
    assert len(set(first.tolist())) == len(first)


def test_noise_and_false_detections():
    both, first, second = pair(found=0.8, false=1.0)
    right = (first == second) & (first >= 0)
    assert right.mean() > 0.9
    true = WORLD.part(first[right])
    error = both.centre_m[right] - true.centre_m
    assert np.sqrt(np.mean(error[:, :2] ** 2)) < 1.0
    assert np.sqrt(np.mean(error[:, 2] ** 2)) < 2.0
    # Of the craters that both views show, most are mapped.
    assert right.sum() > 0.75 * 0.8**2 * len(projected(WORLD, CAMERA, poses()[0], least_radius_px=2.5).index) * 0.8


def test_what_is_left_between_rays_states_the_noise():
    both, first, second = pair(seed=1)
    right = first == second
    error = (both.centre_m[right] - WORLD.part(first[right]).centre_m)[:, 1]
    stated = both.apart_m[right][:, 1] / 2
    assert np.median(np.abs(error)) == pytest.approx(np.median(np.abs(stated)), rel=0.25)


def test_other_ground_is_not_matched():
    rng = np.random.default_rng(0)
    first, _ = seen(poses()[0], rng)
    second, _ = seen(poses()[1], rng)
    mixed = rng.uniform(0, 1024, second.sightings.centre_px.shape)
    other = View(CAMERA, second.pose, Sightings(mixed, second.sightings.radius_px, second.sightings.score))
    assert len(matched(first, other).score) < 0.2 * len(matched(first, second).score)


def test_views_without_craters():
    nothing = View(CAMERA, poses()[0], Sightings(np.zeros((0, 2)), np.zeros(0), np.zeros(0)))
    second, _ = seen(poses()[1], np.random.default_rng(0))
    assert len(matched(nothing, second).score) == 0
    assert len(matched(second, nothing).score) == 0


def test_ground_follows_its_craters():
    place = np.random.default_rng(0).uniform(-900, 900, (2000, 2))
    ground = Ground(place, ground_m(place))
    spots = np.random.default_rng(1).uniform(-700, 700, (200, 2))
    assert np.sqrt(np.mean((ground.at(spots) - ground_m(spots)) ** 2)) < 1.0


def test_a_map_is_measured_by_the_craters_that_it_has():
    part = WORLD.part(np.arange(len(WORLD)) % 2 == 0)
    moved = type(part)(part.centre_m + np.array([0.3, -0.3, 0.5]), part.normal, part.radius_m * 1.1, 0.0, 0.0)
    rows = measured(moved, WORLD, np.array([900.0, 900.0])).set_index("diameter_m")
    row = rows.loc["10 to 20"]
    assert row["true_share"] == pytest.approx(1.0, abs=0.02)
    assert row["position_rmse_m"] == pytest.approx(0.3, rel=0.15)
    assert row["height_rmse_m"] == pytest.approx(0.5, rel=0.15)
    assert row["diameter_bias_share"] == pytest.approx(np.log(1.1), abs=0.01)
    assert 0.4 < row["found_share"] < 0.6
    assert rows["mapped"].sum() == len(part)
