#!/usr/bin/env python3
"""Writes the network that nrff-eval measures LPIPS with, as ONNX, from the published `lpips` package.

    pip install lpips onnx xxhash
    eval/export_lpips.py ~/.local/share/nrff/lpips_vgg.onnx [--net vgg|alex] [--version 0.1]

Needs a network once: the package fetches the backbone's weights (VGG-16 or AlexNet); its own linear weights come with it.

The graph takes `image` [1, 3, height, width], RGB in [0, 1], and gives the five feature maps that LPIPS compares,
`feature0` to `feature4`. Mapping to the range the backbone was trained on is its first two nodes. The linear weights are
the constants `weight0` to `weight4` [channels], which no node reads. metadata_props has `nrff_lpips` (the version of this
layout), `network`, `lpips_version`, `backbone` (published, or random with --random-backbone, for tests) and `hash`:
XXH3-128, in hex, of every constant in the order of the file, each as its name and its float32 bytes, little endian.
"""

import argparse
import pathlib

import numpy
import onnx
import torch
import xxhash
from onnx import TensorProto, helper, numpy_helper

LAYOUT = "1"
OPSET = 11  # what OpenCV 4.6 reads


def features_of(model):
    """The backbone's five slices, each a list of modules."""
    return [list(slice_) for slice_ in model.net.children()][:5]


def make_model(model, network, version, backbone):
    """model: an lpips.LPIPS. Returns an onnx.ModelProto."""
    nodes, constants, outputs = [], [], []

    def constant(name, values):
        values = numpy.ascontiguousarray(values, dtype=numpy.float32)
        constants.append(numpy_helper.from_array(values, name))
        return name

    def node(kind, inputs, output, **attributes):
        nodes.append(helper.make_node(kind, inputs, [output], name=output, **attributes))
        return output

    # 2 x - 1, minus shift, over scale.
    shift, scale = (t.detach().double().numpy().reshape(1, 3, 1, 1)
                    for t in (model.scaling_layer.shift, model.scaling_layer.scale))
    at = node("Mul", ["image", constant("preprocess.factor", 2 / scale)], "preprocess.scaled")
    at = node("Add", [at, constant("preprocess.term", (-1 - shift) / scale)], "preprocess.shifted")
    for i, modules in enumerate(features_of(model)):
        for j, module in enumerate(modules):
            name = f"slice{i}.{j}"
            if isinstance(module, torch.nn.Conv2d):
                inputs = [at, constant(f"{name}.weight", module.weight.detach().numpy()),
                          constant(f"{name}.bias", module.bias.detach().numpy())]
                at = node("Conv", inputs, name, kernel_shape=module.kernel_size, strides=module.stride,
                          pads=module.padding * 2, dilations=module.dilation, group=module.groups)
            elif isinstance(module, torch.nn.ReLU):
                last = j + 1 == len(modules)
                at = node("Relu", [at], f"feature{i}" if last else name)
            elif isinstance(module, torch.nn.MaxPool2d):
                kernel, stride = (v if isinstance(v, tuple) else (v, v) for v in (module.kernel_size, module.stride))
                at = node("MaxPool", [at], name, kernel_shape=kernel, strides=stride)
            else:
                raise SystemExit(f"export_lpips: {name} is a {type(module).__name__}, which no LPIPS backbone has")
        if at != f"feature{i}":
            raise SystemExit(f"export_lpips: slice {i} does not end in a ReLU")
        outputs.append(helper.make_tensor_value_info(at, TensorProto.FLOAT, [1, None, None, None]))
    for i, lin in enumerate(model.lins):
        constant(f"weight{i}", lin.model[-1].weight.detach().numpy().reshape(-1))
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, "height", "width"])
    graph = helper.make_graph(nodes, "lpips", [image], outputs, constants)
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=6,
                             producer_name="nrff export_lpips.py")
    digest = xxhash.xxh3_128()
    for tensor in constants:
        digest.update(tensor.name.encode())
        digest.update(tensor.raw_data)
    helper.set_model_props(made, {"nrff_lpips": LAYOUT, "network": network, "lpips_version": version,
                                  "backbone": backbone, "hash": digest.hexdigest()})
    onnx.checker.check_model(made)
    return made


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--net", choices=["vgg", "alex"], default="vgg")
    parser.add_argument("--version", default="0.1", help="of the linear weights")
    parser.add_argument("--random-backbone", type=int, metavar="SEED", help="for tests, where no weights can be had")
    arguments = parser.parse_args()
    import lpips  # pylint: disable=import-outside-toplevel
    random = arguments.random_backbone is not None
    if random:
        torch.manual_seed(arguments.random_backbone)
    model = lpips.LPIPS(net=arguments.net, version=arguments.version, pnet_rand=random, verbose=False).eval()
    made = make_model(model, arguments.net, arguments.version, "random" if random else "published")
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(made, arguments.out)
    print(f"{arguments.out}: LPIPS {arguments.version} with {arguments.net}, "
          f"{'a random' if random else 'the published'} backbone")


if __name__ == "__main__":
    main()
