"""Noise of known level added to one channel of a real recording, and found again.

Three triaxial seismometers of the US Geological Survey, 6 h at 40 Hz, in counts (public domain).
The samples are no part of the project: `HUDDLE_DATA` names the folder that has them.
"""

import os
from pathlib import Path

import numpy as np

import huddle

FOLDER = Path(os.environ.get("HUDDLE_DATA", "../shared/data")) / "usgs-tst-huddle"
SENSORS = {"A": "TST5_00", "B": "TST5_10", "C": "TST6_00"}
FS = 40
BANDS = ((0.5, 1), (1, 2), (2, 4), (4, 8), (8, 15))
"""Hz."""


def noise(sensors: dict[str, np.ndarray]) -> np.ndarray:
    """Return the mean noise PSD of all channels in each band, in counts²/Hz."""
    result = huddle.self_noise(
        sensors, fs=FS, channels="012", segment="51.2s", detrend="none", method="three-sensor"
    )
    return np.array([result.band(*band).noise_psd for band in BANDS])


def main() -> None:
    """Add noise to the first channel of A, and compare the estimates before and after."""
    if not FOLDER.is_dir():
        print("skipped: no recording in HUDDLE_DATA")
        return
    import obspy  # noqa: PLC0415 - only where there are data

    sensors = {
        name: np.column_stack(
            [obspy.read(FOLDER / f"{code}_BH{c}.mseed")[0].data.astype(float) for c in range(3)]
        )
        for name, code in SENSORS.items()
    }
    before = noise(sensors)
    added = 4 * before[2, 0]  # four times the noise from 2 to 4 Hz
    rng = np.random.default_rng(1)
    sensors["A"][:, 0] += rng.normal(0, np.sqrt(added * FS / 2), len(sensors["A"]))
    after = noise(sensors)
    found = 10 * np.log10((after[:, 0] - before[:, 0]) / added)
    others = np.abs(10 * np.log10(after[:, 1:] / before[:, 1:])).max(axis=1)
    own = 10 * np.log10(np.column_stack([before[:, 0], after[:, 0]]))
    print("Hz      before  after   found  others (dB)")
    for band, levels, error, other in zip(BANDS, own, found, others, strict=True):
        print("{}–{}".format(*band).ljust(6), "{:7.2f} {:6.2f}".format(*levels), end="")
        print(f" {error:+7.2f} {other:7.2f}")


if __name__ == "__main__":
    main()
