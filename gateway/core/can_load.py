"""How much of a CAN bus the cycle takes, with worst-case bit stuffing.

A data frame with an 11-bit identifier and s bytes has at most 55 + 10 s bits, interframe space included
(R. I. Davis, A. Burns, R. J. Bril, J. J. Lukkien, "Controller Area Network (CAN) schedulability analysis",
Real-Time Systems 35, 2007, eq. 1).
"""

from collections import Counter
from math import ceil

from gateway.core.line import CanopenBus, Line

HEARTBEAT_PERIOD_S = 0.1
REFUSED_LOAD = 0.8  #: above it, retransmissions after an error no longer fit into the period
ODD_LOAD = 0.6
_SYNC_BYTES, _HEARTBEAT_BYTES = 0, 1
_DRIVE_BYTES = (5, 8)  #: RPDO: controlword, torque, mode; TPDO: statusword, speed, torque
_OTHER_BYTES = (8, 8)  #: any other device, at most: what a PLC sends and gets, or what an amplifier sends
_CHANNELS_PER_AMPLIFIER = 4  #: that two frames carry; each further four count as another device


def frame_bits(data_bytes: int) -> int:
    """Bits of a classic CAN data frame on the wire, at worst."""
    return 55 + 10 * data_bytes


def can_load(drives: int, others: int, bitrate_bit_per_s: int, period_s: float) -> float:
    """Fraction of the bus that SYNC, PDOs and heartbeats of so many devices take."""
    per_period = frame_bits(_SYNC_BYTES)
    per_period += drives * sum(map(frame_bits, _DRIVE_BYTES)) + others * sum(map(frame_bits, _OTHER_BYTES))
    per_heartbeat = (drives + others) * frame_bits(_HEARTBEAT_BYTES)
    return (per_period / period_s + per_heartbeat / HEARTBEAT_PERIOD_S) / bitrate_bit_per_s


def bus_devices(line: Line, bus: CanopenBus) -> tuple[int, int]:
    """Drives, and other nodes, on `bus`; a load-cell amplifier with many channels counts for several."""
    channels = Counter(cell.address for cell in line.load_cells if cell.bus == bus.name)
    others = sum(ceil(count / _CHANNELS_PER_AMPLIFIER) for count in channels.values()) + (line.plc.bus == bus.name)
    return sum(drive.bus == bus.name for drive in line.drives), others


def bus_load(line: Line, bus: CanopenBus) -> float:
    """Load of a bus of the line, as a fraction."""
    return can_load(*bus_devices(line, bus), bus.bitrate_bit_per_s, line.control.period_s)


def fitting_period_s(drives: int, others: int, bitrate_bit_per_s: int) -> float | None:
    """The shortest period in whole milliseconds at which the bus is not overloaded; None if even 0.1 s is too short."""
    periods = (milliseconds / 1000 for milliseconds in range(1, 101))
    return next((T for T in periods if can_load(drives, others, bitrate_bit_per_s, T) <= REFUSED_LOAD), None)


def fitting_buses(drives: int, bitrate_bit_per_s: int, period_s: float, most: float = REFUSED_LOAD) -> int | None:
    """On how many buses so many drives fit with a load of at most `most`; None if one drive is too much for a bus."""
    counts = range(1, max(drives, 1) + 1)
    return next((n for n in counts if can_load(ceil(drives / n), 0, bitrate_bit_per_s, period_s) <= most), None)
