#!/usr/bin/env python3
"""Compare recipes with the reference on captures, and write the tables of docs/RECIPES.md with their picture.

    python3 benches/recipes.py run SPLAT CAPTURE...   # trains what docs/recipes.csv has not yet; hours
    python3 benches/recipes.py report                 # writes docs/RECIPES.md and docs/recipes.svg

SPLAT is the program (target/release/splat). Runs are half size, 7,000 steps, on the CPU, with the seeds 0, 1 and 2.
The reference is adaptive density control with the published rates, the default before there were recipes; where
docs/strategies.csv has such a run it is not made again. What `compact` makes is also written by `splat compact` as SPZ,
which is read again and scored. Every run adds a line to docs/recipes.csv, as in benches/strategies.py. Times are
compared by `splat bench recipes`, which takes turns.
"""

import subprocess
import tempfile
from pathlib import Path

import runs
import strategies

STEPS, SEEDS = strategies.STEPS, strategies.SEEDS
RECIPES = Path(__file__).parents[1] / "crates/trainer/src/recipes"
#: Name and colour of each arm.
ARMS = {
    "reference": ("reference", "#1f77b4"),
    "compact": ("compact", "#d62728"),
    "best": ("best", "#2ca02c"),
}
# Bytes of a Gaussian in a PLY file, with normals, as 3DGS writes it.
PLY_BYTES = 248
FILE = ("file_gaussians", "file_bytes", "file_psnr", "file_ssim")
TABLE = runs.Table("recipes.csv", ("psnr", "ssim", "gaussians", *FILE))


def known():
    """All runs so far, those of ADC in docs/strategies.csv among them."""
    found = TABLE.runs()
    for (capture, arm, seed), figures in strategies.TABLE.runs().items():
        if arm == "adc":
            found.setdefault((capture, "reference", seed), figures)
    return found


def run(splat, captures):
    for seed in SEEDS:
        for capture in captures:
            for arm in ARMS:
                if (capture.name, arm, seed) not in known():
                    train(splat, capture, arm, seed)


def train(splat, capture, arm, seed):
    config = strategies.RATES if arm == "reference" else (RECIPES / f"{arm}.toml").read_text()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        figures = runs.train(splat, capture, seed, STEPS, config, out)
        if arm == "compact":
            figures |= written(splat, capture, out)
    TABLE.keep(capture.name, arm, seed, figures)
    print(f"{capture.name:15} {arm:9} seed {seed}: {figures['psnr']:.2f} dB, {figures['gaussians']} Gaussians", flush=True)


def written(splat, capture, out):
    """The figures of the scene as a small file."""
    file, scores = out / "scene.spz", out / "scores.json"
    command = [splat, "--device", "cpu", "--quiet", "compact", out / "scene.ply", "--capture", capture, "--downscale", 2]
    said = subprocess.run([*map(str, command), "--out", str(file)], check=True, stdout=subprocess.PIPE, text=True).stdout
    # "from the file" and the number of Gaussians.
    (line,) = (line for line in said.splitlines() if line.startswith("from the file"))
    runs.call([splat, "--device", "cpu", "--quiet", "eval", capture, file, "--downscale", 2, "--json", scores])
    scores = runs.json.loads(scores.read_text())
    return dict(zip(FILE, (int(line.split()[3]), file.stat().st_size, scores["psnr"], scores["ssim"])))


def by_capture():
    """For each capture and arm, the figures of all seeds that are there."""
    found = {}
    for (capture, arm, _), figures in sorted(known().items()):
        found.setdefault(capture, {}).setdefault(arm, []).append(figures)
    return found


def beside(arm, reference):
    """What `arm` has beside `reference`, as means over the seeds: dB, SSIM, shares of Gaussians and of bytes."""
    mean = lambda runs_of, name: runs.summary([each[name] for each in runs_of])[0]
    difference = lambda name: mean(arm, name) - mean(reference, name.removeprefix("file_"))
    share = mean(arm, "gaussians") / mean(reference, "gaussians")
    figures = {"psnr": difference("psnr"), "ssim": difference("ssim"), "gaussians": share}
    if arm[0].get("file_psnr") is not None:
        figures["gaussians"] = mean(arm, "file_gaussians") / mean(reference, "gaussians")
        figures |= {"psnr": difference("file_psnr"), "ssim": difference("file_ssim")}
        figures["bytes"] = mean(arm, "file_bytes") / (PLY_BYTES * mean(reference, "gaussians"))
    return figures


def rows(found):
    yield "| capture | recipe | runs | PSNR (dB) | SSIM | Gaussians | as SPZ: PSNR (dB) | SSIM | Gaussians | kB |"
    yield "|---|---|--:|--:|--:|--:|--:|--:|--:|--:|"
    for capture, arms in found.items():
        for arm in (arm for arm in ARMS if arm in arms):
            cells = [capture, f"`{arm}`" if arm != "reference" else arm, str(len(arms[arm]))]
            for key, digits in (("psnr", 2), ("ssim", 4), ("gaussians", 0)):
                cells.append(runs.cell([figures[key] for figures in arms[arm]], digits))
            for key, digits, unit in (("file_psnr", 2, 1), ("file_ssim", 4, 1), ("file_gaussians", 0, 1), ("file_bytes", 0, 1e3)):
                values = [figures.get(key) for figures in arms[arm]]
                cells.append("" if None in values else runs.cell([value / unit for value in values], digits))
            yield "| " + " | ".join(cells) + " |"
    yield "\nBeside the reference, means over the seeds; `compact` as the file that was read again:\n"
    yield "| capture | recipe | PSNR (dB) | SSIM | Gaussians | bytes of the PLY |\n|---|---|--:|--:|--:|--:|"
    for arm in (arm for arm in ARMS if arm != "reference"):
        compared = {
            capture: beside(arms[arm], arms["reference"])
            for capture, arms in found.items()
            if arm in arms and "reference" in arms
        }
        if len(compared) > 1:
            names = next(iter(compared.values()))
            compared["mean"] = {name: runs.summary([each[name] for each in compared.values()])[0] for name in names}
        for capture, figures in compared.items():
            cells = [capture, f"`{arm}`", f"{figures['psnr']:+.2f}", f"{figures['ssim']:+.4f}", f"{figures['gaussians']:.1%}"]
            yield "| " + " | ".join([*cells, f"{figures['bytes']:.1%}" if "bytes" in figures else ""]) + " |"


def report():
    """Replaces what is between the markers of RECIPES.md, and writes the picture."""
    found = by_capture()
    runs.replace("RECIPES.md", "\n".join(rows(found)))
    runs.picture("recipes.svg", ARMS, found)


if __name__ == "__main__":
    runs.main(run, report, __doc__)
