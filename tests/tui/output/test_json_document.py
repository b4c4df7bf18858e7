"""The document that --json writes, as docs/json.md describes it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

from estimator.checks.kinds import Untested
from estimator.self_noise.result import Flag
from estimator.spectra.segment_rejection import Reason
from tests.tui.example_snapshot import SETTINGS, diagnosed, made_snapshot
from tui.output.console import finite
from tui.output.json_document import document, result_document


def test_advice_has_its_kind_its_numbers_and_its_words() -> None:
    change = np.eye(9)
    change[5, 5] = -1
    found = json.loads(json.dumps(finite(document(diagnosed(change), SETTINGS))))
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
            clipped={4: 0.25},
            stood_still={0: 3.0},
            untested=Untested.TOO_FEW_SENSORS,
        ),
    )
    told = json.loads(json.dumps(finite(result_document(faulty, "three-sensor"))))["diagnostics"]
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
