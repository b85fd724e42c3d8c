"""Crater masks, compared with densely sampled discs, an analytical ridge and a rendered dataset."""

from dataclasses import replace

import numpy as np
import pytest

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera, camera_from_site
from perilune_shared.geometry.ellipse import plane_basis
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_shared.labels.masks import crater_masks, frame_masks

CAMERA = Camera(120, 90, 130.0, 120.0, 57.0, 48.0)
BARREL = replace(CAMERA, distortion=(-0.25, 0.04, 0.003, -0.002, 0.0))
CENTRES = np.array([[2.0, -3.0, 100.0], [-44.0, 30.0, 110.0], [30.0, 10.0, 60.0], [0.0, 0.0, -50.0]])
NORMALS = np.array([[0.3, 0.1, -1.0], [-0.2, 0.5, -1.0], [0.6, 0.0, -1.0], [0.0, 0.0, -1.0]])
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
RADII = np.array([12.0, 14.0, 9.0, 10.0])


def whole(mask, camera, which="amodal"):
    image = np.zeros((camera.height_px, camera.width_px), bool)
    image[mask.window] = getattr(mask, which)
    return image


@pytest.mark.parametrize("camera", [CAMERA, BARREL])
def test_an_amodal_mask_is_the_image_of_the_disc(camera):
    masks = crater_masks(camera, [7, 8, 9, 10], CENTRES, NORMALS, RADII)
    assert [mask.crater_id for mask in masks] == [7, 8, 9, 10]
    p, q = plane_basis(NORMALS)
    rho, angle = (
        part.ravel()[:, None] for part in np.meshgrid(np.linspace(0, 1, 400), np.linspace(0, 2 * np.pi, 1500))
    )
    for k in range(3):
        image = whole(masks[k], camera)
        disc = CENTRES[k] + RADII[k] * rho * (np.cos(angle) * p[k] + np.sin(angle) * q[k])
        pixels = camera.project(disc)
        pixels = pixels[camera.inside(pixels)].astype(int)
        touched = np.zeros_like(image)
        touched[pixels[:, 1], pixels[:, 0]] = True
        # Every pixel of the mask contains a part of the disc; only pixels at its edge are partly covered.
        assert image.sum() > 100 and not (image & ~touched).any()
        inner = touched.copy()
        for axis in (0, 1):
            for step in (-1, 1):
                inner &= np.roll(touched, step, axis)
        edge = ~np.ones_like(inner)
        edge[[0, -1]], edge[:, [0, -1]] = True, True
        assert not (inner & ~image & ~edge).any()
    # A crater behind the camera has no pixels; without depth there is no visible mask.
    assert masks[3].amodal.size == 0 and masks[0].visible is None
    # The second crater is partly outside the image.
    assert whole(masks[1], camera)[:, 0].any()


def test_a_ridge_hides_craters_behind_it():
    """A wall at 60 m covers the image rows from 50 on; elsewhere the terrain is at the depth of the disc."""
    rays = CAMERA.rays(CAMERA.pixel_centres())
    ground = (CENTRES[0] @ NORMALS[0]) / (rays @ NORMALS[0])
    floor = ground + 3.0
    wall = np.arange(90)[:, None] >= 50
    (mask,) = crater_masks(CAMERA, [1], CENTRES[:1], NORMALS[:1], RADII[:1], np.where(wall, 60.0, floor))
    amodal, visible = whole(mask, CAMERA), whole(mask, CAMERA, "visible")
    np.testing.assert_array_equal(visible, amodal & ~wall)
    assert visible.any() and (amodal & wall).any()
    # Terrain nearer than the disc by less than the tolerance, here 2 x 100 / 130 m, does not hide it.
    for nearer, seen in ((1.4, True), (1.7, False)):
        (mask,) = crater_masks(CAMERA, [1], CENTRES[:1], NORMALS[:1], RADII[:1], ground - nearer)
        assert mask.visible.any() == seen and (not seen or (mask.visible == mask.amodal).all())
    # Sky, where depth is infinite, shows no crater.
    (mask,) = crater_masks(CAMERA, [1], CENTRES[:1], NORMALS[:1], RADII[:1], np.full((90, 120), np.inf))
    assert mask.amodal.any() and not mask.visible.any()


def test_masks_of_a_rendered_frame(quick):
    from perilune_render.imaging.exr import read_exr

    dataset = open_dataset(quick / "detect")
    frame = dataset.table("frames").to_pandas().iloc[5]
    exr = read_exr(dataset.file(frame.exr_path))
    labels = dataset.table("labels").to_pandas()
    labels = labels[labels["frame_id"] == frame.frame_id]
    masks = frame_masks(dataset, frame.frame_id, depth_m=exr["Z"])
    assert [mask.crater_id for mask in masks] == labels["crater_id"].tolist()
    camera = dataset.camera
    inside = labels[["bbox_x0_px", "bbox_y0_px"]].min(axis=1) > 0
    inside &= labels[["bbox_x1_px", "bbox_y1_px"]].max(axis=1) < camera.width_px
    area = np.array([mask.amodal.sum() for mask in masks])
    ellipse = (np.pi * labels["radius_px"] ** 2).to_numpy()
    large = inside.to_numpy() & (labels["radius_px"] > 4).to_numpy()
    assert large.sum() > 5
    np.testing.assert_allclose(area[large], ellipse[large], rtol=0.08)
    # From above, nearly everything is visible, as in the labels.
    share = np.array([mask.visible.sum() for mask in masks]) / area
    assert np.median(share) == 1 and share.min() < 1.01
    # The terrain of the EXR in a visible pixel is below the disc or slightly above it.
    craters = dataset.table("craters", scene_id=frame.scene_id).to_pandas().set_index("crater_id")
    rotation = matrix_from_quaternion(frame.rotation_wxyz)
    points = camera.rays(camera.pixel_centres()) * exr["Z"][..., None] @ rotation + frame.position_m
    for mask in masks:
        crater = craters.loc[mask.crater_id]
        off = points[mask.window][mask.visible] - crater[["x_m", "y_m", "z_m"]].to_numpy(float)
        assert (np.hypot(off[:, 0], off[:, 1]) < 0.8 * crater.diameter_m).all()
    # The instance image has the smallest visible crater of each pixel.
    owner = np.full(exr["Z"].shape, -1.0)
    every = craters.index[np.argsort(-craters["diameter_m"].to_numpy(), kind="stable")]
    z = camera_from_site(craters.loc[every, ["x_m", "y_m", "z_m"]].to_numpy(), frame.position_m, rotation)[:, 2]
    across = 2 * camera.fx_px * craters.loc[every, "diameter_m"].to_numpy() / 2 > z
    for mask in frame_masks(dataset, frame.frame_id, every[across].tolist(), exr["Z"], "exr"):
        owner[mask.window][mask.visible] = mask.crater_id
    assert (owner == exr["crater"]).mean() > 0.9999 and (owner >= 0).any()


def test_masks_with_distortion_use_the_requested_camera(quick_detect):
    """Read a pinhole dataset as one of a distorted camera with a smaller view: same terrain, other pixels."""
    from perilune_render.imaging.exr import read_exr

    dataset = open_dataset(quick_detect)
    pinhole = dataset.info.camera
    bent = pinhole.model_copy(update={"width_px": 64, "height_px": 64, "cx_px": 31.7, "cy_px": 32.0})
    bent = bent.model_copy(update={"distortion": (-0.3, 0.0, 0.0, 0.0, 0.0)})
    dataset.info = dataset.info.model_copy(update={"camera": bent, "exr_camera": pinhole})
    frame = dataset.table("frames").to_pandas().iloc[5]
    depth_m = read_exr(dataset.file(frame.exr_path))["Z"]
    # A near obstacle hides the right half of the pinhole image.
    depth_m[:, 64:] = 1.0
    camera, exr_camera = bent.intrinsics(), pinhole.intrinsics()
    labels = dataset.table("labels").to_pandas()
    crater = labels[labels["frame_id"] == frame.frame_id]["crater_id"].tolist()
    in_png = frame_masks(dataset, frame.frame_id, crater, depth_m)
    in_exr = frame_masks(dataset, frame.frame_id, crater, depth_m, "exr")
    place = exr_camera.project(camera.rays(camera.pixel_centres())).astype(int)
    compared = 0
    beside = np.zeros(2, int)
    for png, exr in zip(in_png, in_exr, strict=True):
        for which in ("amodal", "visible"):
            expected = whole(exr, exr_camera, which)[place[..., 1], place[..., 0]]
            found = whole(png, camera, which)
            compared += found.sum()
            # Equal except at the edge, because depth is sampled at the nearest pixel.
            assert (found != expected).sum() <= 4 + 0.5 * np.sqrt(found.sum()) * np.pi
        amodal, visible = whole(png, camera), whole(png, camera, "visible")
        assert not visible[:, 32:].any()
        beside += amodal[:, 31].sum(), visible[:, 31].sum()
    # Exactly the right half is hidden.
    assert compared > 1000 and 0.9 * beside[0] < beside[1] > 0


def test_unknown_frames_and_craters_are_refused(quick):
    dataset = open_dataset(quick / "detect")
    frame_id = dataset.table("frames", ["frame_id"])["frame_id"][0].as_py()
    with pytest.raises(UserError, match="frame_id: got nowhere"):
        frame_masks(dataset, "nowhere")
    with pytest.raises(UserError, match="crater_id: got -4"):
        frame_masks(dataset, frame_id, [-4])
    with pytest.raises(UserError, match=r"depth_m.*128 x 128"):
        frame_masks(dataset, frame_id, depth_m=np.ones((4, 4)))
