"""From the network's output to detections: scales, tiles, suppression."""
