"""Maps over images: attention masks, baselines, attributions, and their pictures."""
