"""Label files of other tools, in the layouts and with the habits in which people have them."""

import json
import sys

import numpy as np
import pytest
from PIL import Image

from perilune_shared.errors import UserError
from perilune_train.detect.images.labelled import Request, read_images
from perilune_train.detect.images.pictures import pictures_of

BOXES = [[2.0, 3, 12, 15], [20, 10, 30, 22]]
WIDTH, HEIGHT = 40, 30


def picture(path, width=WIDTH, height=HEIGHT):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (height, width), np.uint8)).save(path)
    return path


def written(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text if isinstance(text, str) else json.dumps(text), encoding="utf-8", newline="")
    return path


def sized(box):
    return [box[0], box[1], box[2] - box[0], box[3] - box[1]]


def coco(names=("a.png",), **changes):
    images = [{"id": k, "file_name": name, "width": WIDTH, "height": HEIGHT} for k, name in enumerate(names, 1)]
    boxes = [{"id": k, "image_id": 1, "category_id": 1, "bbox": sized(box)} for k, box in enumerate(BOXES)]
    return {"images": images, "annotations": boxes, "categories": [{"id": 1, "name": "crater"}], **changes}


def only(found):
    (image,) = found.images
    return image.boxes.tolist()


def yolo_rows(separator=" ", end="\n", boxes=BOXES):
    rows = []
    for x0, y0, x1, y1 in boxes:
        numbers = [(x0 + x1) / 2 / WIDTH, (y0 + y1) / 2 / HEIGHT, (x1 - x0) / WIDTH, (y1 - y0) / HEIGHT]
        rows.append(separator.join(["0", *(f"{value:.10f}" for value in numbers)]))
    return end.join(rows) + end


# COCO


def test_ids_and_sizes_as_text(tmp_path):
    picture(tmp_path / "a.png")
    content = coco()
    content["images"][0] |= {"id": "1", "width": "40", "height": "30"}
    content["annotations"][1] |= {"image_id": 1.0, "category_id": "1", "bbox": [str(v) for v in sized(BOXES[1])]}
    content["categories"].append({"id": 2, "name": "rock"})
    written(tmp_path / "annotations.json", content)
    assert only(read_images(tmp_path)) == BOXES
    content["images"].append({"id": 1, "file_name": "b.png"})
    written(tmp_path / "annotations.json", content)
    with pytest.raises(UserError, match="duplicate ids"):
        read_images(tmp_path)


@pytest.mark.parametrize("stated", [{}, {"width": None, "height": 0}, {"width": 40.0}])
def test_sizes_that_are_not_stated(tmp_path, stated):
    picture(tmp_path / "a.png")
    written(tmp_path / "annotations.json", coco(images=[{"id": 1, "file_name": "a.png", **stated}]))
    assert only(read_images(tmp_path)) == BOXES


@pytest.mark.parametrize("empty", [{}, {"bbox": None}, {"bbox": []}])
def test_polygons_without_a_box(tmp_path, empty):
    picture(tmp_path / "a.png")
    polygons = [[[2, 3, 12, 5, 7, 15]], [[20, 10, 30, 10, 30, 15], [22, 18, 25, 22, 28, 20]]]
    rows = [
        {"id": k, "image_id": 1, "category_id": 1, "segmentation": each, **empty} for k, each in enumerate(polygons)
    ]
    written(tmp_path / "annotations.json", coco(annotations=rows))
    assert only(read_images(tmp_path)) == BOXES
    for odd, message in (
        ([[1, 2, 3]], "segmentation: got"),
        ([], "bbox: got"),
        ({"counts": "a", "size": [1, 1]}, "run-length mask"),
        ([["a", "b"]], "no points"),
        ([[1e9, 1]], "too large"),
        (3, "no points"),
    ):
        written(tmp_path / "annotations.json", coco(annotations=[rows[0] | {"segmentation": odd}]))
        with pytest.raises(UserError, match=message):
            read_images(tmp_path)


def test_boxes_end_at_the_edges_of_the_picture(tmp_path, capsys):
    picture(tmp_path / "a.png")
    beyond = [[-5, -5, 10, 12], [35, 20, 20, 20], [50, 1, 5, 5], [-9, 0, 9, 9]]
    rows = [{"id": k, "image_id": 1, "category_id": 1, "bbox": box} for k, box in enumerate(beyond)]
    written(tmp_path / "annotations.json", coco(annotations=rows))
    found = read_images(tmp_path)
    assert found.clipped and only(found) == [[0, 0, 5, 7], [35, 20, 40, 30]]
    assert "2 boxes without width or height in the picture are left out" in " ".join(capsys.readouterr().err.split())


def test_crowds_are_regions(tmp_path):
    picture(tmp_path / "a.png")
    content = coco()
    content["annotations"][0]["iscrowd"] = 1
    content["annotations"][1]["ignore"] = 1
    content["annotations"].append({"id": 9, "image_id": 1, "category_id": 1, "bbox": [1, 1, 9, 9], "iscrowd": "0"})
    written(tmp_path / "annotations.json", content)
    (image,) = read_images(tmp_path).images
    assert image.crowd.tolist() == [True, False, False] and image.not_ignored.tolist() == [False, False, True]


def test_categories_by_name(tmp_path, capsys):
    picture(tmp_path / "a.png")
    content = coco(categories=[{"id": 1, "name": "moon-crater"}, {"id": 2, "name": "boulder"}])
    content["annotations"][1]["category_id"] = 2
    written(tmp_path / "annotations.json", content)
    with pytest.raises(UserError, match=r"categories: got moon-crater, boulder, expected .*--category NAME"):
        read_images(tmp_path)
    for wanted, expected in ((("Moon-Crater",), BOXES[:1]), (("2",), BOXES[1:]), (("moon-crater", "boulder"), BOXES)):
        assert only(read_images(tmp_path, Request(categories=wanted))) == expected
    assert "categories taken as craters: moon-crater (1); left out: boulder (2)" in " ".join(
        capsys.readouterr().err.split()
    )
    with pytest.raises(UserError, match="--category: got craterr, expected one of moon-crater, boulder"):
        read_images(tmp_path, Request(categories=("craterr",)))
    written(tmp_path / "annotations.json", coco(categories=[{"id": 1, "name": "boulder"}]))
    assert read_images(tmp_path).categories == "every object is taken as a crater; their category is boulder"


def test_two_pictures_of_one_file_name_are_refused(tmp_path):
    picture(tmp_path / "a.png")
    written(tmp_path / "annotations.json", coco(("a.png", "a.png")))
    with pytest.raises(UserError, match=r"a\.png: name: got a second image of this name, expected unique file names"):
        read_images(tmp_path)
    written(tmp_path / "annotations.json", coco(("a.png", "./a.png")))
    with pytest.raises(UserError, match="a second image"):
        read_images(tmp_path)


def test_windows_separators_and_a_folder_of_pictures(tmp_path):
    picture(tmp_path / "given" / "deep" / "a.png")
    path = written(tmp_path / "labels" / "coco.json", coco(("deep\\a.png",)))
    with pytest.raises(UserError, match=r"a\.png: image: got no such file, expected .*--image-folder"):
        read_images(path)
    assert only(read_images(path, Request(image_folder=tmp_path / "given"))) == BOXES
    written(path, coco(("../labels/a.png",)))
    with pytest.raises(UserError, match="file_name: got"):
        read_images(path, Request(image_folder=tmp_path / "given"))


# Splits


def roboflow(root, splits=("train", "valid", "test")):
    for split in splits:
        picture(root / split / "a.png")
        content = coco()
        content["annotations"] = content["annotations"][: 2 if split == "test" else 1]
        written(root / split / "_annotations.coco.json", content)
    written(root / "README.dataset.txt", "crater > 2026")


def test_a_split_of_a_folder_of_roboflow(tmp_path, capsys):
    roboflow(tmp_path / "set")
    found = read_images(tmp_path / "set")
    assert only(found) == BOXES and found.split == "split test of test, train, val"
    assert "set: split test of test, train, val" in capsys.readouterr().err
    assert only(read_images(tmp_path / "set", Request(split="val"))) == BOXES[:1]
    assert read_images(tmp_path / "set" / "valid").split == ""
    with pytest.raises(UserError, match="--split: got val, expected a source with splits"):
        read_images(tmp_path / "set" / "valid", Request(split="val"))
    roboflow(tmp_path / "two", ("train", "valid"))
    with pytest.raises(UserError, match="splits: got train, val, expected test among them, or --split"):
        read_images(tmp_path / "two")
    roboflow(tmp_path / "one", ("train",))
    assert only(read_images(tmp_path / "one")) == BOXES[:1]


def test_instances_by_split(tmp_path):
    for split in ("train", "val"):
        picture(tmp_path / "images" / f"{split}2017" / "a.png")
        written(tmp_path / "annotations" / f"instances_{split}2017.json", coco())
    written(tmp_path / "annotations" / "captions_val2017.json", {"images": [], "annotations": []})
    assert only(read_images(tmp_path, Request(split="train"))) == BOXES


# YOLO


@pytest.mark.parametrize("separator", [" ", "\t", "   ", ","])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\n\n"])
def test_rows_of_yolo(tmp_path, separator, end):
    picture(tmp_path / "a.png")
    written(tmp_path / "a.txt", "\ufeff" + yolo_rows(separator, end))
    found = read_images(tmp_path)
    assert found.clipped and np.allclose(only(found), BOXES, atol=1e-6)


def test_other_rows_of_yolo(tmp_path):
    for name in "abc":
        picture(tmp_path / f"{name}.png")
    (x0, y0, x1, y1), _ = BOXES
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (7, 8)]
    polygon = " ".join(f"{x / WIDTH:.9f} {y / HEIGHT:.9f}" for x, y in corners)
    score = yolo_rows(boxes=BOXES[1:]).strip() + " 0.87"
    written(tmp_path / "a.txt", f"0 {polygon}\n{score}\n")
    written(tmp_path / "b.txt", "")
    written(tmp_path / "c.txt", yolo_rows(boxes=[[-4, 5, 10, 15]]))
    images = read_images(tmp_path).images
    assert np.allclose(images[0].boxes, BOXES, atol=1e-6)
    assert images[1].boxes.shape == (0, 4) and np.allclose(images[2].boxes, [[0, 5, 10, 15]], atol=1e-6)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("0 0.5 0.5 0.1", "line 1: got 4 values"),
        ("0 120 80 20 20", "fractions of the image's width and height"),
        ("0 0.5 0.5 0.1 -0.1", "at least 0"),
        ("0 0.5 0.5 nan 0.1", "fractions"),
        ("0 0.1 0.2 0.3 0.4 0.5 0.6 0.7", "8 values"),
        ("1e999 0.5 0.5 0.1 0.1", "numbers: class"),
    ],
)
def test_odd_rows_of_yolo_are_refused(tmp_path, row, message):
    picture(tmp_path / "a.png")
    written(tmp_path / "a.txt", row)
    with pytest.raises(UserError, match=message):
        read_images(tmp_path)


@pytest.mark.parametrize(
    "yaml",
    [
        "train: train/images\nval: valid/images\ntest: test/images\nnames: [crater, rock]\n",
        "train: ../train/images\nval: ../valid/images\ntest: ../test/images\nnc: 2\nnames: ['crater', 'rock']\n",
        "test: list.txt\nnames:\n  0: crater\n  1: rock\n",
        "path: ../datasets/x\ntest: [test/images]\nnames: {0: Crater, 1: rock}\n",
    ],
)
def test_the_layout_of_yolo(tmp_path, yaml):
    picture(tmp_path / "test" / "images" / "deep" / "a.png")
    picture(tmp_path / "test" / "images" / "b.png")
    written(tmp_path / "test" / "labels" / "deep" / "a.txt", yolo_rows() + "1 0.5 0.5 0.2 0.2\n")
    written(tmp_path / "list.txt", "./test/images/deep/a.png\n./test/images/b.png\n")
    written(tmp_path / "data.yaml", yaml)
    for source in (tmp_path, tmp_path / "data.yaml"):
        images = {image.name: image.boxes for image in read_images(source).images}
        assert np.allclose(images["test/images/deep/a.png"], BOXES, atol=1e-6)
        assert images["test/images/b.png"].shape == (0, 4)
    with pytest.raises(UserError, match=r"a folder of images, or a list|expected (train|val) among"):
        read_images(tmp_path, Request(split="val" if "val" not in yaml else "train"))


@pytest.mark.parametrize("value", ["/etc", "../../x", "3", "{}", "data.yaml", "list.txt"])
def test_a_data_yaml_reads_nothing_outside_its_folder(tmp_path, value):
    picture(tmp_path / "x.png")
    root = tmp_path / "a" / "b"
    written(root / "list.txt", "../../x.png\n")
    written(root / "data.yaml", f"test: {value}\nnames: [crater]\n")
    with pytest.raises(UserError):
        read_images(root)


def test_folders_of_images_and_labels_without_a_yaml(tmp_path, capsys):
    picture(tmp_path / "images" / "a.png")
    picture(tmp_path / "images" / "b.png")
    written(tmp_path / "labels" / "a.txt", yolo_rows())
    written(tmp_path / "labels" / "classes.txt", "crater\nrock\n")
    assert np.allclose(only(read_images(tmp_path)), BOXES, atol=1e-6)
    assert "1 images without labels are left out" in " ".join(capsys.readouterr().err.split())


# Pascal VOC, CVAT, LabelMe


def voc(objects, size=(WIDTH, HEIGHT)):
    text = "".join(
        f"<object><name>{name}</name><difficult>{difficult}</difficult><bndbox><xmin>{box[0]}</xmin>"
        f"<ymin>{box[1]}</ymin><xmax>{box[2]}</xmax><ymax>{box[3]}</ymax></bndbox></object>"
        for name, box, difficult in objects
    )
    size = f"<size><width>{size[0]}</width><height>{size[1]}</height><depth>1</depth></size>"
    return f'<?xml version="1.0" encoding="utf-8"?>\n<annotation><filename>a.png</filename>{size}{text}</annotation>'


@pytest.mark.parametrize(
    ("pictures", "labels"),
    [("", ""), ("images", "annotations"), ("JPEGImages", "Annotations"), ("images", "images")],
)
def test_pascal_voc(tmp_path, pictures, labels):
    picture(tmp_path / pictures / "a.png")
    objects = [("crater", BOXES[0], 0), ("crater", BOXES[1], 1), ("rock", BOXES[1], 0)]
    written(tmp_path / labels / "a.xml", voc(objects))
    (image,) = read_images(tmp_path).images
    assert image.boxes.tolist() == BOXES and image.not_ignored.tolist() == [True, False]
    written(tmp_path / labels / "a.xml", voc(objects, (HEIGHT, WIDTH)))
    with pytest.raises(UserError, match=r"a\.png: size: got 40 x 30, expected 30 x 40, as stated in a\.xml"):
        read_images(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<annotation><object/></annotation>", "no <bndbox>"),
        ("<annotation><object><bndbox><xmin>a</xmin></bndbox></object></annotation>", "a number"),
        ("<html/>", "as in Pascal VOC"),
        ("<annotation>", "XML"),
        ('<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><annotation>&x;</annotation>', "a document type"),
    ],
)
def test_odd_xml_is_refused(tmp_path, text, message):
    picture(tmp_path / "a.png")
    written(tmp_path / "a.xml", text)
    with pytest.raises(UserError, match=message):
        read_images(tmp_path)


def test_cvat(tmp_path, capsys):
    picture(tmp_path / "images" / "a.png")
    shapes = (
        '<box label="crater" xtl="2" ytl="3" xbr="12" ybr="15" occluded="0"/>'
        '<polygon label="crater" points="20,10;30,12;24,22"/>'
        '<ellipse label="crater" cx="10" cy="12" rx="4" ry="2"/>'
        '<box label="crater" xtl="20" ytl="5" xbr="24" ybr="13" rotation="90"/>'
        '<points label="crater" points="1,2"/><box label="rock" xtl="1" ytl="1" xbr="9" ybr="9"/>'
    )
    head = "<meta><job><labels><label><name>crater</name></label></labels></job></meta>"
    image = f'<image id="0" name="a.png" width="40" height="30">{shapes}</image>'
    path = written(tmp_path / "annotations.xml", f"<annotations>{head}{image}</annotations>")
    for source in (tmp_path, path):
        assert np.allclose(only(read_images(source)), [*BOXES, [6, 10, 14, 14], [18, 7, 26, 11]])
    said = " ".join(capsys.readouterr().err.split())
    assert "1 points, lines and other shapes without an area are left out" in said and "left out: rock" in said
    written(path, "<annotations><track/></annotations>")
    with pytest.raises(UserError, match="CVAT for video"):
        read_images(tmp_path)
    written(path, f"<annotations>{image.replace('a.png', '../../etc/passwd')}</annotations>")
    with pytest.raises(UserError, match="name: got"):
        read_images(tmp_path)


def test_labelme(tmp_path, capsys):
    picture(tmp_path / "a.png")
    picture(tmp_path / "b.png")
    shapes = [
        {"label": "crater", "shape_type": "rectangle", "points": [[12, 15], [2, 3]]},
        {"label": "crater", "shape_type": "polygon", "points": [[20, 10], [30, 12], [24, 22]]},
        {"label": "crater", "shape_type": "circle", "points": [[10, 12], [13, 16]]},
        {"label": "crater", "shape_type": "point", "points": [[10, 12]]},
        {"label": "rock", "shape_type": "rectangle", "points": [[1, 1], [9, 9]]},
    ]
    content = {"version": "5.4", "shapes": shapes, "imagePath": "..\\a.png", "imageData": "AAAA", "imageWidth": WIDTH}
    written(tmp_path / "a.json", content)
    assert only(read_images(tmp_path)) == [*BOXES, [5, 7, 15, 17]]
    said = " ".join(capsys.readouterr().err.split())
    assert "1 points and lines are left out" in said and "1 images without labels are left out" in said
    for odd in ({"shapes": 3}, {"shapes": [{"points": 3}]}, {"shapes": [{"shape_type": "circle", "points": [[1, 2]]}]}):
        written(tmp_path / "a.json", content | odd)
        with pytest.raises(UserError):
            read_images(tmp_path)


# Folders


def test_hidden_files_and_masks_are_left_out_and_counted(tmp_path, capsys):
    root = tmp_path / "set"
    names = ("a.png", "b.jpg", "a_mask.png", "b.jpg.overlay.png", "B_mask_of_its_own.png", "mask.png")
    for name in names:
        picture(root / name)
    (root / "._a.png").write_bytes(b"\0\5\x16\7")
    (root / "__MACOSX").mkdir()
    assert [path.name for path in pictures_of(root)] == ["B_mask_of_its_own.png", "a.png", "b.jpg", "mask.png"]
    assert "set: 1 hidden files and 2 masks or overlays are left out" in " ".join(capsys.readouterr().err.split())


def test_label_files_that_two_pictures_share_are_refused(tmp_path):
    for name in ("a.png", "a.jpg"):
        picture(tmp_path / name)
    written(tmp_path / "a.txt", yolo_rows())
    with pytest.raises(UserError, match=r"a\.png: labels: got a\.txt, also the label file of a\.jpg"):
        read_images(tmp_path)
    (tmp_path / "a.jpg").unlink()
    written(tmp_path / "a.xml", voc([]))
    with pytest.raises(UserError, match=r"files of 2 kinds: \.txt, \.xml, expected one kind"):
        read_images(tmp_path)


def test_large_and_deep_label_files_are_refused(tmp_path, monkeypatch):
    picture(tmp_path / "a.png")
    texts = sys.modules["perilune_train.detect.images.labels.texts"]
    monkeypatch.setattr(texts, "_MAX_BRACKETS", 100)
    written(tmp_path / "annotations.json", "[" + "[]," * 200 + "[]]")
    with pytest.raises(UserError, match="more than 100 lists and objects"):
        read_images(tmp_path)
    (tmp_path / "annotations.json").unlink()
    written(tmp_path / "a.xml", "<annotation>" + "<a/>" * 200 + "</annotation>")
    with pytest.raises(UserError, match="more than 100 elements"):
        read_images(tmp_path)
