"""The packet codec against known bytes, dynamixel-sdk's own, and noise."""

import random

from hypothesis import given, settings
from hypothesis import strategies as st
from motor_packets import (
    HEADER,
    LONGEST,
    Instruction,
    Packet,
    PacketReader,
    encode,
)

packets = st.builds(
    Packet,
    id=st.integers(0, 252),
    instruction=st.sampled_from(list(Instruction)),
    parameters=st.one_of(
        st.binary(max_size=40),
        # What has to be stuffed, again and again.
        st.lists(st.sampled_from([b"\xff", b"\xfd", b"\xff\xff\xfd", b"\x00"]), max_size=20).map(
            b"".join
        ),
    ),
)


def test_packets_of_the_published_examples():
    """Ping of motor 1, and a read of four bytes at 132, as the protocol's description prints them."""
    assert encode(Packet(1, Instruction.PING, b"")).hex(" ") == "ff ff fd 00 01 03 00 01 19 4e"
    read = Packet(1, Instruction.READ, bytes([132, 0, 4, 0]))
    assert encode(read).hex(" ") == "ff ff fd 00 01 07 00 02 84 00 04 00 1d 15"


@settings(max_examples=100, deadline=None)
@given(packet=packets)
def test_what_is_encoded_is_read_back_and_holds_no_header(packet):
    frame = encode(packet)
    assert PacketReader().feed(frame) == [packet]
    assert HEADER not in frame[4:-2]


@settings(max_examples=100, deadline=None)
@given(
    sent=st.lists(packets, max_size=6),
    noise=st.lists(st.binary(max_size=9), max_size=6),
    cut=st.integers(1, 9),
)
def test_packets_are_found_in_noise_and_in_pieces(sent, noise, cut):
    # Noise without the header's first byte cannot pretend to be a longer packet.
    noise = [piece.replace(b"\xff", b"") for piece in noise] + [b""] * len(sent)
    stream = b"".join(piece + encode(packet) for piece, packet in zip(noise, sent, strict=False))
    reader = PacketReader()
    found = [
        packet for i in range(0, len(stream), cut) for packet in reader.feed(stream[i : i + cut])
    ]
    assert found == sent


def test_a_sound_packet_after_a_broken_one_is_found():
    good = encode(Packet(2, Instruction.PING, b""))
    half = encode(Packet(1, Instruction.WRITE, bytes(30)))[:20]
    reader = PacketReader()
    assert reader.feed(half + good) == []  # it could still be the rest of the first
    assert reader.waiting
    assert reader.give_up() == [Packet(2, Instruction.PING, b"")]


def test_the_buffer_is_bounded_whatever_comes():
    rng = random.Random(0)
    reader = PacketReader()
    for _ in range(2000):
        reader.feed(rng.randbytes(50) + rng.choice([b"", HEADER, HEADER + b"\x01\xff\x03"]))
        assert len(reader._buffer) <= LONGEST + 60
