#!/usr/bin/env python3
"""Makes tests/data/lpips_narrow.onnx and lpips_narrow.json: a network of VGG-16's shape with a sixteenth of its channels
and random weights, exported by eval/export_lpips.py, and what the `lpips` package computes with it, in double precision,
for the pairs of images that tests/eval_test.cc makes too.

    pip install lpips onnx xxhash
    tests/make_lpips_fixture.py
    tests/make_lpips_fixture.py --full DIR TRUTH.png RENDERED.png [...]

With --full it writes VGG and AlexNet of full size, with random backbones, to DIR, and to DIR/pairs.json what the package
computes for pairs of images: `NRFF_LPIPS=DIR build/tests/eval_test --gtest_filter='Lpips.*'` compares.
"""

import json
import pathlib
import sys

import lpips
import numpy
import onnx
import torch
from PIL import Image

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "eval"))
import export_lpips  # noqa: E402  pylint: disable=wrong-import-position,import-error

NARROWER = 16


def image(width, height, which):
    """Pattern(width, height, which) of eval_test.cc, [1, 3, height, width]."""
    y, x, c = numpy.mgrid[0:height, 0:width, 0:3]
    pixels = (7 * x + 13 * y + 29 * c + which * (x * y // 8 + 11 * c)) % 256
    return torch.tensor(pixels / 255).permute(2, 0, 1)[None]


def full(folder, paths):
    folder.mkdir(parents=True, exist_ok=True)
    pairs = []
    for network in ["vgg", "alex"]:
        torch.manual_seed(0)
        model = lpips.LPIPS(net=network, pnet_rand=True, verbose=False).eval()
        onnx.save(export_lpips.make_model(model, network, "0.1", "random"), folder / f"{network}.onnx")
        model.double()
        for truth, rendered in zip(paths[::2], paths[1::2]):
            images = [torch.tensor(numpy.asarray(Image.open(path).convert("RGB")) / 255).permute(2, 0, 1)[None]
                      for path in (truth, rendered)]
            with torch.no_grad():
                distance = model(*images, normalize=True).item()
            pairs.append({"network": f"{network}.onnx", "truth": truth, "rendered": rendered, "distance": distance})
    (folder / "pairs.json").write_text(json.dumps(pairs, indent=1) + "\n")


def narrow():
    torch.manual_seed(0)
    model = lpips.LPIPS(net="vgg", pnet_rand=True, verbose=False).eval()
    for modules in export_lpips.features_of(model):
        for module in modules:
            if isinstance(module, torch.nn.Conv2d):
                n_out, n_in = module.out_channels // NARROWER, max(3, module.in_channels // NARROWER)
                scale = (2 / (9 * n_in)) ** 0.5
                module.weight = torch.nn.Parameter(torch.randn(n_out, n_in, 3, 3) * scale)
                module.bias = torch.nn.Parameter(torch.randn(n_out) * 0.1)
    for lin in model.lins:
        n = lin.model[-1].in_channels // NARROWER
        lin.model[-1].weight = torch.nn.Parameter(torch.rand(1, n, 1, 1))
    onnx.save(export_lpips.make_model(model, "narrow", "0.1", "random"), HERE / "data/lpips_narrow.onnx")
    model.double()
    pairs = []
    with torch.no_grad():
        for width, height in [(48, 40), (33, 65), (32, 32)]:
            distance = model(image(width, height, 0), image(width, height, 1), normalize=True).item()
            pairs.append({"width": width, "height": height, "distance": distance})
    (HERE / "data/lpips_narrow.json").write_text(json.dumps(pairs, indent=1) + "\n")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--full"] and len(sys.argv) >= 5 and len(sys.argv) % 2 == 1:
        full(pathlib.Path(sys.argv[2]), sys.argv[3:])
    elif len(sys.argv) == 1:
        narrow()
    else:
        sys.exit(__doc__)
