#!/usr/bin/env python3
"""Which preset shows more after so many seconds of training: the crossing points in needs::SmallModel.

    tests/bench/presets.py DATA_DIR OUT.json [--budgets 5s 10s 20s] [--presets tiny small] [--only lego fox]

Measured on training views that are held out from training (hold_out_training_views of features.py), never on the
captures' own held-out views. Every training has the whole machine, which should have nothing else to do. OUT.md is
written beside OUT.json; poses are kept in --work, models are trained anew. Python's standard library only.
"""

import argparse
import datetime
import json
import pathlib
import subprocess

from captures_table import machine
from features import facts_of_training, hold_out_training_views, run

HERE = pathlib.Path(__file__).resolve().parent
CAPTURES = {"lego": ("scenes/lego_nsvf_400", 200), "fox": ("scenes/fox/images", 384)}


def train(nrff, scene, out, preset, budget):
    facts = facts_of_training(nrff, scene, out, "--preset", preset, "--budget", budget)
    return {"budget": budget, "preset": preset, "psnr": facts["curve"][-1]["psnr"], "steps": facts["steps"],
            "seconds_training": facts["seconds_training"]}


def table(result):
    lines = ["# Presets by training time", "",
             f"Made by `tests/bench/presets.py` on {result['date']} with {result['version']} on "
             f"{result['machine']['cpu']}, {result['machine']['cores']} cores: {result['protocol']}", "",
             "| capture | training views | budget | preset | steps | PSNR, dB |", "|---|---:|---:|---|---:|---:|"]
    for capture in result["captures"]:
        lines += [f"| {capture['name']} | {capture['fold']['n_train']} | {entry['budget']} | {entry['preset']} | "
                  f"{entry['steps']} | {entry['psnr']:.2f} |" for entry in capture["runs"]]
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--budgets", nargs="+", default=["5s", "10s", "20s"])
    parser.add_argument("--presets", nargs="+", default=["tiny", "small"])
    parser.add_argument("--only", nargs="+", choices=CAPTURES, default=list(CAPTURES))
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("work/presets"))
    parser.add_argument("--nrff", type=pathlib.Path, default=HERE / "../../build/bin/nrff")
    arguments = parser.parse_args()

    result = {
        "date": datetime.date.today().isoformat(),
        "version": subprocess.run([arguments.nrff, "--version"], capture_output=True, text=True,
                                  check=True).stdout.strip(),
        "machine": machine(),
        "protocol": "mean PSNR on a regular eighth of the training views, held out from training (poses were estimated "
                    "with them); seconds of training alone; seed 0.",
        "captures": [],
    }
    for name in arguments.only:
        source, size = CAPTURES[name]
        workspace, scene = arguments.work / name, arguments.work / f"{name}-scene"
        run([arguments.nrff, "run", arguments.data / source, "--workspace", workspace, "--until", "pose",
             "--max-image-size", size, "--quiet"])
        capture = {"name": name, "source": source, "max_image_size": size,
                   "fold": hold_out_training_views(workspace / "pose", scene, fold=0), "runs": []}
        result["captures"].append(capture)
        for budget in arguments.budgets:
            for preset in arguments.presets:
                capture["runs"].append(train(arguments.nrff, scene, arguments.work / f"{name}-{preset}-{budget}", preset,
                                             budget))
                print(f"{name} {preset} {budget}: {capture['runs'][-1]['psnr']:.2f} dB", flush=True)
                arguments.out.write_text(json.dumps(result, indent=1) + "\n")
                arguments.out.with_suffix(".md").write_text(table(result))


if __name__ == "__main__":
    main()
