#!/usr/bin/env python3
"""What training gains from features that nrff leaves out of some scenes, measured where the decision may be tuned: on
training views that are held out from training, never on the held-out views of the captures.

    tests/bench/features.py DATA_DIR OUT.json [--steps 1500] [--folds 2]

Every run is one thread and a number of steps, so that the figures do not depend on what else the machine does; the runs
of one scene and fold differ in the options alone. OUT.md is written beside OUT.json. Poses are kept in --work, models are trained anew. Python's standard library
only.
"""

import argparse
import concurrent.futures
import datetime
import json
import os
import pathlib
import shutil
import statistics
import struct
import subprocess
import sys

from captures_table import machine

HERE = pathlib.Path(__file__).resolve().parent
DEPTH_RECORD = struct.Struct("<I4f")  # SparseDepth of pipeline/scene.h

CAPTURES = [  # name, source, what is compared
    ("castle", "photos/sceaux_castle", "few"),
    ("kermit", "photos/kermit", "few"),
    ("ET", "photos/ET", "few"),
    ("fox", "scenes/fox/images", "many"),
    ("cup", "colmap_models/cup_simple_pinhole", "many"),
    ("maryrose", "photos/maryrose", "bounded"),
]
ARMS = {
    "plain": ["--sparse-depth", "off", "--fine-levels", "off"],
    "fine": ["--sparse-depth", "off", "--fine-levels", "on"],
    "depth": ["--sparse-depth", "on", "--fine-levels", "off"],
    "depth+fine": ["--sparse-depth", "on", "--fine-levels", "on"],
}
COMPARED = {"few": ["plain", "fine", "depth", "depth+fine"], "many": ["fine", "depth+fine"],
            "bounded": ["fine", "depth+fine"]}


def run(command):
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False,
                          env={**os.environ, "GOMP_SPINCOUNT": "1000"})
    if done.returncode != 0:
        sys.exit(f"{' '.join(str(part) for part in command)}: exit code {done.returncode}\n{done.stderr[-2000:]}")


def hold_out_training_views(source, target, fold):
    """Copies a pose artifact, the true held-out views left out and some training views held out in their place."""
    scene = json.loads((source / "scene.json").read_text())
    kept = [index for index, view in enumerate(scene["views"]) if view["split"] == "train"]
    every = 8 if len(kept) >= 16 else 4
    views = [scene["views"][index] for index in kept]
    for index, view in enumerate(views):
        view["split"] = "test" if index % every == (every // 2 + fold) % every else "train"
    new_index = {old: new for new, old in enumerate(kept)}
    depths = b""
    for view, *rest in DEPTH_RECORD.iter_unpack((source / "depths.bin").read_bytes()):
        new = new_index.get(view)
        if new is not None and views[new]["split"] == "train":
            depths += DEPTH_RECORD.pack(new, *rest)
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    (target / "scene.json").write_text(json.dumps({**scene, "views": views}))
    (target / "depths.bin").write_bytes(depths)
    os.link(source / "images.u8", target / "images.u8")
    manifest = json.loads((source / "manifest.json").read_text())
    manifest["outputs"] = [output for output in manifest["outputs"] if (target / output["path"]).exists()]
    for output in manifest["outputs"]:
        output["size_bytes"] = (target / output["path"]).stat().st_size
    (target / "manifest.json").write_text(json.dumps(manifest))
    return {"n_train": sum(view["split"] == "train" for view in views),
            "n_held_out": sum(view["split"] == "test" for view in views),
            "n_depths": len(depths) // DEPTH_RECORD.size}


def facts_of_training(nrff, scene, out, *options):
    """Of a model trained anew in `out`."""
    shutil.rmtree(out, ignore_errors=True)
    run([nrff.with_name("nrff-train"), "--scene", scene, "--out", out, "--quiet", *options])
    return json.loads((out / "manifest.json").read_text())["facts"]


def train(job):
    nrff, scene, out, arm, steps, seed = job
    facts = facts_of_training(nrff, scene, out, "--steps", steps, "--threads", 1, "--seed", seed, *ARMS[arm])
    print(f"{out.name}: {facts['curve'][-1]['psnr']:.2f} dB", flush=True)
    return {"psnr": facts["curve"][-1]["psnr"], "seconds": facts["seconds_training"],
            "finest_level": facts["settings"]["field"]["max_resolution"]}


def table(result):
    lines = ["# What sparse depths and fine grid levels gain", "",
             f"Made by `tests/bench/features.py` on {result['date']} with {result['version']} on "
             f"{result['machine']['cpu']}, {result['machine']['cores']} cores: {result['protocol']}", "",
             "| capture | training views | PSNR, dB: neither | fine levels | depths | both |", "|---|---:|---:|---:|---:|---:|"]
    for capture in result["captures"]:
        cells = []
        for arm in ARMS:
            runs = [entry["psnr"] for entry in capture["runs"] if entry["arm"] == arm]
            cells.append(f"{statistics.mean(runs):.2f} ({', '.join(f'{psnr:.2f}' for psnr in runs)})" if runs else "–")
        sizes = "/".join(str(fold["n_train"]) for fold in capture["folds"])
        lines.append(f"| {capture['name']} | {sizes} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--steps", type=int, default=1500, help="of each training")
    parser.add_argument("--folds", type=int, default=2, help="choices of held-out training views, each with its seed")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="trainings at a time")
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("work/features"))
    parser.add_argument("--nrff", type=pathlib.Path, default=HERE / "../../build/bin/nrff")
    arguments = parser.parse_args()

    captures, jobs, labels = [], [], []
    for name, source, compared in CAPTURES:
        workspace = arguments.work / name
        run([arguments.nrff, "run", arguments.data / source, "--workspace", workspace, "--until", "pose",
             "--max-image-size", 400, "--quiet"])
        capture = {"name": name, "source": source, "folds": [], "runs": []}
        for fold in range(arguments.folds):
            scene = arguments.work / f"{name}-scene{fold}"
            capture["folds"].append(hold_out_training_views(workspace / "pose", scene, fold))
            for arm in COMPARED[compared]:
                out = arguments.work / f"{name}-{arm}-{fold}"
                jobs.append((arguments.nrff, scene, out, arm, arguments.steps, fold))
                labels.append((capture, arm, fold))
        captures.append(capture)
    with concurrent.futures.ThreadPoolExecutor(arguments.jobs) as pool:
        for (capture, arm, fold), figures in zip(labels, pool.map(train, jobs)):
            capture["runs"].append({"arm": arm, "fold": fold, **figures})
    result = {
        "date": datetime.date.today().isoformat(),
        "version": subprocess.run([arguments.nrff, "--version"], capture_output=True, text=True,
                                  check=True).stdout.strip(),
        "machine": machine(),
        "protocol": f"{arguments.steps} steps of training on one thread, photos of at most 400 px, preset small; PSNR on "
                    "every eighth training view (every fourth of fewer than 16); training leaves those out with the "
                    "depths on their rays, but poses and points were estimated with them; one choice of views and one seed per figure in brackets.",
        "captures": captures,
    }
    arguments.out.write_text(json.dumps(result, indent=1) + "\n")
    arguments.out.with_suffix(".md").write_text(table(result))


if __name__ == "__main__":
    main()
