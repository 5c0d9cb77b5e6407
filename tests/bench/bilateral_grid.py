#!/usr/bin/env python3
"""Whether photos are better brought to one exposure by bilateral grids than by an affine map of colours for each.

    tests/bench/bilateral_grid.py OUT POSE… [--seeds N…] [--steps N] [--bin DIR] [--work DIR]

POSE: artifacts of `nrff-pose normalise`, in workspaces named as their captures. Needs numpy, scipy and Pillow; writes
OUT.json and OUT.md. A model is trained without corrections and renders the training views. Every training photo is then
mapped to what the model shows of it (where the photos agree, each seen by all): not at all, by an affine map of colours
(3 × 4), by bilateral grids of such maps (x, y, brightness), interpolated linearly and drawn to their neighbours. A new
model is trained on the mapped photos, again without corrections. That is one step of what training grids along with the
field does, with the same start for all; held-out photos stay as they are."""
import argparse
import datetime
import json
import pathlib
import shlex
import shutil
import statistics
import subprocess

import numpy
from PIL import Image
from scipy.sparse import block_diag, coo_matrix, hstack, identity, vstack
from scipy.sparse.linalg import splu

ROOT = pathlib.Path(__file__).resolve().parents[2]
AFFINE = (1, 1, 1)
# x, y, brightness; how much cells are drawn to their neighbours, relative to a cell's share of the pixels
MAPS = {"none": None, "affine": (AFFINE, 0), "4×4×2, 1": ((4, 4, 2), 1), "8×8×4, 1": ((8, 8, 4), 1),
        "8×8×4, 10": ((8, 8, 4), 10), "16×16×8, 10": ((16, 16, 8), 10)}
TO_NONE = 1e-4  # how much they are drawn to none, the same


def interpolation(rendered, shape):
    """One row a pixel: its weights on the grid's cells."""
    height, width, _ = rendered.shape
    rows, columns = numpy.mgrid[0:height, 0:width]
    places = [columns / (width - 1), rows / (height - 1), numpy.clip(rendered.mean(axis=2), 0, 1)]
    index, weight = numpy.zeros((height * width, 1), int), numpy.ones((height * width, 1))
    for place, n in zip(places, shape):
        if n == 1:
            continue
        at = place.reshape(-1, 1) * (n - 1)
        low = numpy.minimum(at.astype(int), n - 2)
        index = numpy.hstack([index * n + low, index * n + low + 1])
        weight = numpy.hstack([weight * (1 - at + low), weight * (at - low)])
    pixel = numpy.repeat(numpy.arange(height * width), index.shape[1])
    return coo_matrix((weight.ravel(), (pixel, index.ravel())), (height * width, int(numpy.prod(shape)))).tocsr()


def differences(shape):
    """One row for each two cells beside each other."""
    cells = numpy.arange(numpy.prod(shape)).reshape(shape)
    pairs = numpy.concatenate([
        numpy.stack([numpy.take(cells, range(n - 1), axis).ravel(), numpy.take(cells, range(1, n), axis).ravel()], 1)
        for axis, n in enumerate(shape)])
    row, ones = numpy.arange(len(pairs)), numpy.ones(len(pairs))
    return coo_matrix((numpy.concatenate([ones, -ones]), (numpy.tile(row, 2), pairs.T.ravel())),
                      (len(pairs), cells.size)).tocsr()


def mapped(photo, shown, shape, smoothness):
    """The photo by the grid of maps that brings it nearest to what is shown; both [height, width, 3], 0 to 1."""
    colours = numpy.concatenate([photo.reshape(-1, 3), numpy.ones((photo.size // 3, 1))], 1)
    weights = interpolation(photo, shape)
    design = hstack([weights.multiply(colours[:, k:k + 1]) for k in range(4)]).tocsr()
    share = len(colours) / weights.shape[1]
    parts = [design, identity(design.shape[1]) * numpy.sqrt(TO_NONE * share)]
    if shape != AFFINE:
        parts.append(block_diag([differences(shape)] * 4) * numpy.sqrt(smoothness * share))
    stacked = vstack(parts).tocsc()
    solve = splu((stacked.T @ stacked).tocsc()).solve
    result = photo.copy()
    for channel in range(3):
        residual = (shown - photo)[..., channel].ravel()
        result[..., channel] += (design @ solve(design.T @ residual)).reshape(photo.shape[:2])
    return result


def read(path):
    with open(path) as file:
        return json.load(file)


def train(scene, out, seed, args):
    if not (out / "manifest.json").exists():
        subprocess.run([args.bin / "nrff-train", "--scene", scene, "--out", out, "--steps", str(args.steps), "--seed",
                        str(seed), "--exposure-correction", "off", "--quiet"], check=True)
    return out


def with_mapped_photos(pose, renders, into, how):
    """A copy of the artifact whose training photos are mapped to the renders."""
    shutil.copytree(pose, into, dirs_exist_ok=True)
    pack = numpy.fromfile(pose / "images.u8", dtype=numpy.uint8)
    for view in read(pose / "scene.json")["views"]:
        if view["split"] != "train":
            continue
        height, width, channels = view["height"], view["width"], view["channels"]
        pixels = pack[view["pack_offset"]:][:height * width * channels].reshape(height, width, channels)
        shown = numpy.asarray(Image.open(renders / "rgb" / f"{view['id']}.png").convert("RGB")) / 255
        result = mapped(pixels[..., :3] / 255, shown, *how)
        pixels[..., :3] = numpy.clip(numpy.round(result * 255), 0, 255)
    pack.tofile(into / "images.u8")
    return into


def measure(pose, args):
    name = pose.parent.name
    work = args.work.resolve() / name
    rows = []
    for label, how in MAPS.items():
        runs = []
        for seed in args.seeds:
            first = train(pose, work / f"first-{seed}", seed, args)
            renders = work / f"renders-{seed}"
            if not renders.exists():
                subprocess.run([args.bin / "nrff-render", "--scene", pose, "--model", first, "--out", renders,
                                "--split", "train", "--quiet"], check=True)
            out = work / f"{label}-{seed}"
            scene = pose if how is None else with_mapped_photos(pose, renders, out / "pose", how)
            model = train(scene, out / "train", seed + 100, args)
            for command in (["nrff-render", "--scene", pose, "--model", model, "--out", out / "render", "--quiet"],
                            ["nrff-eval", "--scene", pose, "--renders", out / "render", "--out", out / "eval",
                             "--lpips", "none", "--quiet"]):
                subprocess.run([args.bin / command[0], *command[1:]], check=True)
            metrics = read(out / "eval/metrics.json")["metrics"]
            runs.append({"psnr": metrics["psnr"], "ssim": metrics["ssim"], **metrics["variants"]})
        rows.append({"map": label, "runs": runs})
        print(name, label, " ".join(f"{run['psnr']:.2f}" for run in runs), flush=True)
    return {"capture": name, "rows": rows}


def table(result):
    lines = ["# Bilateral grids or affine maps of colours", "",
             f"`{result['command']}`, {result['date']}: models trained on photos mapped to what a first model shows of "
             f"them, {result['steps']} steps of the preset small each, means over {len(result['seeds'])} seed(s). PSNR of "
             "held-out views, dB: as they are, of their right halves, and of these with colours fitted (an affine map) "
             "on the left halves. Grids: x × y × brightness, and how much cells are drawn to their neighbours.", "",
             "| capture | map | PSNR (each seed) | right half | colours fitted | SSIM |", "|---|---|---:|---:|---:|---:|"]
    for capture in result["captures"]:
        for row in capture["rows"]:
            mean = {key: statistics.mean(run[key] for run in row["runs"]) for key in row["runs"][0]
                    if all(isinstance(run.get(key), float) for run in row["runs"])}
            each = ", ".join(f"{run['psnr']:.2f}" for run in row["runs"])
            lines.append(f"| {capture['capture']} | {row['map']} | {mean['psnr']:.2f} ({each}) | "
                         f"{mean['psnr_right_half']:.2f} | {mean['psnr_colour_fitted']:.2f} | {mean['ssim']:.4f} |")
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("poses", type=pathlib.Path, nargs="+")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--bin", type=pathlib.Path, default=ROOT / "build/bin")
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("bilateral-work"))
    args = parser.parse_args()
    names = " ".join(shlex.quote(f"{pose.parent.name}/pose") for pose in args.poses)
    result = {"command": f"tests/bench/bilateral_grid.py {args.out.name} {names}", "steps": args.steps,
              "seeds": args.seeds, "date": datetime.date.today().isoformat(), "captures": []}
    for pose in args.poses:
        result["captures"].append(measure(pose, args))
        args.out.with_suffix(".json").write_text(json.dumps(result, indent=1) + "\n")
        args.out.with_suffix(".md").write_text(table(result))


if __name__ == "__main__":
    main()
