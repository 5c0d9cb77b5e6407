#!/usr/bin/env python3
"""Poses of captures that are hard on SfM: lenses that distort, several cameras, zoomed and turned photos, and two or
three captures in one folder.

    tests/bench/hard_captures.py DATA OUT [--only NAME…] [--work DIR] [--bin DIR]

DATA holds photos/ and scenes/; "none" leaves real captures out. Writes OUT.json and OUT.md after each row; of rows that
are not run, what OUT.json has is kept. Pose errors are medians after alignment to the truth of made captures."""
import argparse
import datetime
import json
import pathlib
import shutil
import subprocess
import time

import captures_table

ROOT = pathlib.Path(__file__).resolve().parents[2]
SIZE = ["--views", "20"]


def made(*arguments):
    def into(folder, data, bin):
        if not (folder / "truth").exists():
            subprocess.run([bin / "make_capture", "--out", folder, "--quiet", *SIZE, *arguments], check=True)
        return folder / "photos"
    return into


def mixed(**parts):
    """Photos of each, so many of them by name, under its name and theirs."""
    def into(folder, data, bin):
        if data is None:
            return None
        if not folder.exists():
            folder.mkdir(parents=True)
            for name, (path, n) in parts.items():
                for photo in sorted((data / path).iterdir())[:n]:
                    shutil.copy(photo, folder / f"{name}_{photo.name}")
        return folder
    return into


SIMPLE = ("SIMPLE_RADIAL", ["--camera-model", "SIMPLE_RADIAL"])
AUTO = ("chosen", [])
# name, capture, variants: name and options of `nrff-pose estimate`
CASES = [
    ("pinhole", made(), [SIMPLE, AUTO]),
    ("moustache", made("--lens", "brown"), [SIMPLE, AUTO]),
    ("wide", made("--lens", "wide"), [SIMPLE, AUTO]),
    ("wide, no EXIF", made("--lens", "wide", "--no-focal"), [SIMPLE, AUTO]),
    ("fisheye", made("--lens", "fisheye"), [SIMPLE, AUTO, ("OPENCV_FISHEYE", ["--camera-model", "OPENCV_FISHEYE"])]),
    ("fisheye, no EXIF", made("--lens", "fisheye", "--no-focal"), [SIMPLE, AUTO]),
    ("two cameras", made("--second-camera"), [AUTO]),
    ("turned", made("--turned"), [AUTO]),
    ("two cameras, turned", made("--second-camera", "--turned"), [AUTO]),
    ("zoom, 3 settings", made("--zoom", "3"), [AUTO]),
    ("zoom, 20 settings", made("--zoom", "20"), [AUTO]),
    ("zoom, no EXIF", made("--zoom", "20", "--no-focal"), [("shared", ["--own-focal-lengths", "off"]), AUTO]),
    ("EXIF jitters", made("--focal-jitter"), [AUTO]),
    ("kermit + ET", mixed(kermit=("photos/kermit", 11), ET=("photos/ET", 9)), [AUTO]),
    ("kermit + ET + castle", mixed(kermit=("photos/kermit", 11), ET=("photos/ET", 9),
                                   castle=("photos/sceaux_castle", 11)), [AUTO]),
    ("fox + maryrose", mixed(fox=("scenes/fox/images", 18), maryrose=("photos/maryrose", 16)), [AUTO]),
    ("fox + cup", mixed(fox=("scenes/fox/images", 18), cup=("colmap_models/cup_simple_pinhole/images", 16)), [AUTO]),
]


def read(path):
    with open(path) as file:
        return json.load(file)


def measure(case, variant, args):
    name, capture, _ = case
    label, options = variant
    work = args.work / name.replace(" ", "-").replace(",", "")
    folder = capture(work / "capture", args.data, args.bin)
    if folder is None:
        return None
    row = {"capture": name, "variant": label}
    subprocess.run([args.bin / "nrff-ingest", folder, "--out", work / "ingest", "--quiet"], check=True)
    row["n_cameras"] = read(work / "ingest" / "manifest.json")["facts"]["n_cameras"]
    out, start = work / f"sfm-{label}", time.time()
    result = subprocess.run([args.bin / "nrff-pose", "estimate", "--ingest", work / "ingest", "--out", out, "--threads",
                             "2", "--quiet", *options], capture_output=True, text=True)
    row["seconds"] = time.time() - start
    if result.returncode:
        row["error"] = result.stderr.strip().replace(str(args.work), "…")
        return row
    facts = read(out / "manifest.json")["facts"]
    row |= {key: facts.get(key) for key in ("n_images", "n_registered", "n_points", "reprojection_error_px", "groups",
                                            "groups_advice", "camera_models", "field_of_view_deg", "lens_trials")}
    row["attempts"] = [[attempt["settings"], attempt["n_registered"], attempt["seconds"]]
                       for attempt in facts["attempts"]]
    truth = folder.parent / "truth"
    if truth.exists():
        errors = json.loads(subprocess.run([args.bin / "nrff-pose", "compare", "--estimated", out, "--truth", truth,
                                            "--json", "--quiet"], check=True, capture_output=True, text=True).stdout)
        row |= {"position": errors["position"]["median"], "rotation_deg": errors["rotation_deg"]["median"]}
    return row


def number(value, digits):
    return "–" if value is None else f"{value:.{digits}f}"


def markdown(rows):
    machines = sorted({f"{row['machine']} on {row['date']}" for row in rows})
    lines = ["# Captures that are hard on SfM", "",
             f"Made by `tests/bench/hard_captures.py` on {'; '.join(machines)}. Made captures: 20 photos of "
             "640×480 px of a still life, cameras some 3 units from it; pose errors in its units and degrees, median "
             "after alignment to the truth. Other work ran on the machine: seconds are no measure.", "",
             "| capture | lenses | cameras | registered | points | reprojection, px | position | rotation, ° | "
             "field, ° | model | held out, px | s |", "|---|---|---:|---:|---:|---:|---:|---:|---:|---|---|---:|"]
    said = []
    for row in rows:
        if row.get("error"):
            lines.append(f"| {row['capture']} | {row['variant']} | {row['n_cameras']} | none | | | | | | | | "
                         f"{row['seconds']:.0f} |")
            said.append(f"**{row['capture']}** ({row['variant']}) ends with: {row['error']}")
            continue
        trials = ", ".join(f"{trial['camera_model']} {trial['error_px']:.3f}" for trial in row["lens_trials"])
        lines.append(f"| {row['capture']} | {row['variant']} | {row['n_cameras']} | {row['n_registered']} of "
                     f"{row['n_images']} | {row['n_points']} | {row['reprojection_error_px']:.3f} | "
                     f"{number(row.get('position'), 5)} | {number(row.get('rotation_deg'), 4)} | "
                     f"{row['field_of_view_deg']:.0f} | {', '.join(row['camera_models'])} | {trials} | "
                     f"{row['seconds']:.0f} |")
        if row.get("groups"):
            groups = "; ".join(f"{g['n_images']} photos, {g['n_points']} points: {g['photos']}" for g in row["groups"])
            tried = ", ".join(f"{name}: {n} placed" for name, n, _ in row["attempts"])
            said.append(f"**{row['capture']}** falls into {groups}. {row['groups_advice']}. Attempts: {tried}.")
    for text in said:
        lines += ["", text]
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=lambda text: None if text == "none" else pathlib.Path(text))
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--only", nargs="+", default=[])
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("hard-captures-work"))
    parser.add_argument("--bin", type=pathlib.Path, default=ROOT / "build" / "bin")
    args = parser.parse_args()
    args.work = args.work.resolve()
    host = {"machine": "{cpu}, {cores} cores".format(**captures_table.machine()), "date": str(datetime.date.today())}
    found = read(args.out.with_suffix(".json"))["rows"] if args.out.with_suffix(".json").exists() else []
    rows = {(row["capture"], row["variant"]): row for row in found}
    for case in CASES:
        for variant in case[2]:
            if args.only and case[0] not in args.only and f"{case[0]}/{variant[0]}" not in args.only:
                continue
            row = measure(case, variant, args)
            if row is None:
                continue
            rows[case[0], variant[0]] = row | host
            print(json.dumps({key: value for key, value in row.items() if key != "groups"}, ensure_ascii=False),
                  flush=True)
            ordered = [rows[c[0], v[0]] for c in CASES for v in c[2] if (c[0], v[0]) in rows]
            args.out.with_suffix(".json").write_text(
                json.dumps({"rows": ordered}, indent=1, ensure_ascii=False) + "\n")
            args.out.with_suffix(".md").write_text(markdown(ordered))


if __name__ == "__main__":
    main()
