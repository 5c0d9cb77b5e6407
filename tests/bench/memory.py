#!/usr/bin/env python3
"""Memory of training by the number of photos: what the process allocates, and what it maps of the image pack.

    tests/bench/memory.py OUT.json [--views 10 50 500] [--steps 500] [--work DIR]

Captures of the example scene with exact poses, 400 x 300 px, preset small. `allocated` is the peak of RssAnon in
/proc, read every 20 ms: it cannot be taken back. `mapped` is the peak of RssFile: program, libraries and the pages of
the image pack that were read, which the system drops when it needs them. OUT.md is written beside OUT.json. Python's
standard library only.
"""

import argparse
import datetime
import json
import pathlib
import subprocess
import sys
import time

from captures_table import machine

HERE = pathlib.Path(__file__).resolve().parent


def checked(command, **options):
    done = subprocess.run([str(part) for part in command], check=False, **options)
    if done.returncode != 0:
        sys.exit(f"{' '.join(str(part) for part in command)}: exit code {done.returncode}")


def peaks(command):
    """Peak RssAnon and RssFile of a process, bytes."""
    process = subprocess.Popen([str(part) for part in command])
    peak = {"RssAnon": 0, "RssFile": 0}
    while process.poll() is None:
        try:
            status = pathlib.Path(f"/proc/{process.pid}/status").read_text()
        except OSError:
            break
        for line in status.splitlines():
            name = line.split(":")[0]
            if name in peak:
                peak[name] = max(peak[name], int(line.split()[1]) * 1024)
        time.sleep(0.02)
    if process.wait() != 0:
        sys.exit(f"{' '.join(str(part) for part in command)}: exit code {process.returncode}")
    return {"allocated_bytes": peak["RssAnon"], "mapped_bytes": peak["RssFile"]}


def measure(build, work, n_views, steps):
    capture, workspace, model = work / f"capture-{n_views}", work / f"workspace-{n_views}", work / f"model-{n_views}"
    if not capture.exists():
        checked([build / "make_capture", "--out", capture, "--views", n_views, "--width", 400, "--height", 300,
                 "--samples", 1, "--posed", "--quiet"])
    checked([build / "nrff", "run", capture, "--workspace", workspace, "--until", "pose", "--quiet"])
    result = {"views": n_views, "pack_bytes": (workspace / "pose/images.u8").stat().st_size}
    result |= peaks([build / "nrff-train", "--scene", workspace / "pose", "--out", model, "--steps", steps,
                     "--fine-levels", "on", "--quiet"])
    result["n_parameters"] = json.loads((model / "manifest.json").read_text())["facts"]["n_parameters"]
    return result


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--views", type=int, nargs="+", default=[10, 50, 500])
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("work/memory"))
    parser.add_argument("--build", type=pathlib.Path, default=HERE / "../../build/bin")
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    runs = [measure(arguments.build, arguments.work, n, arguments.steps) for n in arguments.views]
    result = {"date": datetime.date.today().isoformat(), "machine": machine(), "steps": arguments.steps,
              "protocol": " ".join(__doc__.split("\n\n")[2].split()), "runs": runs}
    arguments.out.write_text(json.dumps(result, indent=1) + "\n")
    lines = ["# Memory of training by the number of photos", "",
             f"Made by `tests/bench/memory.py` on {result['date']}, {result['machine']['cpu']}. {result['protocol']}", "",
             "| photos | pack, MiB | parameters | allocated, MiB | mapped, MiB |", "|---:|---:|---:|---:|---:|"]
    lines += [f"| {r['views']} | {r['pack_bytes'] >> 20} | {r['n_parameters']} | {r['allocated_bytes'] >> 20} | "
              f"{r['mapped_bytes'] >> 20} |" for r in runs]
    arguments.out.with_suffix(".md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines[4:]))


if __name__ == "__main__":
    main()
