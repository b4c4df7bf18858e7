"""Results as values that JSON knows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import numpy as np
from pydantic_core import to_json


def plain(value: Any) -> Any:  # noqa: ANN401 - any result
    """Return dataclasses, enumerations and arrays as what JSON knows."""
    if is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, np.ndarray | np.generic):
        if np.iscomplexobj(value):
            value = {"real": value.real, "imag": value.imag}
        else:
            return value.tolist()
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Mapping):
        return {str(plain(key)): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return value


def json_text(document: Any) -> str:  # noqa: ANN401 - any result
    """Return a result as one line of JSON; numbers that are not finite become null.

    Every number is read back as it was. Arrays become lists row by row: of many sensors, lists take
    more memory than all else.

    Raises
    ------
    PydanticSerializationError
        The document holds what is no result, or a text that is not Unicode.
    """
    return to_json(document, inf_nan_mode="null", fallback=_by_row).decode()


def _by_row(value: Any) -> Any:  # noqa: ANN401 - any result
    is_table = isinstance(value, np.ndarray) and value.ndim > 1 and not np.iscomplexobj(value)
    return list(value) if is_table else plain(value)
