import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.topics import TOPICS
from gateway.mailbox.codec import MAX_DATAGRAM, MAX_ID, MAX_TOPIC, Envelope, Kind, MalformedEnvelope, decode, encode
from gateway.mailbox.port import MAX_PAYLOAD

names = st.text(st.characters(min_codepoint=0, max_codepoint=127), min_size=1, max_size=MAX_TOPIC)
envelopes = st.builds(Envelope, st.sampled_from(Kind), names, st.integers(0, MAX_ID), st.binary(max_size=300))


@given(envelopes)
def test_what_is_encoded_is_decoded(envelope: Envelope) -> None:
    assert decode(encode(envelope)) == envelope


@given(st.binary(max_size=200))
def test_any_bytes_are_an_envelope_that_encodes_to_them_or_malformed(datagram: bytes) -> None:
    try:
        envelope = decode(datagram)
    except MalformedEnvelope:
        return
    assert encode(envelope) == datagram


@given(envelopes, st.data())
def test_a_cut_datagram_never_gives_another_topic(envelope: Envelope, data: st.DataObject) -> None:
    whole = encode(envelope)
    cut = whole[: data.draw(st.integers(0, len(whole) - 1))]
    try:
        found = decode(cut)
    except MalformedEnvelope:
        return
    assert found[:3] == envelope[:3]
    assert envelope.payload.startswith(found.payload)


def test_the_layout_is_what_the_docstring_says() -> None:
    datagram = encode(Envelope(Kind.REQUEST, "loop/command", 0x0102, b"{}"))
    assert datagram == bytes([1, 2, 2, 1, 0, 0, 0, 0, 0, 0, 12]) + b"loop/command" + b"{}"


@pytest.mark.parametrize("kind", Kind)
def test_the_longest_payload_passes_and_one_byte_more_does_not(kind: Kind) -> None:
    longest = Envelope(kind, "t" * MAX_TOPIC, MAX_ID, bytes(MAX_PAYLOAD))
    datagram = encode(longest)
    assert len(datagram) == MAX_DATAGRAM
    assert decode(datagram) == longest
    with pytest.raises(MalformedEnvelope, match=f"{MAX_PAYLOAD + 1} bytes"):
        encode(longest._replace(payload=bytes(MAX_PAYLOAD + 1)))
    with pytest.raises(MalformedEnvelope, match=f"{MAX_PAYLOAD + 1} bytes"):
        decode(datagram + b"x")


@pytest.mark.parametrize("topic", ["", "t" * (MAX_TOPIC + 1), "Öl"])
def test_a_topic_that_no_receiver_takes_is_not_sent(topic: str) -> None:
    with pytest.raises(MalformedEnvelope, match="ASCII"):
        encode(Envelope(Kind.PUBLISH, topic, 0, b""))


@pytest.mark.parametrize(
    ("datagram", "why"),
    [
        (b"", "shorter"),
        (bytes([2, 1]) + bytes(8) + b"\x01t", "version 2"),
        (bytes([1, 5]) + bytes(8) + b"\x01t", "kind 5"),
        (bytes([1, 1]) + bytes(8) + b"\x00", "topic"),
        (bytes([1, 1]) + bytes(8) + b"\x02t", "topic"),
        (bytes([1, 1]) + bytes(8) + b"\x01\xff", "topic"),
    ],
)
def test_a_malformed_datagram_is_told_why(datagram: bytes, why: str) -> None:
    with pytest.raises(MalformedEnvelope, match=why):
        decode(datagram)


def test_every_topic_of_the_table_fits() -> None:
    for topic in TOPICS:
        assert decode(encode(Envelope(Kind.PUBLISH, topic.name, 0, b""))).topic == topic.name
