#!/usr/bin/env python3
"""Compare the strategies on captures, and write docs/STRATEGIES.md with its picture.

    python3 benches/strategies.py run SPLAT FOLDER CAPTURE...   # trains what is missing in FOLDER; hours
    python3 benches/strategies.py report FOLDER docs            # writes STRATEGIES.md and strategies.svg

SPLAT is the program (target/release/splat). Every run keeps its metrics.json in FOLDER, so that an interrupted
comparison goes on. Runs are half size, 7,000 steps, on the CPU, with the seeds 0, 1 and 2.
"""

import json
import math
import resource
import shutil
import subprocess
import sys
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


def metrics(folder, capture, arm, seed):
    path = folder / f"{capture}-{arm}-{seed}.json"
    return json.loads(path.read_text()) if path.exists() else None


def run(splat, folder, captures):
    folder.mkdir(parents=True, exist_ok=True)
    for seed in SEEDS:
        for capture in captures:
            for arm in ARMS:
                if metrics(folder, capture.name, arm, seed) is None:
                    train(splat, folder, capture, arm, seed)


def train(splat, folder, capture, arm, seed):
    _, text, divisor = ARMS[arm]
    out, config = folder / "run", folder / "run.toml"
    config.write_text(text)
    command = [splat, "--device", "cpu", "--seed", str(seed), "--quiet", "train", capture, "--downscale", "2"]
    command += ["--steps", str(STEPS), "--config", config, "--out", out]
    if divisor:
        adc = metrics(folder, capture.name, "adc", seed)
        command += ["--max-gaussians", str(adc["gaussians"] // divisor)]
    shutil.rmtree(out, ignore_errors=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([str(part) for part in command], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    found = json.loads((out / "metrics.json").read_text())
    cap = adc["gaussians"] // divisor if divisor else None
    if cap and found["gaussians"] > cap:
        print(f"{capture.name}, {arm}: {found['gaussians']} Gaussians from the start are more than the {cap} that were meant")
    # Of the processor, which other work on the machine changes less than it does wall time.
    found["processor_seconds"] = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    (folder / f"{capture.name}-{arm}-{seed}.json").write_text(json.dumps(found))
    print(f"{capture.name:12} {arm:9} seed {seed}: {found['psnr']:.2f} dB, {found['gaussians']} Gaussians", flush=True)


def summary(values):
    """Mean, and standard error of the mean."""
    mean = sum(values) / len(values)
    if len(values) < 2:
        return mean, float("nan")
    variance = sum((value - mean) ** 2 for value in values) / (len(values) - 1)
    return mean, math.sqrt(variance / len(values))


def gather(folder):
    """For each capture and arm, the metrics of all seeds that are there."""
    found = {}
    for path in sorted(folder.glob("*-*-*.json")):
        capture, arm, _ = path.stem.rsplit("-", 2)
        found.setdefault(capture, {}).setdefault(arm, []).append(json.loads(path.read_text()))
    return found


def rows(found):
    for capture, arms in found.items():
        yield f"\n### {capture}\n\n| strategy | runs | PSNR (dB) | SSIM | Gaussians | processor time (s) |\n|---|--:|--:|--:|--:|--:|"
        for arm, (name, _, _) in ARMS.items():
            if arm not in arms:
                continue
            cells = [name, str(len(arms[arm]))]
            for key, digits in (("psnr", 2), ("ssim", 4), ("gaussians", 0), ("processor_seconds", 0)):
                mean, error = summary([metrics[key] for metrics in arms[arm]])
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


def report(folder, docs):
    """Replaces what is between the markers of STRATEGIES.md, and writes the picture."""
    found = gather(folder)
    page = docs / "STRATEGIES.md"
    before, rest = page.read_text().split("<!-- runs -->\n")
    _, after = rest.split("<!-- end of runs -->\n")
    table = "\n".join(rows(found)).strip()
    page.write_text(f"{before}<!-- runs -->\n{table}\n<!-- end of runs -->\n{after}")
    (docs / "strategies.svg").write_text(picture(found))


if __name__ == "__main__":
    what, *paths = sys.argv[1:] or [""]
    paths = [Path(path) for path in paths]
    if what == "run" and len(paths) > 2:
        run(paths[0], paths[1], paths[2:])
    elif what == "report" and len(paths) == 2:
        report(*paths)
    else:
        sys.exit(__doc__)
