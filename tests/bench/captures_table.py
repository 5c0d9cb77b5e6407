"""Writes what captures.sh found as JSON and as a table for people. Python's standard library only."""

import argparse
import datetime
import json
import os
import pathlib
import platform
import re

STAGES = ["ingest", "sfm", "pose", "train", "render", "eval"]


def machine():
    cpu = platform.processor() or platform.machine()
    memory_bytes = None
    for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            cpu = line.split(":", 1)[1].strip()
            break
    for line in pathlib.Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemTotal:"):
            memory_bytes = int(line.split()[1]) * 1024
    return {"cpu": cpu, "cores": len(os.sched_getaffinity(0)), "memory_bytes": memory_bytes,
            "os": f"{platform.system()} {platform.release()}"}


def read_json(path):
    return json.loads(path.read_text()) if path.is_file() else {}


def last_error(path, data):
    errors = [line for line in path.read_text(errors="replace").splitlines() if line.startswith("error: ")]
    # Where the data and the log lie says nothing to a reader of the table.
    return re.sub(r" \(log: [^()]*\)$", "", errors[-1].removeprefix("error: ")).replace(data, "") if errors else None


def collect(workspaces, data, name, source):
    workspace = workspaces / name
    exit_code = int((workspaces / f"{name}.exit").read_text())
    manifests = {stage: read_json(workspace / stage / "manifest.json") for stage in STAGES}
    facts = {stage: manifest.get("facts", {}) for stage, manifest in manifests.items()}
    made = {stage: manifest for stage, manifest in manifests.items() if manifest}
    posed = facts["ingest"].get("posed")
    return {
        "name": name,
        "source": source,
        "exit_code": exit_code,
        "error": last_error(workspaces / f"{name}.stderr", data) if exit_code else None,
        "n_images": facts["ingest"].get("n_images"),
        "n_test": facts["ingest"].get("n_test"),
        "poses": {True: "given", False: "COLMAP", None: None}[posed],
        "n_registered": facts["sfm"].get("n_registered"),
        "reprojection_error_px": facts["sfm"].get("reprojection_error_px"),
        "seconds": {stage: manifest["seconds"] for stage, manifest in made.items()},
        "peak_memory_bytes": max((manifest["peak_memory_bytes"] for manifest in made.values()), default=None),
        "width": facts["pose"].get("width"),
        "height": facts["pose"].get("height"),
        "unbounded": facts["pose"].get("unbounded"),
        "psnr": facts["eval"].get("psnr"),
        "ssim": facts["eval"].get("ssim"),
        "training_steps": facts["train"].get("steps"),
        "training_seconds": facts["train"].get("seconds_training"),
        "preset": facts["train"].get("preset"),
    }


def text(value, form="{}"):
    return "–" if value is None else form.format(value)


def table(result):
    host = result["machine"]
    lines = [
        "# Real captures", "",
        f"Made by `tests/bench/captures.sh` on {result['date']} with nrff {result['version']}: `{result['command']}`",
        f"on {host['cpu']}, {host['cores']} cores, {host['memory_bytes'] / 2**30:.1f} GiB, no GPU used.", "",
        "| capture | registered | size, px | " + " | ".join(f"{stage}, s" for stage in STAGES) +
        " | steps | training, s | held out | PSNR, dB | SSIM | memory, MiB |",
        "|---|---|---|" + "---:|" * (len(STAGES) + 6),
    ]
    for capture in result["captures"]:
        registered = {"given": "given", "COLMAP": f"{capture['n_registered'] or 0} of {capture['n_images']}", None: "–"}
        memory = capture["peak_memory_bytes"]
        cells = [capture["name"], registered[capture["poses"]],
                 text(capture["width"] and f"{capture['width']}×{capture['height']}")]
        cells += [text(capture["seconds"].get(stage), "{:.1f}") for stage in STAGES]
        cells += [text(capture["training_steps"]), text(capture["training_seconds"], "{:.0f}"), text(capture["n_test"]),
                  text(capture["psnr"], "{:.2f}"), text(capture["ssim"], "{:.4f}"),
                  text(memory and memory / 2**20, "{:.0f}")]
        lines.append("| " + " | ".join(cells) + " |")
    failed = [capture for capture in result["captures"] if capture["exit_code"]]
    if failed:
        lines += ["", "Failed:", ""]
        lines += [f"- {capture['name']} (exit code {capture['exit_code']}): {capture['error']}" for capture in failed]
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ["workspaces", "data", "out", "version", "command", "captures"]:
        parser.add_argument(f"--{name}", required=True)
    arguments = parser.parse_args()
    rows = [line.split() for line in arguments.captures.splitlines() if line.strip()]
    result = {
        "schema_version": 1,
        "date": datetime.date.today().isoformat(),
        "version": arguments.version,
        "command": arguments.command.strip(),
        "machine": machine(),
        "captures": [collect(pathlib.Path(arguments.workspaces), arguments.data, *row) for row in rows],
    }
    out = pathlib.Path(arguments.out)
    out.write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n")
    out.with_suffix(".md").write_text(table(result))
    print(table(result), end="")


if __name__ == "__main__":
    main()
