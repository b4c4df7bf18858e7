"""Result documents against their published JSON Schema, and what they say of their origin."""

from __future__ import annotations

import copy
import hashlib
import json
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from typer.testing import CliRunner

import huddle
from daq.bench.estimate_settings import table_keys
from daq.recording.reader import Recording
from daq.recording.sensor_record import _NEWEST_ROWS
from docs.schema import texts
from tests.daq.clocks.recordings import write_polled
from tests.full_disk import files_limited_to
from tests.tui.night_recording import HOSTILE, record
from tests.tui.schemas import SCHEMAS, thinned, validate, validator
from tui.commands.main import app
from tui.output.json_document import SCHEMA_VERSION

SCHEMA = SCHEMAS[f"result-{SCHEMA_VERSION}.schema.json"]


@dataclass(frozen=True, slots=True)
class Written:
    """A recording, and what ``huddle estimate --json`` wrote of it."""

    recording: Path
    document: dict[str, Any]


def estimated(recording: Path, *options: str) -> dict[str, Any]:
    """Run ``huddle estimate --json -``."""
    result = CliRunner().invoke(
        app, ["estimate", str(recording), "--segment", "1s", "--json", "-", *options]
    )
    assert result.exit_code in {0, 4}, result.output
    found: dict[str, Any] = json.loads(result.stdout)
    return found


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    recording = record(tmp_path_factory.mktemp("document") / "night.h5")
    return Written(recording, estimated(recording, "--noise-parameters"))


def test_a_recording_of_many_blocks_is_described(tmp_path: Path) -> None:
    """Old blocks are in its file only, which must be open: JSON after 3 h at 200 Hz failed."""
    lost = {name: np.zeros(4400, np.bool_) for name in "abc"}
    path = write_polled(tmp_path / "long.h5", lost, rate=4.0)
    with Recording.open(path) as recording:
        assert all(len(each.blocks) > 2 * _NEWEST_ROWS for each in recording.sensors)
    found = estimated(path, "--segment", "20s")
    validate("result-2", found)
    assert found["recordings"][0]["sensors"]


def test_the_schema_is_one_itself() -> None:
    Draft202012Validator.check_schema(SCHEMA)
    assert SCHEMA["properties"]["schema_version"] == {
        "const": SCHEMA_VERSION,
        "description": SCHEMA["properties"]["schema_version"]["description"],
    }


def test_the_published_schemas_are_those_of_the_declared_types() -> None:
    """``python -m docs.schema`` writes them again."""
    for name, text in texts().items():
        assert (resources.files("tui.resources") / name).read_text("utf-8") == text, name


def test_the_schema_refuses_what_is_wrong(written: Written) -> None:
    validator = Draft202012Validator(SCHEMA)
    for change in (
        {"schema_version": 1},
        {"verdict": "passed"},
        {"channels": [{"sensor": "A"}]},
        {"recordings": [written.document["recordings"][0] | {"sha256": "none"}]},
    ):
        assert not validator.is_valid(written.document | change), change
    bare = {key: value for key, value in written.document.items() if key != "frequency_hz"}
    assert not validator.is_valid(bare)


@pytest.mark.parametrize("wrong", ["nan", [1.0], True])
def test_one_wrong_number_of_many_is_refused(written: Written, wrong: object) -> None:
    """Also of an array that was thinned."""
    channel = copy.deepcopy(written.document["channels"][0])
    numbers = next(each for each in channel.values() if isinstance(each, list) and len(each) > 20)
    numbers[17] = wrong
    document = written.document | {"channels": [channel]}
    assert not validator("result-2").is_valid(thinned(document))


def test_one_method_with_limits_gaps_and_noise_parameters(written: Written) -> None:
    validate("result-2", written.document)
    assert written.document["method"] == "maximum-likelihood"  # four sensors leave room
    assert written.document["verdict"] == "not-decided"
    assert len(written.document["noise_parameters"]) == 8


def test_several_methods(written: Written) -> None:
    document = estimated(written.recording, "--method", "all", "--octaves", "--dimension", "auto")
    validate("result-2", document)
    methods = [each["method"] for each in document["results"]]
    assert document["settings"]["method"] == methods
    assert {each["method"] for each in document["band_means"]} == set(methods)
    assert len(document["band_means"]) == 8 * len(methods)


def test_arrays_have_no_recording() -> None:
    model = huddle.simulate("fig9", duration="1min")
    document = huddle.self_noise(model, fs=model.fs, segment="2s").to_dict()
    found = json.loads(json.dumps(document, default=str))
    validate("result-2", found)
    assert found["run_id"] is None
    assert found["recordings"] == []


def test_a_script_has_the_document_of_the_command(written: Written) -> None:
    result = huddle.estimate(written.recording, segment="1s")
    document = result.to_dict()
    del written.document["noise_parameters"]
    assert json.loads(json.dumps(document)).keys() == written.document.keys()
    assert document["recordings"] == written.document["recordings"]
    assert document["verdict"] == written.document["verdict"]


def test_it_says_what_it_was_made_from(written: Written) -> None:
    (recording,) = written.document["recordings"]
    content = written.recording.read_bytes()
    assert recording["sha256"] == hashlib.sha256(content).hexdigest()
    assert recording["bytes"] == len(content)
    assert recording["run_id"] == written.document["run_id"]
    assert recording["file"] == "night.h5"
    assert recording["state"] == "closed"
    assert recording["started"] == "2016-07-14T01:00:00+00:00"
    names = [(each["name"], each["serial_number"]) for each in recording["sensors"]]
    assert names == [("A", "SN-0"), ("B", "SN-1"), ("C", "SN-2"), (HOSTILE, "SN-3")]
    settings = written.document["settings"]
    assert set(table_keys()) <= set(settings)
    assert settings["segment"] == 1.0
    assert settings["band"] == [2.0, 20.0]
    assert written.document["software"] == {
        "name": "huddle-bench", "version": huddle.__version__,
    }  # fmt: skip


def test_band_means_are_those_of_the_table(written: Written) -> None:
    result = huddle.estimate(written.recording, segment="1s")
    band = result.band()
    means = written.document["band_means"]
    assert [each["noise_psd"] for each in means[:7]] == pytest.approx(band.noise_psd[:7], rel=1e-12)
    assert [each["noise_psd_high"] for each in means[:7]] == pytest.approx(
        band.noise_high[:7], rel=1e-12
    )
    assert means[7]["noise_psd"] is None  # a dead channel
    assert {(each["low_hz"], each["high_hz"]) for each in means} == {(2.0, 20.0)}


def test_a_growing_recording_has_no_checksum(tmp_path: Path) -> None:
    recording, found = tmp_path / "live.h5", []
    record(recording, before_end=lambda: found.append(estimated(recording)))
    validate("result-2", found[0])
    assert found[0]["recordings"][0]["sha256"] is None
    assert found[0]["recordings"][0]["state"] == "growing"


def test_a_full_disk_leaves_the_earlier_file(written: Written, tmp_path: Path) -> None:
    out = tmp_path / "result"
    out.write_text("the earlier one", encoding="utf-8")
    arguments = ["estimate", str(written.recording), "--segment", "1s", "--json", str(out)]
    with files_limited_to(1_000):
        result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 3
    assert out.read_text(encoding="utf-8") == "the earlier one"
    assert list(tmp_path.iterdir()) == [out]
