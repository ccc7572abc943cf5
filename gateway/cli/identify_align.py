"""Time offsets between channels taken out of recordings before anything is estimated from them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from gateway.core.line import Line
from gateway.core.line_model import ChannelDelay
from gateway.core.recording import Recording
from gateway.identification.alignment import Alignment, aligned
from gateway.identification.assessment import OFFSET_WARNED_PERIODS, assess
from gateway.identification.findings import Severity


@dataclass(frozen=True)
class Moved:
    recording: Recording
    delays: list[ChannelDelay]  #: what was found and taken out


def without_offsets(recording: Recording, line: Line) -> Moved:
    """With every channel moved whose interval lies beyond a tenth of a period; by whole periods where one is in it.

    Torques stay: what acts late there is the model's latency and lag. Where the data are refused for anything but
    offsets they stay as they are: offsets mean nothing then.
    """
    said = assess(recording, line)
    if said.kinds(Severity.REFUSAL) - {"offset"}:
        return Moved(recording, [])
    late = [_whole(one, recording.period_s) for one in said.alignments if _is_late(one, recording.period_s)]
    delays = [
        ChannelDelay(channel=one.channel, late_s=one.offset_s, low_s=one.low_s, high_s=one.high_s) for one in late
    ]
    return Moved(aligned(recording, late), delays)


def all_delays(delays: Sequence[Sequence[ChannelDelay]]) -> list[ChannelDelay]:
    """Of each channel, the longest that any recording had."""
    found: dict[str, ChannelDelay] = {}
    for one in [delay for each in delays for delay in each]:
        if one.channel not in found or abs(one.late_s) > abs(found[one.channel].late_s):
            found[one.channel] = one
    return list(found.values())


def _is_late(one: Alignment, period_s: float) -> bool:
    beyond_s = max(one.low_s, -one.high_s)
    measured = not one.reference and not one.channel.startswith("torque")
    return one.known and measured and beyond_s > OFFSET_WARNED_PERIODS * period_s


def _whole(one: Alignment, period_s: float) -> Alignment:
    """By whole periods nothing is lost of noise or signal."""
    whole_s = period_s * round(one.offset_s / period_s)
    return replace(one, offset_s=whole_s) if whole_s and one.low_s <= whole_s <= one.high_s else one
