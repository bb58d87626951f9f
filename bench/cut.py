#!/usr/bin/env python3
"""Makes photographs of many cameras out of those of one: each is cut around its middle to 65 to 100 % of its sides and scaled.

    python3 -m venv venv && venv/bin/pip install pillow
    venv/bin/python bench/cut.py PHOTOS OUT [--same-size] [--seed 1]

Each gets a size of its own, or with --same-size all get 80 % of their first size, so that sizes do not tell cameras apart. The pictures
have no metadata; their places are those of PHOTOS.
"""

import argparse
import pathlib
import random

from PIL import Image

options = argparse.ArgumentParser()
options.add_argument("photos", type=pathlib.Path)
options.add_argument("out", type=pathlib.Path)
options.add_argument("--same-size", action="store_true")
options.add_argument("--seed", type=int, default=1)
options = options.parse_args()

rng = random.Random(options.seed)
options.out.mkdir(parents=True)
taken = set()
for path in sorted(options.photos.iterdir()):
    image = Image.open(path).convert("RGB")
    width, height = image.size
    keep = rng.uniform(0.65, 1)
    cut = [round(width * keep), round(height * keep)]
    left, top = (width - cut[0]) // 2, (height - cut[1]) // 2
    image = image.crop((left, top, left + cut[0], top + cut[1]))
    if options.same_size:
        size = [round(0.8 * width), round(0.8 * height)]
    else:
        scale = min(rng.uniform(0.6, 1) / keep, 1)
        size = [round(side * scale) for side in cut]
        while tuple(size) in taken:
            size[0] -= 1
        taken.add(tuple(size))
    image.resize(size, Image.LANCZOS).save(options.out / f"{path.stem}.jpg", quality=95)
