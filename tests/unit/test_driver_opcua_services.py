"""The bytes of Read and Write as the client says and hears them; asyncua's codec is the other side."""

import struct
import uuid
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from asyncua import ua
from asyncua.common.utils import Buffer
from asyncua.ua.ua_binary import nodeid_to_binary, struct_from_binary, struct_to_binary
from hypothesis import given
from hypothesis import strategies as st

from drivers.opcua.nodes import SERIAL, Reading
from drivers.opcua.services import READ_VARIANTS, Misfit, Services, statuses
from drivers.opcua.status import BAD_TYPE_MISMATCH

V = ua.VariantType
TYPES = {
    "bool": (V.Boolean, st.booleans()),
    "i8": (V.SByte, st.integers(-0x80, 0x7F)),
    "u8": (V.Byte, st.integers(0, 0xFF)),
    "i16": (V.Int16, st.integers(-0x8000, 0x7FFF)),
    "u16": (V.UInt16, st.integers(0, 0xFFFF)),
    "i32": (V.Int32, st.integers(-0x80000000, 0x7FFFFFFF)),
    "u32": (V.UInt32, st.integers(0, 0xFFFFFFFF)),
    "f32": (V.Float, st.floats(allow_nan=False, width=32)),
    "f64": (V.Double, st.floats(allow_nan=False)),
}
KINDS = list(TYPES)
IDS = [ua.NodeId(f"A.{kind}", 2) if k % 2 else ua.NodeId(70_000 * k, 300 * k) for k, kind in enumerate(KINDS)]
EPOCH = datetime(1601, 1, 1, tzinfo=UTC)
TOKEN = ua.NodeId(b"\x01\x02\x03\x04", 1, ua.NodeIdType.ByteString)

typed = st.sampled_from(range(len(KINDS))).flatmap(lambda k: st.tuples(st.just(k), TYPES[KINDS[k]][1]))
stamps = st.none() | st.integers(0, 10**16).map(lambda us: EPOCH + timedelta(microseconds=us))


def services() -> Services:
    return Services([nodeid_to_binary(node) for node in IDS], KINDS)


def behind_header(request: bytes) -> bytes:
    """The parameters: behind type, token, time, handle, diagnostics, audit entry, timeout and additional header."""
    return request[4 + len(nodeid_to_binary(TOKEN)) + 8 + 4 + 4 + 4 + 4 + 3 :]


def answer_of(results: list[ua.DataValue]) -> bytes:
    return struct_to_binary(ua.ReadResponse(Results=results))


def double(value: float) -> ua.DataValue:
    return ua.DataValue(ua.Variant(value, V.Double), StatusCode=None)


@given(st.lists(st.integers(0, len(KINDS) - 1), min_size=1, max_size=20), st.integers(0, 0xFFFFFFFF))
def test_a_read_is_what_a_server_decodes(places: list[int], handle: int) -> None:
    encoded = services().read(tuple(places)).encode(nodeid_to_binary(TOKEN), handle, 2000)
    request = struct_from_binary(ua.ReadRequest, Buffer(encoded))
    header, parameters = request.RequestHeader, request.Parameters
    assert request.TypeId == ua.NodeId(ua.ObjectIds.ReadRequest_Encoding_DefaultBinary)
    assert (header.AuthenticationToken, header.RequestHandle, header.TimeoutHint) == (TOKEN, handle, 2000)
    assert abs(header.Timestamp - datetime.now(UTC)) < timedelta(minutes=1)
    assert parameters.TimestampsToReturn is ua.TimestampsToReturn.Source
    assert [item.NodeId for item in parameters.NodesToRead] == [IDS[place] for place in places]
    assert {item.AttributeId for item in parameters.NodesToRead} == {ua.AttributeIds.Value}
    assert behind_header(encoded) == struct_to_binary(parameters)


@given(st.lists(typed, min_size=1, max_size=20))
def test_a_write_is_what_a_server_decodes(writes: list[tuple[int, Any]]) -> None:
    numbers = [(place, float(value)) for place, value in writes]
    encoded = services().write(numbers).encode(nodeid_to_binary(TOKEN), 1, 2000)
    request = struct_from_binary(ua.WriteRequest, Buffer(encoded))
    assert request.TypeId == ua.NodeId(ua.ObjectIds.WriteRequest_Encoding_DefaultBinary)
    # Bare values: neither status nor time stamps.
    values = [ua.DataValue(ua.Variant(value, TYPES[KINDS[place]][0]), StatusCode=None) for place, value in writes]
    items = [
        ua.WriteValue(IDS[place], ua.AttributeIds.Value, Value=value)
        for (place, _), value in zip(writes, values, strict=True)
    ]
    assert behind_header(encoded) == struct_to_binary(ua.WriteParameters(NodesToWrite=items))
    with pytest.raises(struct.error):
        services().write([(KINDS.index("u16"), 65536.0)])


@given(st.lists(st.tuples(typed, st.none() | st.integers(0, 0xFFFFFFFF), stamps, stamps), max_size=20))
def test_readings_are_what_a_server_says(said: list[tuple[tuple[int, Any], int | None, Any, Any]]) -> None:
    results = [
        ua.DataValue(
            ua.Variant(value, TYPES[KINDS[place]][0]),
            None if status is None else ua.StatusCode(status),
            SourceTimestamp=source,
            ServerTimestamp=server,
            SourcePicoseconds=7 if source else None,
            ServerPicoseconds=7 if server else None,
        )
        for (place, value), status, source, server in said
    ]
    places = tuple(place for (place, _), _, _, _ in said)
    assert services().readings(answer_of(results), places) == tuple(
        Reading(status or 0, float(value), 0 if source is None else (source - EPOCH) // timedelta(microseconds=1))
        for (_, value), status, source, _ in said
    )


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (ua.Variant(" SN-7\0", V.String), "SN-7"),
        (ua.Variant("", V.String), ""),
        (ua.Variant(None, V.String), ""),
        (ua.Variant(None, V.Null), ""),
        (ua.Variant(2**64 - 1, V.UInt64), str(2**64 - 1)),
        (ua.Variant(-7, V.Int16), "-7"),
        (ua.Variant(0, V.UInt32), ""),
    ],
)
def test_a_serial_number_is_a_text_or_a_whole_number(value: ua.Variant, told: str) -> None:
    asked = Services([nodeid_to_binary(IDS[0])], [SERIAL])
    answer = answer_of([ua.DataValue(value, StatusCode=None)])
    assert asked.readings(answer, (0,)) == (Reading(0, 0.0),) and asked.serial(answer, (0,)) == told
    for other in (ua.Variant(4711.0, V.Double), ua.Variant(["SN-7"], V.String)):
        (reading,) = asked.readings(answer_of([ua.DataValue(other, StatusCode=None)]), (0,))
        assert reading.status == BAD_TYPE_MISMATCH


NODE_IDS = [
    ua.NodeId(1, 0),
    ua.NodeId(300, 5),
    ua.NodeId(70_000, 5),
    ua.NodeId("a", 5),
    ua.NodeId(b"abc", 5),
    ua.NodeId(uuid.UUID(int=7), 5),
]
OTHERS = [
    ua.Variant(None, V.Null),
    ua.Variant("12.0", V.String),
    ua.Variant(None, V.String),
    ua.Variant(b"12", V.ByteString),
    ua.Variant(12.0, V.Float),
    ua.Variant(12, V.Int64),
    ua.Variant(datetime(2024, 1, 1, tzinfo=UTC), V.DateTime),
    ua.Variant([1.0, 2.0], V.Double),
    ua.Variant([], V.Double),
    ua.Variant(["a", None, "b"], V.String),
    ua.Variant([[1.0, 2.0], [3.0, 4.0]], V.Double, Dimensions=[2, 2]),
    ua.Variant(ua.LocalizedText("auf", "de"), V.LocalizedText),
    ua.Variant(ua.LocalizedText("auf"), V.LocalizedText),
    ua.Variant(ua.LocalizedText(), V.LocalizedText),
    ua.Variant([ua.LocalizedText("auf"), ua.LocalizedText(None, "de")], V.LocalizedText),
    ua.Variant(ua.QualifiedName("a", 1), V.QualifiedName),
    ua.Variant([ua.QualifiedName("a", 1), ua.QualifiedName(None, 0)], V.QualifiedName),
    ua.Variant(NODE_IDS, V.NodeId),
    *(ua.Variant(node, V.NodeId) for node in NODE_IDS),
    ua.Variant(ua.ExpandedNodeId("a", 3, NamespaceUri="urn:x", ServerIndex=4), V.ExpandedNodeId),
    ua.Variant(ua.Range(1.0, 2.0), V.ExtensionObject),
    ua.Variant(None, V.ExtensionObject),
    ua.Variant([ua.Range(1.0, 2.0), ua.EUInformation("urn:x", 7)], V.ExtensionObject),
]


@pytest.mark.parametrize("other", OTHERS)
def test_a_value_of_another_type_is_bad_and_the_next_one_is_found(other: ua.Variant) -> None:
    place = KINDS.index("f64")
    both = ua.DataValue(other, StatusCode=None), ua.DataValue(other, ua.StatusCode(0x808C0000))
    mismatch, failed, good = services().readings(answer_of([*both, double(3.0)]), (place,) * 3)
    assert (mismatch.status, failed.status) == (BAD_TYPE_MISMATCH, 0x808C0000)
    assert (mismatch.value, failed.value) == (0.0, 0.0)
    assert good == Reading(0, 3.0)


def test_a_reading_without_a_value_is_bad() -> None:
    place = KINDS.index("f64")
    head = answer_of([double(1.0)])[:-14]  # without mask, type and number, and what comes behind
    assert services().readings(head + b"\x02\x00\x00\x8c\x80" + bytes(4), (place,)) == (Reading(0x808C0000, 0.0),)
    assert services().readings(head + b"\x00" + b"\xff" * 4, (place,)) == (Reading(BAD_TYPE_MISMATCH, 0.0),)


def test_what_does_not_fit_the_question_is_no_answer() -> None:
    place = KINDS.index("f64")
    good = answer_of([double(1.0)])
    written = struct_to_binary(ua.WriteResponse(Results=[ua.StatusCode(0)]))
    fault = ua.ServiceFault()
    fault.ResponseHeader.ServiceResult = ua.StatusCode(ua.StatusCodes.BadSessionIdInvalid)
    put_off = ua.ReadResponse(Results=[double(1.0)])
    put_off.ResponseHeader.ServiceResult = ua.StatusCode(ua.StatusCodes.GoodCompletesAsynchronously)
    for answer, why in (
        (written, "not ReadResponse"),
        (struct_to_binary(fault), "the server answered Bad"),
        (struct_to_binary(put_off), "GoodCompletesAsynchronously"),
        (answer_of([]), "0 results, asked for 1"),
        (answer_of([double(1.0)] * 2), "2 results, asked for 1"),
        (good + b"\x00", "does not end with its results"),
        (good[:24] + b"\x01" + good[25:], "which nobody asked for"),
        (b"\x03" + good[1:], "answered with 0300.*, not ReadResponse"),
        (b"\x01\x01" + good[2:], "not ReadResponse"),
        (b"", "cut short"),
    ):
        with pytest.raises(Misfit, match=why):
            services().readings(answer, (place,))
    with pytest.raises(Misfit, match="not WriteResponse"):
        statuses(good, 1)
    with pytest.raises(Misfit, match="cut short"):
        statuses(written[:-6], 1)
    with pytest.raises(Misfit, match="cut short"):
        statuses(b"", 1)
    assert statuses(written, 1) == (0,)


@pytest.mark.parametrize(
    ("value", "why"),
    [
        (ua.Variant([ua.Variant(1.0, V.Double)], V.Variant), "built-in type 24"),
        (ua.Variant(ua.DataValue(ua.Variant(1.0, V.Double)), V.DataValue), "built-in type 23"),
        (ua.Variant(ua.DiagnosticInfo(), V.DiagnosticInfo), "built-in type 25"),
    ],
)
def test_a_value_that_can_hold_others_is_refused_with_its_place(value: ua.Variant, why: str) -> None:
    answer = answer_of([double(1.0), ua.DataValue(value, StatusCode=None), double(3.0)])
    with pytest.raises(Misfit, match=f"{why}, result 2 of 3"):
        services().readings(answer, (KINDS.index("f64"),) * 3)


@pytest.mark.parametrize(
    ("body", "why"),
    [
        (b"\x11\x06\x00", "a node id with the encoding 0x06"),
        (b"\x16\x00\x00\x03", "an ExtensionObject with the encoding 3"),
        (b"\x3f", "built-in type 63"),
        (b"\x96\xff\xff\xff\x7f\x00\x00\x07", "an ExtensionObject with the encoding 7"),
    ],
)
def test_an_encoding_that_does_not_exist_is_refused_with_its_place(body: bytes, why: str) -> None:
    head = answer_of([double(1.0)])[:-13]  # without type and number, and what comes behind
    with pytest.raises(Misfit, match=f"{why}, result 1 of 1"):
        services().readings(head + body, (KINDS.index("f64"),))


@pytest.mark.parametrize("number", range(26, 32))
def test_a_type_that_is_not_assigned_yet_is_a_string_of_bytes(number: int) -> None:
    place = KINDS.index("f64")
    answer = answer_of([ua.DataValue(ua.Variant(b"12", V.ByteString), StatusCode=None), double(3.0)])
    at = answer.index(b"\x0f\x02\x00\x00\x0012")
    found = services().readings(answer[:at] + bytes((number,)) + answer[at + 1 :], (place, place))
    assert [reading.status for reading in found] == [BAD_TYPE_MISMATCH, 0]


def in_numeric_encoding(answer: bytes) -> bytes:
    """With the id of its type in seven bytes instead of four."""
    return b"\x02" + struct.pack("<HI", answer[1], int.from_bytes(answer[2:4], "little")) + answer[4:]


def test_the_type_of_an_answer_comes_in_any_encoding() -> None:
    place = KINDS.index("f64")
    good, written = answer_of([double(1.0)]), struct_to_binary(ua.WriteResponse(Results=[ua.StatusCode(0)]))
    assert services().readings(in_numeric_encoding(good), (place,)) == (Reading(0, 1.0),)
    assert statuses(in_numeric_encoding(written), 1) == (0,)
    with pytest.raises(Misfit, match="not ReadResponse"):
        services().readings(in_numeric_encoding(written), (place,))


def test_diagnostics_that_say_nothing_are_none() -> None:
    place = KINDS.index("f64")
    read = ua.ReadResponse(Results=[double(1.0), double(2.0)], DiagnosticInfos=[ua.DiagnosticInfo()] * 2)
    write = ua.WriteResponse(Results=[ua.StatusCode(0)] * 2, DiagnosticInfos=[ua.DiagnosticInfo()] * 2)
    assert [reading.value for reading in services().readings(struct_to_binary(read), (place,) * 2)] == [1.0, 2.0]
    assert statuses(struct_to_binary(write), 2) == (0, 0)
    for wrong in ([ua.DiagnosticInfo()], [ua.DiagnosticInfo(), ua.DiagnosticInfo(SymbolicId=ua.Int32(1))]):
        read.DiagnosticInfos = wrong
        with pytest.raises(Misfit, match="does not end with its results"):
            services().readings(struct_to_binary(read), (place,) * 2)


@pytest.mark.parametrize("kind", range(256))
@pytest.mark.parametrize("count", [0x7FFFFFFF, 0x80000000, 0xFFFFFFFF])
def test_a_value_that_would_not_end_is_refused(kind: int, count: int) -> None:
    """As bytes of a type, and a number of elements that no message has."""
    good = answer_of([double(1.0)])
    at = good.index(b"\x0b" + struct.pack("<d", 1.0))
    try:
        found = services().readings(good[:at] + bytes((kind,)) + struct.pack("<I", count), (KINDS.index("f64"),))
    except Misfit:
        return
    assert not found[0].good


@given(st.data())
def test_no_bytes_are_more_than_refused(data: st.DataObject) -> None:
    places = (KINDS.index("f64"), KINDS.index("u16"), KINDS.index("bool"))
    values = [double(1.5), ua.DataValue(ua.Variant(7, V.UInt16)), ua.DataValue(ua.Variant(True, V.Boolean))]
    body = bytearray(answer_of(values))
    for _ in range(data.draw(st.integers(0, 6))):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(body[: data.draw(st.integers(0, len(body)))])
    try:
        readings = services().readings(cut, places)
    except Misfit:
        return
    assert len(readings) == len(places)
    assert not readings[0].good or struct.pack("<d", readings[0].value) in cut


def test_few_prepared_reads_are_kept() -> None:
    some = services()
    first = some.read((0,))
    assert some.read((0,)) is first
    for place in range(1, READ_VARIANTS + 1):
        some.read((place,) * 2)
    assert some.read((0,)) is not first
