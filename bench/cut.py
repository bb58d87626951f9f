#!/usr/bin/env python3
"""Simulates photographs of many cameras from those of one: each is cropped around its centre to 65 to 100 % of its sides and scaled.

    python3 -m venv venv && venv/bin/pip install pillow
    venv/bin/python bench/cut.py PHOTOS OUT [--same-size | --beside each|alike] [--seed 1]

Each gets a different size, or with --same-size all get 80 % of their original size, so that sizes do not tell cameras apart. With --beside
they are cropped off-centre and not scaled: each at a random position, or all to 75 % of each side at the lower left corner. The
results have no metadata; their camera positions are those of PHOTOS.
"""

import argparse
import pathlib
import random

from PIL import Image

options = argparse.ArgumentParser()
options.add_argument("photos", type=pathlib.Path)
options.add_argument("out", type=pathlib.Path)
kind = options.add_mutually_exclusive_group()
kind.add_argument("--same-size", action="store_true")
kind.add_argument("--beside", choices=["each", "alike"])
options.add_argument("--seed", type=int, default=1)
options = options.parse_args()

rng = random.Random(options.seed)
options.out.mkdir(parents=True)
taken = set()
for path in sorted(options.photos.iterdir()):
    image = Image.open(path).convert("RGB")
    width, height = image.size
    keep, before = rng.uniform(0.65, 1), (0.5, 0.5)
    if options.beside == "each":
        before = rng.random(), rng.random()
    elif options.beside == "alike":
        keep, before = 0.75, (0, 1)
    cut = [round(width * keep), round(height * keep)]
    left, top = int((width - cut[0]) * before[0]), int((height - cut[1]) * before[1])
    image = image.crop((left, top, left + cut[0], top + cut[1]))
    if options.beside:
        size = cut
    elif options.same_size:
        size = [round(0.8 * width), round(0.8 * height)]
    else:
        scale = min(rng.uniform(0.6, 1) / keep, 1)
        size = [round(side * scale) for side in cut]
        while tuple(size) in taken:
            size[0] -= 1
        taken.add(tuple(size))
    image.resize(size, Image.LANCZOS).save(options.out / f"{path.stem}.jpg", quality=95)
