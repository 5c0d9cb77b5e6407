#!/usr/bin/env python3
"""What each facility for real captures is worth: the same training without and with it, on captures that need it.

    tests/bench/facilities.py DATA OUT [--only CAPTURE|FACILITY|FACILITY/CAPTURE…] [--seeds N…] [--steps N] [--work DIR]

DATA holds photos/, scenes/ and colmap_models/ as tests/bench/captures.sh wants them; "none" leaves real captures out.
Writes OUT.json and OUT.md, after each capture; of captures that are not run, what OUT.json has is kept. Poses are
estimated once for each set of options that they depend on; training, rendering
and scoring are done for every seed. Pose errors are against the truth of made captures. Needs the built programs in
build/bin."""
import argparse
import datetime
import json
import math
import pathlib
import random
import shutil
import statistics
import subprocess

import captures_table

ROOT = pathlib.Path(__file__).resolve().parents[2]
BIN = ROOT / "build" / "bin"


def make(arguments):
    def into(folder, data):
        if not (folder / "truth").exists():
            subprocess.run([BIN / "make_capture", "--out", folder, "--quiet", *arguments], check=True)
        return folder / "photos"
    return into


def real(path):
    return lambda folder, data: data / path if data else None


def ffmpeg(*arguments):
    subprocess.run(["ffmpeg", "-nostdin", "-v", "error", "-y", *map(str, arguments)], check=True)


def fox_video(folder, data):
    """The photos of fox as a video in which every photo is four frames in random order: twice as it is, twice blurred."""
    photos = sorted((data / "scenes/fox/images").iterdir()) if data else []
    video = folder / "fox.mp4"
    if not photos or video.exists():
        return video if photos else None
    frames = folder / "frames"
    frames.mkdir(parents=True, exist_ok=True)
    order, n = random.Random(1), 0
    for photo in photos:
        kinds = ["sharp", "sharp", "blurred", "blurred"]
        order.shuffle(kinds)
        for kind in kinds:
            n += 1
            ffmpeg("-i", photo, *(["-vf", "gblur=sigma=5"] if kind == "blurred" else []), "-q:v", "1",
                   frames / f"{n:05d}.jpg")
    ffmpeg("-framerate", "12", "-i", frames / "%05d.jpg", "-c:v", "libx264", "-crf", "14", "-pix_fmt", "yuv420p", video)
    return video


def every_fourth(folder, data):
    """As many frames of that video, by their number alone."""
    video = fox_video(folder, data)
    photos = folder / "every-fourth"
    if video and not photos.exists():
        photos.mkdir()
        ffmpeg("-i", video, "-vf", "select=not(mod(n\\,4))", "-vsync", "passthrough", "-q:v", "2", photos / "%05d.jpg")
    return photos if video else None


def moved(rows, turn, shift):
    """A 3×4 or 4×4 matrix of a camera, turned by a normal `turn` (radians) about each of its axes and moved by a normal
    `shift` along each."""
    x, y, z = (RANDOM.gauss(0, turn) for _ in range(3))
    angle = math.hypot(x, y, z)
    ax, ay, az = (x / angle, y / angle, z / angle) if angle else (1, 0, 0)
    c, s = math.cos(angle), math.sin(angle)
    rotation = [[c + ax * ax * (1 - c), ax * ay * (1 - c) - az * s, ax * az * (1 - c) + ay * s],
                [ay * ax * (1 - c) + az * s, c + ay * ay * (1 - c), ay * az * (1 - c) - ax * s],
                [az * ax * (1 - c) - ay * s, az * ay * (1 - c) + ax * s, c + az * az * (1 - c)]]
    return [[sum(row[k] * rotation[k][j] for k in range(3)) for j in range(3)] + [row[3] + RANDOM.gauss(0, shift)]
            for row in rows[:3]] + [[0, 0, 0, 1]]


def lego_with_wrong_poses(folder, data):
    """NSVF's lego whose training cameras are turned by 0.1° about each axis and moved by 0.007 of some 4 (a pixel)."""
    if data is None:
        return None
    source, capture = data / "scenes/lego_nsvf_400", folder / "capture"
    if not capture.exists():
        RANDOM.seed(1)
        capture.mkdir(parents=True)
        (capture / "rgb").symlink_to(source / "rgb")
        (folder / "truth").symlink_to(source / "gt/pose")
        (capture / "pose").mkdir()
        for name in ["intrinsics.txt", "bbox.txt"]:
            shutil.copyfile(source / "gt" / name, capture / name)
        for file in sorted((source / "gt/pose").iterdir()):
            rows = [[float(word) for word in line.split()] for line in file.read_text().splitlines() if line.strip()]
            if file.name.startswith("0_"):
                rows = moved(rows, math.radians(0.1), 0.007)
            (capture / "pose" / file.name).write_text("\n".join(" ".join(map(repr, row)) for row in rows) + "\n")
    return capture


def made_with_wrong_poses(folder, data):
    """The example's photos, given with their poses, those of training views as wrong as lego's (its orbit: 4 units)."""
    capture = folder / "capture"
    if not capture.exists():
        RANDOM.seed(2)
        subprocess.run([BIN / "make_capture", "--out", capture, "--quiet", "--posed", "--views", "32"], check=True)
        transforms = read(capture / "transforms.json")
        frames = transforms.pop("frames")
        for split, own in {"test": frames[::8], "train": [frame for i, frame in enumerate(frames) if i % 8]}.items():
            if split == "train":
                for frame in own:
                    frame["transform_matrix"] = moved(frame["transform_matrix"], math.radians(0.1), 0.007)
            (capture / f"transforms_{split}.json").write_text(json.dumps(transforms | {"frames": own}))
        (capture / "transforms.json").rename(folder / "truth.json")
    return capture


RANDOM = random.Random()
CAMERAS = [("without", [], ["--camera-correction", "off"]), ("with", [], ["--camera-correction", "on"])]
EXPOSURE = [("without", [], ["--exposure-correction", "off"]), ("with", [], ["--exposure-correction", "on"])]
MASKS = [("without", ["--masks", "off"], []), ("with", ["--masks", "ignore"], [])]
FLOATERS = [(f"sparsity loss {weight}", [], ["--set", f"train.sparsity_weight={weight}"])
            for weight in ("0", "1e-5", "1e-3")]
FLOATERS.append(("1e-5, cells that few views see kept", [], ["--set", "train.occupancy_min_views=0"]))
CUP = "colmap_models/cup_simple_pinhole"


def decision(feature):
    return [("without", ["--leave-out", feature], []), ("with", ["--need", feature], [])]


# name, facility, capture, and for each variant: its options of the run up to poses, and of training, and its capture
# where that is another
VIDEO = [("every 4th frame", [], [], every_fourth), ("chosen", [], []), ("chosen, 50", ["--frames", "50"], [])]
CASES = [
    ("kermit", "exposure", real("photos/kermit"), EXPOSURE),
    ("ET", "exposure", real("photos/ET"), EXPOSURE),
    ("castle", "exposure", real("photos/sceaux_castle"), EXPOSURE),
    ("fox", "exposure", real("scenes/fox/images"), EXPOSURE),
    ("cup", "exposure", real(CUP), EXPOSURE),
    ("maryrose", "exposure", real("photos/maryrose"), EXPOSURE),
    ("drifting", "exposure", make(["--views", "32", "--exposure-drift", "2"]), EXPOSURE),
    ("steady", "exposure", make(["--views", "32"]), EXPOSURE),
    ("fox-video", "video", fox_video, VIDEO),
    ("lego, wrong poses", "cameras", lego_with_wrong_poses, CAMERAS),
    ("lego", "cameras", real("scenes/lego_nsvf_400"), CAMERAS),
    ("made, wrong poses", "cameras", made_with_wrong_poses, CAMERAS),
    ("fox, given poses", "cameras", real("scenes/fox"), CAMERAS),
    ("fox, COLMAP's poses", "cameras", real("scenes/fox/images"), CAMERAS),
    ("cup", "a focal length for each photo", real(CUP + "/images"),
     [*decision("own_focal_lengths"), ("given poses", [], [], real(CUP))]),
    ("fox", "refinement of poses, lenses and points", real("scenes/fox/images"), decision("refinement")),
    ("fox", "contraction", real("scenes/fox/images"), decision("contraction")),
    ("castle", "contraction", real("photos/sceaux_castle"), decision("contraction")),
    ("fox", "floaters", real("scenes/fox/images"), FLOATERS),
    ("castle", "floaters", real("photos/sceaux_castle"), FLOATERS),
    ("passers-by", "masks", make(["--views", "32", "--passers-by"]), MASKS),
]


def read(path):
    with open(path) as file:
        return json.load(file)


def pose_error(workspace, truth):
    """Median absolute errors after alignment, in the truth's units and degrees, or None without a truth."""
    if not truth.exists():
        return None
    answer = subprocess.run([BIN / "nrff-pose", "compare", "--estimated", workspace, "--truth", truth, "--json",
                             "--quiet"], check=True, capture_output=True, text=True).stdout
    errors = json.loads(answer)
    return {"position": errors["position"]["median"], "rotation_deg": errors["rotation_deg"]["median"]}


def measure(case, args, work):
    name, facility, capture, variants = case
    result = {"name": name, "facility": facility, "variants": []}
    for variant, before, training, *own_capture in variants:
        folder = (own_capture[0] if own_capture else capture)(work / "captures" / name, args.data)
        if folder is None:
            return None
        workspace = work / name / "-".join(["poses", folder.name, *before])
        subprocess.run([BIN / "nrff", "run", folder, "-w", workspace, "--max-image-size", str(args.max_image_size),
                        "--until", "pose", "--quiet", *before], check=True)
        facts = {stage: read(workspace / stage / "manifest.json") for stage in ("ingest", "pose")}
        row = {"variant": variant, "n_images": facts["ingest"]["facts"]["n_images"],
               "n_registered": facts["pose"]["facts"]["n_views_train"] + facts["pose"]["facts"]["n_views_test"],
               "exposure_spread_ev": facts["pose"]["facts"]["exposure_spread_ev"], "runs": []}
        if (workspace / "sfm" / "manifest.json").exists():
            row["seconds_sfm"] = read(workspace / "sfm" / "manifest.json")["seconds"]
        row["pose_error"] = pose_error(workspace, folder.parent / "truth")
        for seed in args.seeds:
            out = work / name / facility / f"{variant}-{seed}"
            subprocess.run([BIN / "nrff-train", "--scene", workspace / "pose", "--out", out / "train", "--steps",
                            str(args.steps), "--seed", str(seed), "--quiet", *training], check=True)
            subprocess.run([BIN / "nrff-render", "--scene", workspace / "pose", "--model", out / "train", "--out",
                            out / "render", "--quiet"], check=True)
            subprocess.run([BIN / "nrff-eval", "--scene", workspace / "pose", "--renders", out / "render", "--out",
                            out / "eval", "--lpips", "none", "--quiet"], check=True)
            if (out / "train/cameras.json").exists():
                row["pose_error"] = pose_error(out / "train", folder.parent / "truth")
            metrics, train = read(out / "eval" / "metrics.json")["metrics"], read(out / "train" / "manifest.json")
            row["runs"].append({"seed": seed, "psnr": metrics["psnr"], "ssim": metrics["ssim"],
                                **metrics["variants"], "train_psnr": train["facts"]["train_psnr"],
                                "seconds_training": train["facts"]["seconds_training"],
                                "camera_displacement_px": train["facts"].get("camera_displacement_px")})
        result["variants"].append(row)
        print(name, variant, " ".join(f"{run['psnr']:.2f}" for run in row["runs"]), flush=True)
    return result


def mean(row, key):
    values = [run[key] for run in row["runs"] if run.get(key) is not None]
    return statistics.mean(values) if values else None


def number(value, digits=2):
    return "–" if value is None else f"{value:.{digits}f}"


def markdown(results):
    machines = sorted({f"{result['machine']} on {result['date']}" for result in results})
    lines = ["# What facilities for real captures are worth", "",
             f"Made by `tests/bench/facilities.py` on {'; '.join(machines)}: the preset small, means over the seeds of "
             "training, poses estimated once. PSNR of held-out views as they are (of masked ones: the pixels that count; "
             "whole images beside it), of their right halves, and of these with colours fitted on the left halves. Pose "
             "errors: median after alignment to the truth. Other work ran on the machine: seconds are no measure.", ""]
    for facility in dict.fromkeys(result["facility"] for result in results):
        lines += [f"## {facility}", "",
                  "| capture | | registered | SfM, s | pose error | steps, px, seeds | PSNR, dB (each seed) | whole | right half | colours fitted | SSIM | training views | training, s |",
                  "|---|---|---|---:|---|---|---:|---:|---:|---:|---:|---:|---:|"]
        for result in results:
            if result["facility"] != facility:
                continue
            for row in result["variants"]:
                error = row["pose_error"]
                error = f"{error['position']:.4f}, {error['rotation_deg']:.3f}°" if error else "–"
                spread = f" ({row['exposure_spread_ev']:.2f} EV)" if facility == "exposure" else ""
                lines.append(
                    f"| {result['name']}{spread} | {row['variant']} | {row['n_registered']} of {row['n_images']} | "
                    f"{number(row.get('seconds_sfm'), 0)} | {error} | {result['steps']}, {result['max_image_size']}, "
                    f"{len(result['seeds'])} | {number(mean(row, 'psnr'))} "
                    f"({', '.join(number(run['psnr']) for run in row['runs'])}) | "
                    f"{number(mean(row, 'psnr_whole'))} | {number(mean(row, 'psnr_right_half'))} | "
                    f"{number(mean(row, 'psnr_colour_fitted'))} | {number(mean(row, 'ssim'), 4)} | "
                    f"{number(mean(row, 'train_psnr'))} | {number(mean(row, 'seconds_training'), 0)} |")
        lines.append("")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=lambda text: None if text == "none" else pathlib.Path(text))
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--only", nargs="+", default=[])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--max-image-size", type=int, default=400)
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("facilities-work"))
    args = parser.parse_args()
    machine = "{cpu}, {cores} cores".format(**captures_table.machine())
    found = read(args.out.with_suffix(".json"))["results"] if args.out.with_suffix(".json").exists() else []
    by_case = {(result["name"], result["facility"]): result for result in found}
    for case in CASES:
        if args.only and not {case[0], case[1], f"{case[1]}/{case[0]}"} & set(args.only):
            continue
        result = measure(case, args, args.work.resolve())
        if result is None:
            continue
        result |= {"date": str(datetime.date.today()), "machine": machine, "steps": args.steps, "seeds": args.seeds,
                   "max_image_size": args.max_image_size}
        by_case[case[:2]] = result
        results = [by_case[other[:2]] for other in CASES if other[:2] in by_case]
        args.out.with_suffix(".json").write_text(json.dumps({"results": results}, indent=1) + "\n")
        args.out.with_suffix(".md").write_text(markdown(results))


if __name__ == "__main__":
    main()
