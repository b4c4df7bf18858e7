"""Studies of the estimates: what they draw, and that they can fail."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.studies.__main__ import STUDIES
from benchmarks.studies.draws import averaged, bench
from estimator.methods import self_noise


def quiet(what: str, share: float) -> None:
    assert what
    assert 0 <= share <= 1


def test_averages_scatter_about_the_true_matrix_as_so_many_do() -> None:
    rng = np.random.default_rng(1)
    true = bench(rng, d=2, snr=3.0, shared=((0, 3),), coherency=0.4)
    assert true.shape == (6, 6)
    drawn = averaged(np.broadcast_to(true, (4000, 6, 6)), 20, rng)
    power = np.sqrt(np.outer(np.diag(true).real, np.diag(true).real))
    np.testing.assert_allclose(drawn.mean(axis=0) / power, true / power, atol=5 / np.sqrt(80_000))
    np.testing.assert_allclose(drawn.var(axis=0), power**2 / 20, rtol=5 * np.sqrt(3 / 4000))


@pytest.mark.parametrize(
    "name",
    [
        "small-samples",
        "unequal",
        *(pytest.param(each, marks=pytest.mark.long) for each in ("quiet", "contrasts")),
    ],
)
def test_short_studies_agree(name: str) -> None:
    study = STUDIES[name](quiet, 0.02)
    assert study.name == name
    assert study.agrees


def test_an_estimate_that_is_wrong_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """Averages counted twice: intervals are too narrow."""

    def twice(method: str, csm: object, *, n_effective: float, **known: object) -> object:
        return self_noise(method, csm, n_effective=2 * n_effective, **known)  # type: ignore[arg-type]

    monkeypatch.setattr("benchmarks.studies.estimates.self_noise", twice)
    study = STUDIES["coverage"](quiet, 0.05)
    assert not study.agrees
