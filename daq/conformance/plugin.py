"""pytest plugin (entry point ``huddle``): failed assertions of the suite show their values."""

from __future__ import annotations

import pytest

pytest.register_assert_rewrite("daq.conformance.suite")
