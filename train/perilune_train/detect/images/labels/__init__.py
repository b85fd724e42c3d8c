"""Label files of other tools: COCO, YOLO, Pascal VOC, CVAT, LabelMe and tables of boxes."""
