#!/usr/bin/env python3
"""Poses by `nrff-pose estimate` beside those of COLMAP's default settings with exhaustive matching, on real captures.

    tests/bench/matching.py DATA_DIR OUT.json [--work DIR] [--bin DIR] [--only NAME …]

DATA_DIR holds photos/maryrose, scenes/fox and colmap_models/cup_simple_pinhole, whose given poses are the truth. Each of
the captures is also estimated under random file names, in which no order is left, and captures of 16 to 500 photos of
the example generator give the number of pairs by the number of photos. OUT.md is written beside OUT.json. Finished
steps are kept in the work folder and not timed again; captures that are not run keep their rows. Other programs
disturb wall times; the seconds of processor time are the fair comparison. Python's standard library only.
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
PAIRS = "pairs"  # of made captures, by the number of photos
NAMES = [*CAPTURES, "maryrose-shuffled", "fox-shuffled", PAIRS]
NUMBERS_OF_PHOTOS = [16, 32, 64, 128, 256, 500]
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
    work.mkdir(parents=True, exist_ok=True)
    subprocess.run(["colmap", "model_converter", "--input_path", data / "colmap_models/cup_simple_pinhole/sparse/0",
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


def ours(work, photos, binaries, *options):
    """nrff-ingest and nrff-pose estimate. Returns a folder with the model, images called by their ids, and figures."""
    work.mkdir(parents=True, exist_ok=True)
    timed(work, "ingest", [binaries / "nrff-ingest", photos, "--out", work / "ingest"])
    seconds = timed(work, "estimate", [binaries / "nrff-pose", "estimate", "--ingest", work / "ingest", "--out",
                                       work / "sfm", *options])
    facts = json.loads((work / "sfm/manifest.json").read_text())["facts"]
    return work / "sfm/sparse", seconds | {key: facts[key] for key in ["n_registered", "n_models", "matching"]} | {
        "n_pairs": sum(attempt["n_pairs"] for attempt in facts["attempts"] if attempt["seconds"] > 0), "attempts": facts["attempts"],
        "seconds_features": facts["seconds_features"], "seconds_matching": facts["seconds_matching"],
        "seconds_mapping": facts["seconds_mapping"]}


def photos_of(data, name, work):
    """The folder of photos, and {name of a photo's file: its name in the data}; of "NAME-shuffled" a copy."""
    source = data / CAPTURES[name.removesuffix("-shuffled")]
    names = sorted(path.name for path in source.iterdir())
    if not name.endswith("-shuffled"):
        return source, {file: file for file in names}
    generator = random.Random(7)
    renamed = {f"{generator.getrandbits(64):016x}{pathlib.Path(file).suffix}": file for file in names}
    copy_photos(source, renamed, work / "photos")
    return work / "photos", renamed


def copy_photos(source, renamed, folder):
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, file in renamed.items():
        shutil.copyfile(source / file, folder / name)


def ids_of(ingest):
    """{id: file name}"""
    images = json.loads((ingest / "capture.json").read_text())["images"]
    return {image["id"]: image["path"] for image in images}


def run_capture(data, name, work, binaries):
    base = name.removesuffix("-shuffled")
    photos, original = photos_of(data, name, work)
    poses = given_poses(data, base, work)
    default_model, default = colmap_default(work.parent / base / "colmap-default", data / CAPTURES[base])
    by_name = {pathlib.Path(file).stem: pose for file, pose in poses.items()}
    default["errors"] = compare(binaries, default_model, write_truth(by_name, work / "truth-by-name"))

    def estimated(folder, *options):
        model, nrff = ours(work / folder, photos, binaries, *options)
        by_id = {image: poses[original[file]] for image, file in ids_of(work / folder / "ingest").items()}
        # Copied out of the artifact, whose images are known to be called by ids.
        shutil.copytree(model, work / folder / "model", dirs_exist_ok=True)
        nrff["errors"] = compare(binaries, work / folder / "model", write_truth(by_id, work / "truth-by-id"))
        return nrff

    nrff = estimated("nrff")
    simple = estimated("nrff-simple", "--refinement", "off", "--camera-model", "SIMPLE_RADIAL")
    n_images = len(original)
    return {"capture": name, "n_images": n_images, "n_all_pairs": n_images * (n_images - 1) // 2,
            "colmap_default": default, "nrff": nrff, "nrff_simple": simple,
            "ratio": {key: round(nrff[key] / default[key], 3) for key in ["wall_seconds", "cpu_seconds"]}}


# COLMAP's features alone: pairs are written down instead of matched, and nothing is mapped.
PAIRS_ALONE = """#!/bin/sh
[ "$2" = --help ] && exec colmap "$@"
case $1 in
  matches_importer)
    while [ "$1" != --match_list_path ]; do shift; done
    exec cat "$2" >>"$PAIRS" ;;
  mapper) echo 'failed to create a sparse model'; exit 1 ;;
esac
exec colmap "$@"
"""


def count_pairs(n_images, work, binaries):
    """Pairs chosen for so many photos of the example scene, 320×240 px, in order and under random names."""
    work.mkdir(parents=True, exist_ok=True)
    script = work / "colmap"
    script.write_text(PAIRS_ALONE)
    script.chmod(0o755)
    timed(work, "make", [binaries / "make_capture", "--out", work / "capture", "--views", n_images, "--width", 320,
                         "--height", 240, "--samples", 1])
    files = sorted(path.name for path in (work / "capture/photos").iterdir())
    generator = random.Random(n_images)
    copy_photos(work / "capture/photos", {f"{generator.getrandbits(64):016x}.jpg": file for file in files},
                work / "shuffled")
    row = {"n_images": n_images, "n_all_pairs": n_images * (n_images - 1) // 2}
    for order, photos in {"ordered": work / "capture/photos", "shuffled": work / "shuffled"}.items():
        ingest, sfm = work / order / "ingest", work / order / "sfm"
        pairs = work / order / "pairs.txt"
        if not pairs.is_file():
            subprocess.run([binaries / "nrff-ingest", photos, "--out", ingest, "--quiet"], check=True)
            subprocess.run([binaries / "nrff-pose", "estimate", "--ingest", ingest, "--out", sfm, "--quiet",
                            "--sfm-image-size", "320"], capture_output=True,
                           env=ENVIRONMENT | {"NRFF_COLMAP": str(script), "PAIRS": str(pairs)})
        row[order] = len(set(pairs.read_text().splitlines()))
    return row


def table(result):
    when = "; ".join(f"{row['capture']}: {row['date']}, {row['machine']['cpu']}, {row['machine']['cores']} cores"
                     for row in result["captures"])
    lines = [f"Poses by `nrff-pose estimate` beside COLMAP {result['colmap_version']}'s default settings with exhaustive "
             f"matching (`tests/bench/matching.py DATA_DIR OUT.json`; {when}).", "",
             "Other programs ran on these cores: processor seconds are the fair comparison. Errors are against the poses "
             "that came with the captures: medians after alignment, positions in thousandths of the cameras' radius. "
             "`simple` is nrff with COLMAP's SIMPLE_RADIAL lens and last adjustment, neither chosen nor refined. Pairs "
             "that are verified again with another lens count twice.", "",
             "| capture | photos | registered: COLMAP | nrff | pairs: all | nrff | CPU s: COLMAP | nrff | ratio | "
             "simple | rotation °: COLMAP | nrff | simple | position ‰: COLMAP | nrff | "
             "simple |",
             "|---|" + "---:|" * 15]
    for row in result["captures"]:
        default, nrff, simple = row["colmap_default"], row["nrff"], row["nrff_simple"]
        rotations = " | ".join(f"{one['errors']['rotation_deg']:.3f}" for one in [default, nrff, simple])
        positions = " | ".join(f"{1e3 * one['errors']['position']:.2f}" for one in [default, nrff, simple])
        lines.append(
            f"| {row['capture']} | {row['n_images']} | {default['n_registered']} | {nrff['n_registered']} | "
            f"{row['n_all_pairs']} | {nrff['n_pairs']} | {default['cpu_seconds']:.0f} | {nrff['cpu_seconds']:.0f} | "
            f"{row['ratio']['cpu_seconds']:.2f} | {simple['cpu_seconds']:.0f} | {rotations} | {positions} |")
    if not result["pairs_by_photos"]:
        return "\n".join(lines) + "\n"
    lines += ["", "Pairs by the number of photos: the example generator's scene at 320×240 px, in order and under random "
              "names.", "",
              "| photos | all pairs | in order | a photo | random names | a photo |", "|---:|---:|---:|---:|---:|---:|"]
    for row in result["pairs_by_photos"]:
        cells = " | ".join(f"{row[order]} | {row[order] / row['n_images']:.1f}" for order in ["ordered", "shuffled"])
        lines.append(f"| {row['n_images']} | {row['n_all_pairs']} | {cells} |")
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("work/matching"))
    parser.add_argument("--bin", type=pathlib.Path, default=HERE / "../../build/bin")
    parser.add_argument("--only", nargs="+", choices=NAMES, default=NAMES, metavar="NAME")
    options = parser.parse_args()
    binaries, work = options.bin.resolve(), options.work.resolve()
    version = subprocess.run(["colmap", "help"], capture_output=True, text=True, env=ENVIRONMENT).stdout
    result = json.loads(options.out.read_text()) if options.out.exists() else {"captures": [], "pairs_by_photos": []}
    rows = {row["capture"]: row for row in result["captures"]}
    host = {"date": datetime.date.today().isoformat(), "machine": machine()}
    for name in options.only:
        if name != PAIRS:
            rows[name] = run_capture(options.data.resolve(), name, work / name, binaries) | host
    if PAIRS in options.only:
        result["pairs_by_photos"] = [count_pairs(n, work / f"pairs-{n}", binaries) for n in NUMBERS_OF_PHOTOS]
    result = {"schema_version": 2, "colmap_version": version.split()[1], "pairs_by_photos": result["pairs_by_photos"],
              "captures": [rows[name] for name in NAMES if name in rows]}
    options.out.write_text(json.dumps(result, indent=1) + "\n")
    options.out.with_suffix(".md").write_text(table(result))
    print(table(result))


if __name__ == "__main__":
    main()
