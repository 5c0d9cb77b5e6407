#!/usr/bin/env python3
"""A full-size training step and a rendered view: the authors' code [Han23] against ours, interleaved A/B/A/B.

    tests/bench/against_authors.py CHECKOUT DATA_DIR OUT.json [--rounds 3] [--steps 2 40] [--threads 2]

CHECKOUT: a checkout of the authors' code (not part of this project). DATA_DIR holds scenes/lego_nsvf_400. Needs
Python's torch (the version is recorded; the CPU does all the work) and numpy.

Same state: a model of the paper's size is trained for a few minutes at 200 px and given to both, with the box it
shrank to, the marching step of the schedule's last stage (1/600 of the box) and the same batches of 4096 rays. Each side
makes its own occupancy mask from that model by its own rule. A step is rays, loss (MSE, orientation, density L1),
gradients and Adam; `--steps A B` are timed per round after one that is not. The view is 200 x 200; ours,
as nrff-render does, with a colour tolerance of half an 8-bit step (step_bench views has what that changes).
Before timing, the first batch is compared without jitter and masks: loss, and the gradient of every parameter against
the authors' code in double precision.
"""

import argparse
import datetime
import json
import math
import os
import pathlib
import statistics
import subprocess
import sys
import time
import types

from captures_table import machine

HERE = pathlib.Path(__file__).resolve().parent
SCENE = "scenes/lego_nsvf_400"
STATE_STEPS = 2500
# Trains the paper's model quickly to a state with sharp surfaces: few samples shaded, occupancy updated throughout.
STATE_SETTINGS = " ".join([
    "train.target_shaded=4096", "train.rays=1024", "train.occupancy_interval=16", "train.occupancy_moments=[]",
    "train.occupancy_cells=65536", "train.occupancy_threshold=0.01", "train.occupancy_decay=0.6",
    "train.occupancy_dilate=false", "train.lazy_grids=true", "train.reset_with_step=false",
    "train.weight_threshold_first=0.008", "train.weight_threshold_last=0.004"])


def read_safetensors(path, torch):
    data = path.read_bytes()
    n = int.from_bytes(data[:8], "little")
    header = json.loads(data[8:8 + n])
    types_of = {"F32": torch.float32, "F64": torch.float64, "I64": torch.int64, "U8": torch.uint8}
    tensors = {}
    for name, entry in header.items():
        if name == "__metadata__":
            continue
        begin, end = entry["data_offsets"]
        tensors[name] = torch.frombuffer(bytearray(data[8 + n + begin:8 + n + end]),
                                         dtype=types_of[entry["dtype"]]).reshape(entry["shape"])
    return tensors, header.get("__metadata__", {})


def import_authors(checkout):
    """Their module imports plotting, metrics and video libraries that a step does not use: empty ones stand in."""
    sys.path.insert(0, str(checkout))
    for name in ["cv2", "imageio", "plyfile", "skimage", "skimage.measure", "kornia", "lpips", "scipy", "scipy.signal",
                 "configargparse"]:
        try:
            __import__(name)
        except ImportError:
            sys.modules[name] = types.ModuleType(name)
    from models.model import NRFF  # pylint: disable=import-outside-toplevel,import-error
    return NRFF


class Authors:
    """Their model in our state."""

    def __init__(self, torch, checkout, model_path, prepared):
        self.torch = torch
        self.inputs, metadata = read_safetensors(prepared, torch)
        self.facts = json.loads(metadata["facts"])
        self.parameters, _ = read_safetensors(model_path, torch)
        nrff = import_authors(checkout)
        facts, field = self.facts, self.facts["field"]
        box = torch.tensor([facts["aabb_min"], facts["aabb_max"]], dtype=torch.float32)
        self.model = nrff(box, [300, 300, 300], torch.device("cpu"), near_far=[facts["near"], facts["far"]],
                          density_shift=field["density_shift"], distance_scale=field["density_scale"],
                          alphaMask_thres=facts["occupancy_threshold"],
                          rayMarch_weight_thres=facts["weight_threshold"], step_ratio=0.5, fea2denseAct="softplus")
        self.load()
        self.model.stepSize = torch.tensor(facts["step"])
        self.model.nSamples = int((self.model.aabbDiag / self.model.stepSize).item()) + 1

    def grids(self, density):
        """Their planes and lines in our order, level by level."""
        field = self.model.density_field if density else self.model.appearance_field
        for level in field.tensors:
            yield [level.plane_yz, level.plane_xz, level.plane_xy], [level.line_x, level.line_y, level.line_z]

    def layers(self):
        net = self.model.rendering_net
        for ours, theirs in [("spatial_mlp", net.spatial_mlp), ("asg_mlp", net.asg_mlp),
                             ("directional_mlp", net.directional_mlp)]:
            linears = [m for m in theirs if hasattr(m, "weight")]
            for i, linear in enumerate(linears):
                yield ours, i, linear

    def copy_grid(self, flat, density, read):
        """Between our flat channels-last buffer and their planes and lines: read(theirs, our slice)."""
        at = 0
        for planes, lines in self.grids(density):
            for tensor in planes + lines:
                _, c, rows, columns = tensor.shape
                n = c * rows * columns
                read(tensor, flat[at:at + n].reshape(1, rows, columns, c).permute(0, 3, 1, 2))
                at += n
        assert at == flat.numel(), (at, flat.numel())

    def load(self):
        with self.torch.no_grad():
            for name, density in [("density_grid", True), ("appearance_grid", False)]:
                self.copy_grid(self.parameters[f"parameter/{name}"], density, lambda a, b: a.copy_(b))
            for name, tensor in self.networks():
                tensor.copy_(self.parameters[f"parameter/{name}"].reshape(tensor.shape))

    def networks(self):
        for ours, i, linear in self.layers():
            prefix = "lobes" if ours == "asg_mlp" else f"{ours}.{i}"
            yield f"{prefix}.weight", linear.weight
            yield f"{prefix}.bias", linear.bias

    def batch(self, i):
        return [self.inputs[f"batch/{i % 8}/{what}"] for what in ("origins", "directions", "target")]

    def loss(self, i, jitter):
        torch, facts = self.torch, self.facts
        origins, directions, target = (x.to(self.model.aabb.dtype) for x in self.batch(i))
        out = self.model(torch.cat([origins, directions], 1), is_train=jitter, white_bg=facts["background"] == 1,
                         N_samples=self.model.nSamples)
        mse = torch.mean((out["rgb_map"] - target) ** 2)
        facing = torch.relu(torch.sum(out["normals"] * out["valid_viewdirs"], dim=-1)).pow(2) * out["valid_weights"]
        total = mse + facts["orientation_weight"] * facing.mean() + \
            facts["density_l1_weight"] * self.model.density_L1()
        return total, mse.item(), out["valid_weights"].numel()

    def gradients(self):
        """Of the first batch, without jitter and mask: loss, samples shaded, and by our names the gradients."""
        total, mse, n_shaded = self.loss(0, jitter=False)
        self.model.zero_grad()
        total.backward()
        found = {}

        def note(name, parameter, ours):
            found.setdefault(name, []).append((parameter.grad.double().clone(), ours.double()))

        for name, density in [("density_grid", True), ("appearance_grid", False)]:
            self.copy_grid(self.inputs[f"gradient/{name}"], density, lambda a, b, name=name: note(name, a, b))
        for name, tensor in self.networks():
            note(name, tensor, self.inputs[f"gradient/{name}"].reshape(tensor.shape))
        return mse, n_shaded, found

    def compare(self):
        """Largest difference of a gradient from the authors' code in double precision, over the largest gradient of
        that parameter: of our float, and of the authors' code in float."""
        torch = self.torch
        mse_float, _, in_float = self.gradients()
        torch.set_default_dtype(torch.float64)  # their code makes tensors of the default type
        self.model.double()
        self.model.aabb = self.model.aabb.double()
        self.model.update_stepSize([300, 300, 300])
        self.model.stepSize = torch.tensor(self.facts["step"], dtype=torch.float64)
        self.model.nSamples = int((self.model.aabbDiag / self.model.stepSize).item()) + 1
        ree = self.model.rendering_net.ree_function
        for name in ["omega", "omega_la", "omega_mu"]:
            setattr(ree, name, getattr(ree, name).double())
        mse, n_shaded, in_double = self.gradients()
        torch.set_default_dtype(torch.float32)

        def difference(parts, side):
            largest = max(exact.abs().max() for exact, _ in parts)
            return (max((value - exact).abs().max() for (exact, _), value in zip(parts, side)) / largest).item()

        return {"mse": {"double": mse, "ours": self.facts["mse"], "authors_float": mse_float},
                "shaded": {"double": n_shaded, "ours": self.facts["n_shaded"]},
                "gradient_difference": {
                    name: {"ours": difference(parts, [ours for _, ours in parts]),
                           "authors_float": difference(parts, [value for value, _ in in_float[name]])}
                    for name, parts in in_double.items()}}

    def run(self, n_steps):
        """Seconds of a view, then of n_steps steps after one that is not counted, from the given state."""
        torch = self.torch
        self.load()
        rays = torch.cat([self.inputs["view/origins"], self.inputs["view/directions"]], 1)
        with torch.no_grad():
            start = time.perf_counter()
            rows = [self.model(chunk, white_bg=self.facts["background"] == 1, N_samples=self.model.nSamples)["rgb_map"]
                    for chunk in rays.split(4096)]
            view_seconds = time.perf_counter() - start
        optimizer = torch.optim.Adam(self.model.get_optparam_groups(self.facts["grid_rate"],
                                                                    self.facts["network_rate"]), betas=(0.9, 0.99))
        result = {"view_seconds": [view_seconds], "step_seconds": [], "step_shaded": [], "step_mse": []}
        for i in range(n_steps + 1):
            start = time.perf_counter()
            total, mse, n_shaded = self.loss(i, jitter=True)
            optimizer.zero_grad()
            total.backward()
            optimizer.step()
            result["step_seconds"].append(time.perf_counter() - start)
            result["step_shaded"].append(n_shaded)
            result["step_mse"].append(mse)
        image = torch.cat(rows).reshape(self.inputs["view/rgb"].shape)
        error = torch.mean((image - self.inputs["view/rgb"]) ** 2).item()
        return result, -10 * math.log10(max(error, 1e-20))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=pathlib.Path)
    parser.add_argument("data", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, nargs=2, default=[2, 40], metavar=("A", "B"))
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("work/against_authors"))
    parser.add_argument("--build", type=pathlib.Path, default=HERE / "../../build")
    arguments = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = str(arguments.threads)  # of both sides
    os.environ["GOMP_SPINCOUNT"] = "1000"                   # the side that waits must not spin
    import torch  # pylint: disable=import-outside-toplevel
    torch.set_num_threads(arguments.threads)

    nrff, bench = arguments.build / "bin/nrff", arguments.build / "tests/step_bench"
    subprocess.run([nrff, "run", arguments.data / SCENE, "--workspace", arguments.work, "--max-image-size", "200",
                    "--until", "train", "--preset", "paper", "--steps", str(STATE_STEPS), "--set", STATE_SETTINGS],
                   check=True)
    model, scene = arguments.work / "train", arguments.work / "pose"
    prepared = arguments.work / "authors-inputs.safetensors"
    subprocess.run([bench, "prepare", model, scene, prepared], check=True)

    def authors():
        return Authors(torch, arguments.checkout, model / "model.safetensors", prepared)

    print("comparing gradients", flush=True)
    comparison = authors().compare()
    print(json.dumps(comparison, indent=1), flush=True)
    theirs = authors()
    theirs.model.updateAlphaMask((theirs.facts["occupancy_resolution"],) * 3)
    a = {"view_seconds": [], "step_seconds": [], "step_shaded": [], "step_mse": []}
    b = {"view_seconds": [], "step_seconds": [], "step_shaded": [], "step_mse": []}
    for _ in range(arguments.rounds):
        run, agreement = theirs.run(arguments.steps[0])
        ours = json.loads(subprocess.run([bench, "run", model, scene, str(arguments.steps[1] + 1), "5"], check=True,
                                         capture_output=True, text=True).stdout)
        for side, new in [(a, run), (b, ours)]:
            for key, values in side.items():
                values += new[key][1:] if key.startswith("step") else new[key]
        print(f"view {run['view_seconds'][0]:.2f} s / {statistics.median(ours['view_seconds']):.4f} s, "
              f"step {statistics.median(run['step_seconds'][1:]):.2f} s / "
              f"{statistics.median(ours['step_seconds'][1:]):.4f} s", flush=True)
    ratio = {what: statistics.median(a[f"{what}_seconds"]) / statistics.median(b[f"{what}_seconds"])
             for what in ("step", "view")}
    result = {"date": datetime.date.today().isoformat(), "machine": machine(), "threads": arguments.threads,
              "torch": torch.__version__, "protocol": " ".join(__doc__.split("\n\n")[3].split()),
              "version": subprocess.run([nrff, "--version"], capture_output=True, text=True, check=True).stdout.strip(),
              "ratio": ratio, "comparison": comparison, "view_agreement_psnr": agreement, "authors": a, "ours": b}
    arguments.out.write_text(json.dumps(result, indent=1) + "\n")
    print(f"ratio of medians: step {ratio['step']:.1f}, view {ratio['view']:.1f}; views agree to {agreement:.1f} dB")


if __name__ == "__main__":
    main()
