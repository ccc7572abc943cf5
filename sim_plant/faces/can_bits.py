"""How long a classic CAN frame is on the wire: its bits, with the stuff bits that its content needs.

After ISO 11898-1 (Robert Bosch GmbH, CAN specification 2.0, 1991, 3.1 and 5): from the start of frame to the end of
the check sequence a bit of the other value follows every five equal ones, stuff bits among them. Bits are kept as
numbers, the first bit on the wire as the highest; 0 is dominant.
"""

import can

INTERMISSION_BITS = 3  #: after a frame, before the next one may begin
#: CRC delimiter, acknowledge slot and delimiter, end of frame: never stuffed.
_TRAILER_BITS = 1 + 2 + 7
_CRC_POLYNOMIAL = 0x4599
_CRC_BITS = 15
_STUFF_AFTER = 5
_BASE_HEADER_BITS = 1 + 11 + 3 + 4  #: start of frame, arbitration field, control field
_EXTENDED_HEADER_BITS = 1 + 32 + 2 + 4


def frame_bits(message: can.Message) -> int:
    """Bits of a classic frame from its start to the end of its end-of-frame field, stuff bits included."""
    content, width = _header(message)
    if not message.is_remote_frame:
        data = message.data
        content, width = content << 8 * len(data) | int.from_bytes(data, "big"), width + 8 * len(data)
    check = crc15(content.to_bytes((width + 7) // 8, "big"))  # zeros in front do not change it
    content, width = content << _CRC_BITS | check, width + _CRC_BITS
    return width + stuff_bits(content, width) + _TRAILER_BITS


def arbitration_key(message: can.Message) -> int:
    """Of two frames that begin together the one with the smaller key goes first."""
    header, width = _header(message)
    return header << _EXTENDED_HEADER_BITS - width


def crc15(data: bytes) -> int:
    """The check sequence over the bits before stuffing (CRC-15/CAN)."""
    register = 0
    for byte in data:
        register = (register << 8 ^ _CRC_OF[register >> 7 ^ byte]) & 0x7FFF
    return register


def stuff_bits(content: int, width: int) -> int:
    """How many stuff bits a transmitter puts between the `width` bits of `content`, the first of which is dominant."""
    padding = -width % 8  # in front, without a run, and ending recessive: it needs no stuff bit and brings none
    padded = (0x55 & (1 << padding) - 1) << width | content
    count, state = 0, _BEGIN
    for byte in padded.to_bytes((width + padding) // 8, "big"):
        state, more = _STUFFED[state][byte]
        count += more
    return count


def _header(message: can.Message) -> tuple[int, int]:
    """Start of frame, arbitration field and control field, and how many bits these are."""
    identifier, remote, length = message.arbitration_id, int(message.is_remote_frame), message.dlc
    if not message.is_extended_id:
        return identifier << 7 | remote << 6 | length, _BASE_HEADER_BITS
    base, extension = identifier >> 18, identifier & 0x3FFFF
    # Substitute remote request and identifier extension are recessive.
    return base << 27 | 0b11 << 25 | extension << 7 | remote << 6 | length, _EXTENDED_HEADER_BITS


def _crc_step(byte: int) -> int:
    register = byte << _CRC_BITS - 8
    for _ in range(8):
        register = register << 1 ^ (_CRC_POLYNOMIAL if register >> _CRC_BITS - 1 else 0)
        register &= (1 << _CRC_BITS) - 1
    return register


def _stuff_step(state: int, byte: int) -> tuple[int, int]:
    """The state after the bits of a byte, and the stuff bits on the way.

    A state is the length of the run that is there, 0 to 4, twice, and the value of its bits.
    """
    run, last, count = state >> 1, state & 1, 0
    for k in range(7, -1, -1):
        bit = byte >> k & 1
        run, last = (run + 1 if bit == last else 1), bit
        if run == _STUFF_AFTER:
            count += 1
            run, last = 1, 1 - bit  # the stuff bit itself begins the next run
    return run << 1 | last, count


_BEGIN = 0  #: no run
_CRC_OF = [_crc_step(byte) for byte in range(256)]
_STUFFED = [[_stuff_step(state, byte) for byte in range(256)] for state in range(2 * _STUFF_AFTER)]
