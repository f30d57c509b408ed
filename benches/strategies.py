#!/usr/bin/env python3
"""Compare the strategies on captures, and write docs/STRATEGIES.md with its picture.

    python3 benches/strategies.py run SPLAT CAPTURE...   # trains what docs/strategies.csv has not yet; hours
    python3 benches/strategies.py report                 # writes docs/STRATEGIES.md and docs/strategies.svg

SPLAT is the program (target/release/splat). Every run adds a line to docs/strategies.csv, so that an interrupted
comparison goes on, and processes for different captures may run at once (RAYON_NUM_THREADS gives each its threads).
Runs are half size, 7,000 steps, on the CPU, with the seeds 0, 1 and 2.
"""

import tempfile
from pathlib import Path

import runs

STEPS = 7000
SEEDS = (0, 1, 2)
#: Name of each arm, and what of its settings is not the default. MCMC's cap is a share of what ADC ends with.
ARMS = {
    "adc": ("ADC", 'strategy = "adc"\n', None),
    "absgrad6": ("AbsGrad, 6e-4", 'strategy = "adc"\n[density]\nabsgrad = true\ngrow_gradient = 6e-4\n', None),
    "absgrad8": ("AbsGrad, 8e-4", 'strategy = "adc"\n[density]\nabsgrad = true\ngrow_gradient = 8e-4\n', None),
    "mcmc": ("MCMC, up to ADC's count", 'strategy = "mcmc"\n', 1),
    "mcmc3": ("MCMC, up to a third", 'strategy = "mcmc"\n', 3),
}
COLORS = {"adc": "#1f77b4", "absgrad6": "#ff7f0e", "absgrad8": "#d62728", "mcmc": "#2ca02c", "mcmc3": "#17becf"}
# Strategies are compared with the rates that their constants are for.
RATES = "[learning_rates]\nshort_run_exponent = 0.0\n"
TABLE = runs.Table("strategies.csv", ("psnr", "ssim", "gaussians", "processor_seconds"))


def run(splat, captures):
    for seed in SEEDS:
        for capture in captures:
            for arm in ARMS:
                if (capture.name, arm, seed) not in TABLE.runs():
                    train(splat, capture, arm, seed)


def train(splat, capture, arm, seed):
    _, text, divisor = ARMS[arm]
    arguments, cap = [], None
    if divisor:
        cap = int(TABLE.runs()[capture.name, "adc", seed]["gaussians"]) // divisor
        arguments = ["--max-gaussians", cap]
    with tempfile.TemporaryDirectory() as folder:
        figures = runs.train(splat, capture, seed, STEPS, text + RATES, Path(folder) / "run", arguments)
    TABLE.keep(capture.name, arm, seed, figures)
    print(f"{capture.name:12} {arm:9} seed {seed}: {figures['psnr']:.2f} dB, {figures['gaussians']} Gaussians", flush=True)
    if cap and figures["gaussians"] > cap:
        print(f"  the capture has more points than the {cap} Gaussians that were meant")


def by_capture():
    """For each capture and arm, the figures of all seeds that are there."""
    found, all_runs = {}, TABLE.runs()
    for (capture, arm, seed), figures in sorted(all_runs.items()):
        # Machines differ; the run of ADC with the same seed is to be on the same one.
        figures["time"] = figures["processor_seconds"] / all_runs[capture, "adc", seed]["processor_seconds"]
        found.setdefault(capture, {}).setdefault(arm, []).append(figures)
    return found


def rows(found):
    for capture, arms in found.items():
        yield f"\n### {capture}\n\n| strategy | runs | PSNR (dB) | SSIM | Gaussians | time |\n|---|--:|--:|--:|--:|--:|"
        for arm, (name, _, _) in ARMS.items():
            if arm not in arms:
                continue
            cells = [name, str(len(arms[arm]))]
            for key, digits in (("psnr", 2), ("ssim", 4), ("gaussians", 0), ("time", 2)):
                values = [figures[key] for figures in arms[arm]]
                cells.append("1" if (arm, key) == ("adc", "time") else runs.cell(values, digits))
            yield "| " + " | ".join(cells) + " |"


def report():
    """Replaces what is between the markers of STRATEGIES.md, and writes the picture."""
    found = by_capture()
    runs.replace("STRATEGIES.md", "\n".join(rows(found)))
    runs.picture("strategies.svg", {arm: (ARMS[arm][0], COLORS[arm]) for arm in ARMS}, found)


if __name__ == "__main__":
    runs.main(run, report, __doc__)
