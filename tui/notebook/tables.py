"""Spectra as an xarray Dataset and as a pandas DataFrame."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from daq.bench.units import cf_unit
from estimator.self_noise.result import Flag
from tui.output.curves import CURVES
from tui.output.extras import load

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd
    import xarray as xr

    from daq.bench.channel import Channel
    from daq.estimation.snapshot import Snapshot

_LONG_NAMES = {
    **{curve.name: curve.meaning for curve in CURVES},
    "data_psd": "one-sided power spectral density of the samples",
    "flags": "sum of flags",
    "csm_real": "real part of E[X conj(Y)], X of trace and Y of other_trace, one-sided",
    "csm_imag": "imaginary part of E[X conj(Y)], X of trace and Y of other_trace, one-sided",
    "coherence": "magnitude-squared coherence of trace and other_trace",
    "response_amplitude": "counts that a unit of motion gives, in response_unit",
    "response_phase": "phase of the counts against the motion",
}
_AXES = ("estimate", "trace", "frequency")


def to_xarray(
    snapshot: Snapshot,
    said: Mapping[str, str],
    channels: Mapping[str, Channel] | None = None,
    *,
    matrix: bool = False,
) -> xr.Dataset:
    """Return the spectra of all methods; see `tui.notebook.result.Result.to_xarray`.

    Parameters
    ----------
    snapshot : Snapshot
    said : mapping of str to str
        Attributes: what made the estimate.
    channels : mapping of str to Channel, optional
        Sensitivity and response by ``sensor.channel``.
    matrix : bool
        Whether the cross-spectral matrix and the coherence are in it.
    """
    xarray = load("xarray")
    labels, results = snapshot.channels, snapshot.results.values()
    density = f"({cf_unit(snapshot.unit)})2 Hz-1"
    variables: dict[str, Any] = {
        name: (_AXES, np.stack([getattr(each, field).T for each in results]))
        for name, field in (*((curve.name, curve.field) for curve in CURVES), ("flags", "flags"))
    }
    variables["data_psd"] = (_AXES[1:], snapshot.data_psd.T)
    coords: dict[str, Any] = {
        "estimate": list(snapshot.results),  # "method" is an argument of sel()
        "trace": [label.name for label in labels],
        "sensor": ("trace", [label.sensor for label in labels]),
        "channel": ("trace", [label.channel for label in labels]),
        "frequency": (
            "frequency",
            snapshot.frequency,
            {"units": "Hz", "long_name": "frequency"},
            {"_FillValue": None},  # CF forbids one of coordinates
        ),
    }
    if matrix:
        csm = np.moveaxis(snapshot.csm, 0, -1)
        power = np.einsum("ppf->pf", csm).real
        with np.errstate(divide="ignore", invalid="ignore"):
            coherence = np.abs(csm) ** 2 / (power[:, np.newaxis] * power)
        pair = ("trace", "other_trace", "frequency")
        coords["other_trace"] = coords["trace"]
        # netCDF has no complex numbers.
        variables |= {"csm_real": (pair, csm.real), "csm_imag": (pair, csm.imag)}
        variables["coherence"] = (pair, coherence)
    if channels is not None:
        gain = np.full((len(labels), len(snapshot.frequency)), np.nan, np.complex128)
        for row, label in enumerate(labels):
            channel = channels[label.name]
            gain[row] = channel.sensitivity
            if channel.response is not None:
                gain[row] *= channel.response.at(snapshot.frequency)
        variables["response_amplitude"] = (_AXES[1:], np.abs(gain))
        variables["response_phase"] = (_AXES[1:], np.angle(gain))
        units = [cf_unit(channels[label.name].unit) for label in labels]
        coords["response_unit"] = ("trace", [f"count ({unit})-1" for unit in units])
    found: xr.Dataset = xarray.Dataset(
        variables,
        coords=coords,
        attrs={
            "Conventions": "CF-1.11",
            **said,
            "n_segments": snapshot.n_segments,
            "effective_averages": snapshot.n_effective,
            "unit_of_motion": snapshot.unit,
        },
    )
    numbers = {curve.name for curve in CURVES if not curve.is_density} | {"coherence"}
    densities = {curve.name for curve in CURVES} - numbers | {"data_psd", "csm_real", "csm_imag"}
    for name in variables:
        found[name].attrs["long_name"] = _LONG_NAMES[name]
        if name in densities | numbers:
            found[name].attrs["units"] = density if name in densities else "1"
    if "response_phase" in variables:
        found["response_phase"].attrs["units"] = "rad"
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
                **{each.name: getattr(noise, each.field)[:, column] for each in CURVES},
                "flags": noise.flags[:, column],
            }
        )
        for method, noise in snapshot.results.items()
        for column, label in enumerate(snapshot.channels)
    ]
    whole: pd.DataFrame = pandas.concat(parts, ignore_index=True)
    return whole
