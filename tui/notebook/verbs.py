"""Commands as functions: calibrate, export, report; noise models, and saved results.

Each takes a `Result`, or the recordings and options from which `huddle.estimate` makes one, and has
the numbers of the command.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, Unpack

import numpy as np

from daq.bench.masks.mask_file import masks_named
from daq.errors import WrongSettingError
from daq.results.calibration import CONFIDENCE, Calibration
from daq.results.calibration import calibrate as calibrated
from tui.notebook.curve_files import MINISEED, WRITERS, loaded, write_curves, write_samples
from tui.notebook.estimates import PathLike, estimated
from tui.notebook.result import Result
from tui.output.extras import require
from tui.output.json_document import provenance

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import xarray as xr
    from numpy.typing import ArrayLike

    from estimator.types import FloatArray
    from tui.notebook.options import EstimateOptions

    Estimated: TypeAlias = Result | PathLike | Iterable[PathLike]
    """A result, or what `huddle.estimate` takes."""

_SUFFIXES = (".html", ".htm", ".pdf")


def _result(given: Estimated, options: EstimateOptions, *, calibrates: bool = False) -> Result:
    if not isinstance(given, Result):
        return estimated(given, calibrates=calibrates, **options)
    if options:
        raise WrongSettingError(
            f"{', '.join(options)} with a Result; expected recordings, or options where the"
            " Result was estimated"
        )
    return given


def calibrate(
    result: Estimated,
    *,
    reference: str | None = None,
    confidence: float = CONFIDENCE,
    **options: Unpack[EstimateOptions],
) -> Calibration:
    """Calibrate all sensors against one of them, as ``huddle calibrate`` does.

    Parameters
    ----------
    result : Result, path or iterable of paths
        An estimate, or recordings to estimate. Uncertainties are larger with an estimate: some of
        its segments tell what may bend a channel, of recordings all.
    reference : str, optional
        Name of the sensor; by default the first with certificates, or else the first of all.
    confidence : float
        Level of the expanded uncertainties.
    **options
        Options of the estimate: those of `huddle.estimate`.

    Returns
    -------
    Calibration
        Sensitivity, cross-axis response, angles and delay of every channel, with budgets.

    Raises
    ------
    HuddleError
        If the reference is unknown, or the level not between 0 and 1.
    EstimatorError
        If no sensor can be compared with the reference.
    """
    found = _result(result, options, calibrates=True)
    return calibrated(found.result, found.bench, reference=reference, confidence=confidence)


def export(
    result: Estimated,
    path: PathLike,
    *,
    kind: str | None = None,
    **options: Unpack[EstimateOptions],
) -> None:
    """Write noise curves, or samples, to a file of another program, as ``huddle export`` does.

    Parameters
    ----------
    result : Result, path or iterable of paths
        An estimate, or recordings to estimate.
    path : path
    kind : str, optional
        ``csv``, ``parquet``, ``netcdf``, ``mat``, ``npz`` or ``uff58``; or ``mseed``, all samples
        of one recording with StationXML beside them; by the suffix, if not given.
    **options
        Options of the estimate: those of `huddle.estimate`.

    Raises
    ------
    HuddleError
        If the format is unknown, or a package is missing.

    Examples
    --------
    >>> import huddle
    >>> import numpy as np
    >>> sensors = huddle.simulate("fig9", duration="1min")
    >>> result = huddle.self_noise(sensors, fs=sensors.fs, sample_unit="m/s²", segment="2s")
    >>> huddle.export(result, "noise.npz")
    >>> np.array_equal(np.load("noise.npz")["data_psd"], result.data_psd, equal_nan=True)
    True
    """
    out = Path(path)
    if kind is None:
        of_suffix = {suffix: name for name, (suffix, _) in WRITERS.items()}
        kind = of_suffix.get(out.suffix.lower(), "")
        kind = MINISEED if out.suffix.lower() == ".mseed" else kind
    if kind == MINISEED:
        if options or not isinstance(result, (str, os.PathLike)):
            raise WrongSettingError(
                f"{out}: miniSEED holds all samples of one recording; expected its path in place of"
                " an estimate, and no options"
            )
        write_samples(Path(result), out)
        return
    if kind not in WRITERS:
        suffixes = ", ".join(suffix for suffix, _ in WRITERS.values())
        raise WrongSettingError(
            f"{out}: expected a name that ends in {suffixes} or .mseed, or kind= one of"
            f" {', '.join((*WRITERS, MINISEED))}"
        )
    found = _result(result, options)
    write_curves(found.snapshot, kind, out, provenance(found.result))


def report(
    result: Estimated,
    path: PathLike,
    *,
    models: str | Sequence[str] = (),
    **options: Unpack[EstimateOptions],
) -> None:
    """Write a calibration report, as ``huddle report`` does.

    Parameters
    ----------
    result : Result, path or iterable of paths
        An estimate of recordings, or recordings to estimate.
    path : path
        Ends in ``.html`` or ``.pdf``.
    models : str or sequence of str
        Noise models to show, such as ``"nlnm"``, or CSV files of masks.
    **options
        Options of the estimate: those of `huddle.estimate`.

    Raises
    ------
    HuddleError
        If the name is wrong, the estimate is of arrays, or the file cannot be written.
    """
    out = Path(path)
    if out.suffix.lower() not in _SUFFIXES:
        raise WrongSettingError(f"{out}: expected a file name that ends in .html or .pdf")
    require("matplotlib", "jinja2", *(["fpdf"] if out.suffix.lower() == ".pdf" else []))
    found = _result(result, options, calibrates=True)
    if not found.recordings:
        raise WrongSettingError(
            "the estimate is of arrays; expected recordings, whose checksums a report states:"
            " huddle import makes recordings of files"
        )
    from tui.report.writing import write  # noqa: PLC0415 - loads matplotlib

    masks = masks_named(models if isinstance(models, str) else ",".join(models))
    write(found.result, out, models=masks)


def noise_model(name: str, frequency: ArrayLike, *, unit: str = "m/s²") -> FloatArray:
    """Return a model of the ground's noise, or a mask of a CSV file.

    Parameters
    ----------
    name : str
        ``"nlnm"`` or ``"nhnm"`` (Peterson 1993), ``"alnm"`` or ``"ahnm"`` (Cauzzi and Clinton
        2013), or a CSV file.
    frequency : float64, shape (n_freqs,)
        In Hz.
    unit : str
        Of the motion.

    Returns
    -------
    float64, shape (n_freqs,)
        One-sided PSD in unit**2/Hz; NaN outside of the model.

    Raises
    ------
    HuddleError
        If there is no such model, or the unit is none of motion.

    Examples
    --------
    >>> import huddle
    >>> import numpy as np
    >>> (10 * np.log10(huddle.noise_model("nlnm", [0.05, 1.0]))).round(1).tolist()
    [-173.4, -166.4]
    """
    masks = masks_named(os.fspath(name))
    if len(masks) != 1:
        raise WrongSettingError(f"name={name!r}: expected one model")
    masks[0].check_unit(unit)
    return masks[0].at(np.asarray(frequency, np.float64), unit)


def load(path: PathLike) -> xr.Dataset:
    """Read what `Result.save` or ``huddle export``, as netCDF or Zarr, wrote.

    Parameters
    ----------
    path : path

    Returns
    -------
    xarray.Dataset
        In memory; see `Result.to_xarray`. Needs xarray, and h5netcdf or zarr.

    Raises
    ------
    OSError
        The file is missing, is neither netCDF nor Zarr, or none that they write.

    Examples
    --------
    >>> import huddle
    >>> sensors = huddle.simulate("fig9", duration="1min")
    >>> result = huddle.self_noise(sensors, fs=sensors.fs, sample_unit="m/s²", segment="2s")
    >>> result.save("noise.nc")
    >>> huddle.load("noise.nc").noise_psd.attrs["units"]
    '(m s-2)2 Hz-1'
    """
    return loaded(Path(path))
