"""Training runs of a comparison: kept in a CSV as soon as they end, and reported with their standard errors."""

import csv
import json
import math
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"
KEY = ("capture", "arm", "seed")


class Table:
    """A CSV in docs/ with a line for each run: capture, arm, seed and figures."""

    def __init__(self, name, figures):
        self.path, self.figures = DOCS / name, figures

    def runs(self):
        """The figures of all runs so far, by capture, arm and seed; `None` where a run has not such a figure."""
        if not self.path.exists():
            return {}
        with self.path.open() as file:
            lines = list(csv.DictReader(file))
        return {
            (line["capture"], line["arm"], int(line["seed"])): {
                name: float(line[name]) if line[name] else None for name in self.figures
            }
            for line in lines
        }

    def keep(self, capture, arm, seed, figures):
        begins = not self.path.exists()
        with self.path.open("a") as file:
            writer = csv.writer(file, lineterminator="\n")
            if begins:
                writer.writerow([*KEY, *self.figures])
            values = ["" if figures.get(name) is None else f"{figures[name]:.6g}" for name in self.figures]
            writer.writerow([capture, arm, seed, *values])


def train(splat, capture, seed, steps, config, out, arguments=()):
    """Trains at half size on the CPU with the settings of `config`, and returns the figures of the run."""
    with tempfile.NamedTemporaryFile("w", suffix=".toml") as file:
        file.write(config)
        file.flush()
        command = [splat, "--device", "cpu", "--seed", seed, "--quiet", "train", capture, "--downscale", 2]
        command += ["--steps", steps, "--config", file.name, "--out", out, *arguments]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        call(command)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    # Of the processor, which other work on the machine changes less than it does wall time.
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return json.loads((Path(out) / "metrics.json").read_text()) | {"processor_seconds": spent}


def call(command):
    subprocess.run([str(part) for part in command], check=True, stdout=subprocess.DEVNULL)


def summary(values):
    """Mean, and standard error of the mean."""
    mean = sum(values) / len(values)
    if len(values) < 2:
        return mean, math.nan
    variance = sum((value - mean) ** 2 for value in values) / (len(values) - 1)
    return mean, math.sqrt(variance / len(values))


def cell(values, digits):
    """A cell of a table."""
    mean, error = summary(values)
    return f"{mean:,.{digits}f}" + ("" if math.isnan(error) else f" ± {error:,.{digits}f}")


def replace(page, text, name="runs"):
    """Puts text between the markers of a page in docs/."""
    page = DOCS / page
    begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->\n"
    before, rest = page.read_text().split(begin)
    _, after = rest.split(end)
    page.write_text(f"{before}{begin}{text.strip()}\n{end}{after}")


def picture(name, arms, captures):
    """Draws PSNR against the number of Gaussians into docs/, a panel for each capture, a dot for each run.

    `arms` has name and colour of each arm, `captures` the figures of the runs of each arm.
    """
    side, gap = 300, 70
    # At least as wide as the names of the arms below.
    width = max(gap + len(captures) * (side + gap), gap + 200 * len(arms))
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {side + 130}" font-family="sans-serif" font-size="12">']
    parts.append(f'<rect width="{width}" height="{side + 130}" fill="white"/>')
    for index, (capture, runs_of) in enumerate(captures.items()):
        left, top = gap + index * (side + gap), 40
        runs = [(arm, each["gaussians"] / 1000, each["psnr"]) for arm in runs_of for each in runs_of[arm]]
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
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4.5" fill="{arms[arm][1]}" fill-opacity="0.75"/>')
    parts.append(f'<text x="{gap}" y="{side + 78}">held-out PSNR (dB) against Gaussians</text>')
    for index, (label, color) in enumerate(arms.values()):
        x = gap + index * 200
        parts.append(f'<circle cx="{x + 5}" cy="{side + 100}" r="5" fill="{color}"/>')
        parts.append(f'<text x="{x + 16}" y="{side + 104}">{label}</text>')
    (DOCS / name).write_text("\n".join([*parts, "</svg>\n"]))


def axis(values, least=None):
    """Ends of an axis that holds the values, and ticks on it."""
    low, high = (min(values) if least is None else least), max(values)
    step = 10 ** math.floor(math.log10(max(high - low, 1e-3)))
    step = next(each for each in (step / 5, step / 2, step, step * 2) if (high - low) / each <= 6)
    first, last = math.floor(low / step - 0.2), math.ceil(high / step + 0.2)
    first = max(first, 0) if least == 0 else first
    return first * step, last * step, [round(tick * step, 6) for tick in range(first, last + 1)]


def main(run, report, usage):
    """The command line of a comparison: `run SPLAT CAPTURE...` or `report`."""
    what, *paths = sys.argv[1:] or [""]
    if what == "run" and len(paths) > 1:
        run(Path(paths[0]), [Path(path) for path in paths[1:]])
    elif what == "report" and not paths:
        report()
    else:
        sys.exit(usage)
