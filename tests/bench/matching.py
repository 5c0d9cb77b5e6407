#!/usr/bin/env python3
"""Poses by `nrff-pose estimate` beside those of COLMAP's default settings with exhaustive matching, on real captures.

    tests/bench/matching.py DATA_DIR OUT.json [--work DIR] [--bin DIR] [--only NAME …]

DATA_DIR holds photos/maryrose, scenes/fox and colmap_models/cup_simple_pinhole, whose given poses are the truth. Each of
the captures is also estimated under random file names, in which no order is left, and captures of 16 to 500 photos of
the example generator (tests/bench/matching.py makes them small) give the number of pairs by the number of photos. OUT.md
is written beside OUT.json. Finished steps are kept in the work folder and not timed again. Other programs disturb wall
times; the seconds of processor time are the fair comparison. Python's standard library only.
"""

import argparse
import ast
import datetime
import json
import os
import pathlib
import random
import shutil
import struct
import subprocess
import sys
import time

from captures_table import machine

HERE = pathlib.Path(__file__).resolve().parent
CAPTURES = {"maryrose": "photos/maryrose", "fox": "scenes/fox/images", "cup": "colmap_models/cup_simple_pinhole/images"}
ENVIRONMENT = os.environ | {"QT_QPA_PLATFORM": "offscreen"}


def timed(work, name, command):
    """Runs it unless it has finished before. Returns {wall_seconds, cpu_seconds}, the latter with its children's."""
    record = work / f"{name}.seconds.json"
    if not record.is_file():
        print(f"{work.name}: {name} …", file=sys.stderr, flush=True)
        start = time.monotonic()
        with open(work / f"{name}.log", "wb") as log:
            process = subprocess.Popen([str(word) for word in command], stdout=log, stderr=log, env=ENVIRONMENT)
            _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(f"{name} of {work.name} failed with status {process.returncode}; see {work / name}.log")
        record.write_text(json.dumps({"wall_seconds": round(time.monotonic() - start, 1),
                                      "cpu_seconds": round(usage.ru_utime + usage.ru_stime, 1)}))
    return json.loads(record.read_text())


def read_npy(path):
    """A two-dimensional array of doubles as a list of rows."""
    data = path.read_bytes()
    begin = 10 + struct.unpack("<H", data[8:10])[0]
    shape = ast.literal_eval(data[10:begin].decode())["shape"]
    values = struct.unpack(f"<{shape[0] * shape[1]}d", data[begin:])
    return [values[row * shape[1]:(row + 1) * shape[1]] for row in range(shape[0])]


def given_poses(data, name, work):
    """{file name: 3×4 world_from_camera, OpenCV axes} of the poses that came with the capture."""
    if name == "maryrose":  # LLFF: columns down, right, backwards, centre, (height, width, focal)
        photos = sorted(path.name for path in (data / CAPTURES[name]).iterdir())
        rows = read_npy(data / "photos/maryrose_poses_bounds.npy")
        return {photo: [[row[5 * i + 1], row[5 * i], -row[5 * i + 2], row[5 * i + 3]] for i in range(3)]
                for photo, row in zip(photos, rows, strict=True)}
    if name == "fox":  # OpenGL axes
        frames = json.loads((data / "scenes/fox/transforms.json").read_text())["frames"]
        return {pathlib.Path(frame["file_path"]).name: [[row[0], -row[1], -row[2], row[3]]
                                                        for row in frame["transform_matrix"][:3]] for frame in frames}
    subprocess.run(["colmap", "model_converter", "--input_path", data / "colmap_models/cup_simple_pinhole/sparse",
                    "--output_path", work, "--output_type", "TXT"], check=True, capture_output=True, env=ENVIRONMENT)
    lines = [line for line in (work / "images.txt").read_text().splitlines() if not line.startswith("#")]
    poses = {}
    for line in lines[::2]:  # id, quaternion and translation of camera_from_world, camera, name
        fields = line.split()
        w, x, y, z, *t = map(float, fields[1:8])
        camera_from_world = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                             [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                             [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
        poses[pathlib.Path(fields[9]).name] = [
            [camera_from_world[i][j] for i in range(3)] + [-sum(camera_from_world[i][j] * t[i] for i in range(3))]
            for j in range(3)]
    return poses


def write_truth(poses, folder):
    """`poses`: {name: 3×4}; one file each, as `nrff-pose compare` reads them."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, rows in poses.items():
        text = "\n".join(" ".join(repr(x) for x in row) for row in [*rows, [0, 0, 0, 1]])
        (folder / f"{name}.txt").write_text(text + "\n")
    return folder


def compare(binaries, estimated, truth):
    output = subprocess.run([binaries / "nrff-pose", "compare", "--json", "--quiet", "--estimated", estimated, "--truth",
                             truth], check=True, capture_output=True, text=True).stdout
    errors = json.loads(output)
    return {"rotation_deg": errors["rotation_deg"]["median"], "position": errors["position"]["median"],
            "rotation_deg_max": errors["rotation_deg"]["max"], "position_max": errors["position"]["max"],
            "relative_deg": {kind: errors["relative_deg"][kind]["median"] for kind in ["rotation", "direction"]},
            "relative_auc": errors["relative_deg"]["auc"]}


def n_registered(model):
    with open(model / "images.bin", "rb") as file:
        return struct.unpack("<Q", file.read(8))[0]


def colmap_default(work, photos):
    """COLMAP's feature_extractor, exhaustive_matcher and mapper with their default settings."""
    work.mkdir(parents=True, exist_ok=True)
    (work / "sparse").mkdir(exist_ok=True)
    database = work / "database.db"
    if not (work / "matching.seconds.json").is_file():  # a step that was cut short has left rows behind
        database.unlink(missing_ok=True)
        (work / "features.seconds.json").unlink(missing_ok=True)
    steps = {"features": ["feature_extractor", "--image_path", photos, "--SiftExtraction.use_gpu", "0"],
             "matching": ["exhaustive_matcher", "--SiftMatching.use_gpu", "0"],
             "mapping": ["mapper", "--image_path", photos, "--output_path", work / "sparse"]}
    seconds = {step: timed(work, step, ["colmap", *command, "--database_path", database])
               for step, command in steps.items()}
    largest = max((work / "sparse").iterdir(), key=n_registered)
    return largest, {"n_registered": n_registered(largest), "n_models": len(list((work / "sparse").iterdir())),
                     "steps": seconds} | {key: round(sum(step[key] for step in seconds.values()), 1)
                                          for key in ["wall_seconds", "cpu_seconds"]}


def ours(work, photos, binaries):
    """nrff-ingest and nrff-pose estimate. Returns a folder with the model, images called by their ids, and figures."""
    work.mkdir(parents=True, exist_ok=True)
    timed(work, "ingest", [binaries / "nrff-ingest", photos, "--out", work / "ingest"])
    seconds = timed(work, "estimate", [binaries / "nrff-pose", "estimate", "--ingest", work / "ingest", "--out",
                                       work / "sfm"])
    facts = json.loads((work / "sfm/manifest.json").read_text())["facts"]
    return work / "sfm/sparse", seconds | {key: facts[key] for key in ["n_registered", "n_models", "matching"]} | {
        "n_pairs": sum(attempt["n_pairs"] for attempt in facts["attempts"]), "attempts": facts["attempts"],
        "seconds_features": facts["seconds_features"], "seconds_matching": facts["seconds_matching"],
        "seconds_mapping": facts["seconds_mapping"]}
