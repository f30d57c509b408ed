#!/usr/bin/env python3
"""Compare gsplat with `splat bench` on the same scene, views and losses: forward, backward, training step.

    python benches/gsplat_side_by_side.py scene.ply capture/ --downscale 2 \
        --ours rasterize.json --ours-step step.json --json gsplat.json

scene.ply is one that `splat train` wrote, capture/ a folder with images/ and a binary COLMAP model in sparse/0/.
Needs torch with CUDA, gsplat 1.x, numpy and Pillow; with --check only numpy: it reads everything, says what there is,
and measures nothing.

Forward is projection, colours and rasterisation of one view; backward that of the mean squared difference to its photo.
A step is forward, 0.8 L1 + 0.2 (1 - SSIM), backward and Adam; without fused_ssim installed the SSIM is torch's
convolutions, which is slower: the JSON says which. No density control. Each is timed from an idle device to an idle one.
Memory is what each allocator counts over all of it.
"""

import argparse
import json
import statistics
import struct
import sys
import time
from pathlib import Path

import numpy as np

# As in `splat bench rasterize`.
VIEWS = 8
HOLD_OUT = 8
ADAM_RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "sh_rest": 1.25e-4}


def read(path):
    try:
        return Path(path).read_bytes()
    except OSError as error:
        sys.exit(f"error: {path}: {error.strerror}")


def write(path, text):
    """Write a file atomically."""
    whole = Path(f"{path}.tmp")
    try:
        whole.write_text(text)
        whole.replace(path)
    except OSError as error:
        sys.exit(f"error: {path}: {error.strerror}")


def read_ply(path):
    """Read the fields of a binary little-endian PLY of floats, by name."""
    data = read(path)
    end = data.find(b"end_header\n")
    if end < 0:
        sys.exit(f"error: {path}: not a PLY file")
    header = data[:end].decode("ascii", "replace").splitlines()
    if "format binary_little_endian 1.0" not in header:
        sys.exit(f"error: {path}: only binary little-endian PLY is read")
    count = next((int(line.split()[2]) for line in header if line.startswith("element vertex ")), 0)
    names = [line.split()[2] for line in header if line.startswith("property float ")]
    rows = np.frombuffer(data, "<f4", count * len(names), end + len(b"end_header\n")).reshape(count, len(names))
    return {name: rows[:, index] for index, name in enumerate(names)}


def gaussians(path):
    """means [N, 3], scales [N, 3] (log), quats [N, 4], opacities [N] (logit), sh0 [N, 1, 3], sh_rest [N, K, 3]."""
    ply = read_ply(path)
    try:
        stack = lambda names: np.stack([ply[name] for name in names], -1)
        rest = sum(name.startswith("f_rest_") for name in ply)
        coefficients = stack([f"f_rest_{i}" for i in range(rest)]) if rest else np.zeros((len(ply["x"]), 0))
        return {
            "means": stack("xyz"),
            "scales": stack([f"scale_{i}" for i in range(3)]),
            "quats": stack([f"rot_{i}" for i in range(4)]),
            "opacities": ply["opacity"],
            "sh0": stack([f"f_dc_{i}" for i in range(3)])[:, None],
            # The file stores red, then green, then blue.
            "sh_rest": coefficients.reshape(len(ply["x"]), 3, rest // 3).transpose(0, 2, 1),
        }
    except KeyError as missing:
        sys.exit(f"error: {path}: there is no property {missing}")


def read_model(folder):
    """Return (name, world-to-camera [4, 4], (fx, fy, cx, cy), (width, height)) of every photo, sorted by name."""
    model = Path(folder) / "sparse" / "0"
    cameras_bin, images_bin = read(model / "cameras.bin"), read(model / "images.bin")
    cameras, at = {}, 8
    for _ in range(struct.unpack_from("<Q", cameras_bin)[0]):
        number, kind, width, height = struct.unpack_from("<iiQQ", cameras_bin, at)
        at += 24
        if kind not in (0, 1):
            sys.exit(f"error: {model}/cameras.bin: camera {number} is neither SIMPLE_PINHOLE nor PINHOLE")
        values = struct.unpack_from(f"<{3 + kind}d", cameras_bin, at)
        at += 8 * (3 + kind)
        cameras[number] = (((values[0],) + values) if kind == 0 else values, (width, height))
    views, at = [], 8
    for _ in range(struct.unpack_from("<Q", images_bin)[0]):
        qw, qx, qy, qz, *translation = struct.unpack_from("<4x7d", images_bin, at)
        (camera,) = struct.unpack_from("<i", images_bin, at + 60)
        end = images_bin.index(b"\0", at + 64)
        name = images_bin[at + 64 : end].decode()
        (points,) = struct.unpack_from("<Q", images_bin, end + 1)
        at = end + 9 + 24 * points
        viewmat = np.eye(4)
        viewmat[:3, :3] = [
            [1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy)],
            [2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx)],
            [2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy)],
        ]
        viewmat[:3, 3] = translation
        views.append((name, viewmat, *cameras[camera]))
    return sorted(views, key=lambda view: view[0])


def train_views(folder, downscale):
    """Return at most VIEWS training views, evenly spread, with sizes and intrinsics divided by `downscale`."""
    views, split = read_model(folder), Path(folder) / "split.json"
    if split.exists():
        try:
            names = set(json.loads(read(split))["train"])
        except (KeyError, TypeError, ValueError) as error:
            sys.exit(f"error: {split}: not a split, an object with the lists train and test: {error!r}")
        views = [view for view in views if view[0] in names]
    else:
        views = [view for index, view in enumerate(views) if index % HOLD_OUT]
    count = min(len(views), VIEWS)
    chosen = [views[i * len(views) // count] for i in range(count)]
    divided = lambda values: tuple(value / downscale for value in values)
    return [(n, v, divided(k), tuple(side // downscale for side in size)) for n, v, k, size in chosen]


def spread(seconds):
    """Return median, smallest and largest time in milliseconds."""
    return {"median": 1e3 * statistics.median(seconds), "min": 1e3 * min(seconds), "max": 1e3 * max(seconds)}


def ratio(gsplat, ours):
    """Return our time as a multiple of gsplat's: of the medians, and the limits allowed by both spreads."""
    return {
        "median": ours["median"] / gsplat["median"],
        "min": ours["min"] / gsplat["max"],
        "max": ours["max"] / gsplat["min"],
    }


def measure(scene, views, capture, downscale, passes, ours, ours_step):
    try:
        import gsplat
        import torch
        import torch.nn.functional as F
        from PIL import Image
    except ImportError as error:
        sys.exit(f"error: {error}; this needs torch, gsplat and Pillow (or --check)")

    if not torch.cuda.is_available():
        sys.exit("error: torch sees no CUDA device")
    device = torch.device("cuda")
    try:
        from fused_ssim import fused_ssim

        ssim_of, ssim_name = lambda a, b: fused_ssim(a, b), "fused_ssim"
    except ImportError:
        taps = torch.exp(-((torch.arange(11, device=device) - 5.0) ** 2) / (2 * 1.5**2))
        taps = taps / taps.sum()

        def blur(x):
            rows = F.conv2d(x, taps.view(1, 1, 1, 11).expand(3, -1, -1, -1), padding=(0, 5), groups=3)
            return F.conv2d(rows, taps.view(1, 1, 11, 1).expand(3, -1, -1, -1), padding=(5, 0), groups=3)

        def ssim_of(a, b):
            ma, mb = blur(a), blur(b)
            va, vb, cov = blur(a * a) - ma * ma, blur(b * b) - mb * mb, blur(a * b) - ma * mb
            top = (2 * ma * mb + 0.01**2) * (2 * cov + 0.03**2)
            return (top / ((ma * ma + mb * mb + 0.01**2) * (va + vb + 0.03**2))).mean()

        ssim_name = "torch"

    params = {
        name: torch.nn.Parameter(torch.tensor(np.ascontiguousarray(values), dtype=torch.float32, device=device))
        for name, values in scene.items()
    }
    degree = int((1 + params["sh_rest"].shape[1]) ** 0.5) - 1
    inputs = []
    for name, viewmat, (fx, fy, cx, cy), (width, height) in views:
        photo = Image.open(Path(capture) / "images" / name).convert("RGB").reduce(downscale).crop((0, 0, width, height))
        inputs.append(
            (
                torch.tensor(viewmat, dtype=torch.float32, device=device)[None],
                torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float32, device=device)[None],
                torch.tensor(np.asarray(photo), dtype=torch.float32, device=device)[None] / 255,
                width,
                height,
            )
        )

    def render(viewmat, intrinsics, width, height):
        image, _, _ = gsplat.rasterization(
            params["means"],
            params["quats"],
            params["scales"].exp(),
            params["opacities"].sigmoid(),
            torch.cat([params["sh0"], params["sh_rest"]], 1),
            viewmat,
            intrinsics,
            width,
            height,
            near_plane=0.01,
            eps2d=0.3,
            sh_degree=degree,
            packed=False,
        )
        return image

    def timed(work):
        torch.cuda.synchronize()
        start = time.perf_counter()
        result = work()
        torch.cuda.synchronize()
        return result, time.perf_counter() - start

    forward, backward = [], []
    for number in range(1 + passes):
        ahead, back = 0.0, 0.0
        for viewmat, intrinsics, photo, width, height in inputs:
            image, seconds = timed(lambda: render(viewmat, intrinsics, width, height))
            ahead += seconds
            loss = (image - photo).square().mean()
            _, seconds = timed(loss.backward)
            back += seconds
            for param in params.values():
                param.grad = None
        if number:
            forward.append(ahead / len(inputs))
            backward.append(back / len(inputs))

    groups = [{"params": [params[name]], "lr": rate} for name, rate in ADAM_RATES.items()]
    optimizer = torch.optim.Adam(groups, eps=1e-15, fused=True)

    def step(viewmat, intrinsics, photo, width, height):
        image = render(viewmat, intrinsics, width, height)
        similarity = ssim_of(image.permute(0, 3, 1, 2), photo.permute(0, 3, 1, 2))
        (0.8 * (image - photo).abs().mean() + 0.2 * (1 - similarity)).backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)

    steps = []
    for number in range(5 + passes):
        _, seconds = timed(lambda: step(*inputs[number % len(inputs)]))
        if number >= 5:
            steps.append(seconds)

    result = {
        "gsplat": gsplat.__version__,
        "torch": torch.__version__,
        "device": torch.cuda.get_device_name(),
        "ssim": ssim_name,
        "gaussians": len(scene["means"]),
        "sh_degree": degree,
        "views": len(views),
        "forward_milliseconds": spread(forward),
        "backward_milliseconds": spread(backward),
        "step_milliseconds": spread(steps),
        "peak_bytes": torch.cuda.max_memory_allocated(),
        "reserved_bytes": torch.cuda.max_memory_reserved(),
        "ours_times_gsplat": {},
    }
    if ours:
        row = ours["rows"][0]
        for name in ("forward", "backward"):
            whole = row.get(f"render_{name}_milliseconds")
            if whole:
                result["ours_times_gsplat"][name] = ratio(result[f"{name}_milliseconds"], whole)
    if ours_step:
        row = next((row for row in ours_step["rows"] if row["sh_degree"] == degree), None)
        if row:
            times = result["ours_times_gsplat"]
            times["step"] = ratio(result["step_milliseconds"], row["milliseconds"])
            # Peak memory in use (ours between stages), and memory reserved by the allocators.
            times["memory in use"] = row["memory"]["most_bytes"] / result["peak_bytes"]
            times["memory reserved"] = row["memory"]["reserved_bytes"] / result["reserved_bytes"]
    return result


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="scene.ply of `splat train`")
    parser.add_argument("capture", help="folder with images/ and sparse/0/")
    parser.add_argument("--downscale", type=int, default=1, metavar="K")
    parser.add_argument("--passes", type=int, default=30, metavar="N", help="passes over the views, and steps, measured")
    parser.add_argument("--ours", metavar="JSON", help="what `splat bench rasterize` measured of the same scene")
    parser.add_argument("--ours-step", metavar="JSON", help="what `splat bench step` measured of the same capture")
    parser.add_argument("--json", metavar="OUT", help="also write the figures here")
    parser.add_argument("--check", action="store_true", help="read everything, measure nothing; needs only numpy")
    args = parser.parse_args()
    if args.downscale < 1 or args.passes < 1:
        parser.error("--downscale and --passes must be at least 1")
    scene = gaussians(args.scene)
    views = train_views(args.capture, args.downscale)
    if not views:
        sys.exit(f"error: {args.capture}: no view to measure")
    ours, ours_step = (json.loads(read(p)) if p else None for p in (args.ours, args.ours_step))
    if args.check:
        result = {
            "gaussians": len(scene["means"]),
            "coefficients": 1 + scene["sh_rest"].shape[1],
            "views": [[name, *size] for name, _, _, size in views],
            "ours": [bool(ours), bool(ours_step)],
        }
    else:
        result = measure(scene, views, args.capture, args.downscale, args.passes, ours, ours_step)
    text = json.dumps(result, indent=2)
    print(text)
    if args.json:
        write(args.json, text + "\n")


if __name__ == "__main__":
    main()
