"""Results as values that JSON knows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson

from estimator.records import json_keys

if TYPE_CHECKING:
    from daq.estimation.snapshot import ChannelLabel
    from tui.output.documents import LabelDocument


def plain(value: Any, *, array: Callable[[Any], Any] = np.ndarray.tolist) -> Any:  # noqa: ANN401
    """Return any result as what JSON knows: fields under the names that they declare.

    Arrays become what `array` makes of them; complex ones their real and imaginary parts.
    """
    if is_dataclass(value) and not isinstance(value, type):
        value = {key: getattr(value, name) for key, name in json_keys(type(value)).items()}
    if isinstance(value, np.generic):
        value = np.asarray(value) if np.iscomplexobj(value) else value.item()
    if isinstance(value, np.ndarray):
        if not np.iscomplexobj(value):
            return array(value)
        value = {"real": value.real, "imag": value.imag}
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Mapping):
        return {str(plain(key)): plain(entry, array=array) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry, array=array) for entry in value]
    return value


def label_document(label: ChannelLabel) -> LabelDocument:
    """Return what a channel is called, and the unit of its motion."""
    return {"sensor": label.sensor, "channel": label.channel, "unit": label.unit}


def json_text(document: Any) -> str:  # noqa: ANN401 - any result
    """Return a result as one line of JSON; numbers that are not finite become null.

    Every number is read back as it was.

    Raises
    ------
    TypeError
        The document holds what is no result, or a text that is not Unicode.
    """
    return orjson.dumps(plain(document, array=_doubles), option=orjson.OPT_SERIALIZE_NUMPY).decode()


def _doubles(values: Any) -> Any:  # noqa: ANN401 - an array
    """Return floats as orjson writes them without lists; other arrays as lists."""
    is_float = values.ndim and values.dtype.kind == "f"
    return np.ascontiguousarray(values, np.float64) if is_float else values.tolist()
