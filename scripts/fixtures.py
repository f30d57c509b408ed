#!/usr/bin/env python3
"""Write a gradient fixture of a PyTorch function, for `splat_lab::central::check_against_fixture`.

    from fixtures import write_fixture

    def attention(q, k, v):
        return torch.softmax(q @ k.T, 1) @ v

    write_fixture("attention.safetensors", attention, {"q": q, "k": k, "v": v})

The function gets the inputs by name, in float64 on the CPU, and returns a tensor or a dictionary of named tensors. Needs
torch and numpy. The same inputs and the same version of PyTorch make the same bytes.

The file, in the safetensors format:

    x         an input
    grad.x    its gradient; an input in `constants` has none
    y         an output (a single tensor is called `output`)
    grad_y    its upstream gradient
    metadata  `outputs`: names of the outputs in order, separated by commas; `case`: a description

All tensors are float64; a scalar has the shape [1].
"""

import json
import struct
from pathlib import Path

import numpy as np
import torch


def write_fixture(path, function, inputs, upstream=None, constants=(), case="", seed=0, metadata=None):
    """Evaluate `function(**inputs)`, differentiate `sum(upstream * outputs)`, and write all of it to `path`.

    inputs     dictionary of tensors, arrays or numbers
    upstream   dictionary of output name -> gradient of the loss to it; random from 0.5 to 1 of either sign by default
    constants  names of inputs that are not differentiated
    metadata   dictionary of further entries, strings
    Returns the gradients by input.
    """
    unknown = set(constants) - set(inputs)
    if unknown:
        raise ValueError(f"constants {sorted(unknown)} are no inputs")
    leaves = {name: leaf(name, value, name not in constants) for name, value in inputs.items()}
    outputs = function(**leaves)
    if not isinstance(outputs, dict):
        outputs = {"output": outputs}
    for name, value in outputs.items():
        check_name(name)
        if name in leaves:
            raise ValueError(f"`{name}` is an input and an output: rename one of them")
        if value.dtype != torch.float64:
            raise ValueError(f"output `{name}` is {value.dtype}: compute in the type of the inputs")
    generator = np.random.default_rng(seed)
    weights = {name: weight(name, value, upstream, generator) for name, value in outputs.items()}
    loss = sum((outputs[name] * weights[name]).sum() for name in outputs)
    tracked = {name: value for name, value in leaves.items() if value.requires_grad}
    gradients = dict(zip(tracked, torch.autograd.grad(loss, list(tracked.values()), allow_unused=True)))
    gradients = {k: torch.zeros_like(tracked[k]) if g is None else g for k, g in gradients.items()}

    tensors = dict(leaves)
    tensors.update({f"grad.{name}": value for name, value in gradients.items()})
    tensors.update(outputs)
    tensors.update({f"grad_{name}": value for name, value in weights.items()})
    arrays = {}
    for name, value in tensors.items():
        array = np.atleast_1d(value.detach().cpu().numpy())
        if not np.isfinite(array).all():
            raise ValueError(f"`{name}` is not finite")
        if name in arrays:
            raise ValueError(f"two tensors are named `{name}`")
        arrays[name] = array
    Path(path).write_bytes(serialise(arrays, {**(metadata or {}), "outputs": ",".join(outputs), "case": case}))
    return gradients


def leaf(name, value, differentiated):
    check_name(name)
    value = torch.as_tensor(value)
    if value.is_complex():
        raise ValueError(f"input `{name}` is complex")
    return value.detach().to(torch.float64).cpu().clone().requires_grad_(differentiated)


def check_name(name):
    if name.startswith(("grad.", "grad_")) or "," in name or not name:
        raise ValueError(f"`{name}`: a name must not be empty, begin with `grad.` or `grad_`, or hold a comma")


def weight(name, output, upstream, generator):
    if upstream is not None:
        weights = torch.as_tensor(upstream[name]).to(torch.float64)
        if weights.shape != output.shape:
            raise ValueError(f"the upstream gradient of `{name}` has shape {tuple(weights.shape)}, not {tuple(output.shape)}")
        return weights
    signs = generator.choice([-1.0, 1.0], size=tuple(output.shape))
    return torch.from_numpy(np.asarray(signs * generator.uniform(0.5, 1.0, size=tuple(output.shape))))


def serialise(arrays, metadata):
    """Return the bytes of a safetensors file: length of the header, JSON header, tensors."""
    header, data = {"__metadata__": dict(sorted(metadata.items()))}, b""
    for name, array in sorted(arrays.items()):
        raw = np.ascontiguousarray(array, dtype="<f8").tobytes()
        header[name] = {"dtype": "F64", "shape": list(array.shape), "data_offsets": [len(data), len(data) + len(raw)]}
        data += raw
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + data
