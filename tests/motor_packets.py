"""Dynamixel protocol 2.0 as bytes.

Packets, their check, byte stuffing, and finding packets in a stream.

A packet is FF FF FD 00, ID, length (2 bytes, little-endian, of all that follows), instruction,
parameters and CRC-16. Within instruction and parameters FF FF FD is followed by one more FD, so
that no header appears.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from functools import cache

HEADER = b"\xff\xff\xfd\x00"
STUFFED, STUFFING = b"\xff\xff\xfd", b"\xfd"
BROADCAST = 0xFE
MAX_ID = 0xFC
SHORTEST, LONGEST = 3, 1024
"""Values of the length field: instruction and CRC at least; the largest buffer of an X motor at
most.
"""
STATUS_BYTES = 11
"""Bytes of a status packet without data."""
POLYNOMIAL = 0x8005
ALERT = 0x80
"""Bit of a status packet's error byte: the motor's hardware error status is not zero."""


class Instruction(IntEnum):
    """Instructions of the protocol."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


class Failure(IntEnum):
    """Error numbers of a status packet (its lower seven bits)."""

    NONE = 0
    INSTRUCTION = 2
    CRC = 3
    RANGE = 4
    LENGTH = 5
    LIMIT = 6
    ACCESS = 7


@dataclass(frozen=True)
class Packet:
    """One packet, without header, stuffing and check."""

    id: int
    """Motor, or :data:`BROADCAST`."""
    instruction: int
    """An :class:`Instruction`, or what else stood in its place."""
    parameters: bytes
    """Parameters; of a status packet the error byte, then data."""


@cache
def _crc_of_byte(byte: int) -> int:
    value = byte << 8
    for _ in range(8):
        value = (value << 1) ^ (POLYNOMIAL if value & 0x8000 else 0)
    return value & 0xFFFF


def crc16(data: bytes) -> int:
    """CRC-16 of the protocol: polynomial 0x8005, not reflected, starting at 0."""
    value = 0
    for byte in data:
        value = ((value << 8) & 0xFFFF) ^ _crc_of_byte((value >> 8) ^ byte)
    return value


def encode(packet: Packet) -> bytes:
    """The bytes of a packet on the wire."""
    body = bytes([packet.instruction]) + packet.parameters
    body = body.replace(STUFFED, STUFFED + STUFFING)
    start = HEADER + bytes([packet.id]) + (len(body) + 2).to_bytes(2, "little") + body
    return start + crc16(start).to_bytes(2, "little")


def numbers(*values: int) -> bytes:
    """Numbers of two bytes, as addresses and lengths are."""
    return b"".join(value.to_bytes(2, "little") for value in values)


def status(id: int, error: int, data: bytes = b"") -> Packet:
    """A status packet."""
    return Packet(id, Instruction.STATUS, bytes([error]) + data)


class PacketReader:
    """Finds whole, sound packets in a stream of bytes, whatever is between them.

    Its buffer is bounded.
    """

    def __init__(self) -> None:
        """Begin with nothing read."""
        self._buffer = bytearray()

    @property
    def waiting(self) -> bool:
        """Whether a packet has begun and not ended."""
        return bool(self._buffer)

    def feed(self, data: bytes) -> list[Packet]:
        """Take bytes in and return the packets that they complete."""
        self._buffer += data
        return list(self._packets())

    def give_up(self) -> list[Packet]:
        """The line has fallen silent: drop the packet that has begun.

        Returns what was behind its start.
        """
        del self._buffer[:1]
        return list(self._packets())

    def _packets(self) -> Iterator[Packet]:
        while True:
            start = self._buffer.find(HEADER)
            if start < 0:
                # The last bytes may be the begin of a header.
                del self._buffer[: max(0, len(self._buffer) - len(HEADER) + 1)]
                return
            del self._buffer[:start]
            if len(self._buffer) < 7:
                return
            length = int.from_bytes(self._buffer[5:7], "little")
            packet = None
            if SHORTEST <= length <= LONGEST:
                if len(self._buffer) < 7 + length:
                    return
                packet = decode(bytes(self._buffer[: 7 + length]))
            # Skip one byte only of a broken one: a sound packet may begin inside of it.
            del self._buffer[: 1 if packet is None else 7 + length]
            if packet is not None:
                yield packet


def decode(frame: bytes) -> Packet | None:
    """The packet of one whole frame; None if it is not sound."""
    if crc16(frame[:-2]) != int.from_bytes(frame[-2:], "little"):
        return None
    body = frame[7:-2].replace(STUFFED + STUFFING, STUFFED)
    return Packet(frame[4], body[0], body[1:])
