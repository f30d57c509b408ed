#!/usr/bin/env python3
"""Train captures with the defaults and print a table of what came out.

    python3 benches/captures.py SPLAT OUT CAPTURE... [-- ARGUMENT...]

SPLAT is the program (target/release/splat), OUT a folder for the runs, one in each of its folders. Arguments behind `--`
are given to every run, such as `--steps 2000`. A run that is there already is not repeated.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

ROW = "| {} | {} | {} | {} | {} | {} | {} | {} |"


def train(splat, capture, out, arguments):
    """Trains a capture, unless that is done, and returns what the program said."""
    log = out.with_suffix(".log")
    if not (out / "metrics.json").exists():
        run = subprocess.run(
            [splat, "train", capture, "--out", out, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        log.write_text(run.stdout)
        if run.returncode != 0:
            sys.exit(f"{capture}: exit status {run.returncode}, see {log}")
    return log.read_text()


def main():
    arguments = sys.argv[1:]
    extra = arguments.index("--") if "--" in arguments else len(arguments)
    arguments, extra = arguments[:extra], arguments[extra + 1 :]
    if len(arguments) < 3:
        sys.exit(__doc__)
    splat, out, captures = arguments[0], Path(arguments[1]), [Path(path) for path in arguments[2:]]
    out.mkdir(parents=True, exist_ok=True)
    print(ROW.format("capture", "photos, held out", "points", "PSNR, dB", "SSIM", "Gaussians", "time, s", "warnings"))
    print("|---|--:|--:|--:|--:|--:|--:|--:|")
    for capture in captures:
        folder = out / capture.name
        said = train(splat, capture, folder, extra)
        metrics = json.loads((folder / "metrics.json").read_text())
        photos, held_out, points = re.search(r"(\d+) photos to train on, (\d+) held out, (\d+) points", said).groups()
        print(
            ROW.format(
                capture.name,
                f"{photos}, {held_out}",
                f"{int(points):,}",
                f"{metrics['psnr']:.2f}",
                f"{metrics['ssim']:.3f}",
                f"{metrics['gaussians']:,}",
                f"{metrics['seconds']:.0f}",
                sum(line.startswith("warning") for line in said.splitlines()),
            ),
            flush=True,
        )


if __name__ == "__main__":
    main()
