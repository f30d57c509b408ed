#!/usr/bin/env python3
"""Compare gsplat's errors on this project's fixtures (tests/fixtures, PyTorch float64) with those of `splat gradcheck`.

    python benches/gsplat_errors.py tests/fixtures/*.safetensors --ours gradcheck.json --json errors.json

Needs torch with CUDA, gsplat 1.x and numpy. Errors are |a - b| / |b| (relative L2) of the image, of alpha, and of every gradient
that gsplat has (not that of the intrinsics). Left out, with the reason: fixtures that ask what gsplat cannot be asked.
"""

import argparse
import json
import statistics
import struct
import sys
from pathlib import Path

import numpy as np

from gsplat_side_by_side import read, write

# Constants in the kernels of gsplat 1.x, by their names in the fixtures; values within a thousandth count as equal.
THRESHOLDS = {"alpha_min": 1 / 255, "alpha_max": 0.99, "transmittance_min": 1e-4}
GROUPS = ("means", "quats", "scales", "opacities", "sh0", "sh_rest", "viewmat", "background")
INPUTS = ("means", "quats", "scales", "opacities", "sh_coeffs", "background", "viewmat")
SETTINGS = ("width", "height", "near", "far", "eps2d", "sh_degree", "antialias")
KINDS = {"F32": "<f4", "F64": "<f8"}


def read_fixture(path):
    """Read a safetensors file: settings as text, and tensors by name."""
    data = read(path)
    try:
        length = struct.unpack_from("<Q", data)[0]
        header = json.loads(data[8 : 8 + length])
        settings = header.pop("__metadata__")
        tensors = {}
        for name, entry in header.items():
            start, end = (8 + length + offset for offset in entry["data_offsets"])
            tensors[name] = np.frombuffer(data[start:end], KINDS[entry["dtype"]]).reshape(entry["shape"])
    except (AttributeError, KeyError, TypeError, ValueError, struct.error) as error:
        sys.exit(f"error: {path}: not a fixture: {error!r}")
    needed = {"image", "alpha", "grad_image", "grad_alpha", "intrinsics", *INPUTS, *(f"grad.{name}" for name in INPUTS)}
    for name in sorted(needed - tensors.keys()):
        sys.exit(f"error: {path}: not a fixture: there is no tensor {name}")
    for name in sorted({*THRESHOLDS, *SETTINGS} - settings.keys()):
        sys.exit(f"error: {path}: not a fixture: there is no setting {name}")
    return settings, tensors


def unsuitable(settings, tensors):
    """Return why gsplat cannot run this fixture, or None."""
    if "depth" in tensors:
        return "it has depth"
    if not len(tensors["means"]):
        return "it has no Gaussians"
    for name, value in THRESHOLDS.items():
        if abs(float(settings[name]) / value - 1) > 1e-3:
            return f"its {name} is another"
    return None


def relative(found, expected):
    """Return |found - expected| / |expected|, or None if nothing is expected."""
    norm = np.linalg.norm(expected)
    return float(np.linalg.norm(found - expected) / norm) if norm else None


def errors(gsplat, torch, settings, tensors):
    """Return relative errors by group."""
    leaf = lambda values: torch.tensor(np.array(values), dtype=torch.float32, device="cuda", requires_grad=True)
    inputs = {name: leaf(tensors[name]) for name in INPUTS}
    inputs["viewmat"] = leaf(tensors["viewmat"].reshape(-1, 4, 4))
    cameras = len(inputs["viewmat"])
    intrinsics = np.zeros((cameras, 3, 3), np.float32)
    for matrix, (fx, fy, cx, cy) in zip(intrinsics, tensors["intrinsics"].reshape(-1, 4)):
        matrix[:] = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    image, alpha, _ = gsplat.rasterization(
        inputs["means"],
        inputs["quats"],
        inputs["scales"],
        inputs["opacities"],
        inputs["sh_coeffs"],
        inputs["viewmat"],
        torch.tensor(intrinsics, device="cuda"),
        int(settings["width"]),
        int(settings["height"]),
        near_plane=float(settings["near"]),
        far_plane=float(settings["far"]),
        eps2d=float(settings["eps2d"]),
        sh_degree=int(settings["sh_degree"]),
        packed=False,
        backgrounds=inputs["background"].expand(cameras, -1),
        rasterize_mode="antialiased" if settings["antialias"] == "1" else "classic",
    )
    upstream = lambda name, like: torch.tensor(np.array(tensors[name]), device="cuda").reshape(like.shape)
    loss = (image * upstream("grad_image", image)).sum() + (alpha * upstream("grad_alpha", alpha)).sum()
    loss.backward()
    host = lambda tensor: tensor.detach().cpu().double().numpy()
    grads = {name: host(x.grad) if x.grad is not None else np.zeros(x.shape) for name, x in inputs.items()}
    expected = {name: tensors[f"grad.{name}"] for name in inputs}
    for values in (grads, expected):
        coefficients = values.pop("sh_coeffs")
        values["sh0"], values["sh_rest"] = coefficients[:, :1], coefficients[:, 1:]
    found = {name: relative(grads[name].reshape(expected[name].shape), expected[name]) for name in GROUPS}
    found["image"] = relative(host(image).reshape(tensors["image"].shape), tensors["image"])
    found["alpha"] = relative(host(alpha).reshape(tensors["alpha"].shape), tensors["alpha"])
    return found


def of_ours(path):
    """Return the errors in the output of `splat gradcheck --json`, by file name."""
    if not path:
        return {}
    found = {}
    try:
        for file in json.loads(read(path))["files"]:
            groups = {name: file[name]["rel_l2"] for name in ("image", "alpha")}
            groups.update((name, group["rel_l2"]) for name, group in file["groups"].items())
            found[Path(file["file"]).name] = groups
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        sys.exit(f"error: {path}: not what `splat gradcheck --json` writes: {error!r}")
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fixtures", nargs="+", help="files of tests/fixtures")
    parser.add_argument("--ours", metavar="JSON", help="what `splat gradcheck --json` wrote of the same files")
    parser.add_argument("--json", metavar="OUT", help="also write the figures here")
    args = parser.parse_args()
    try:
        import gsplat
        import torch
    except ImportError as error:
        sys.exit(f"error: {error}; this needs torch and gsplat")
    if not torch.cuda.is_available():
        sys.exit("error: torch sees no CUDA device")
    ours, files, left_out = of_ours(args.ours), {}, {}
    for path in args.fixtures:
        name = Path(path).name
        settings, tensors = read_fixture(path)
        reason = unsuitable(settings, tensors)
        if reason:
            left_out[name] = reason
            continue
        theirs = errors(gsplat, torch, settings, tensors)
        files[name] = {group: {"gsplat": theirs[group], "ours": ours.get(name, {}).get(group)} for group in theirs}

    medians = {}
    for group in [*GROUPS, "image", "alpha"]:
        values = [(file[group]["gsplat"], file[group]["ours"]) for file in files.values() if file[group]["gsplat"] is not None]
        middle = lambda which: statistics.median(which) if which else None
        medians[group] = {
            "fixtures": len(values),
            "gsplat": middle([theirs for theirs, _ in values]),
            "ours": middle([mine for _, mine in values if mine is not None]),
        }
    result = {"gsplat": gsplat.__version__, "medians": medians, "files": files, "left_out": left_out}
    print(json.dumps({"medians": medians, "left_out": left_out}, indent=2))
    if args.json:
        write(args.json, json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
