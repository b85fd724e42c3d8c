"""Detection in images of any size: overlapping tiles, several scales, one list of boxes.

The network was trained on frames of one size, each normalised by its mean and standard deviation. So an image is cut
into tiles of that size, and each tile is normalised separately. Where tiles overlap, a box is taken from the tile whose
borders are farthest from the box: near a border the network does not see whole craters. Keeping the boxes of both tiles
would add false positives.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.config import COARSEST_STRIDE
from perilune_train.detect.evaluate.boxes import suppress
from perilune_train.detect.evaluate.matching import Detections, joined_detections
from perilune_train.detect.inference.detector import Detector
from perilune_train.detect.inference.scales import Enlarged, resized
from perilune_train.detect.inference.suppression import detections_of
from perilune_train.detect.inference.tiling import Tiling

Array = NDArray[np.float64]
_MAX_TOGETHER = 5_000
"""Largest number of boxes that are suppressed together; more boxes are suppressed block by block."""
_MAX_ENLARGED_PIXELS = 2**27
"""An image that would have more pixels when enlarged is enlarged tile by tile."""
_TOLERANCE_PX = 2.0
"""Tolerance of the distance to a tile's border. Two tiles detect a crater at slightly different positions; without a
tolerance both could drop it."""


def tile_starts(length_px: int, tile_px: int, overlap_px: int) -> NDArray[np.intp]:
    """Starts of the tiles along a side, evenly spaced, pixels; the tiles reach both edges of the image."""
    if length_px <= tile_px:
        return np.zeros(1, np.intp)
    count = -(-(length_px - overlap_px) // (tile_px - overlap_px))
    return np.rint(np.linspace(0, length_px - tile_px, count)).astype(np.intp)


def padded(image: NDArray[np.uint8], tile_px: int) -> NDArray[np.uint8]:
    """Pad an image at right and bottom with reflected pixels.

    Only sides that are shorter than a tile and not a multiple of 32 are padded.
    """
    more = [max(0, min(tile_px, -(-side // COARSEST_STRIDE) * COARSEST_STRIDE) - side) for side in image.shape]
    return np.pad(image, [(0, more[0]), (0, more[1])], mode="reflect") if any(more) else image


def count_tiles(height_px: int, width_px: int, tiling: Tiling) -> int:
    """Number of tiles of an image, summed over all scales."""
    return sum(
        len(tile_starts(round(height_px * s), tiling.tile_px, tiling.overlap_px))
        * len(tile_starts(round(width_px * s), tiling.tile_px, tiling.overlap_px))
        for s in tiling.scales_of(height_px, width_px)
    )


def detect_image(
    detector: Detector, image: NDArray[np.uint8], tiling: Tiling, advance: Callable[[int], object] = lambda n: None
) -> Detections:
    """Detections in an image (height, width) of any size, best first.

    `advance(n)` is called after every n tiles. For an image of the size of one tile at scale 1, the detections equal
    the result of `detect_at_scales`. The novelty of the image is the median over its tiles at scale 1.
    """
    height, width = image.shape
    parts: list[Detections] = []
    novelty: list[float] = []
    scales = tiling.scales_of(height, width)
    for scale in scales:
        size = max(round(width * scale), 1), max(round(height * scale), 1)
        large = scale > 1 and size[0] * size[1] > _MAX_ENLARGED_PIXELS and min(size) >= tiling.tile_px
        scaled = Enlarged(image, *size) if large else resized(image, *size)
        whole = scaled if isinstance(scaled, Enlarged) else padded(scaled, tiling.tile_px)
        for detections in _detect_tiles(detector, whole, tiling, advance, with_novelty=scale == 1):
            if detections.novelty is not None:
                novelty.append(detections.novelty)
            inside = np.ones(len(detections.scores), bool)
            if whole.shape != scaled.shape:
                # Drop craters in the reflected padding.
                inside = ((detections.boxes[:, :2] + detections.boxes[:, 2:]) / 2 < size).all(axis=1)
            if scale < min(1, max(scales)):
                sides_px = np.maximum(detections.boxes[:, 2:] - detections.boxes[:, :2], 0)
                inside &= np.sqrt(sides_px.prod(axis=1)) / 2 >= tiling.min_coarse_radius_px
            parts.append(detections.take(inside).divided(size[0] / width, size[1] / height))
    every = joined_detections(parts)
    found = every.take(suppress_in_blocks(every.boxes, every.scores, detector.config.evaluation.nms_iou))
    margin = tiling.box_margin_px * np.array([-1, -1, 1, 1])
    found = replace(found, boxes=found.boxes + margin, novelty=float(np.median(novelty)) if novelty else None)
    return detector.calibrated(found)


def suppress_in_blocks(boxes: Array, scores: Array, threshold_iou: float, block_px: float = 512.0) -> NDArray[np.intp]:
    """Non-maximum suppression of any number of boxes (N, 4): indices of the kept boxes, best first.

    The time of `suppress` grows with the square of the number of boxes. Many boxes are therefore suppressed block by
    block of the image. Each block also includes the boxes centred within a margin around it: half a block or half the
    side of the largest box, whichever is larger (the IoU of boxes with centres farther apart is below 0.5). Boxes
    larger than a block are suppressed separately, because a margin for them would put every box into every block; each
    group also includes the boxes of the other group that are close enough in size to suppress its boxes. The result
    differs from `suppress` only if a long chain of boxes that suppress each other crosses a block.
    """
    if len(boxes) <= _MAX_TOGETHER:
        return suppress(boxes, scores, threshold_iou, len(boxes))
    # The IoU of two boxes is at most the ratio of their areas.
    size, similar = np.sqrt((boxes[:, 2:] - boxes[:, :2]).prod(axis=1)), np.sqrt(threshold_iou)
    is_large = size > block_px
    among = np.flatnonzero(size > similar * block_px)
    chosen = among[suppress(boxes[among], scores[among], threshold_iou, len(among))]
    kept = [chosen[is_large[chosen]]]
    among = np.flatnonzero(size <= block_px / similar)
    centre = (boxes[among, :2] + boxes[among, 2:]) / 2
    margin = max(block_px / 2, float((boxes[among, 2:] - boxes[among, :2]).max(initial=0)) / 2)
    for block in np.unique(np.floor(centre / block_px), axis=0):
        low, high = block * block_px, (block + 1) * block_px
        near = among[((centre >= low - margin) & (centre < high + margin)).all(axis=1)]
        chosen = near[suppress(boxes[near], scores[near], threshold_iou, len(near))]
        middle = (boxes[chosen, :2] + boxes[chosen, 2:]) / 2
        kept.append(chosen[((middle >= low) & (middle < high)).all(axis=1) & ~is_large[chosen]])
    every = np.concatenate(kept)
    return every[np.argsort(-scores[every], kind="stable")]


def _detect_tiles(
    detector: Detector,
    image: NDArray[np.uint8] | Enlarged,
    tiling: Tiling,
    advance: Callable[[int], object],
    *,
    with_novelty: bool,
) -> Iterator[Detections]:
    """Detections of each tile, in pixels of the whole image, without boxes that another tile keeps."""
    tops, lefts = (tile_starts(side, tiling.tile_px, tiling.overlap_px) for side in image.shape)
    corners = [(int(top), int(left)) for top in tops for left in lefts]
    tile_h, tile_w = (min(tiling.tile_px, side) for side in image.shape)
    for first in range(0, len(corners), detector.config.batch_size):
        batch = corners[first : first + detector.config.batch_size]
        tiles = np.stack([image[top : top + tile_h, left : left + tile_w] for top, left in batch])
        if with_novelty:
            boxes, scores, shapes, novelty = detector.predict_with_novelty(tiles)
        else:
            (boxes, scores, shapes), novelty = detector.predict(tiles), None
        predictions = detections_of(boxes, scores, detector.config.evaluation, shapes)
        for number, (corner, in_tile) in enumerate(zip(batch, predictions, strict=True)):
            in_tile = replace(in_tile, novelty=None if novelty is None else novelty[number])
            detections = in_tile.moved(corner[1], corner[0])
            clear = [
                _clearance(detections.boxes[:, [axis, axis + 2]], starts, length, image.shape[1 - axis])
                for axis, starts, length in ((0, lefts, tile_w), (1, tops, tile_h))
            ]
            column, row = int(np.searchsorted(lefts, corner[1])), int(np.searchsorted(tops, corner[0]))
            clearance = np.minimum(clear[0][:, column], clear[1][:, row])
            best = np.minimum(clear[0].max(axis=1), clear[1].max(axis=1))
            kept = clearance >= best - _TOLERANCE_PX
            yield detections.take(kept)
        advance(len(batch))


def _clearance(spans: Array, starts: NDArray[np.intp], tile_px: int, length_px: int) -> Array:
    """Distance (D, T) from spans (D, 2) along one axis to the nearest border of each tile.

    Tile borders at the edge of the image do not count.
    """
    low = np.where(starts > 0, spans[:, :1] - starts, np.inf)
    high = np.where(starts + tile_px < length_px, starts + tile_px - spans[:, 1:], np.inf)
    return np.minimum(low, high)
