#!/usr/bin/env python3
"""gsplat's errors on this project's fixtures (tests/fixtures, float64 by PyTorch), beside those that `splat gradcheck` found.

    python benches/gsplat_errors.py tests/fixtures/*.safetensors --ours gradcheck.json --json errors.json

Needs torch with CUDA, gsplat 1.x and numpy. Errors are |a - b| / |b| (relative L2) of the image, of alpha, and of every gradient
that gsplat has (not that of the intrinsics). Left out, with the reason: fixtures whose thresholds gsplat cannot be given, or
that reach its cap of alpha, which is another one.
"""

import argparse
import json
import statistics
import struct
import sys
from pathlib import Path

import numpy as np

GROUPS = ("means", "quats", "scales", "opacities", "sh0", "sh_rest", "viewmat", "background")
KINDS = {"F32": "<f4", "F64": "<f8"}


def read_fixture(path):
    """Settings as text, and tensors by name, of a safetensors file."""
    try:
        data = Path(path).read_bytes()
        length = struct.unpack_from("<Q", data)[0]
        header = json.loads(data[8 : 8 + length])
        settings = header.pop("__metadata__")
        tensors = {}
        for name, entry in header.items():
            start, end = (8 + length + offset for offset in entry["data_offsets"])
            tensors[name] = np.frombuffer(data[start:end], KINDS[entry["dtype"]]).reshape(entry["shape"])
        return settings, tensors
    except OSError as error:
        sys.exit(f"error: {path}: {error.strerror}")
    except (KeyError, ValueError, struct.error) as error:
        sys.exit(f"error: {path}: not a fixture: {error!r}")


def unsuitable(settings, tensors):
    """Why gsplat cannot be asked this, or None."""
    if "depth" in tensors:
        return "it has depth"
    if not len(tensors["means"]):
        return "it has no Gaussians"
    if abs(float(settings["alpha_min"]) * 255 - 1) > 1e-6 or abs(float(settings["transmittance_min"]) / 1e-4 - 1) > 1e-2:
        return "its thresholds are others"
    if tensors["opacities"].max() >= min(0.98, float(settings["alpha_max"])):
        return "it may reach the cap of alpha"
    return None


def relative(found, expected):
    """|found - expected| / |expected|; None where nothing is expected."""
    norm = np.linalg.norm(expected)
    return float(np.linalg.norm(found - expected) / norm) if norm else None


def errors(gsplat, torch, settings, tensors):
    """Relative errors by group."""
    leaf = lambda values: torch.tensor(np.array(values), dtype=torch.float32, device="cuda", requires_grad=True)
    inputs = {name: leaf(tensors[name]) for name in ("means", "quats", "scales", "opacities", "sh_coeffs", "background")}
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
    """The same of `splat gradcheck --json`, by file name."""
    if not path:
        return {}
    try:
        files = json.loads(Path(path).read_text())["files"]
    except (OSError, KeyError, ValueError) as error:
        sys.exit(f"error: {path}: not what `splat gradcheck --json` writes: {error!r}")
    found = {}
    for file in files:
        groups = {name: file[name]["rel_l2"] for name in ("image", "alpha")}
        groups.update((name, group["rel_l2"]) for name, group in file["groups"].items())
        found[Path(file["file"]).name] = groups
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
        Path(args.json).write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
