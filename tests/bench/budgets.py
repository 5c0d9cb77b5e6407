#!/usr/bin/env python3
"""What training for a given time on this CPU is worth: PSNR of the held-out views by budget.

    tests/bench/budgets.py DATA_DIR OUT.json [--budgets 1m 5m ...] [--only NAME ...] [--seeds 0 1 2]

The machine should have nothing else to do. OUT.md is written beside OUT.json; rows of OUT.json that are not measured
again stay, so that it should be of one kind of machine. Workspaces are kept in --work: what is
complete is not run again, and poses are estimated once per capture. Python's standard library only.
"""

import argparse
import datetime
import itertools
import json
import pathlib
import shutil
import subprocess
import sys

from captures_table import machine

HERE = pathlib.Path(__file__).resolve().parent
CAPTURES = {  # name: source, longest side in px, budgets
    "lego": ("scenes/lego_nsvf_400", 200, ["1m", "5m", "20m"]),
    "fox": ("scenes/fox/images", 384, ["1m", "5m"]),
    "maryrose_tnt": ("scenes/maryrose_tnt", 384, ["1m", "5m"]),
    "maryrose": ("photos/maryrose", 384, ["1m", "5m"]),
    "sceaux_castle": ("photos/sceaux_castle", 384, ["1m", "5m"]),
}


def run(nrff, source, workspace, *options):
    command = [nrff, "run", source, "--workspace", workspace, "--quiet", *options]
    done = subprocess.run([str(part) for part in command], check=False)
    if done.returncode != 0:
        sys.exit(f"{' '.join(str(part) for part in command)}: exit code {done.returncode}")


def manifest(workspace, stage):
    return json.loads((workspace / stage / "manifest.json").read_text())


def measure(nrff, source, size, budget, seed, poses, workspace):
    run(nrff, source, poses, "--max-image-size", size, "--until", "pose")
    if not workspace.exists():
        shutil.copytree(poses, workspace)
    run(nrff, source, workspace, "--max-image-size", size, "--budget", budget,
        *(["--seed", str(seed)] if seed else []))
    train, evaluation = manifest(workspace, "train"), manifest(workspace, "eval")
    facts = train["facts"]
    return {
        "date": datetime.date.today().isoformat(), "budget": budget, "seed": seed,
        "psnr": evaluation["facts"]["psnr"], "ssim": evaluation["facts"]["ssim"],
        "n_images": evaluation["facts"]["n_images"], "train_psnr": facts["train_psnr"],
        "seconds_training": facts["seconds_training"], "seconds_evaluating": facts["seconds_evaluating"],
        "steps": facts["steps"], "samples": facts["samples"], "n_parameters": facts["n_parameters"],
        "peak_memory_bytes": train["peak_memory_bytes"], "threads": facts["threads"],
        "seconds_per_view": manifest(workspace, "render")["facts"]["seconds_per_view"],
        "curve": facts["curve"],
    }


def table(result):
    host = result["machine"]
    lines = ["# Quality by training time on a CPU", "",
             f"Made by `tests/bench/budgets.py` with {result['version']} on {host['cpu']}, "
             f"{host['cores']} cores. {result['protocol']}", "",
             "| capture | px | budget | seed | training, s | evaluating, s | steps | PSNR, dB | SSIM | training views, dB | "
             "peak memory, MiB | s a view | date |", "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---|"]
    for capture in result["captures"]:
        for entry in capture["runs"]:
            lines.append(
                f"| {capture['name']} | {capture['max_image_size']} | {entry['budget']} | {entry['seed']} | "
                f"{entry['seconds_training']:.1f} | {entry['seconds_evaluating']:.1f} | {entry['steps']} | "
                f"{entry['psnr']:.2f} | {entry['ssim']:.3f} | {entry['train_psnr']:.2f} | "
                f"{entry['peak_memory_bytes'] >> 20} | {entry['seconds_per_view']:.3f} | {entry['date']} |")
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--budgets", nargs="+", help="instead of each capture's own")
    parser.add_argument("--only", nargs="+", choices=CAPTURES, default=list(CAPTURES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("work/budgets"))
    parser.add_argument("--nrff", type=pathlib.Path, default=HERE / "../../build/bin/nrff")
    arguments = parser.parse_args()
    result = {
        "version": subprocess.run([arguments.nrff, "--version"], capture_output=True, text=True,
                                  check=True).stdout.strip(),
        "machine": machine(),
        "protocol": "Default preset; all held-out views (the data set's test split, or the first of every "
                    "eight photos by name); PSNR per image on 8-bit renderings, then the mean; SSIM on RGB, 11 x 11 "
                    "Gaussian, valid border; \"training views\" is the running mean over the last batches.",
        "captures": json.loads(arguments.out.read_text())["captures"] if arguments.out.exists() else [],
    }
    for name in arguments.only:
        source, size, budgets = CAPTURES[name]
        capture = next((c for c in result["captures"] if c["name"] == name), None)
        if capture is None:
            capture = {"name": name, "source": source, "max_image_size": size, "runs": []}
            result["captures"].append(capture)
        for budget, seed in itertools.product(arguments.budgets or budgets, arguments.seeds):
            workspace = arguments.work / (f"{name}-{budget}" + (f"-seed-{seed}" if seed else ""))
            entry = measure(arguments.nrff, arguments.data / source, size, budget, seed, arguments.work / name, workspace)
            same = [i for i, old in enumerate(capture["runs"]) if (old["budget"], old["seed"]) == (budget, seed)]
            if same:
                capture["runs"][same[0]] = entry
            else:
                capture["runs"].append(entry)
            print(f"{name} {budget}: {entry['psnr']:.2f} dB", flush=True)
            arguments.out.write_text(json.dumps(result, indent=1) + "\n")
            arguments.out.with_suffix(".md").write_text(table(result))


if __name__ == "__main__":
    main()
