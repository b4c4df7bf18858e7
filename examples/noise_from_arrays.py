"""Self-noise of three accelerometers, from arrays."""

import numpy as np

import huddle

# Arrays as your own program has them: 10 minutes of three triaxial sensors at 200 Hz, in m/s².
# These are simulated. Motion is white, noise is 1e-13 (m/s²)²/Hz, -130 dB; B and C are rotated.
fs = 200
scenario = {
    "seed": 1,
    "motion": {"spectra": [{"shape": "white", "level": 1e-10}] * 3},
    "sensors": {
        "A": {"noise": {"shape": "white", "level": 1e-13}},
        "B": {"noise": {"shape": "white", "level": 1e-13}, "rotation": 15.0},
        "C": {"noise": {"shape": "white", "level": 1e-13}, "rotation": [80.0, 20.0, -5.0]},
    },
}
samples = huddle.simulate(scenario, duration="10min", fs=fs)
a, b, c = (np.array(samples[name]) for name in "ABC")
b[30_000:30_050] = np.nan  # lost samples

result = huddle.self_noise(
    {"A": a, "B": b, "C": c},
    fs=fs,
    channels="XYZ",
    sample_unit="m/s²",
    segment="5s",
    method="all",
)
print(result)

# The mean over a band, with its 95 % interval, by a method that assumes aligned sensors.
print(result.with_method("three-channel").band(1, 50))

# One channel against frequency.
x = result["B", "X"]
at_10_hz = np.argmin(np.abs(x.frequency - 10))
print(f"{x!r}: {x.noise_psd[at_10_hz]:.2e} ({x.unit})²/Hz at 10 Hz")

print("Facts about the test, the worst first:")
for each in result.facts:
    print(each.line)

result.plot().savefig("noise.svg")
