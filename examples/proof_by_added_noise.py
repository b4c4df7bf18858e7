"""Three sensors beside rotated channels, and with noise of known level added."""

import numpy as np

import huddle

# Your own samples in m/s², here simulated: 5 minutes of three triaxial sensors at 100 Hz. Motion is
# 60 dB above the noise of -130 dB. B and C are rotated, and their axes 0.5° off a right angle.
fs = 100
sensor = {"noise": {"shape": "white", "level": 1e-13}}
scenario = {
    "seed": 1,
    "motion": {"spectra": [{"shape": "white", "level": 1e-7}] * 3},
    "sensors": {
        "A": sensor,
        "B": sensor | {"rotation": 15.0},
        "C": sensor | {"rotation": [80.0, 20.0, -5.0]},
    },
}
samples = huddle.simulate(scenario, duration="5min", fs=fs)
a, b, c = (np.array(samples[name]) for name in "ABC")
axes = np.eye(3) + np.sin(np.deg2rad(0.5)) * np.eye(3, k=1)
b, c = b @ axes, c @ axes.T


def rotated(other: np.ndarray) -> np.ndarray:
    """Return the samples of another sensor in the directions of A."""
    u, _, vt = np.linalg.svd(other.T @ a)
    turned: np.ndarray = other @ u @ vt
    return turned


def noise(sensors: dict[str, np.ndarray], method: str) -> np.ndarray:
    """Return the mean noise of A from 1 to 40 Hz in dB, by channel."""
    result = huddle.self_noise(
        sensors, fs=fs, channels="XYZ", sample_unit="m/s²", segment="2s", method=method
    )
    levels: np.ndarray = result.band(1, 40).noise_db
    return levels[:3].round(1)


print("three-channel:            ", noise({"A": a, "B": b, "C": c}, "three-channel"))
print(
    "rotated first:            ", noise({"A": a, "B": rotated(b), "C": rotated(c)}, "three-channel")
)
print("three-sensor:             ", noise({"A": a, "B": b, "C": c}, "three-sensor"))

# Noise of known level in one channel, 4e-13 (m/s²)²/Hz: its estimate must rise by the factor 5,
# 7.0 dB, and the others must stay.
added = a.copy()
added[:, 0] += np.random.default_rng(1).normal(0, np.sqrt(4e-13 * fs / 2), len(a))
print("7.0 dB more noise in A.X: ", noise({"A": added, "B": b, "C": c}, "three-sensor"))
