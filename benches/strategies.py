#!/usr/bin/env python3
"""Compare the strategies on captures, and write docs/STRATEGIES.md with its picture.

    python3 benches/strategies.py run SPLAT CAPTURE...   # trains what docs/strategies.csv has not yet; hours
    python3 benches/strategies.py report                 # writes docs/STRATEGIES.md and docs/strategies.svg

SPLAT is the program (target/release/splat). Every run adds a line to docs/strategies.csv, so that an interrupted
comparison goes on. Runs are half size, 7,000 steps, on the CPU, with the seeds 0, 1 and 2.
"""

import csv
import json
import math
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

STEPS = 7000
SEEDS = (0, 1, 2)
#: Name of each arm, and what of its settings is not the default. MCMC's cap is a share of what ADC ends with.
ARMS = {
    "adc": ("ADC", 'strategy = "adc"\n', None),
    "absgrad6": ("AbsGrad, 6e-4", 'strategy = "adc"\n[density]\nabsgrad = true\ngrow_gradient = 6e-4\n', None),
    "absgrad8": ("AbsGrad, 8e-4", 'strategy = "adc"\n[density]\nabsgrad = true\ngrow_gradient = 8e-4\n', None),
    "mcmc": ("MCMC, as many as ADC", 'strategy = "mcmc"\n', 1),
    "mcmc3": ("MCMC, a third", 'strategy = "mcmc"\n', 3),
}


# Strategies are compared with the rates that their constants are for.
RATES = "[learning_rates]\nshort_run_exponent = 0.0\n"
DOCS = Path(__file__).parents[1] / "docs"
FIGURES = ("psnr", "ssim", "gaussians", "processor_seconds")


def gather():
    """The figures of all runs so far, by capture, arm and seed."""
    path = DOCS / "strategies.csv"
    if not path.exists():
        return {}
    with path.open() as file:
        runs = list(csv.DictReader(file))
    return {(run["capture"], run["arm"], int(run["seed"])): {key: float(run[key]) for key in FIGURES} for run in runs}


def keep(capture, arm, seed, figures):
    path = DOCS / "strategies.csv"
    begins = not path.exists()
    with path.open("a") as file:
        writer = csv.writer(file, lineterminator="\n")
        if begins:
            writer.writerow(["capture", "arm", "seed", *FIGURES])
        writer.writerow([capture, arm, seed, *(f"{figures[key]:.6g}" for key in FIGURES)])


def run(splat, captures):
    for seed in SEEDS:
        for capture in captures:
            for arm in ARMS:
                if (capture.name, arm, seed) not in gather():
                    train(splat, capture, arm, seed)


def train(splat, capture, arm, seed):
    _, text, divisor = ARMS[arm]
    with tempfile.TemporaryDirectory() as folder:
        out, config = Path(folder) / "run", Path(folder) / "run.toml"
        config.write_text(text + RATES)
        command = [splat, "--device", "cpu", "--seed", seed, "--quiet", "train", capture, "--downscale", 2]
        command += ["--steps", STEPS, "--config", config, "--out", out]
        cap = None
        if divisor:
            cap = int(gather()[capture.name, "adc", seed]["gaussians"]) // divisor
            command += ["--max-gaussians", cap]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([str(part) for part in command], check=True, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        figures = json.loads((out / "metrics.json").read_text())
    # Of the processor, which other work on the machine changes less than it does wall time.
    figures["processor_seconds"] = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    keep(capture.name, arm, seed, figures)
    print(f"{capture.name:12} {arm:9} seed {seed}: {figures['psnr']:.2f} dB, {figures['gaussians']} Gaussians", flush=True)
    if cap and figures["gaussians"] > cap:
        print(f"  the capture has more points than the {cap} Gaussians that were meant")


def summary(values):
    """Mean, and standard error of the mean."""
    mean = sum(values) / len(values)
    if len(values) < 2:
        return mean, float("nan")
    variance = sum((value - mean) ** 2 for value in values) / (len(values) - 1)
    return mean, math.sqrt(variance / len(values))


def by_capture():
    """For each capture and arm, the figures of all seeds that are there."""
    found = {}
    for (capture, arm, _), figures in gather().items():
        found.setdefault(capture, {}).setdefault(arm, []).append(figures)
    return found


def rows(found):
    for capture, arms in found.items():
        yield f"\n### {capture}\n\n| strategy | runs | PSNR (dB) | SSIM | Gaussians | processor time (s) |\n|---|--:|--:|--:|--:|--:|"
        for arm, (name, _, _) in ARMS.items():
            if arm not in arms:
                continue
            cells = [name, str(len(arms[arm]))]
            for key, digits in (("psnr", 2), ("ssim", 4), ("gaussians", 0), ("processor_seconds", 0)):
                mean, error = summary([figures[key] for figures in arms[arm]])
                cells.append(f"{mean:,.{digits}f}" + ("" if math.isnan(error) else f" ± {error:,.{digits}f}"))
            yield "| " + " | ".join(cells) + " |"


COLORS = {"adc": "#1f77b4", "absgrad6": "#ff7f0e", "absgrad8": "#d62728", "mcmc": "#2ca02c", "mcmc3": "#17becf"}


def picture(found):
    """PSNR against the number of Gaussians, a panel for each capture, a dot for each run."""
    side, gap = 300, 70
    width = gap + len(found) * (side + gap)
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {side + 130}" font-family="sans-serif" font-size="12">']
    parts.append(f'<rect width="{width}" height="{side + 130}" fill="white"/>')
    for index, (capture, arms) in enumerate(found.items()):
        left, top = gap + index * (side + gap), 40
        runs = [(arm, each["gaussians"] / 1000, each["psnr"]) for arm in arms for each in arms[arm]]
        across, up = axis([x for _, x, _ in runs], 0), axis([y for _, _, y in runs])
        parts.append(f'<text x="{left + side / 2}" y="28" text-anchor="middle" font-size="14">{capture}</text>')
        parts.append(f'<rect x="{left}" y="{top}" width="{side}" height="{side}" fill="none" stroke="#888"/>')
        for tick in across[2]:
            x = left + side * (tick - across[0]) / (across[1] - across[0])
            parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{top}" y2="{top + side}" stroke="#eee"/>')
            parts.append(f'<text x="{x:.1f}" y="{top + side + 16}" text-anchor="middle">{tick:g}k</text>')
        for tick in up[2]:
            y = top + side - side * (tick - up[0]) / (up[1] - up[0])
            parts.append(f'<line x1="{left}" x2="{left + side}" y1="{y:.1f}" y2="{y:.1f}" stroke="#eee"/>')
            parts.append(f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">{tick:g}</text>')
        for arm, x, y in runs:
            x = left + side * (x - across[0]) / (across[1] - across[0])
            y = top + side - side * (y - up[0]) / (up[1] - up[0])
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4.5" fill="{COLORS[arm]}" fill-opacity="0.75"/>')
    parts.append(f'<text x="{gap}" y="{side + 78}">held-out PSNR (dB) against Gaussians</text>')
    for index, (arm, (name, _, _)) in enumerate(ARMS.items()):
        x = gap + index * 200
        parts.append(f'<circle cx="{x + 5}" cy="{side + 100}" r="5" fill="{COLORS[arm]}"/>')
        parts.append(f'<text x="{x + 16}" y="{side + 104}">{name}</text>')
    return "\n".join([*parts, "</svg>\n"])


def axis(values, least=None):
    """Ends of an axis that holds the values, and ticks on it."""
    low, high = (min(values) if least is None else least), max(values)
    step = 10 ** math.floor(math.log10(max(high - low, 1e-3)))
    step = next(each for each in (step / 5, step / 2, step, step * 2) if (high - low) / each <= 6)
    first, last = math.floor(low / step - 0.2), math.ceil(high / step + 0.2)
    first = max(first, 0) if least == 0 else first
    return first * step, last * step, [round(tick * step, 6) for tick in range(first, last + 1)]


def report():
    """Replaces what is between the markers of STRATEGIES.md, and writes the picture."""
    found = by_capture()
    page = DOCS / "STRATEGIES.md"
    before, rest = page.read_text().split("<!-- runs -->\n")
    _, after = rest.split("<!-- end of runs -->\n")
    table = "\n".join(rows(found)).strip()
    page.write_text(f"{before}<!-- runs -->\n{table}\n<!-- end of runs -->\n{after}")
    (DOCS / "strategies.svg").write_text(picture(found))


if __name__ == "__main__":
    what, *paths = sys.argv[1:] or [""]
    if what == "run" and len(paths) > 1:
        run(Path(paths[0]), [Path(path) for path in paths[1:]])
    elif what == "report" and not paths:
        report()
    else:
        sys.exit(__doc__)
