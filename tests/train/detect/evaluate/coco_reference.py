"""Average precision by pycocotools, an independent implementation."""

import contextlib
import io

import numpy as np
from pycocotools import mask
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

IGNORED_AREA = 1e12


def coco_evaluation(found, labels, copies=1):
    """Return the AP at each IoU of COCO, by 101 points and by all points.

    COCOeval uses a higher maxDets and one range of areas. Ignored labels are outside that range, and each is repeated
    `copies` times; with None, once for each detection that may match it.
    """
    images, annotations, results, averages = [], [], [], []
    for frame, (ours, truth) in enumerate(zip(found, labels, strict=True), start=1):
        images.append({"id": frame})
        repeats = _matchable(ours.boxes, truth.boxes) if copies is None else np.full(len(truth.boxes), copies)
        crowds = np.zeros(len(truth.boxes), bool) if truth.crowd is None else truth.crowd
        rows = zip(truth.boxes.tolist(), truth.selected, crowds, repeats, strict=True)
        for (x0, y0, x1, y1), is_selected, is_crowd, repeat in rows:
            for _ in range(1 if is_selected or is_crowd else repeat):
                one = {"id": len(annotations) + 1, "image_id": frame, "category_id": 1, "iscrowd": int(is_crowd)}
                area = (x1 - x0) * (y1 - y0) if is_selected or is_crowd else IGNORED_AREA
                annotations.append({**one, "bbox": [x0, y0, x1 - x0, y1 - y0], "area": area})
        for (x0, y0, x1, y1), score in zip(ours.boxes.tolist(), ours.scores.tolist(), strict=True):
            results.append({"image_id": frame, "category_id": 1, "bbox": [x0, y0, x1 - x0, y1 - y0], "score": score})
    with contextlib.redirect_stdout(io.StringIO()):
        truth_set = COCO()
        truth_set.dataset = {"images": images, "annotations": annotations, "categories": [{"id": 1}], "info": {}}
        truth_set.createIndex()
        evaluation = COCOeval(truth_set, truth_set.loadRes(results), "bbox")
        evaluation.params.maxDets = [100_000]
        evaluation.params.areaRng, evaluation.params.areaRngLbl = [[0, 1e10]], ["all"]
        n_selected = sum(int(part.selected.sum()) for part in labels)
        # Matching does not depend on the recalls.
        evaluation.evaluate()
        # 101 recalls, then every reachable recall; the mean over these is the area under all points.
        for recalls in (np.linspace(0, 1, 101), np.arange(1, n_selected + 1) / n_selected):
            evaluation.params.recThrs = recalls
            evaluation.accumulate()
            averages.append(evaluation.eval["precision"][:, :, 0, 0, 0].mean(axis=1))
    return averages


def _matchable(found, labels):
    """Count the boxes `found` (N, 4) that overlap each label (M, 4) with an IoU of at least 0.5; at least 1."""
    if not len(found) or not len(labels):
        return np.ones(len(labels), int)
    sized = [np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1) for boxes in (found, labels)]
    return np.maximum((mask.iou(*sized, np.zeros(len(labels), np.uint8)) > 0.499).sum(0), 1)
