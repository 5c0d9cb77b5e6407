#!/usr/bin/env python3
"""What it is worth to go on from a model when photos are added to a capture, against making everything anew.

    tests/bench/extending.py DATA_DIR OUT.json [--steps 1500] [--first 35] [--size 400] [--work DIR]

DATA_DIR holds scenes/fox with its poses. The stages run, as `nrff run` runs them, on the first photos by name; then all
are in the folder, and they run with --base on what there is, and anew. Both hold out the same photos. Seconds are of
the processors, which other work on the machine hardly changes. What is in --work is not run again, and OUT.md is
written beside OUT.json. Python's standard library only.
"""

import argparse
import datetime
import json
import pathlib
import resource
import shutil
import subprocess
import sys

from captures_table import machine

HERE = pathlib.Path(__file__).resolve().parent
BIN = HERE.parents[1] / "build/bin"
STAGES = {"ingest": "nrff-ingest {photos} {base} --out {out}",
          "sfm": "nrff-pose estimate --ingest {run}/ingest {base} --out {out}",
          "pose": "nrff-pose normalise --ingest {run}/ingest --sfm {run}/sfm {base} --max-image-size {size} --out {out}",
          "train": "nrff-train --scene {run}/pose {base} --preset small --steps {steps} --out {out}",
          "render": "nrff-render --scene {run}/pose --model {run}/train --out {out}",
          "eval": "nrff-eval --scene {run}/pose --renders {run}/render --lpips none --out {out}"}


def processor_seconds():
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def facts_of(run, stage):
    return json.loads((run / stage / "manifest.json").read_text())["facts"]


def run_stages(photos, run, base, args):
    """Processor seconds by stage; kept beside the artifacts."""
    seconds = {}
    for stage, command in STAGES.items():
        cost = run / f"{stage}.seconds"
        if not cost.exists():
            taken = f"--base {base / stage}" if base and stage in ("ingest", "sfm", "pose", "train") else ""
            words = command.format(photos=photos, run=run, out=run / stage, base=taken, size=args.size,
                                   steps=args.steps).split()
            before = processor_seconds()
            if subprocess.run([str(BIN / words[0]), *words[1:], "--quiet"], check=False).returncode != 0:
                sys.exit(" ".join(words) + " failed")
            cost.write_text(str(processor_seconds() - before))
        seconds[stage] = float(cost.read_text())
    return seconds


def row_of(what, run, seconds, truth):
    errors = json.loads(subprocess.run([str(BIN / "nrff-pose"), "compare", "--estimated", str(run / "pose"),
                                        "--truth", str(truth), "--json"], check=True, capture_output=True).stdout)
    sfm, train, evaluation = (facts_of(run, stage) for stage in ("sfm", "train", "eval"))
    metrics = json.loads((run / "eval/metrics.json").read_text())
    return {"what": what, "processor_seconds": seconds, "registered": sfm["n_registered"], "n_images": sfm["n_images"],
            "position_median": errors["position"]["median"], "rotation_deg_median": errors["rotation_deg"]["median"],
            "relative_auc_1": errors["relative_deg"]["auc"]["1"], "steps": train["steps"], "psnr": evaluation["psnr"],
            "ssim": evaluation["ssim"], "held_out": {image["name"]: image["psnr"] for image in metrics["images"]},
            "extension": sfm.get("extension"), "extended": train.get("extended")}


def markdown(results):
    lines = ["# Photos added to a capture: going on against making everything anew", "",
             f"Made by `{results['command']}` with {results['version']} on {results['machine']['cpu']}, "
             f"{results['machine']['cores']} cores, "
             f"{results['date']}: fox, preset small, photos of {results['size']} px, {results['steps']} steps from "
             "scratch. Pose errors are those of `nrff-pose compare` against the poses that come with the scene, "
             "positions in per cent of their radius. Both runs of all photos hold out the same ones; the one that goes on "
             "has the steps of the first run behind it.", "",
             "| photos | registered | sfm, s | train, s | all, s | steps | position | rotation | PSNR | SSIM |",
             "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|"]
    for row in results["rows"]:
        seconds = row["processor_seconds"]
        lines.append(f"| {row['what']} | {row['registered']} of {row['n_images']} | {seconds['sfm']:.0f} | "
                     f"{seconds['train']:.0f} | {sum(seconds.values()):.0f} | {row['steps']} | "
                     f"{100 * row['position_median']:.3f} % | {row['rotation_deg_median']:.3f}° | {row['psnr']:.2f} | "
                     f"{row['ssim']:.4f} |")
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--first", type=int, default=35)
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("work/extending"))
    args = parser.parse_args()
    truth = args.data / "scenes/fox"
    photos = sorted((truth / "images").iterdir())
    version = subprocess.run([str(BIN / "nrff-pose"), "--version"], check=True, capture_output=True, text=True).stdout
    results = {"version": version.split()[-1], "machine": machine(), "date": datetime.date.today().isoformat(),
               "command": f"tests/bench/extending.py DATA_DIR OUT.json --steps {args.steps} --first {args.first} "
                          f"--size {args.size}", "steps": args.steps, "size": args.size, "rows": []}
    folder = args.work / "fox"
    for what, run, base, n in ((f"{args.first}", "first", None, args.first),
                               (f"{len(photos)}, going on from {args.first}", "on", args.work / "first", len(photos)),
                               (f"{len(photos)}, anew", "anew", None, len(photos))):
        folder.mkdir(parents=True, exist_ok=True)
        for photo in photos[:n]:
            shutil.copy(photo, folder / photo.name)
        (args.work / run).mkdir(exist_ok=True)
        seconds = run_stages(folder, args.work / run, base, args)
        results["rows"].append(row_of(what, args.work / run, seconds, truth))
        args.out.write_text(json.dumps(results, indent=1) + "\n")
        args.out.with_suffix(".md").write_text(markdown(results))
    if set(results["rows"][-1]["held_out"]) != set(results["rows"][-2]["held_out"]):
        print("going on and anew hold out different photos: choose another --first", file=sys.stderr)


if __name__ == "__main__":
    main()
