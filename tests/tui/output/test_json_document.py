"""The document that --json writes, as docs/json.md describes it."""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from daq.results.decision.facts import WrongSensitivity
from daq.results.decision.verdict import LimitResult, TestVerdict
from daq.results.facts.fact import Fact
from daq.results.result import Result
from estimator.checks.advice import Advice, Untested
from estimator.checks.count_limits import CountLimits
from estimator.decision.verdict import Obstacle, Verdict
from estimator.records import json_key
from estimator.self_noise.result import Flag
from estimator.spectra.segment_rejection import Reason
from tests.tui.example_snapshot import SETTINGS, diagnosed, judged, made_snapshot
from tests.tui.wording.fact_examples import EXAMPLES, kinds
from tui.output.console import write_json
from tui.output.json_document import document, result_document
from tui.output.json_values import json_text
from tui.wording.verdict_text import headline, what_to_do


def test_advice_has_its_kind_its_numbers_and_its_words() -> None:
    change = np.eye(9)
    change[5, 5] = -1
    found = json.loads(json_text(document(Result(diagnosed(change), SETTINGS))))
    diagnostics = found["results"][0]["diagnostics"]
    by_kind = {
        fact["numbers"]["findings"][0]["kind"]: fact
        for fact in found["facts"]
        if fact["kind"] == "finding"
    }
    polarity = by_kind["reversed-polarity"]
    assert [(a["sensors"], a["numbers"]) for a in polarity["numbers"]["findings"]] == [
        ([0, 1], {"channel": 5, "counterpart": 2}),
        ([1, 2], {"channel": 8, "counterpart": 5}),
    ]
    assert (polarity["rank"], polarity["sensors"]) == ("delays", ["A", "B", "C"])
    assert polarity["line"].startswith("B.Z has the opposite polarity to A.Z")
    assert polarity["action"].endswith(".")
    (rotated, *_) = by_kind["rotated"]["numbers"]["findings"]
    assert set(rotated["numbers"]) == {"angle_deg", "horizontal_deg", "error_deg"}
    assert diagnostics["tested_dimensions"] == 3
    assert diagnostics["untested"] is None
    assert diagnostics["pairs"] == [["A", "B"], ["A", "C"], ["B", "C"]]
    assert set(diagnostics["per_frequency"]) == {
        "coherence", "condition", "dimension", "snr", "statistic", "degrees", "p_value",
    }  # fmt: skip
    assert len(diagnostics["per_frequency"]["coherence"][0]) == 3
    assert set(diagnostics["bands"][0]["test"]) == {
        "statistic", "degrees", "p_value", "frequencies", "spread",
    }  # fmt: skip


def test_what_is_not_known_is_left_out() -> None:
    snapshot = made_snapshot()
    diagnostics = result_document(snapshot, "three-sensor")["diagnostics"]
    assert not {"bands", "clipped_share", "stood_still_s", "dimensions"} & set(diagnostics)
    assert diagnostics["untested"] == "unfinished"
    assert diagnostics["flags"] == {flag.name: flag.value for flag in Flag}
    faulty = replace(
        snapshot,
        left_out={Reason.GAP: 2, Reason.TRANSIENT: 0},
        diagnostics=replace(
            snapshot.diagnostics,
            counts=CountLimits({4: 0.25}),
            stood_still={0: 3.0},
            untested=Untested.TOO_FEW_SENSORS,
        ),
    )
    told = json.loads(json_text(result_document(faulty, "three-sensor")))["diagnostics"]
    assert told["clipped_share"] == {"B.Y": 0.25}
    assert told["stood_still_s"] == {"A.X": 3.0}
    assert told["excluded_by_reason"] == {"gap": 2, "transient": 0}
    assert told["untested"] == "too-few-sensors"
    assert set(told["synchronisation"]) == {
        "residual_s",
        "noise_bias_share",
        "removed_psd",
        "reference",
    }
    assert told["synchronisation"]["residual_s"]["C"] == 0.6e-6


def test_every_number_is_read_as_it_was(tmp_path: Path) -> None:
    bits = np.random.default_rng(0).integers(0, 1 << 64, 5000, dtype=np.uint64)
    of_any_size, file = bits.view(float), tmp_path / "numbers.json"
    single = np.array([[0.1, math.inf]], dtype=np.float32)
    write_json(
        str(file),
        {"any": of_any_size, "two": (single, 1j * single[:, :1]), "é": {Reason.GAP: None}},
    )
    text = file.read_text(encoding="utf-8")
    found = json.loads(text, parse_constant=pytest.fail)
    assert text.endswith("}\n")
    read = np.array(found.pop("any"), float)
    finite = np.isfinite(of_any_size)
    np.testing.assert_array_equal(read[finite].view(np.uint64), bits[finite])
    assert np.all(np.isnan(read[~finite]))
    tenth = float(single[0, 0])
    turned = {"real": [[0.0]], "imag": [[tenth]]}
    assert found == {"two": [[[tenth, None]], turned], "é": {"gap": None}}
    with pytest.raises(TypeError, match="serial"):
        json_text({"of no result": object()})


DIMENSIONLESS = {
    *("cov", "target", "gains", "gain_errors", "shares", "share", "share_error", "statistic"),
    *("worst_statistic", "p_value", "coherence", "coherence_error", "coherencies"),
    *("snr", "condition", "ratio", "standard_errors", "share_of_frequencies"),
    *("n_dimensions", "n_effective", "share_of_partners", "share_without", "inflation"),
    *("delay_samples", "ppm", "bits", "evidence", "factors"),
}
"""Numbers without a unit; samples, bits and ppm are their own."""


def test_numbers_of_facts_have_their_units_in_their_names() -> None:
    for kind in {*kinds(), *kinds(Advice)}:
        common = {each.name for each in fields(Fact if issubclass(kind, Fact) else Advice)}
        for each in fields(kind):
            if each.name in common or "float" not in str(each.type):
                continue
            name = json_key(each) or ""
            assert name in DIMENSIONLESS or name.endswith(("_s", "_hz", "_share", "_deg", "_db")), (
                kind
            )


def test_a_verdict_has_its_facts_in_the_document() -> None:
    wrong = next(each for each in EXAMPLES if isinstance(each, WrongSensitivity))
    limit = LimitResult(
        *("NLNM", "A", "X", "three-sensor", 1.0, 1e-12, 1e-13, 1e-11, 1e-12),
        verdict=Verdict.NOT_DECIDED,
        covers=(0.1, 100.0),
        judged=(0.2, 90.0),
        obstacle=Obstacle.SPANS_LIMIT,
    )
    found = TestVerdict(
        Verdict.NOT_DECIDED,
        (limit,),
        obstacles=(Obstacle.SENSITIVITY, Obstacle.SPANS_LIMIT),
        sensitivities=(wrong,),
    )
    written = document(judged(Result(diagnosed(), SETTINGS), found))
    facts = {each["kind"]: each for each in written["facts"]}
    assert facts["wrong-sensitivity"]["numbers"]["gains"] == [0.101, 0.103]
    assert facts["limit-undecided"]["channels"] == ["A.X"]
    assert facts["limit-not-judged"]["numbers"]["judged_hz"] == [0.2, 90.0]
    assert [each["channel"] for each in written["sensitivities"]] == ["X", "Y"]
    assert " ".join(what_to_do(found)).count("C reads 0.102 of A and B") == 1
    assert "steady gains" not in headline(found)
    parts = replace(limit, method="multi-part")
    assert headline(replace(found, limits=(parts,))).endswith(", if gains are steady.")
