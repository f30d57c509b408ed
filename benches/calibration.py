#!/usr/bin/env python3
"""Make captures that self-calibration has to find back, and measure how well it did.

    python3 benches/calibration.py warp CAPTURE OUT [--k1 -0.1] [--given-k1 0] [--given-focal 1.05]
    python3 benches/calibration.py perturb CAPTURE OUT [--degrees 1] [--share 0.01] [--seed 0]
                                                      [--without-keypoints]
    python3 benches/calibration.py compare TRUTH REFINED

`warp` resamples the photos of a pinhole capture as a lens with this k1 would have taken them, with a focal length that
keeps every pixel inside of the old photo. Its cameras are the true ones, unless other values are given for them.
`perturb` turns every camera of a capture by `degrees` about a random axis through its centre, and moves it by `share`
of the scene's size (the median distance of cameras and points) in a random direction. Its keypoints stay as they are.
`compare` finds the similarity that takes the centres of the refined cameras to the true ones best (Umeyama 1991) and
prints the errors of rotations and centres that are left, and the intrinsics of both.

CAPTURE, TRUTH and REFINED are folders with a binary COLMAP model in `sparse/0` or themselves. Needs numpy and Pillow.
"""

import argparse
import shutil
import struct
from pathlib import Path

import numpy as np

PINHOLE, OPENCV = 1, 4
PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12}


# --- COLMAP's binary model ---------------------------------------------------------------------------------


class Reader:
    def __init__(self, path):
        self.data, self.at = path.read_bytes(), 0

    def take(self, form):
        values = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return values if len(values) > 1 else values[0]

    def name(self):
        end = self.data.index(b"\0", self.at)
        name, self.at = self.data[self.at : end].decode(), end + 1
        return name


def model_folder(folder):
    return next(f for f in (folder / "sparse" / "0", folder / "sparse", folder) if (f / "cameras.bin").exists())


def read_cameras(folder):
    """id -> (model, width, height, parameters)"""
    reader = Reader(folder / "cameras.bin")
    cameras = {}
    for _ in range(reader.take("Q")):
        number, model, width, height = reader.take("IiQQ")
        cameras[number] = (model, width, height, np.array(reader.take(f"{PARAMETERS[model]}d")))
    return cameras


def read_images(folder):
    """name -> (id, quaternion, translation, camera id, bytes of its keypoints)"""
    reader = Reader(folder / "images.bin")
    images = {}
    for _ in range(reader.take("Q")):
        number, *pose, camera = reader.take("I7dI")
        name = reader.name()
        keypoints = 24 * reader.take("Q")
        keypoints, reader.at = reader.data[reader.at : reader.at + keypoints], reader.at + keypoints
        images[name] = (number, np.array(pose[:4]), np.array(pose[4:]), camera, keypoints)
    return images


def read_points(folder):
    reader = Reader(folder / "points3D.bin")
    points = []
    for _ in range(reader.take("Q")):
        _, x, y, z, _, _, _, _, length = reader.take("Q3d3BdQ")
        reader.at += 8 * length
        points.append((x, y, z))
    return np.array(points)


def write_model(folder, cameras, images, source):
    folder.mkdir(parents=True)
    out = struct.pack("<Q", len(cameras))
    for number, (model, width, height, parameters) in cameras.items():
        out += struct.pack("<IiQQ", number, model, width, height) + np.asarray(parameters, "<f8").tobytes()
    (folder / "cameras.bin").write_bytes(out)
    out = struct.pack("<Q", len(images))
    for name, (number, q, t, camera, keypoints) in images.items():
        out += struct.pack("<I7dI", number, *q, *t, camera) + name.encode() + b"\0"
        out += struct.pack("<Q", len(keypoints) // 24) + keypoints
    (folder / "images.bin").write_bytes(out)
    shutil.copy(source / "points3D.bin", folder)


# --- rotations -----------------------------------------------------------------------------------------------


def matrix(q):
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def product(a, b):
    """Of quaternions: first b, then a."""
    (w, x, y, z), (p, q, r, s) = a, b
    return np.array(
        [
            w * p - x * q - y * r - z * s,
            w * q + x * p + y * s - z * r,
            w * r - x * s + y * p + z * q,
            w * s + x * r - y * q + z * p,
        ]
    )


def angle(rotation):
    """Degrees."""
    # Of the sine and the cosine, which is exact for small angles too.
    sine = np.linalg.norm([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return np.degrees(np.arctan2(sine / 2, (np.trace(rotation) - 1) / 2))


# --- the three commands --------------------------------------------------------------------------------------


def bilinear(photo, x, y):
    """Values of a photo [H, W, 3] at positions in pixels, whose first centre is at 0.5."""
    h, w, _ = photo.shape
    x, y = np.clip(x - 0.5, 0, w - 1), np.clip(y - 0.5, 0, h - 1)
    i, j = np.minimum(x.astype(int), w - 2), np.minimum(y.astype(int), h - 2)
    u, v = (x - i)[..., None], (y - j)[..., None]
    top = photo[j, i] * (1 - u) + photo[j, i + 1] * u
    return top * (1 - v) + (photo[j + 1, i] * (1 - u) + photo[j + 1, i + 1] * u) * v


def undistorted(radius, k1):
    """r with r (1 + k1 r^2) = radius, by Newton's method."""
    r = radius.copy()
    for _ in range(50):
        r -= (r * (1 + k1 * r * r) - radius) / (1 + 3 * k1 * r * r)
    return r


def warp(args):
    from PIL import Image

    source = model_folder(args.capture)
    cameras, images = read_cameras(source), read_images(source)
    (args.out / "images").mkdir(parents=True)
    # One pixel of border is lost where an axis leaves the old photo first.
    new, given = {}, {}
    for number, (model, w, h, parameters) in cameras.items():
        fx, fy, cx, cy = parameters if model == PINHOLE else parameters[[0, 0, 1, 2]]
        edge = lambda f, c, side: min(c, side - c) / f
        # The nearest side must stay inside along its whole length: find the focal length at which it does.
        zoom = 1.0
        for _ in range(200):
            xs, ys = np.meshgrid([0.0, cx, w], [0.0, cy, h])
            a, b = (xs - cx) / (fx * zoom), (ys - cy) / (fy * zoom)
            radius = np.hypot(a, b)
            scale = np.divide(undistorted(radius, args.k1), radius, out=np.ones_like(radius), where=radius > 0)
            inside = (np.abs(a * scale).max() <= edge(fx, cx, w) * 1.0 + 1e-9) and (np.abs(b * scale).max() <= edge(fy, cy, h) + 1e-9)
            if inside:
                break
            zoom *= 1.002
        true = np.array([fx * zoom, fy * zoom, cx, cy, args.k1, 0, 0, 0])
        new[number] = (OPENCV, w, h, true)
        told = true.copy()
        told[:2] *= args.given_focal
        told[4] = args.k1 if args.given_k1 is None else args.given_k1
        given[number] = (OPENCV, w, h, told)
    for name, (_, _, _, camera, _) in images.items():
        photo = np.asarray(Image.open(args.capture / "images" / name).convert("RGB"), dtype=float)
        h, w, _ = photo.shape
        _, _, _, (fx, fy, cx, cy, k1, *_) = new[camera]
        model, cw, ch, parameters = cameras[camera]
        old = parameters if model == PINHOLE else parameters[[0, 0, 1, 2]]
        assert (cw, ch) == (w, h), f"{name} is of another size than its camera"
        xs, ys = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
        a, b = (xs - cx) / fx, (ys - cy) / fy
        radius = np.hypot(a, b)
        scale = np.divide(undistorted(radius, k1), radius, out=np.ones_like(radius), where=radius > 0)
        out = bilinear(photo, old[0] * a * scale + old[2], old[1] * b * scale + old[3])
        path = (args.out / "images" / name).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.uint8(np.rint(out))).save(path)
    # Keypoints are those of the old photos.
    images = {str(Path(name).with_suffix(".png")): (*image[:4], b"") for name, image in images.items()}
    write_model(args.out / "sparse" / "0", given, images, source)
    write_model(args.out / "truth", new, images, source)
    for number, (_, _, _, true) in new.items():
        print(f"camera {number}: true", *np.round(true, 5), " given", *np.round(given[number][3], 5))


def scene_size(images, points):
    centres = [-matrix(q).T @ t for _, q, t, _, _ in images.values()]
    return float(np.median([np.median(np.linalg.norm(points - centre, axis=1)) for centre in centres]))


def perturb(args):
    source = model_folder(args.capture)
    cameras, images = read_cameras(source), read_images(source)
    size = scene_size(images, read_points(source))
    rng = np.random.Generator(np.random.PCG64(args.seed))
    moved = {}
    for name, (number, q, t, camera, keypoints) in images.items():
        axis, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        half = np.radians(args.degrees) / 2
        turned = product(np.array([np.cos(half), *(np.sin(half) * axis)]), q / np.linalg.norm(q))
        centre = -matrix(q).T @ t + args.share * size * shift
        moved[name] = (number, turned, -matrix(turned) @ centre, camera, b"" if args.without_keypoints else keypoints)
    shutil.copytree(args.capture / "images", args.out / "images")
    if (args.capture / "split.json").exists():
        shutil.copy(args.capture / "split.json", args.out)
    write_model(args.out / "sparse" / "0", cameras, moved, source)
    print(f"size of the scene {size:.4f}")


def similarity(source, target):
    """Scale, rotation and translation that take points to others with the least squares (Umeyama 1991)."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ np.diag(signs) @ vt
    scale = (s * signs).sum() / (a**2).sum()
    return scale, rotation, target.mean(0) - scale * rotation @ source.mean(0)


def stem(name):
    return str(Path(name).with_suffix(""))


def compare(args):
    truth, refined = (model_folder(folder) for folder in (args.truth, args.refined))
    size = scene_size(read_images(truth), read_points(truth))
    poses = [{stem(name): image for name, image in read_images(folder).items()} for folder in (truth, refined)]
    names = sorted(set(poses[0]) & set(poses[1]))
    rotations = [np.array([matrix(side[name][1]) for name in names]) for side in poses]
    centres = [np.array([-matrix(side[name][1]).T @ side[name][2] for name in names]) for side in poses]
    scale, rotation, shift = similarity(centres[1], centres[0])
    left = [angle(a @ rotation @ b.T) for a, b in zip(*rotations)]
    off = np.linalg.norm(centres[0] - (scale * centres[1] @ rotation.T + shift), axis=1) / size
    print(f"{len(names)} cameras; rotations off by {np.median(left):.4f} degrees in the median, {max(left):.4f} at most;")
    print(f"centres by {np.median(off):.6f} of the scene's size in the median, {off.max():.6f} at most")
    for label, folder in (("true", truth), ("refined", refined)):
        kinds = {(m, w, h, tuple(np.round(p, 5))) for m, w, h, p in read_cameras(folder).values()}
        for model, w, h, parameters in sorted(kinds)[:4]:
            print(f"{label:8} model {model}, {w}x{h}:", *parameters)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("warp")
    command.add_argument("capture", type=Path)
    command.add_argument("out", type=Path)
    command.add_argument("--k1", type=float, default=-0.1)
    command.add_argument("--given-k1", type=float)
    command.add_argument("--given-focal", type=float, default=1.0)
    command.set_defaults(run=warp)
    command = commands.add_parser("perturb")
    command.add_argument("capture", type=Path)
    command.add_argument("out", type=Path)
    command.add_argument("--degrees", type=float, default=1.0)
    command.add_argument("--share", type=float, default=0.01)
    command.add_argument("--seed", type=int, default=0)
    command.add_argument("--without-keypoints", action="store_true")
    command.set_defaults(run=perturb)
    command = commands.add_parser("compare")
    command.add_argument("truth", type=Path)
    command.add_argument("refined", type=Path)
    command.set_defaults(run=compare)
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()
