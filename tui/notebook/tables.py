"""Spectra as an xarray Dataset and as a pandas DataFrame."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from estimator.self_noise.result import Flag
from tui.output.extras import load

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd
    import xarray as xr
    from numpy.typing import NDArray

    from daq.estimation.snapshot import Snapshot

_CURVES = {"noise_psd": "noise_psd", "noise_low": "low", "noise_high": "high", "cov": "cov"}
"""Attributes of `estimator.self_noise.result.SelfNoise`, by name of the variable."""
_LONG_NAMES = {
    "noise_psd": "one-sided power spectral density of the self-noise",
    "noise_low": "lower end of the 95 % interval of the self-noise",
    "noise_high": "upper end of the 95 % interval of the self-noise",
    "data_psd": "one-sided power spectral density of the samples",
    "cov": "coefficient of variation of the self-noise",
    "flags": "sum of flags",
}


def to_xarray(snapshot: Snapshot, said: Mapping[str, str]) -> xr.Dataset:
    """Return the spectra of all methods; see `tui.notebook.result.Result.to_xarray`.

    Parameters
    ----------
    snapshot : Snapshot
    said : mapping of str to str
        Attributes: what made the estimate.
    """
    xarray = load("xarray")
    labels = snapshot.channels
    sensors = list(snapshot.sensor_names)
    channels = list(dict.fromkeys(label.channel for label in labels))
    rows = [sensors.index(label.sensor) for label in labels]
    columns = [channels.index(label.channel) for label in labels]

    def spread(values: NDArray[Any]) -> NDArray[Any]:
        """Return values by sensor, channel and frequency."""
        shape = (len(sensors), len(channels), len(snapshot.frequency))
        empty = np.nan if values.dtype.kind == "f" else 0
        whole = np.full(shape, empty, dtype=values.dtype)
        whole[rows, columns] = values.T
        return whole

    axes = ("sensor", "channel", "frequency")
    results = snapshot.results.values()
    variables: dict[str, Any] = {
        name: (("estimate", *axes), np.stack([spread(getattr(each, field)) for each in results]))
        for name, field in {**_CURVES, "flags": "flags"}.items()
    }
    variables["data_psd"] = (axes, spread(snapshot.data_psd))
    found: xr.Dataset = xarray.Dataset(
        variables,
        coords={
            "estimate": list(snapshot.results),  # "method" is an argument of sel()
            "sensor": sensors,
            "channel": channels,
            "frequency": ("frequency", snapshot.frequency, {"units": "Hz"}),
        },
        attrs={
            "Conventions": "CF-1.11",
            **said,
            "n_segments": snapshot.n_segments,
            "effective_averages": snapshot.n_effective,
            "unit_of_motion": snapshot.unit,
        },
    )
    for name, long_name in _LONG_NAMES.items():
        found[name].attrs["long_name"] = long_name
        if name.endswith(("psd", "low", "high")):
            found[name].attrs["units"] = f"({snapshot.unit})²/Hz"
    found["cov"].attrs["units"] = "1"
    masks = np.array([int(flag) for flag in Flag], found["flags"].dtype)
    found["flags"].attrs |= {
        "flag_masks": masks,
        "flag_meanings": " ".join(str(flag.name).lower() for flag in Flag),
    }
    return found


def to_frame(snapshot: Snapshot) -> pd.DataFrame:
    """Return the spectra of all methods; see `tui.notebook.result.Result.to_frame`."""
    pandas = load("pandas")
    n_freqs = len(snapshot.frequency)
    parts = [
        pandas.DataFrame(
            {
                "method": np.repeat(method, n_freqs),
                "sensor": np.repeat(label.sensor, n_freqs),
                "channel": np.repeat(label.channel, n_freqs),
                "frequency": snapshot.frequency,
                "data_psd": snapshot.data_psd[:, column],
                **{name: getattr(noise, field)[:, column] for name, field in _CURVES.items()},
                "flags": noise.flags[:, column],
            }
        )
        for method, noise in snapshot.results.items()
        for column, label in enumerate(snapshot.channels)
    ]
    whole: pd.DataFrame = pandas.concat(parts, ignore_index=True)
    return whole
