"""Packages that only some of the commands and functions need, and the extras that install them."""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from types import ModuleType

from daq.errors import HuddleError
from daq.python_process import install_command

_EXTRA = {
    "pyarrow": "parquet",
    "pyuff": "vibration",
    "h5netcdf": "notebook",
    "xarray": "notebook",
    "pandas": "notebook",
    "matplotlib": "report",
    "jinja2": "report",
    "fpdf": "report",
    "pypdf": "report",
    "segno": "report",
    "prometheus_client": "metrics",
    "distributed": "cluster",
    "pyhanko": "sign",
    "cryptography": "sign",
    "starlette": "web",
    "uvicorn": "web",
    "zarr": "zarr",
}


class MissingPackageError(HuddleError, ImportError):
    """A package that an extra installs is missing; the message names both."""

    is_usage_error = True


def load(name: str) -> ModuleType:
    """Import a package, or a module of it.

    Raises
    ------
    MissingPackageError
        If it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise _missing(name.partition(".")[0]) from error


def require(*packages: str) -> None:
    """Refuse, before anything is measured, what could not be written for want of a package.

    Raises
    ------
    MissingPackageError
        If one is not installed.
    """
    for package in packages:
        if find_spec(package) is None:
            raise _missing(package)


def _missing(package: str) -> MissingPackageError:
    return MissingPackageError(
        f"{package} is not installed; run: {install_command(_EXTRA[package])}"
    )
