#!/usr/bin/env python3
"""Times gsplat on splats of `speed -- export FILE CASE`: a frame, with its backward pass, and with Adam.

    python3 bench/peer_gsplat.py FILE

Needs PyTorch with CUDA, numpy and gsplat. The time includes activations, harmonics of degree 3 and the gradients of all parameters, but
no loss: the gradient of the image is fixed.
"""
import struct
import sys
import time

import numpy as np
import torch
from gsplat import rasterization
from gsplat.optimizers import SelectiveAdam

SECONDS = 1.0
# Negligible, so that the scene does not change.
RATE = 1e-12

device = torch.device("cuda")
raw = open(sys.argv[1], "rb").read()
number, width, height = struct.unpack_from("<3I", raw)
floats = torch.from_numpy(np.frombuffer(raw, dtype="<f4", offset=12).copy()).to(device)
fx, fy, cx, cy = floats[:4].tolist()
view, at = floats[4:20].reshape(1, 4, 4), 20
intrinsics = torch.tensor([[[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]], device=device)


def column(*shape):
    global at
    count = number * int(np.prod(shape))
    values = floats[at : at + count].reshape(number, *shape).clone()
    at += count
    return torch.nn.Parameter(values)


means, quats, scales, opacities, harmonics = (column(*shape) for shape in [(3,), (4,), (3,), (), (16, 3)])
parameters = [means, quats, scales, opacities, harmonics]
v_image = torch.randn(1, height, width, 3, device=device)


def frame():
    return rasterization(
        means, quats, scales.exp(), opacities.sigmoid(), harmonics, view, intrinsics, width, height,
        near_plane=0.01, sh_degree=3, packed=False,
    )


def with_backward():
    for parameter in parameters:
        parameter.grad = None
    image, _, meta = frame()
    image.backward(v_image)
    return meta


def timed(name, work):
    """Prints the median milliseconds with a synchronisation after each call, and the mean of many calls in a row without."""
    for _ in range(5):
        work()
    torch.cuda.synchronize()
    times, started = [], time.perf_counter()
    while time.perf_counter() - started < SECONDS:
        before = time.perf_counter()
        work()
        torch.cuda.synchronize()
        times.append(1e3 * (time.perf_counter() - before))
    started = time.perf_counter()
    for _ in times:
        work()
    torch.cuda.synchronize()
    of_many = 1e3 * (time.perf_counter() - started) / len(times)
    print(f"  {name:<36} {np.median(times):7.2f} ms, of many {of_many:7.2f} ms", flush=True)


def still():
    with torch.no_grad():
        frame()


meta = frame()[2]
visible = int((meta["radii"] > 0).all(-1).sum())
print(f"{number} splats, {width} x {height}: {visible} in view, {meta['isect_ids'].numel()} entries")
timed("a frame", still)
timed("frame and backward", with_backward)
selective = [SelectiveAdam([{"params": [p], "lr": RATE}], eps=1e-15, betas=(0.9, 0.999)) for p in parameters]


def step_selective():
    seen = (with_backward()["radii"] > 0).all(-1).any(0)
    for optimizer in selective:
        optimizer.step(seen)


timed("and Adam of visible splats", step_selective)
fused = torch.optim.Adam([{"params": [p], "lr": RATE} for p in parameters], eps=1e-15, fused=True)


def step_fused():
    with_backward()
    fused.step()


timed("and Adam of all, fused", step_fused)
