"""Makes the example capture from its original: photos and cameras halved, keypoints and tracks dropped.

    python3 make.py ORIGINAL OUT        (needs Pillow)

ORIGINAL is a COLMAP folder (images/, sparse/0/*.bin) with PINHOLE cameras. Photos are averaged over blocks of 2 x 2
pixels; with pixel centres at + 0.5 the intrinsics are then exactly halved. Poses and points are copied as they are.
"""

import shutil
import struct
import sys
from pathlib import Path

from PIL import Image

FACTOR = 2
JPEG_QUALITY = 89


def cameras(data):
    out = bytearray(data[:8])
    for i in range(struct.unpack_from("<Q", data)[0]):
        camera, model, width, height, *parameters = struct.unpack_from("<IiQQ4d", data, 8 + 56 * i)
        assert model == 1, "only PINHOLE"
        halved = [value / FACTOR for value in parameters]
        out += struct.pack("<IiQQ4d", camera, model, width // FACTOR, height // FACTOR, *halved)
    return out


def images(data):
    out, at = bytearray(data[:8]), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        name_end = data.index(0, at + 64) + 1
        out += data[at:name_end] + struct.pack("<Q", 0)
        at = name_end + 8 + 24 * struct.unpack_from("<Q", data, name_end)[0]
    return out


def points(data):
    out, at = bytearray(data[:8]), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        out += data[at : at + 43] + struct.pack("<Q", 0)
        at += 51 + 8 * struct.unpack_from("<Q", data, at + 43)[0]
    return out


def main(original, out):
    (out / "images").mkdir(parents=True)
    (out / "sparse/0").mkdir(parents=True)
    for name, halve in [("cameras", cameras), ("images", images), ("points3D", points)]:
        data = (original / f"sparse/0/{name}.bin").read_bytes()
        (out / f"sparse/0/{name}.bin").write_bytes(halve(data))
    for path in sorted((original / "images").iterdir()):
        photo = Image.open(path).convert("RGB")
        whole = [side // FACTOR * FACTOR for side in photo.size]
        photo = photo.crop((0, 0, *whole)).reduce(FACTOR)
        photo.save(out / "images" / path.name, quality=JPEG_QUALITY, optimize=True)
    if (original / "split.json").exists():
        shutil.copyfile(original / "split.json", out / "split.json")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
