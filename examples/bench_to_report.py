"""From a bench file to a calibration report, by the commands of huddle."""

import subprocess
import sys
from pathlib import Path

import huddle


def run(command: str) -> None:
    """Run a command of huddle."""
    print(f"$ {command}", flush=True)
    arguments = command.split()[1:]
    subprocess.run([sys.executable, "-P", "-m", "huddle", *arguments], check=True)


# A commented bench file, to be filled in: sensors, ports, sensitivities, options, limits.
run("huddle init -o lab.toml")

# The limit that a data sheet gives: noise below 1.6e-11 (m/s²)²/Hz, -108 dB.
limit = """
[[limits]]
name = "data sheet"
frequency = [1, 50]
psd = [1.6e-11, 1.6e-11]
"""
bench = Path("lab.toml")
bench.write_text(bench.read_text(encoding="utf-8") + limit, encoding="utf-8")
run("huddle check lab.toml --no-devices")

# How long to record for 5 % precision at each frequency, at motion 250 times the noise.
run("huddle plan lab.toml --snr 250 --cov 0.05")

# With sensors connected: huddle run lab.toml --duration 4min
run("huddle simulate lab.toml --duration 4min --out night.h5")
run("huddle estimate night.h5 --band 1:50")
run("huddle report night.h5 --band 1:50 --out report.html")

# The recording can be read from Python, too.
recording = huddle.open("night.h5")
print(recording.sensors, recording.samples("A").shape, recording.channels("A"))
