"""JSON documents: what is sent comes back bit for bit, and what is malformed is refused by name."""

import json
import re
import types
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.alternatives import Alternatives
from hmt_slam_ros.messages.ambiguity import Ambiguity
from hmt_slam_ros.messages.documents import (
    FinalCounts,
    KeyframeHeader,
    ResetRequest,
    ResetResponse,
    RobotStatus,
    SaveRequest,
    SaveResponse,
    decode,
    encode,
)
from hmt_slam_ros.messages.evidence import Evidence
from hmt_slam_ros.messages.messages import (
    AreaEvents,
    ClosureDecision,
    EarlyEstimate,
    Hypotheses,
    HypothesisEstimate,
    Keyframe,
    LocalEstimate,
    Notice,
    TrackingReset,
)
from hmt_slam_ros.messages.tasks import PlaceEstimate, TaskFeedback
from hmt_slam_ros.messages.team import JoinedGround, TeamGoal, TeamMessage, Verdict
from hmt_slam_ros.messages.topology import Topology
from hmt_slam_ros.plain_data import field_names, is_record
from hmt_slam_ros.registration.consistency import Clutter
from hmt_slam_ros.sensors import Scan

KINDS = (
    KeyframeHeader,
    AreaEvents,
    Hypotheses,
    ClosureDecision,
    LocalEstimate,
    EarlyEstimate,
    TrackingReset,
    Notice,
    FinalCounts,
    RobotStatus,
    SaveRequest,
    SaveResponse,
    ResetRequest,
    ResetResponse,
    PlaceEstimate,
    TaskFeedback,
    Ambiguity,
    *get_args(TeamMessage),
    TeamGoal,
    JoinedGround,
    Topology,
    Alternatives,
    Evidence,
)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
SINGLES = st.floats(allow_nan=False, allow_infinity=False, width=32)
RANGES = st.lists(st.floats(width=32), max_size=5).map(lambda ranges: np.array(ranges, dtype=np.float32))


def values(kind, name=""):
    """Any value that a field of this type may have."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is np.ndarray:
        return (
            RANGES if name in ("ranges", "starts") else arrays((3, 3) if name in ("covariance", "ambiguity") else (3,))
        )
    if origin is tuple:
        return st.lists(values(arguments[0]), max_size=3).map(tuple)
    if origin in (Union, types.UnionType):
        return st.none() | values(arguments[0], name)
    if is_record(kind):
        hints = get_type_hints(kind)
        # The numbers of a scan are rounded to float32.
        singles = {entry: SINGLES for entry in field_names(kind) if kind is Scan and hints[entry] is float}
        others = {entry: values(hints[entry], entry) for entry in field_names(kind) if entry not in singles}
        return st.builds(kind, **singles, **others)
    if origin is Literal or kind is Verdict:
        return st.sampled_from(arguments or kind)
    return {bool: st.booleans(), int: st.integers(-(2**63), 2**63 - 1), float: NUMBERS, str: st.text()}[kind]


def arrays(shape):
    count = int(np.prod(shape))
    return st.lists(NUMBERS, min_size=count, max_size=count).map(lambda flat: np.array(flat).reshape(shape))


def assert_same(a, b):
    assert type(a) is type(b)
    if is_dataclass(a):
        for entry in fields(a):
            assert_same(getattr(a, entry.name), getattr(b, entry.name))
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for left, right in zip(a, b, strict=True):
            assert_same(left, right)
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        assert a.tobytes() == b.tobytes()
    elif isinstance(a, float):
        assert np.float64(a).tobytes() == np.float64(b).tobytes()
    else:
        assert a == b


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_document_comes_back_bit_for_bit(kind):
    @settings(max_examples=40)
    @given(values(kind))
    def round_trip(message):
        assert_same(decode(encode(message), kind), message)

    round_trip()


def test_numpy_scalars_in_a_message_become_plain_numbers():
    belief = PoseGaussian(np.zeros(3), np.eye(3))
    message = LocalEstimate(np.int64(7), np.int64(1), np.int64(0), belief, np.zeros(3), 0)
    assert decode(encode(message), LocalEstimate).stamp == 7


def test_a_keyframe_is_whole_again_with_its_ranges():
    ranges = np.array([1.0, np.nan, np.inf, 0.1], dtype=np.float32)
    scan = Scan(5, ranges, -1.1, 0.1, 0.05, 30.0, np.array([0.1, 0.2, 0.3]), 1e-5)
    pose = PoseGaussian(np.array([1.0, 2.0, 0.1]), np.eye(3))
    child = HypothesisEstimate(3, 4, pose, True, -0.3, 0.2, Clutter(0.01, 0.002), 11.5)
    keyframe = Keyframe(2, scan, 1.25, (child,))
    assert_same(decode(encode(KeyframeHeader.from_keyframe(keyframe)), KeyframeHeader).to_keyframe(ranges), keyframe)


STATUS = RobotStatus("playing", "aces", 12, 3, 7374, 3, 1)
EVENT = '{"hypothesis":1,"kind":"cut","keyframes":[1,2],"area":0,"score":0.5,"into":null}'
EVENTS = f'{{"document":"area_events","version":4,"sequence":3,"events":[{EVENT}],"redundant_keyframes":[]}}'


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('"version":4', '"version":2', "has version 2, not 4"),
        ("area_events", "hypotheses", "is no area_events"),
        ('"sequence":3', '"sequence":"3"', r"area_events\.sequence = 3 is not a whole number"),
        ('"sequence":3', '"sequence":true', r"area_events\.sequence = True is not a whole number"),
        ('"sequence":3,', "", r"area_events\.sequence is missing"),
        ('"sequence":3', '"sequence":3,"colour":1', r"area_events\.colour is unknown"),
        ('"kind":"cut"', '"kind":"torn"', r"area_events\.events\[0\]\.kind = torn is not cut or moved or merged"),
        ('"score":0.5', '"score":NaN', r"no JSON \(NaN is no finite number"),
        ('"sequence":3', '"sequence":1' + 400 * "0", r"no JSON \(an integer of 401 digits"),
        ('"version":4', f'"version":{60 * "[" + 60 * "]"}', r"has version \[\[\["),
        ('"keyframes":[1,2]', '"keyframes":[1,2.5]', r"keyframes\[1\] = 2.5 is not a whole number"),
        ('"keyframes":[1,2]', '"keyframes":1', r"keyframes = 1 is not a list"),
        ("[]}", "[]", "no JSON"),
    ],
)
def test_a_malformed_document_is_refused_by_name(old, new, sentence):
    assert old in EVENTS
    with pytest.raises(HmtSlamError, match=sentence):
        decode(EVENTS.replace(old, new), AreaEvents)


@pytest.mark.parametrize(
    "covariance",
    [
        "[[1,0],[0,1]]",
        "[1,2,3]",
        '"wide"',
        "[[1,0,0],[0,1,0],[0,0,NaN]]",
        "null",
        '[["1"]]',
        '[["1",0,0],[0,1,0],[0,0,1]]',
    ],
)
def test_an_array_of_another_shape_or_kind_is_refused(covariance):
    belief = PoseGaussian(np.zeros(3), np.eye(3))
    content = json.loads(encode(LocalEstimate(1, 0, 0, belief, np.zeros(3), 0)))
    content["pose"]["covariance"] = json.loads(covariance)
    with pytest.raises(HmtSlamError, match=r"local_estimate\.pose\.covariance = .* is not an array|NaN is no finite"):
        decode(json.dumps(content), LocalEstimate)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_number_that_is_not_finite_is_not_sent(value):
    with pytest.raises(HmtSlamError, match="not finite"):
        encode(LocalEstimate(1, 0, 0, PoseGaussian(np.zeros(3), np.eye(3)), np.full(3, value), 0))


@pytest.mark.parametrize("text", ["[]", "3", "null", '"text"', "", "hello", 100_000 * "["])
def test_json_that_is_no_document_is_refused(text):
    with pytest.raises(HmtSlamError):
        decode(text, RobotStatus)


def test_a_status_is_readable_by_people():
    assert json.loads(encode(STATUS))["state"] == "playing"


def test_the_examples_in_the_documentation_are_documents_and_all_of_them():
    text = (Path(__file__).resolve().parent.parent / "docs" / "reference" / "messages.md").read_text()
    examples = re.findall(r"```json\n(.*?)\n```", text, re.DOTALL)
    by_name = {json.loads(encode(decode_any(example)))["document"] for example in examples}
    assert len(examples) == len(by_name) == len(KINDS)


def decode_any(text):
    """The one kind of document that a text is."""
    decoded = []
    for kind in KINDS:
        try:
            decoded.append(decode(text, kind))
        except HmtSlamError:
            continue
    assert len(decoded) == 1, text
    return decoded[0]
