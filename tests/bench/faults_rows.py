"""What is injected into the virtual line, row by row, and what must come of it. Data only.

A template is in the words of docs/faults.md; `{roller}`, `{span}`, `{period}` and the like are filled in for each
injection. `at` counts from the injection there.
"""

from dataclasses import dataclass
from enum import Enum

HEARTBEAT_S = 0.1  #: producer time of the drives
WATCHDOG_S = 0.1  #: that the line sets


class Wanted(Enum):
    """The reaction that a row asks for, and what is timed."""

    HOLD = "held"  #: the torques of the period before are sent again, and the line runs on
    STOP = "stop"  #: the first command that takes speed or torque away
    RUN_ON = "nothing"  #: nothing is held, nothing stops
    SAFE = "safe"  #: anything but an unsafe event: what is wrong cannot be seen in the frame


@dataclass(frozen=True, slots=True)
class Variant:
    """One way to bring the fault about. `faults` come together.

    `spares_heartbeat`: no heartbeat of the target falls into this many seconds from the injection on, because a lost
    heartbeat is another row.
    """

    name: str
    faults: tuple[str, ...] = ()
    action: str = ""  #: of `faults_virtual.ACTIONS`, where no fault has a name for it
    spares_heartbeat_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Row:
    """`bound_s` is from the injection to the reaction, for a period of 10 ms."""

    id: str
    injected: str
    wanted: Wanted
    bound: str  #: for people
    bound_s: float
    variants: tuple[Variant, ...]
    harms_web: bool = False  #: the fault itself takes the tension out of its band
    pause_periods: int = 25  #: until the next injection may come, when the line runs on
    settle_periods: int = 30  #: after a start, before the first injection


T = 0.01
_TARGETS = ("drive {roller}", "load-cell {span}", "plc")


def _frames(faults: tuple[tuple[str, str], ...], lasting: str, spare_s: float = 0.0) -> tuple[Variant, ...]:
    """Every frame fault for every device."""
    return tuple(
        Variant(f"{target.split()[0]} {name}", (f"{target} {fault} {lasting}",), spares_heartbeat_s=spare_s)
        for target in _TARGETS
        for name, fault in faults
    )


_BAD_FRAMES = (
    ("drop", "drop direction=from-device"),
    ("delay", "delay delay_s={late_s}"),
    ("wrong-function", "wrong-function"),
    ("wrong-length", "wrong-length by=-2"),
    ("wrong-length lies", "wrong-length by=-2 field=lies"),
)
_ONE = "for {period}"
_MANY = "for {six_periods}"
_EXCEPTIONS = tuple(Variant(f"{device} exception", action=f"exception {device}") for device in ("load-cell", "plc"))

ROWS = (
    Row(
        "frame-once", "one answer lost, late, of a wrong function or length, or a Modbus exception",
        Wanted.HOLD, "3 T", 3 * T,
        (
            *_frames(_BAD_FRAMES, _ONE, 2 * T),
            *(
                Variant(f"{t.split()[0]} reorder", (f"{t} reorder count=1 for 0.02",), spares_heartbeat_s=3 * T)
                for t in _TARGETS
            ),
            *(Variant(f"{v.name} once", action=f"{v.action} once") for v in _EXCEPTIONS),
        ),
    ),
    Row(
        "frame-twice", "answers come twice", Wanted.RUN_ON, "-", 0.0,
        tuple(Variant(f"{t.split()[0]} duplicate", (f"{t} duplicate for 0.1",)) for t in _TARGETS),
    ),
    Row(
        "frame-corrupt", "a bit of an answer inverted within a whole frame", Wanted.SAFE, "-", 0.0,
        tuple(Variant(f"{t.split()[0]} corrupt", (f"{t} corrupt {_ONE}",)) for t in _TARGETS),
    ),
    Row(
        "frame-thrice", "the same, six periods long", Wanted.STOP, "3 T", 3 * T,
        (*_frames((*_BAD_FRAMES, ("mute", "mute")), _MANY), *_EXCEPTIONS),
    ),
    Row(
        "frame-very-late", "answers come more than a period late, six periods long: they may pass for fresh ones",
        Wanted.SAFE, "-", 0.0,
        tuple(Variant(f"{t.split()[0]} delay", (f"{t} delay delay_s={{very_late_s}} {_MANY}",)) for t in _TARGETS),
    ),
    Row(
        "heartbeat", "a drive's heartbeats lost", Wanted.STOP, "1.5 heartbeats + 2 T", 1.5 * HEARTBEAT_S + 2 * T,
        (Variant("drive heartbeat-lost", ("drive {roller} heartbeat-lost for 0.5",)),),
    ),
    Row(
        "emcy", "a drive's fault with its EMCY", Wanted.STOP, "1.5 heartbeats + 2 T", 1.5 * HEARTBEAT_S + 2 * T,
        (Variant("drive-fault", ("drive {roller} drive-fault code={code}",)),),
    ),
    Row(
        "nmt", "a drive leaves operational unasked", Wanted.STOP, "1.5 heartbeats + 2 T", 1.5 * HEARTBEAT_S + 2 * T,
        (
            Variant("restart", ("drive {roller} restart",)),
            *(
                Variant(f"foreign NMT {name}", action=f"nmt {command}")
                for name, command in (("stop", 2), ("pre-operational", 128), ("reset node", 129), ("reset comm", 130))
            ),
        ),
    ),
    Row(
        "stale-pdo", "no PDO any more: drive silent, bus-off, our receiver dead", Wanted.STOP, "3 T", 3 * T,
        (
            Variant("drive one-way", ("drive {roller} one-way direction=to-device for 0.5",)),
            Variant("canopen mute", ("canopen mute for 0.5",)),
            Variant("canopen disconnect", ("canopen disconnect for 0.5",)),
            Variant("canopen one-way", ("canopen one-way direction=to-device for 0.5",)),
        ),
    ),
    Row(
        "receiver-dead", "a drive that answers and does not hear", Wanted.STOP, "3 T", 3 * T,
        (Variant("drive one-way", ("drive {roller} one-way direction=from-device for 0.5",)),),
    ),
    Row(
        "frozen", "old answers again and again, correctly framed; 4 s after the start", Wanted.STOP, "3 T", 3 * T,
        (
            Variant("drive freeze", ("drive {roller} freeze for 0.5",)),
            Variant("load-cell freeze", ("load-cell {span} freeze for 0.5",)),
            Variant("plc freeze", ("plc freeze for 0.5",)),
            Variant("plc plc-freeze", ("plc plc-freeze for 0.5",)),
        ),
        settle_periods=400,  # the rule for drives has to know their jitter first
    ),
    Row(
        "cell-once", "a load cell without a number, or out of range, in one period", Wanted.HOLD, "same cycle", T,
        (
            Variant("nan", (f"load-cell {{span}} nan {_ONE}",)),
            Variant("out-of-range", (f"load-cell {{span}} out-of-range {_ONE}",)),
            Variant("out-of-range low", (f"load-cell {{span}} out-of-range tension_n=-500 {_ONE}",)),
        ),
    ),
    Row(
        "cell-lost", "the same, six periods long", Wanted.STOP, "3 T", 3 * T,
        (
            Variant("nan", (f"load-cell {{span}} nan {_MANY}",)),
            Variant("out-of-range", (f"load-cell {{span}} out-of-range {_MANY}",)),
        ),
    ),
    Row(
        "cell-stuck", "a load cell that stands still", Wanted.STOP, "1 s", 1.0,
        (Variant("stuck", ("load-cell {span} stuck",)),), settle_periods=60,  # the rule has to know the cell's noise
    ),
    Row(
        "encoder-once", "an encoder jumps in one sample", Wanted.HOLD, "same cycle", T,
        (Variant("encoder-jump", (f"drive {{roller}} encoder-jump delta_m_per_s={{jump}} {_ONE}",)),),
        pause_periods=120,
    ),
    Row(
        "encoder-twice", "an encoder jumps, and again within a second: timed from the second",
        Wanted.STOP, "2 T", 2 * T,
        (
            Variant(
                "encoder-jump",
                (
                    f"drive {{roller}} encoder-jump delta_m_per_s={{jump}} {_ONE}",
                    f"drive {{roller}} encoder-jump delta_m_per_s={{jump}} at {{again_s}} {_ONE}",
                ),
            ),
        ),
    ),
    Row(
        "torque-unlike", "a drive gives a share of its torque, or loses its mode: timed to the stop",
        Wanted.STOP, "1 s", 1.0,
        (
            *(
                Variant(f"share {share}", (f"drive {{roller}} torque-share share={share}",))
                for share in ("0", "0.1", "0.5")
            ),
            Variant("mode lost, told", ("drive {roller} mode-lost",)),
            Variant("mode lost, not told", ("drive {roller} mode-lost says=follows for 0.6",)),
            Variant("power lost", ("drive {roller} no-power",)),
        ),
    ),
    Row(
        "drive-warning", "a drive warns and goes on", Wanted.RUN_ON, "-", 0.0,
        (
            Variant("emergency message", ("drive {roller} drive-warning code=0x4210 register=0x08 for 0.2",)),
            Variant("with the generic bit", ("drive {roller} drive-warning code=0x3110 register=0x05 for 0.2",)),
        ),
    ),
    Row(
        "web-break", "the web tears", Wanted.STOP, "5 T", 5 * T,
        (Variant("web-break", ("web {span} web-break",)),), harms_web=True,
    ),
    Row(
        "slack", "slack web", Wanted.STOP, "5 T", 5 * T,
        (Variant("slack", ("web {span} slack length_m={slack_m}",)),), harms_web=True,
    ),
    Row(
        "overrun-few", "one to five periods missed at once", Wanted.RUN_ON, "-", 0.0,
        tuple(Variant(f"{k} at once", action=f"stall {k}") for k in range(1, 6)),
    ),
    Row(
        "overrun-many", "six to eight periods missed, or some three times in a row: timed from the last wake-up",
        Wanted.STOP, "5 T", 5 * T,
        (
            *(Variant(f"{k} at once", action=f"stall {k}") for k in range(6, 9)),
            Variant("1 three times", action="stall 1 1 1"),
            Variant("2 three times", action="stall 2 2 2"),
        ),
    ),
    Row(
        "loop-dead", "the loop is gone: timed from its last command to zero torque", Wanted.STOP, "watchdog + T",
        WATCHDOG_S + T, (Variant("no period", action="gone"),),
    ),
)  # fmt: skip
