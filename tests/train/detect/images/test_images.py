"""Images and boxes of other people: what is read, and what is refused in one line."""

import json
import os
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from perilune_shared.errors import UserError
from perilune_train.detect.images.labelled import read_images, read_table
from perilune_train.detect.images.read import picture_size, read_grey


def picture(path, width=40, height=30):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (height, width), np.uint8)).save(path)
    return path


@pytest.mark.parametrize("separator", [",", "\t"])
def test_tables_with_commas_and_tabs(tmp_path, separator):
    picture(tmp_path / "b.png")
    picture(tmp_path / "a.png", 50, 60)
    rows = ["ID,X,Y,W,H,C_X,CY", "0,-5.0,2,20,10,5,7", "", "1,30,20,8.0,8.0,34,24", "2,35,10,20,20,45,20"]
    for name in "ab":
        text = "\n".join(rows).replace(",", separator)
        tmp_path.joinpath(f"{name}.txt").write_text(text, encoding="utf-8-sig")
    found = read_images(tmp_path)
    assert not found.clipped
    assert [image.path.name for image in found.images] == ["a.png", "b.png"]
    image = found.images[1]
    assert (image.width_px, image.height_px) == (40, 30)
    assert image.boxes.tolist() == [[-5, 2, 15, 12], [30, 20, 38, 28], [35, 10, 55, 30]]
    assert image.sizes_px == pytest.approx([200**0.5, 8, 20])
    # The third is centred off the image.
    assert image.selected(8.0).tolist() == [True, True, False]
    assert image.selected(8.1).tolist() == [True, False, False]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: got no header, expected a column X"),
        ("ID,X,Y,W\n0,1,2,3", "line 1: got ID,X,Y,W, expected a column H"),
        ("X,Y,W,H\n1,2,3,4\n1,2,3", "line 3: got 3 values, expected 4"),
        ("X,Y,W,H\n1,2,three,4", "line 2: got ['1', '2', 'three', '4'], expected four numbers"),
        ("X,Y,W,H\n1,2,nan,4", "line 2: got ['1', '2', 'nan', '4'], expected a width and height above 0"),
        ("X,Y,W,H\n1,2,3,-4", "line 2: got"),
        ("X,Y,W,H\n1e9,2,3,4", "line 2: got"),
    ],
)
def test_broken_tables_are_named_with_their_line(tmp_path, text, message):
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(UserError) as caught:
        read_table(path)
    assert f"a.txt: {message}" in str(caught.value)


def test_tables_that_are_missing_or_no_text(tmp_path):
    picture(tmp_path / "a.png")
    with pytest.raises(UserError, match=r"a\.txt: boxes: got no such file"):
        read_images(tmp_path)
    (tmp_path / "a.txt").write_bytes(b"X,Y,W,H\n\xff\xfe")
    with pytest.raises(UserError, match=r"a\.txt: boxes: got bytes that are not UTF-8 text"):
        read_images(tmp_path)


def test_folders_without_images(tmp_path):
    with pytest.raises(UserError, match="no PNG, TIFF or JPEG"):
        read_images(tmp_path)
    with pytest.raises(UserError, match="no such folder"):
        read_images(tmp_path / "absent")


def coco(tmp_path, **changes):
    picture(tmp_path / "pictures" / "a b.png")
    content = {
        "images": [{"id": 7, "file_name": "pictures/a b.png", "width": 40, "height": 30}],
        "annotations": [
            {"id": 1, "image_id": 7, "category_id": 1, "bbox": [2, 3, 10, 12]},
            {"id": 2, "image_id": 7, "category_id": 1, "bbox": [1, 1, 20, 20], "iscrowd": 1},
            {"id": 3, "image_id": 7, "category_id": 1, "bbox": [4, 4, 9, 9.5], "ignore": 1},
            {"id": 4, "image_id": 7, "category_id": 2, "bbox": [4, 4, 9, 9]},
        ],
        "categories": [{"id": 1, "name": "Crater"}, {"id": 2, "name": "boulder"}],
    }
    path = tmp_path / "annotations.json"
    path.write_text(json.dumps({**content, **changes}))
    return path


def test_coco(tmp_path):
    path = coco(tmp_path)
    for place in (path, tmp_path):
        found = read_images(place)
        (image,) = found.images
        assert found.clipped
        assert image.name == "pictures/a b.png"
        assert image.path == tmp_path.resolve() / "pictures" / "a b.png"
        assert image.boxes.tolist() == [[2, 3, 12, 15], [1, 1, 21, 21], [4, 4, 13, 13.5]]
        assert image.selected(8.0).tolist() == [True, False, False]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": [{"id": 7, "file_name": "../x.png"}]}, r"images\[0\].file_name: got ../x.png"),
        ({"images": [{"id": 7, "file_name": "/etc/passwd"}]}, r"images\[0\].file_name: got /etc/passwd"),
        ({"images": [{"id": 7, "file_name": 3}]}, r"images\[0\].file_name: got 3"),
        ({"images": [{"id": 7, "file_name": "absent.png"}]}, r"absent.png: image: got no such file"),
        ({"images": [{"id": 7, "file_name": "pictures/a b.png", "width": 41}]}, "size: got 40 x 30, expected 41 x 30"),
        ({"images": [{"file_name": "pictures/a b.png"}]}, r"images\[0\].id: got None"),
        ({"images": []}, "images: got none"),
        ({"images": 3}, "images: got int, expected a list of objects"),
        ({"categories": [{"id": 1, "name": "cat"}, {"id": 2, "name": "dog"}]}, "categories: got cat, dog"),
        ({"annotations": [{"image_id": 8, "category_id": 1, "bbox": [1, 2, 3, 4]}]}, r"annotations\[0\].image_id"),
        ({"annotations": [{"image_id": 7, "category_id": 1, "bbox": [1, 2, 3]}]}, r"annotations\[0\].bbox"),
        ({"annotations": [{"image_id": 7, "category_id": 1, "bbox": [1, 2, -1, 4]}]}, "at least 0"),
        ({"annotations": [{"image_id": 7, "category_id": 1}]}, r"annotations\[0\].bbox: got None"),
    ],
)
def test_odd_coco_files_are_refused_in_one_line(tmp_path, changes, message):
    with pytest.raises(UserError, match=message) as caught:
        read_images(coco(tmp_path, **changes))
    assert "\n" not in str(caught.value)


def test_coco_does_not_follow_a_link_out_of_its_folder(tmp_path):
    picture(tmp_path / "outside.png")
    inner = tmp_path / "inner"
    path = coco(inner, images=[{"id": 7, "file_name": "link.png"}])
    (inner / "link.png").symlink_to(tmp_path / "outside.png")
    with pytest.raises(UserError, match=r"file_name: got link.png"):
        read_images(path)


@pytest.mark.parametrize("folder", ["annotations", "images", "images/train2017", "train2017"])
def test_coco_beside_a_folder_of_images(tmp_path, folder):
    root = tmp_path / "given"
    path = coco(root / "annotations", images=[{"id": 7, "file_name": "a.png"}])
    path = path.rename(path.with_name("instances_train2017.json"))
    expected = picture(root / folder / "a.png")
    assert read_images(path).images[0].path == expected.resolve()
    # Names that lead out of these folders, and links, stay refused, whatever is there.
    picture(tmp_path / "outside.png")
    expected.unlink()
    expected.symlink_to(tmp_path / "outside.png")
    with pytest.raises(UserError, match=r"file_name: got a.png"):
        read_images(path)
    expected.unlink()
    with pytest.raises(UserError, match=r"annotations/a.png: image: got no such file"):
        read_images(path)
    coco(root / "annotations", images=[{"id": 7, "file_name": "../images/b.png"}]).replace(path)
    picture(root / "images" / "b.png")
    with pytest.raises(UserError, match=r"file_name: got ../images/b.png"):
        read_images(path)


def test_coco_boxes_without_an_area_are_left_out_and_told(tmp_path, capsys):
    sizes = [(0, 9), (9, 0.0), (0, 0), (9, 10)]
    path = coco(tmp_path, annotations=[{"image_id": 7, "category_id": 1, "bbox": [2, 3, *size]} for size in sizes])
    (image,) = read_images(path).images
    assert image.boxes.tolist() == [[2, 3, 11, 13]] and image.not_ignored.tolist() == [True]
    assert "annotations.json: 3 boxes without width or height in the picture are left out" in capsys.readouterr().err


def test_coco_as_roboflow_exports_it(tmp_path, capsys):
    """Two categories, the first a placeholder without annotations; both are craters, and it is said."""
    names = [(0, "Craters", "none"), (1, "Crater", "Craters"), (2, "boulder", "Craters")]
    categories = [{"id": number, "name": name, "supercategory": above} for number, name, above in names]
    boxes = [{"id": k, "image_id": 7, "category_id": k, "bbox": [k, 3, 10, 12], "segmentation": []} for k in (1, 2)]
    path = coco(tmp_path, categories=categories, annotations=boxes)
    found = read_images(path.rename(tmp_path / "_annotations.coco.json"))
    assert found.images[0].boxes.tolist() == [[1, 3, 11, 15]]
    assert found.categories == "categories taken as craters: Craters (0), Crater (1); left out: boulder"
    assert f"_annotations.coco.json: {found.categories}" in " ".join(capsys.readouterr().err.split())
    both = [{**box, "category_id": k} for k, box in enumerate(boxes)]
    path = coco(tmp_path, categories=[*categories[:1], {"id": 1, "name": "CRATER"}], annotations=both)
    assert len(read_images(path).images[0].boxes) == 2
    with pytest.raises(UserError, match="categories: got Cratersx, boulder"):
        read_images(coco(tmp_path, categories=[{"id": 0, "name": "Cratersx"}, categories[2]]))


@pytest.mark.parametrize("text", ["[", "[]", "[" * 100_000, '"x"'])
def test_files_that_are_no_coco(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(UserError, match="JSON: got"):
        read_images(path)


def test_pictures_of_every_depth_become_8_bit_grey(tmp_path):
    rng = np.random.default_rng(1)
    grey = rng.integers(0, 256, (20, 30), np.uint8)
    for name in ("a.png", "a.tif"):
        Image.fromarray(grey).save(tmp_path / name)
        assert np.array_equal(read_grey(tmp_path / name), grey)
        assert picture_size(tmp_path / name) == (30, 20)
    deep = grey.astype(np.uint16) * 8 + 100
    for name, pixels in (("d.png", deep), ("d.tif", deep), ("f.tif", deep.astype(np.float32))):
        assert cv2.imwrite(str(tmp_path / name), pixels)
        read = read_grey(tmp_path / name)
        assert read.dtype == np.uint8 and (read.min(), read.max()) == (0, 255)
        assert np.corrcoef(read.ravel(), grey.ravel())[0, 1] > 0.9999
    holes = deep.astype(np.float32)
    holes[:3], holes[3] = np.nan, np.inf
    assert cv2.imwrite(str(tmp_path / "h.tif"), holes)
    assert (read_grey(tmp_path / "h.tif")[:4] == 0).all()
    assert np.corrcoef(read_grey(tmp_path / "h.tif")[4:].ravel(), grey[4:].ravel())[0, 1] > 0.9999
    Image.fromarray(np.dstack([grey] * 3)).save(tmp_path / "c.png")
    assert np.array_equal(read_grey(tmp_path / "c.png"), grey)
    Image.fromarray(np.full((20, 30, 3), 77, np.uint8)).save(tmp_path / "c.jpg")
    assert np.abs(read_grey(tmp_path / "c.jpg").astype(int) - 77).max() <= 1


def test_pictures_that_are_damaged_or_none(tmp_path):
    whole = picture(tmp_path / "a.png", 300, 300).read_bytes()
    cut = tmp_path / "cut.png"
    cut.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match=r"cut\.png: image"):
        read_grey(cut)
    (tmp_path / "text.tif").write_text("<VRTDataset/>")
    with pytest.raises(UserError, match="XML text, which can refer to other files"):
        read_grey(tmp_path / "text.tif")
    with pytest.raises(UserError, match="no such file"):
        read_grey(tmp_path / "absent.png")
    header = b"IHDR" + (2**17).to_bytes(4, "big") * 2 + whole[24:29]
    (tmp_path / "bomb.png").write_bytes(whole[:12] + header + zlib.crc32(header).to_bytes(4, "big") + whole[33:])
    with pytest.raises(UserError, match=r"bomb\.png: size: got 131072 x 131072"):
        read_grey(tmp_path / "bomb.png")


def test_the_real_crops_are_read():
    if "PERILUNE_REAL_NAC" not in os.environ:
        pytest.skip("PERILUNE_REAL_NAC names no folder of real crops")
    images = read_images(Path(os.environ["PERILUNE_REAL_NAC"])).images
    assert len(images) == 12
    assert all((image.width_px, image.height_px) == (800, 800) for image in images)
    assert sum(len(image.boxes) for image in images) == 13453
    assert any((image.boxes[:, :2] < 0).any() for image in images)
