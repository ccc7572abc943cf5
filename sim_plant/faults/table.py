"""Every fault that can be injected into the simulated line, one row each. Nothing else lists them.

A row says what a fault may be asked of; what it does stands in `effects` for devices and the web, and in
`wire_faults` for frames. docs/faults.md is written from this table (`page`).
"""

from dataclasses import dataclass
from enum import Enum
from math import inf


class Kind(Enum):
    """What a fault can be done to. The value is the word for it; that of a wire is the wire's own name."""

    WIRE = "wire"
    DRIVE = "drive"
    LOAD_CELL = "load-cell"
    PLC = "plc"
    WEB = "web"


WIRES = ("canopen", "modbus-tcp", "opcua")  #: the words of the plant's file

#: What the number behind a target counts; None where there is no number.
NUMBERED = {
    Kind.WIRE: "address (node or unit; without it all of them)",
    Kind.DRIVE: "roller",
    Kind.LOAD_CELL: "span",
    Kind.PLC: None,
    Kind.WEB: "span or roller",
}


class Lasting(Enum):
    """How long a fault lasts."""

    WHILE = "until it is cleared, or as long as `for` says"
    ONCE = "happens once"


@dataclass(frozen=True, slots=True)
class Number:
    """A parameter in `unit` between `lowest` and `highest`, both allowed. Without a default it must be given.

    A pure number has no unit.
    """

    name: str
    unit: str
    lowest: float
    highest: float
    default: float | None = None
    whole: bool = False


@dataclass(frozen=True, slots=True)
class Choice:
    """A parameter that is one of some words; the first is the default."""

    name: str
    words: tuple[str, ...]


Parameter = Number | Choice


@dataclass(frozen=True, slots=True)
class Fault:
    name: str
    kinds: tuple[Kind, ...]
    does: str  #: one sentence
    example: str
    lasting: Lasting = Lasting.WHILE
    parameters: tuple[Parameter, ...] = ()
    group: str = ""  #: of faults that the same target cannot have together: all of them change one reading

    def parameter(self, name: str) -> Parameter | None:
        return next((p for p in self.parameters if p.name == name), None)


BOTH, TO_DEVICE, FROM_DEVICE = "both", "to-device", "from-device"

_WHICH = Choice("direction", (BOTH, TO_DEVICE, FROM_DEVICE))
_WHICH_FROM = Choice("direction", (FROM_DEVICE, TO_DEVICE, BOTH))
_PROBABILITY = Number("probability", "", 0.0, 1.0, 1.0)
_COUNT = Number("count", "frames", 1, 1e9, inf, whole=True)
_DICE = (_PROBABILITY, _COUNT)

_FRAMES = (Kind.WIRE, Kind.DRIVE, Kind.LOAD_CELL, Kind.PLC)  #: a device stands for its own address on its own wire
_CELL, _DRIVE, _PLC, _WEB = (Kind.LOAD_CELL,), (Kind.DRIVE,), (Kind.PLC,), (Kind.WEB,)
_NODES = (Kind.DRIVE, Kind.LOAD_CELL, Kind.PLC)
_READING, _TORQUE, _WATCHDOG = "reading", "torque", "watchdog"
IGNORES, FOLLOWS = "ignores", "follows"  #: its target torque, as the statusword says

FAULTS = (
    # Frames. All of them may be asked of a whole wire, of one address on it, or of a device by its own name.
    Fault("drop", _FRAMES, "Frames are lost.", "drive 3 drop probability=0.2 at 5 for 2", parameters=(_WHICH, *_DICE)),
    Fault(
        "delay",
        _FRAMES,
        "Frames come late; those behind them may overtake them.",
        "plc delay delay_s=0.05 at 5 for 1",
        parameters=(Number("delay_s", "s", 0.0, 60.0), _WHICH_FROM, *_DICE),
    ),
    Fault(
        "duplicate",
        _FRAMES,
        "Frames come several times.",
        "canopen duplicate copies=3 probability=0.1",
        parameters=(Number("copies", "frames", 2, 100, 2, whole=True), _WHICH_FROM, *_DICE),
    ),
    Fault(
        "reorder",
        _FRAMES,
        "A frame is held back and comes behind the next one of the same direction.",
        "drive 2 reorder count=1 at 4",
        parameters=(_WHICH_FROM, *_DICE),
    ),
    Fault(
        "corrupt",
        _FRAMES,
        "One bit of the content is inverted; the frame around it stays whole.",
        "modbus-tcp 1 corrupt probability=0.01",
        parameters=(_WHICH_FROM, *_DICE),
    ),
    Fault(
        "wrong-function",
        _FRAMES,
        "The function code is another: that of the PDU, of the COB-ID, or the type of the OPC UA message.",
        "load-cell 1 wrong-function count=1 at 6",
        parameters=(_WHICH_FROM, *_DICE),
    ),
    Fault(
        "wrong-length",
        _FRAMES,
        "Bytes are missing at the end (or zeros are added); the length field tells the new length, or lies.",
        "load-cell 1 wrong-length by=-2 field=lies count=1",
        parameters=(
            Number("by", "bytes", -64, 64, -1, whole=True),
            Choice("field", ("fits", "lies")),
            _WHICH_FROM,
            *_DICE,
        ),
    ),
    Fault(
        "freeze",
        _FRAMES,
        "The first answer of each sort comes again and again in place of new ones, correctly framed.",
        "drive 4 freeze at 5 for 0.5",
    ),
    Fault(
        "one-way",
        _FRAMES,
        "Frames pass in this direction only.",
        "drive 1 one-way direction=to-device at 5",
        parameters=(Choice("direction", (TO_DEVICE, FROM_DEVICE)),),
    ),
    Fault("mute", _FRAMES, "Nothing passes, either way; connections stay open.", "plc mute at 5 for 0.3"),
    Fault(
        "disconnect",
        (Kind.WIRE,),
        "Connections are broken off and refused; on CAN, nothing passes. Of a whole wire only.",
        "modbus-tcp disconnect at 5 for 1",
    ),
    # CANopen nodes.
    Fault(
        "heartbeat-lost",
        _FRAMES,
        "The node's heartbeats are lost, everything else passes. On CANopen only.",
        "drive 3 heartbeat-lost at 5 for 1",
    ),
    Fault(
        "sdo-abort",
        _FRAMES,
        "SDO requests to the node are answered with an abort and change nothing. On CANopen only.",
        "drive 2 sdo-abort index=0x1400 code=0x06090030",
        parameters=(
            Number("index", "object, 0 for any", 0, 0xFFFF, 0, whole=True),
            Number("code", "abort code", 1, 0xFFFFFFFF, 0x08000022, whole=True),
            _COUNT,
        ),
    ),
    # Drives.
    Fault(
        "restart",
        _NODES,
        "The node loses power for a moment: settings are lost, torque is off, it boots up. On CANopen only.",
        "drive 2 restart at 5",
        Lasting.ONCE,
    ),
    Fault(
        "drive-fault",
        _DRIVE,
        "The drive goes to fault, torque off at once, until it is reset.",
        "drive 2 drive-fault code=0x3210 at 5",
        Lasting.ONCE,
        (Number("code", "as in 603Fh", 1, 0xFFFF, 0x2310, whole=True),),
    ),
    Fault(
        "torque-share",
        _DRIVE,
        "The drive gives so many times the torque that it is asked for, and reports what it gives.",
        "drive 2 torque-share share=0.1 at 5",
        parameters=(Number("share", "", -10.0, 10.0),),
        group=_TORQUE,
    ),
    Fault(
        "mode-lost",
        _DRIVE,
        "The drive is in another mode of operation and gives no torque; its state stays. Its statusword (bit 12) says "
        "that it ignores its target torque, or that it follows it.",
        "drive 2 mode-lost says=follows at 5 for 0.6",
        parameters=(Number("mode", "as in 6061h", -128, 127, 0, whole=True), Choice("says", (IGNORES, FOLLOWS))),
        group=_TORQUE,
    ),
    Fault(
        "no-power",
        _DRIVE,
        "The power stage has no supply: torque is off, and the drive cannot be enabled.",
        "drive 2 no-power at 5",
    ),
    Fault(
        "drive-warning",
        _DRIVE,
        "The drive warns of something and goes on: emergency message, bit 7 of its statusword, its error code. On "
        "wires only.",
        "drive 2 drive-warning code=0x4210 register=0x08 at 5",
        parameters=(
            Number("code", "as in 603Fh", 0x100, 0xFFFF, 0x4210, whole=True),
            Number("register", "as in 1001h", 0, 0xFF, 0x08, whole=True),
        ),
    ),
    Fault("sto", _DRIVE, "Safe torque off is active.", "drive 1 sto at 5 for 0.1"),
    Fault(
        "watchdog-dead",
        (Kind.DRIVE, Kind.PLC),
        "The communication watchdog takes its setting and shows it, and never fires.",
        "drive 3 watchdog-dead",
        group=_WATCHDOG,
    ),
    Fault(
        "watchdog-warns",
        (Kind.DRIVE, Kind.PLC),
        "The communication watchdog fires and takes nothing away: a drive warns (emergency message 8250h, bit 7 of its "
        "statusword) and keeps its state, the line PLC says that it has tripped and keeps transport on.",
        "drive 3 watchdog-warns",
        group=_WATCHDOG,
    ),
    Fault(
        "encoder-jump",
        _DRIVE,
        "The measured speed is off by so much.",
        "drive 4 encoder-jump delta_m_per_s=0.05 at 5 for 0.01",
        parameters=(Number("delta_m_per_s", "m/s", -100.0, 100.0),),
        group=_READING,
    ),
    Fault(
        "encoder-frozen",
        _DRIVE,
        "The measured speed stands still.",
        "drive 4 encoder-frozen at 5 for 1",
        group=_READING,
    ),
    Fault(
        "encoder-reversed",
        _DRIVE,
        "The measured speed has the wrong sign; the torque is right.",
        "drive 4 encoder-reversed at 0",
        group=_READING,
    ),
    Fault(
        "reversed",
        _DRIVE,
        "The motor turns its roller backwards; torque and speed have their signs as the drive sees them.",
        "drive 2 reversed at 0",
    ),
    # Load cells. The channel's status stays ok.
    Fault("nan", _CELL, "The measured tension is not a number.", "load-cell 3 nan at 12.5 for 0.2", group=_READING),
    Fault("stuck", _CELL, "The measured tension stands still.", "load-cell 3 stuck at 5", group=_READING),
    Fault(
        "offset",
        _CELL,
        "The measured tension is off by so much.",
        "load-cell 2 offset by_n=3 at 5 for 10",
        parameters=(Number("by_n", "N", -1e5, 1e5),),
        group=_READING,
    ),
    Fault(
        "cell-factor",
        _CELL,
        "The measured tension is so many times the true one; -1 is the wrong way round, 0 nothing.",
        "load-cell 2 cell-factor factor=0.5 at 0",
        parameters=(Number("factor", "", -100.0, 100.0),),
        group=_READING,
    ),
    Fault(
        "cells-swapped",
        _CELL,
        "The plugs of two load cells are exchanged.",
        "load-cell 2 cells-swapped other=3 at 0",
        parameters=(Number("other", "span", 1, 60, whole=True),),
    ),
    Fault(
        "drift",
        _CELL,
        "The measured tension moves away from the true one; cleared, it is true again.",
        "load-cell 2 drift rate_n_per_s=0.1 at 5 for 60",
        parameters=(Number("rate_n_per_s", "N/s", -1e4, 1e4),),
        group=_READING,
    ),
    Fault(
        "spike",
        _CELL,
        "One measurement, the next one that is read, is off by so much.",
        "load-cell 1 spike height_n=30 at 5",
        Lasting.ONCE,
        (Number("height_n", "N", -1e5, 1e5),),
    ),
    Fault(
        "out-of-range",
        _CELL,
        "The measured tension is this, which no cell can carry.",
        "load-cell 1 out-of-range at 5 for 0.1",
        parameters=(Number("tension_n", "N", -1e9, 1e9, 1e6),),
        group=_READING,
    ),
    # Line PLC.
    Fault("emergency-stop", _PLC, "The emergency stop is pressed; cleared, it is released.", "plc emergency-stop at 5"),
    Fault("permissive-lost", _PLC, "The PLC takes its permissive away.", "plc permissive-lost at 5 for 0.5"),
    Fault("local", _PLC, "The line is switched to local operation: nobody starts it from afar.", "plc local at 0"),
    Fault(
        "plc-freeze",
        _PLC,
        "The PLC's program has stopped: it answers, shows old values, and does nothing of what it is told.",
        "plc plc-freeze at 5 for 0.5",
    ),
    # Web.
    Fault(
        "web-break",
        _WEB,
        "The web of a span tears, which counts as tension-band; cleared, it is threaded again.",
        "web 4 web-break at 5",
    ),
    Fault(
        "slip",
        _WEB,
        "The friction between web and roller is so many times what it was; the last roller, a nip or reel, holds.",
        "web 2 slip factor=0.1 at 5 for 2",
        parameters=(Number("factor", "", 0.0, 1.0),),
    ),
    Fault(
        "friction-rise",
        _WEB,
        "The bearing of a roller has so many times its friction, beside its wear.",
        "web 4 friction-rise factor=5 at 5",
        parameters=(Number("factor", "", 1.0, 1e4),),
    ),
    Fault(
        "slack",
        _WEB,
        "So much more web lies in a span at once, as after a sheet that was let go.",
        "web 3 slack length_m=0.002 at 5",
        Lasting.ONCE,
        (Number("length_m", "m", 0.0, 10.0),),
    ),
)

BY_NAME = {fault.name: fault for fault in FAULTS}
