"""A whole run of Rille beside what plain pycolmap takes for the trajectory alone: processor and wall seconds.

    RILLE_DATA=... python benchmarks/colmap_trajectory.py [SEQUENCE] [--frames 51] [--jobs 2]

The street ``kitti06_51`` where RILLE_DATA has it, or the short mockup. COLMAP gets undistorted images as files, the rig
and the intrinsics, which it holds, SIFT with 2000 features from octave 0, left against right and each camera against
three following frames, ``init_min_tri_angle`` .1, the first stereo pair to begin with, and one thread: its defaults
take four times as long and find no model of a street. Rille runs to the report, kernels compiled, from an empty cache.
Each is a process of its own, and its processor time that of all its processes. At last the stages of the run, from its
ledger. Modules are compiled by the first run after an installation, as kernels are: time the second.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

FEATURES, FOLLOWING, MIN_ANGLE_DEG = 2000, 3, 0.1
SIDES = ("left", "right")


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", nargs="?", help="name, folder or manifest")
    parser.add_argument("--frames", type=int, default=51, help="the first so many frames (default 51)")
    parser.add_argument("--jobs", type=int, default=2, help="workers of Rille (default 2)")
    parser.add_argument("--set", action="append", default=[], help="a parameter, section.key=value, of Rille's run")
    parser.add_argument("--colmap", type=Path, help=argparse.SUPPRESS)
    return parser.parse_args()


def written(sequence: Any, frames: range, folder: Path) -> None:
    """Undistorted images, ``left/000000.png``, and the pairs of them that are matched."""
    import cv2
    import numpy as np
    from odometry.chain import Images

    from rille.stages.imaging.features import grey_bytes

    images = Images(sequence, frames)
    for side in SIDES:
        (folder / "images" / side).mkdir(parents=True)
        for k, frame in enumerate(frames):
            image = grey_bytes(np.asarray(images.ideal(frame, side)["image"]))
            cv2.imwrite(str(folder / "images" / side / f"{k:06d}.png"), image)
    pairs = [f"left/{k:06d}.png right/{k:06d}.png" for k in range(len(frames))]
    for side in SIDES:
        for k in range(len(frames)):
            later = range(k + 1, min(k + FOLLOWING + 1, len(frames)))
            pairs += [f"{side}/{k:06d}.png {side}/{j:06d}.png" for j in later]
    (folder / "pairs.txt").write_text("\n".join(pairs) + "\n", encoding="utf-8")


def colmap(folder: Path, rig: Any) -> None:
    """Plain pycolmap, as its documentation has it."""
    import pycolmap

    pycolmap.logging.minloglevel = 2
    database, cameras = folder / "database.db", []
    for side, camera in zip(SIDES, (rig.left, rig.right), strict=True):
        values = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
        known = pycolmap.Camera(model="PINHOLE", width=camera.width, height=camera.height, params=values)
        cameras.append(pycolmap.RigConfigCamera(image_prefix=f"{side}/", camera=known, ref_sensor=side == "left"))
    T = rig.T_right_left
    cameras[1].cam_from_rig = pycolmap.Rigid3d(pycolmap.Rotation3d(T.rotation), T.translation)
    extraction = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=1)
    extraction.sift.first_octave, extraction.sift.max_num_features = 0, FEATURES
    mode = pycolmap.CameraMode.PER_FOLDER
    cpu = pycolmap.Device.cpu
    pycolmap.extract_features(database, folder / "images", [], mode, extraction_options=extraction, device=cpu)
    with pycolmap.Database.open(database) as opened:
        pycolmap.apply_rig_config([pycolmap.RigConfig(cameras=cameras)], opened)
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=1)
    pairing = pycolmap.ImportedPairingOptions(match_list_path=folder / "pairs.txt")
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.num_threads = 1
    pycolmap.match_image_pairs(database, matching, pairing, verification, cpu)
    mapping = pycolmap.IncrementalPipelineOptions(num_threads=1, multiple_models=False, extract_colors=False)
    # Begun with two images of its own choice, a model of a street may end with its first frame.
    with pycolmap.Database.open(database) as opened:
        numbers = {image.name: image.image_id for image in opened.read_all_images()}
    mapping.init_image_id1, mapping.init_image_id2 = (numbers[f"{side}/000000.png"] for side in SIDES)
    mapping.random_seed = mapping.mapper.random_seed = mapping.triangulation.random_seed = 0
    mapping.ba_refine_focal_length = mapping.ba_refine_extra_params = mapping.ba_refine_sensor_from_rig = False
    mapping.mapper.init_min_tri_angle = MIN_ANGLE_DEG
    (folder / "model").mkdir()
    models = pycolmap.incremental_mapping(database, folder / "images", folder / "model", mapping)
    print(f"COLMAP: {max((model.num_reg_frames() for model in models.values()), default=0)} frames have a pose")


def timed(command: list[str]) -> tuple[float, float]:
    """Seconds of the processor, of the command and its processes, and of the wall."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    environment |= {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
    subprocess.run(command, check=True, env=environment)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime, wall


def main() -> None:
    given = arguments()
    from rille.datasets.registry import open_sequence

    street = Path(os.environ.get("RILLE_DATA") or "-") / "kitti06_51"
    name = given.sequence or (str(street) if street.is_dir() else "mockup-short")
    sequence = open_sequence(name)
    if given.colmap:
        colmap(given.colmap, sequence.rig)
        return
    count = min(given.frames, sequence.frames)
    with tempfile.TemporaryDirectory(prefix="rille-bench-") as scratch:
        folder = Path(scratch)
        written(sequence, range(count), folder)
        alone = timed([sys.executable, __file__, name, "--colmap", scratch])
        rille = [sys.executable, "-m", "rille.pipeline.cli"]
        settings = [word for setting in given.set for word in ("--set", setting)]
        run = [*rille, "reconstruct", name, "--frames", f"0:{count}", "--jobs", str(given.jobs), "--quiet", *settings]
        whole = timed([*run, "--cache", str(folder / "cache"), "--runs", str(folder / "runs")])
        print(f"\n{Path(name).name}, {count} frames, {given.jobs} workers\n")
        print("| seconds | processor | wall |\n|---|---|---|")
        for words, (processor, wall) in (("COLMAP, trajectory", alone), ("Rille, to the report", whole)):
            print(f"| {words} | {processor:.1f} | {wall:.1f} |")
        print(f"| ratio | {whole[0] / alone[0]:.2f} | {whole[1] / alone[1]:.2f} |\n", flush=True)
        latest = next((folder / "runs").glob("*/latest"))
        subprocess.run([*rille, "timing", "--run", str(latest.resolve())], check=True)


if __name__ == "__main__":
    main()
