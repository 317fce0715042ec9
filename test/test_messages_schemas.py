"""The JSON schemas fit the documents: those that are published, those of the reference, and no others."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from logs_for_nodes import Corridor
from test_messages_documents import EVENTS, KINDS, values

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.documents import KeyframeHeader, decode, encode
from hmt_slam_ros.messages.messages import AreaEvents, ClosureDecision, Hypotheses, Keyframe
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.topology import Topology
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.process_table import DOCUMENTS

jsonschema = pytest.importorskip("jsonschema", reason="the schemas are tested with jsonschema: pip install jsonschema")

REFERENCE = Path(__file__).resolve().parent.parent / "docs" / "reference"
ROWS = {row.document: row for row in DOCUMENTS}
SCANS = 60


def validator(name):
    schema = json.loads((REFERENCE / "schemas" / f"{name}.schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.fixture(scope="module")
def validators():
    return {name: validator(name) for name in ROWS}


def assert_valid(validators, text):
    content = json.loads(text)
    validators[content["document"]].validate(content)


def test_every_document_has_a_schema_and_every_schema_a_document():
    assert {path.name for path in (REFERENCE / "schemas").iterdir()} == {f"{name}.schema.json" for name in ROWS}


def test_the_examples_of_the_reference_are_valid(validators):
    examples = re.findall(r"```json\n(.*?)\n```", (REFERENCE / "messages.md").read_text(), re.DOTALL)
    assert {json.loads(example)["document"] for example in examples} == set(ROWS)
    for example in examples:
        assert_valid(validators, example)


def test_the_documents_of_a_run_are_valid(validators):
    run, replica, published = LockStepRun(Configuration()), Replica(), set()
    for record in run.unread_records(Corridor(SCANS)):
        for message in run.lock_step.feed(record.measurement):
            if isinstance(message, Keyframe | Hypotheses | ClosureDecision):
                replica.apply_message(message)
            document = KeyframeHeader.from_keyframe(message) if isinstance(message, Keyframe) else message
            if type(document) in KINDS:
                published.add(type(document).__name__)
                assert_valid(validators, encode(document, reset_number=3, system="a_system"))
            if isinstance(message, ClosureDecision) and message.global_poses:
                poses = {entry.area: entry.pose for entry in message.global_poses}
                topology = Topology.from_replica(replica, poses, np.zeros(3), "map", message.sequence + 1, 0)
                assert_valid(validators, encode(topology))
    assert published >= {"KeyframeHeader", "AreaEvents", "Hypotheses", "ClosureDecision", "LocalEstimate"}


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_whatever_a_process_may_send_is_valid(kind, validators):
    @settings(max_examples=10)
    @given(values(kind))
    def check(message):
        assert_valid(validators, encode(message))

    check()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"version":4', '"version":2'),
        ("area_events", "hypotheses"),
        ('"sequence":3', '"sequence":"3"'),
        ('"sequence":3', '"sequence":true'),
        ('"sequence":3,', ""),
        ('"sequence":3', '"sequence":3,"color":1'),
        ('"kind":"cut"', '"kind":"torn"'),
        ('"keyframes":[1,2]', '"keyframes":[1,2.5]'),
        ('"keyframes":[1,2]', '"keyframes":1'),
        ('"into":null', '"into":"0"'),
    ],
)
def test_what_a_node_refuses_is_not_valid(old, new):
    wrong = EVENTS.replace(old, new)
    assert wrong != EVENTS
    with pytest.raises(HmtSlamError):
        decode(wrong, AreaEvents)
    assert not validator("area_events").is_valid(json.loads(wrong))


@pytest.mark.parametrize("covariance", ["[[1,0],[0,1]]", "[1,2,3]", '"wide"', "null", '[["1",0,0],[0,1,0],[0,0,1]]'])
def test_an_array_of_another_shape_is_not_valid(covariance, validators):
    (example,) = re.findall(r'{"document":"local_estimate".*}', (REFERENCE / "messages.md").read_text())
    content = json.loads(example)
    assert validators["local_estimate"].is_valid(content)
    content["pose"]["covariance"] = json.loads(covariance)
    assert not validators["local_estimate"].is_valid(content)
