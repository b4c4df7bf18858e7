"""The curves of an estimate as tables, arrays and JSON have them: an entry for each."""

from __future__ import annotations

from typing import NamedTuple


class ExportedCurve(NamedTuple):
    """A curve of each method and channel.

    Attributes
    ----------
    name : str
        In tables and arrays.
    field : str
        Of `estimator.self_noise.result.SelfNoise`.
    key : str
        In JSON.
    word : str
        In the header of the CSV of an estimate.
    meaning : str
    is_density : bool
        Whether its unit is unit²/Hz; 1 otherwise.
    """

    name: str
    field: str
    key: str
    word: str
    meaning: str
    is_density: bool = True


_END = "end of the 95 % interval of the self-noise"
CURVES = (
    ExportedCurve(
        "noise_psd",
        "noise_psd",
        "noise_psd",
        "noise",
        "one-sided power spectral density of the self-noise",
    ),
    ExportedCurve("noise_low", "low", "noise_psd_low", "low", f"lower {_END}"),
    ExportedCurve("noise_high", "high", "noise_psd_high", "high", f"upper {_END}"),
    ExportedCurve(
        "cov", "cov", "cov", "cov", "coefficient of variation of the self-noise", is_density=False
    ),
)
