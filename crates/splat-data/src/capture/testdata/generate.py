#!/usr/bin/env python3
"""Writes the photos in this folder: one picture of 32 x 24 pixels in several kinds of files.

    python3 generate.py        needs Pillow, of which 9.4 was used

The picture has four quarters: white, red (200, 40, 30), blue (20, 60, 180) and black.
"""

from PIL import Image

COLORS = [(255, 255, 255), (200, 40, 30), (20, 60, 180), (0, 0, 0)]


def quarters(mode, colors):
    picture = Image.new(mode, (32, 24))
    for index, color in enumerate(colors):
        x, y = 16 * (index % 2), 12 * (index // 2)
        picture.paste(color, (x, y, x + 16, y + 12))
    return picture


def ycc(r, g, b):
    return Image.new("RGB", (1, 1), (r, g, b)).convert("YCbCr").getpixel((0, 0))


rgb = quarters("RGB", COLORS)
# Black as a share of the fourth ink, so that it matters.
inks = [(255 - r, 255 - g, 255 - b, 0) for r, g, b in COLORS[:3]] + [(0, 0, 0, 255)]
jpeg = {"quality": 95, "subsampling": 0, "optimize": True}

# Pillow writes inks inverted, with Adobe's marker.
quarters("CMYK", inks).save("cmyk_adobe.jpg", **jpeg)
# The same as luma and chroma, with black apart: transform 2 in Adobe's marker. libjpeg takes the
# complement of what is stored, which is inverted already, so that these are luma and chroma of the inks.
stored = [(*ycc(c, m, y), 255 - k) for c, m, y, k in inks]
inverted = [tuple(255 - value for value in values) for values in stored]
quarters("CMYK", inverted).save("ycck_adobe.jpg", **jpeg)
data = bytearray(open("ycck_adobe.jpg", "rb").read())
data[data.index(b"Adobe") + 11] = 2
open("ycck_adobe.jpg", "wb").write(data)

rgb.quantize(8).save("palette.png", optimize=True)
palette = rgb.quantize(4)
palette.save("palette_transparent.png", transparency=palette.getpixel((0, 0)))
rgb.convert("L").convert("1").save("bilevel.png")
rgb.save("lossy.webp", quality=90)
translucent = rgb.convert("RGBA")
translucent.putalpha(quarters("L", [255, 128, 0, 255]))
translucent.save("lossy_alpha.webp", quality=90, exact=True)
rgb.save("lossless.webp", lossless=True)
rgb.save("lzw.tiff", compression="tiff_lzw")
rgb.save("deflate.tiff", compression="tiff_adobe_deflate")
rgb.save("jpeg.tiff", compression="jpeg", quality=95)
quarters("CMYK", inks).save("cmyk.tiff", compression="tiff_lzw")
