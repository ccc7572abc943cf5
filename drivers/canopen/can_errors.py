"""CAN error frames in words, and which of them mean that the bus has to be opened again. No I/O.

The classes are bits of the identifier, the details bytes of the frame (Linux, include/uapi/linux/can/error.h).
"""

BUS_OFF = 0x040

_CLASSES = {
    0x001: "no receipt for what was sent in time",
    0x002: "lost arbitration",
    0x004: "controller",
    0x008: "protocol violation",
    0x010: "transceiver",
    0x020: "nobody acknowledges what is sent; check wiring, termination, bit rate and that a device is on",
    BUS_OFF: "bus-off: the controller has left the bus; check wiring, termination and bit rate",
    0x080: "bus error",
    0x100: "the controller was restarted",
}
_CONTROLLER = {
    0x01: "receive buffer overflow",
    0x02: "transmit buffer overflow",
    0x04: "many receive errors",
    0x08: "many transmit errors",
    0x10: "error passive, receiving",
    0x20: "error passive, sending",
    0x40: "error active again",
}
_CONTROLLER_CLASS = 0x004
_COUNTERS = 0x200  #: bytes 6 and 7 are the transmit and receive error counters


def error_text(identifier: int, data: bytes | bytearray) -> str:
    """An error frame for a person."""
    words = [text for bit, text in _CLASSES.items() if identifier & bit]
    if identifier & _CONTROLLER_CLASS and len(data) > 1:
        details = [text for bit, text in _CONTROLLER.items() if data[1] & bit]
        words[words.index("controller")] = "controller: " + (", ".join(details) or "no details")
    if identifier & _COUNTERS and len(data) > 7:
        words.append(f"{data[6]} transmit and {data[7]} receive errors counted")
    return "CAN error: " + ("; ".join(words) or f"class {identifier:#x} {bytes(data).hex()}")


def is_bus_off(identifier: int) -> bool:
    """Whether the frame says that the controller takes no more part."""
    return bool(identifier & BUS_OFF)
