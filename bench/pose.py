#!/usr/bin/env python3
"""Poses the same photographs with `irradia pose` and with COLMAP, and compares time, registration and relative poses.

    python3 -m venv venv && venv/bin/pip install pycolmap numpy pillow
    venv/bin/python bench/pose.py target/release/irradia PHOTOS [PHOTOS ..]

COLMAP runs on the CPU with its defaults (SIFT, exhaustive matching, incremental mapping), one camera for all photographs, with the lens
model that irradia chose, since two lens models differ more than two programs do. A second COLMAP run against the first shows how far two
runs with the same features differ. A third one, on mirrored photographs, whose features differ as those of two programs do, shows the
effect of noise in features. AUC@t is the area under the recall of relative poses, the error of a pair
being the larger of the angles between rotations and between directions of translation, up to t degrees, in per cent; a photograph
without a pose counts as wrong.
"""

import itertools
import json
import multiprocessing
import pathlib
import resource
import shutil
import subprocess
import sys
import tempfile
import time

import numpy as np
import pycolmap
from PIL import Image, ImageOps


def timed(work):
    """Wall and CPU seconds of `work`, which runs in child processes."""
    cpu = lambda: sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])
    start, before = time.perf_counter(), cpu()
    work()
    return time.perf_counter() - start, cpu() - before


def run_irradia(program, photos, out):
    command = [program, "pose", photos, "--out", out]
    quiet = subprocess.DEVNULL
    seconds = timed(lambda: subprocess.run(command, check=True, stdout=quiet, stderr=quiet))
    report = json.loads((out / "pose.json").read_text())
    stages = {stage["name"]: stage["seconds"] for stage in report["stages"]}
    return seconds, stages, pycolmap.Reconstruction(out / "sparse" / "0")


def run_colmap(photos, out, lens):
    """Runs COLMAP in a child process, so that its CPU time can be measured."""
    def work():
        child = multiprocessing.get_context("spawn").Process(target=colmap, args=(photos, out, lens))
        child.start()
        child.join()

    seconds = timed(work)
    models = [pycolmap.Reconstruction(model) for model in out.glob("[0-9]*")]
    model = max(models, key=lambda model: model.num_reg_images(), default=pycolmap.Reconstruction())
    return seconds, json.loads((out / "stages.json").read_text()), model


def colmap(photos, out, lens):
    pycolmap.logging.minloglevel = 2
    out.mkdir()
    database = out / "database.db"
    times = [time.perf_counter()]
    pycolmap.extract_features(
        database,
        photos,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=pycolmap.ImageReaderOptions(camera_model=lens),
        device=pycolmap.Device.cpu,
    )
    times.append(time.perf_counter())
    pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
    times.append(time.perf_counter())
    pycolmap.incremental_mapping(database, photos, out)
    times.append(time.perf_counter())
    names = ["features", "matches", "poses"]
    stages = {name: b - a for name, a, b in zip(names, times, times[1:])}
    (out / "stages.json").write_text(json.dumps(stages))


def mirrored(photos, out):
    out.mkdir()
    for file in photos.iterdir():
        if file.suffix.lower() in (".jpg", ".jpeg", ".png"):
            picture = ImageOps.exif_transpose(Image.open(file)).convert("RGB")
            ImageOps.mirror(picture).save(out / f"{file.stem}.png")
    return out


def poses(model, mirror=np.eye(3)):
    """Rotation camera-from-world and centre, by name without extension."""
    found = {}
    for image in model.images.values():
        if image.has_pose:
            rotation = mirror @ image.cam_from_world().rotation.matrix() @ mirror
            found[pathlib.Path(image.name).stem] = (rotation, mirror @ image.projection_center())
    return found


def angle(cosine):
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def pair_errors(truth, other):
    errors = []
    for a, b in itertools.combinations(sorted(truth), 2):
        if a not in other or b not in other:
            errors.append(180.0)
            continue
        relative = [of[b][0] @ of[a][0].T for of in (truth, other)]
        direction = [of[a][0] @ (of[b][1] - of[a][1]) for of in (truth, other)]
        lengths = [np.linalg.norm(d) for d in direction]
        rotation = angle((np.trace(relative[0].T @ relative[1]) - 1.0) / 2.0)
        translation = angle(direction[0] @ direction[1] / max(lengths[0] * lengths[1], 1e-12))
        errors.append(max(rotation, translation))
    return np.array(errors)


def auc(errors, threshold):
    return 100.0 * np.mean(np.maximum(0.0, 1.0 - errors / threshold)) if len(errors) else 0.0


def main():
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    program = pathlib.Path(sys.argv[1]).resolve()
    for photos in map(pathlib.Path, sys.argv[2:]):
        folder = pathlib.Path(tempfile.mkdtemp())
        try:
            ours = run_irradia(program, photos, folder / "irradia")
            lens = next(iter(ours[2].cameras.values())).model.name
            colmap = run_colmap(photos, folder / "colmap", lens)
            again = run_colmap(photos, folder / "again", lens)
            mirror = run_colmap(mirrored(photos, folder / "mirrored"), folder / "mirror", lens)
            count = sum(1 for file in photos.iterdir() if file.suffix.lower() in (".jpg", ".jpeg", ".png"))
            print(f"{photos}: {count} photographs, {lens}")
            for name, ((wall, cpu), stages, model) in (("irradia", ours), ("COLMAP", colmap), ("COLMAP again", again)):
                times = ", ".join(f"{stage} {value:.1f}" for stage, value in stages.items())
                focal = np.mean([camera.mean_focal_length() for camera in model.cameras.values()] or [0.0])
                print(
                    f"  {name:13} {wall:6.1f} s, {cpu:.1f} s of CPU ({times}); {model.num_reg_images()} registered, "
                    f"{model.num_points3D()} points, {model.compute_mean_reprojection_error():.2f} px, focal {focal:.1f}"
                )
            truth = poses(colmap[2])
            others = [("irradia", poses(ours[2])), ("COLMAP again", poses(again[2]))]
            others.append(("COLMAP, mirrored", poses(mirror[2], np.diag([-1.0, 1.0, 1.0]))))
            for name, found in others:
                errors = pair_errors(truth, found)
                print(f"  {name} against COLMAP: AUC@1 {auc(errors, 1):.1f}, AUC@5 {auc(errors, 5):.1f}, median {np.median(errors):.3f} degrees")
        finally:
            shutil.rmtree(folder)


if __name__ == "__main__":
    main()
