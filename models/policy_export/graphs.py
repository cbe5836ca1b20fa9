"""Writes a network as an ONNX graph, and has the layers of an encoder's graph that resize and crop pictures.

Resize and crop stay in the graph, because a bundle's own resize has no antialiasing and torchvision's has.
"""

import warnings
from pathlib import Path

import onnx
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .bundle import CONDITION

OPSET = 17


class Resize(nn.Module):
    """torchvision's bilinear resize with antialiasing, for pictures of one size, as two matrices."""

    def __init__(self, size: tuple[int, int], target: tuple[int, int]):
        super().__init__()
        # It is linear in each direction: applied to the identity, it gives its matrix.
        self.register_buffer("rows", interpolation(size[0], target[0]))
        self.register_buffer("columns", interpolation(size[1], target[1]).T.contiguous())

    def forward(self, x: Tensor) -> Tensor:
        return self.rows @ (x @ self.columns)


class Crop(nn.Module):
    """The centre, as a constant slice: torchvision's CenterCrop cannot be traced."""

    def __init__(self, size: tuple[int, int], target: tuple[int, int]):
        super().__init__()
        # torchvision rounds half to even here, as Python does.
        self.top, self.left = (round((whole - part) / 2) for whole, part in zip(size, target, strict=True))
        self.bottom, self.right = self.top + target[0], self.left + target[1]

    def forward(self, x: Tensor) -> Tensor:
        return x[..., self.top : self.bottom, self.left : self.right]


def interpolation(size: int, target: int) -> Tensor:
    eye = torch.eye(size)[None, None]
    return F.interpolate(eye, (target, size), mode="bilinear", align_corners=False, antialias=True)[0, 0]


def trace_denoiser(module: nn.Module, action: tuple[int, int], condition: Tensor, file: Path) -> None:
    """Writes the graph of a denoiser of actions [Tp, Da]; `condition` is an example of the encoder's output."""
    batch = len(condition)
    args = [torch.randn(batch, *action), torch.zeros(batch, dtype=torch.int64), condition]
    trace(module, args, ["sample", "timestep", CONDITION], "prediction", file)


def trace(module: nn.Module, args: list[Tensor], inputs: list[str], output: str, file: Path) -> Tensor:
    """Writes the graph of `module` to `file`, and returns the result of `module` for `args`."""
    with warnings.catch_warnings():
        # torch prefers its newer exporter, and warns about it for every graph.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            tuple(args),
            str(file),
            input_names=inputs,
            output_names=[output],
            dynamic_axes={name: {0: "B"} for name in [*inputs, output]},
            opset_version=OPSET,
            dynamo=False,
        )
    with torch.no_grad():
        made = module(*args)
    # The tracer leaves the output's other sizes open as well. The program checks them against policy.json.
    model = onnx.load(file)
    # It leaves out inputs that have no effect, such as a pose that only actions are relative to.
    traced = {value.name for value in model.graph.input}
    for name, arg in zip(inputs, args, strict=True):
        if name not in traced:
            shape = ["B", *arg.shape[1:]]
            model.graph.input.append(onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape))
    dims = model.graph.output[0].type.tensor_type.shape.dim
    for dim, size in zip(dims[1:], made.shape[1:], strict=True):
        dim.dim_value = size
    onnx.checker.check_model(model)
    onnx.save(model, file)
    return made
