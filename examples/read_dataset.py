"""Read a dataset with PyTorch, and draw its first frame with labels.

python examples/read_dataset.py data/small/detect frame.png
"""

import sys

from torch.utils.data import DataLoader

import perilune

if len(sys.argv) != 3:
    sys.exit("usage: read_dataset.py DATASET PICTURE")
address, picture = sys.argv[1:]
dataset = perilune.open_dataset(address)
dataset[0].plot().save(picture)
frames = dataset.torch(split="train", selection="visible")
for images, targets in DataLoader(frames, batch_size=8, shuffle=True, collate_fn=frames.collate):
    sys.stdout.write(f"{tuple(images.shape)}, {sum(len(target['boxes']) for target in targets)} craters\n")
