#!/usr/bin/env python3
"""What bilateral grids could explain of the colours of rendered views that an affine map for each view does not.

    tests/bench/bilateral_grid.py OUT WORKSPACE…

Needs numpy, scipy and Pillow; writes OUT.json and OUT.md. The held-out views that each workspace has rendered are fitted
to their photos on the white fields of a chessboard of 16 px and scored on the black ones: as they are, with an affine
map of colours (3 × 4), and with bilateral grids of such maps (x, y, brightness), interpolated linearly and drawn to
their neighbours as much as scores best. Fields lie beside each other, so that a grid is shown at its best: what it gains
here, errors of shape that it hides among it, is the most that it could gain in training."""
import argparse
import datetime
import json
import pathlib
import shlex
import statistics
import sys

import numpy
from PIL import Image
from scipy.sparse import block_diag, coo_matrix, hstack, identity, vstack
from scipy.sparse.linalg import splu

FIELD_PX = 16
AFFINE = (1, 1, 1)
GRIDS = [(4, 4, 2), (8, 8, 4), (16, 16, 8)]
SMOOTHNESS = [0.1, 1.0, 10.0]  # relative to a cell's share of the pixels
TO_NONE = 1e-4                 # the same


def image(path):
    return numpy.asarray(Image.open(path).convert("RGB"), dtype=numpy.float64) / 255


def psnr(rendered, truth, where):
    return -10 * numpy.log10(numpy.mean((numpy.clip(rendered, 0, 1)[where] - truth[where]) ** 2))


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


def corrected(rendered, truth, fitted, shape, smoothness):
    """The rendered view with the grid of maps that fits best where `fitted` says."""
    colours = numpy.concatenate([rendered.reshape(-1, 3), numpy.ones((rendered.size // 3, 1))], 1)
    weights = interpolation(rendered, shape)
    design = hstack([weights.multiply(colours[:, k:k + 1]) for k in range(4)]).tocsr()
    share = fitted.sum() / weights.shape[1]
    parts = [design[fitted.ravel()], identity(design.shape[1]) * numpy.sqrt(TO_NONE * share)]
    if shape != AFFINE:
        parts.append(block_diag([differences(shape)] * 4) * numpy.sqrt(smoothness * share))
    stacked = vstack(parts).tocsc()
    solve = splu((stacked.T @ stacked).tocsc()).solve
    result = rendered.copy()
    for channel in range(3):
        residual = (truth - rendered)[..., channel].ravel()[fitted.ravel()]
        result[..., channel] += (design @ solve(parts[0].T @ residual)).reshape(rendered.shape[:2])
    return result


def measure(workspace):
    rows = []
    for path in sorted((workspace / "eval").glob("truth/*.png")):
        truth, rendered = image(path), image(workspace / "render/rgb" / path.name)
        y, x = numpy.mgrid[0:truth.shape[0], 0:truth.shape[1]] // FIELD_PX
        fitted = (x + y) % 2 == 0
        row = {"view": path.stem, "plain": psnr(rendered, truth, ~fitted),
               "affine": psnr(corrected(rendered, truth, fitted, AFFINE, 0), truth, ~fitted)}
        for shape in GRIDS:
            for smoothness in SMOOTHNESS:
                row[f"{'×'.join(map(str, shape))}, {smoothness:g}"] = psnr(
                    corrected(rendered, truth, fitted, shape, smoothness), truth, ~fitted)
        rows.append(row)
    if not rows:
        sys.exit(f"{workspace} has no scored held-out views")
    keys = [key for key in rows[0] if key != "view"]
    return {"capture": workspace.name, "n_views": len(rows), **{key: statistics.mean(row[key] for row in rows) for key in keys}}


def table(result):
    captures = result["captures"]
    lines = ["# What bilateral grids could explain", "",
             f"PSNR in dB of the black fields of a chessboard, colours fitted on the white ones, mean over held-out views "
             f"(`{result['command']}`, {result['date']}). Grids: x × y × brightness, and how much cells are drawn to "
             "their neighbours; in bold the best of a capture.", "",
             "| | " + " | ".join(f"{capture['capture']} ({capture['n_views']})" for capture in captures) + " |",
             "|---|" + "---:|" * len(captures)]
    for key in [key for key in captures[0] if key not in ("capture", "n_views")]:
        cells = [f"**{capture[key]:.2f}**" if key == best(capture) else f"{capture[key]:.2f}" for capture in captures]
        lines.append(f"| {key} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def best(capture):
    return max((key for key in capture if "," in key), key=capture.get)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("workspaces", type=pathlib.Path, nargs="+")
    args = parser.parse_args()
    names = " ".join(shlex.quote(workspace.name) for workspace in args.workspaces)
    result = {"command": f"tests/bench/bilateral_grid.py {args.out.name} {names}",
              "date": datetime.date.today().isoformat(), "captures": []}
    for workspace in args.workspaces:
        result["captures"].append(measure(workspace))
        print(json.dumps(result["captures"][-1]), flush=True)
        args.out.with_suffix(".json").write_text(json.dumps(result, indent=1) + "\n")
        args.out.with_suffix(".md").write_text(table(result))


if __name__ == "__main__":
    main()
