#!/usr/bin/env python3
"""Whether training depends on the units and the origin of a capture's poses: scenes as they are, scaled and shifted.

    tests/bench/moved_scenes.py DATA_DIR OUT.json [--steps 2000] [--seeds 0 1 2] [--work DIR]

DATA_DIR holds scenes/lego_nsvf_400, scenes/fox and scenes/maryrose_tnt. Every scene is trained with its poses as given
and once more with the same seed, which shows what the order of threads changes, then with the world scaled by 1e-4 and
1e4, and shifted by 1e6 along every axis. Poses are rewritten in the capture's own format with all digits of a double.
OUT.md is written beside OUT.json. Python's standard library only.
"""

import argparse
import datetime
import json
import pathlib
import shutil
import statistics
import subprocess
import sys

from captures_table import machine

HERE = pathlib.Path(__file__).resolve().parent
SCENES = ["lego_nsvf_400", "fox", "maryrose_tnt"]
VARIANTS = {"as given": (1, 0), "again": (1, 0), "scaled by 1e-4": (1e-4, 0), "scaled by 1e4": (1e4, 0),
            "shifted by 1e6": (1, 1e6)}


def move_transforms(source, target, move):
    scene = json.loads(source.read_text())
    for frame in scene["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] = move(row[3])
    target.write_text(json.dumps(scene))


def move_nsvf_pose(source, target, move):
    rows = [[float(x) for x in line.split()] for line in source.read_text().splitlines() if line.strip()]
    for row in rows[:3]:
        row[3] = move(row[3])
    target.write_text("\n".join(" ".join(repr(x) for x in row) for row in rows) + "\n")


def move_box(source, target, move, scale):
    box = [float(x) for x in source.read_text().split()]
    target.write_text(" ".join(repr(x) for x in [move(x) for x in box[:6]] + [scale * x for x in box[6:]]) + "\n")


def moved_capture(source, target, scale, shift):
    """The capture with x → scale · x + shift; images are links."""
    def move(x):
        return scale * x + shift

    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    for entry in sorted(source.iterdir()):
        if entry.name.startswith("transforms") and entry.suffix == ".json":
            move_transforms(entry, target / entry.name, move)
        elif entry.name == "bbox.txt":
            move_box(entry, target / entry.name, move, scale)
        elif entry.name == "pose":
            (target / "pose").mkdir()
            for pose in entry.iterdir():
                move_nsvf_pose(pose, target / "pose" / pose.name, move)
        elif entry.name in ("rgb", "images", "intrinsics.txt"):
            (target / entry.name).symlink_to(entry.resolve())


def measure(nrff, capture, workspace, steps, seed):
    command = [nrff, "run", capture, "--workspace", workspace, "--quiet", "--max-image-size", "200", "--steps", steps,
               "--seed", seed, "--until", "eval"]
    if subprocess.run([str(part) for part in command], check=False).returncode != 0:
        sys.exit(" ".join(str(part) for part in command) + " failed")
    facts = json.loads((workspace / "eval/manifest.json").read_text())["facts"]
    return {"seed": seed, "psnr": facts["psnr"], "ssim": facts["ssim"]}


def mean(runs):
    return statistics.mean(run["psnr"] for run in runs)


def table(result):
    host = result["machine"]
    lines = ["# Scenes in other units and far from their origin", "",
             f"Made by `tests/bench/moved_scenes.py` with {result['version']} on {host['cpu']}, {host['cores']} cores, "
             f"{result['date']}. {result['protocol']}", "",
             "| scene | world | PSNR by seed, dB | mean | from as given |", "|---|---|---|---:|---:|"]
    for scene in result["scenes"]:
        given = mean(scene["variants"]["as given"])
        for name, runs in scene["variants"].items():
            by_seed = ", ".join(f"{run['psnr']:.2f}" for run in runs)
            lines.append(f"| {scene['name']} | {name} | {by_seed} | {mean(runs):.2f} | {mean(runs) - given:+.3f} |")
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("work/moved_scenes"))
    parser.add_argument("--nrff", type=pathlib.Path, default=HERE / "../../build/bin/nrff")
    arguments = parser.parse_args()
    result = {
        "date": datetime.date.today().isoformat(), "machine": machine(),
        "version": subprocess.run([arguments.nrff, "--version"], capture_output=True, text=True,
                                  check=True).stdout.strip(),
        "protocol": f"Default preset, {arguments.steps} steps, 200 px, all held-out views, several threads (whose order "
                    "is not that of the run before: \"again\" is what that changes).",
        "scenes": [],
    }
    for scene in SCENES:
        entry = {"name": scene, "variants": {}}
        result["scenes"].append(entry)
        for name, (scale, shift) in VARIANTS.items():
            capture = arguments.work / "captures" / f"{scene} {name}".replace(" ", "-")
            moved_capture(arguments.data / "scenes" / scene, capture, scale, shift)
            entry["variants"][name] = []
            for seed in arguments.seeds:
                workspace = arguments.work / f"{capture.name}-{seed}"
                entry["variants"][name].append(measure(arguments.nrff, capture, workspace, arguments.steps, seed))
                print(f"{scene}, {name}, seed {seed}: {entry['variants'][name][-1]['psnr']:.3f} dB", flush=True)
            arguments.out.write_text(json.dumps(result, indent=1) + "\n")
            arguments.out.with_suffix(".md").write_text(table(result))


if __name__ == "__main__":
    main()
