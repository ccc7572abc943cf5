"""Assessment of data before anything is estimated from them: what is wrong, what is missing, what would mend it."""

from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.identification.alignment import Alignment, estimate_alignment
from gateway.identification.assess_channels import assess_channels
from gateway.identification.assess_excitation import Wanted, assess_excitation, predicted_intervals
from gateway.identification.assess_physics import assess_physics
from gateway.identification.assess_time import assess_time
from gateway.identification.findings import Assessment, Finding, Severity, gravest_first
from gateway.identification.regressions import equation_fits

#: In periods, which the whole interval of an offset exceeds. A prediction one sample ahead is wrong by the offset times
#: the rate of the signal, and the shorter the period the less noise there is in it to hide this: a tension that is late
#: by 3.5 ms on a line of 10 ms, and by 1 ms on one of 2 ms, leaves innovations equally coloured (4 times what is white)
#: and shifts EA/L by two and a half, and by half, of its interval. At 10 ms a delay of 5 ms gave errors of 7.6 N.
OFFSET_WARNED_PERIODS, OFFSET_REFUSED_PERIODS = 0.1, 0.35
DELAY_REFUSED_PERIODS = 3.0  #: of a torque beyond the line's latency; less, the model's latency and lag take up


def assess(recording: Recording, line: Line, wanted: Wanted | None = None) -> Assessment:
    """All that can be told of `recording` as data of `line`. Raises nothing: what is wrong is a finding."""
    if recording.n != line.n:
        what = f"it has {recording.n} spans, the line {line.n}"
        mend = "this is another line's recording"
        return _alone(Finding("spans", Severity.REFUSAL, what, recording.source, recording.n, line.n, mend))
    found = assess_time(recording, line)
    if any(f.severity is Severity.REFUSAL and f.kind in _BLIND for f in found):
        return Assessment(gravest_first(found), (), (), {})
    found += assess_channels(recording, line)
    suspects = {f.where.split(",")[0] for f in found if f.severity is Severity.REFUSAL and f.kind != "noise"}
    fits = equation_fits(recording, line)
    if not fits:
        return Assessment(gravest_first(found), (), (), {})
    predicted = predicted_intervals(fits, line)
    if "all speeds" not in suspects:
        found += assess_physics(recording, line, fits, suspects)
    grave = any(f.severity is Severity.REFUSAL for f in found)
    alignments = estimate_alignment(recording, line, fits)
    if not grave:  # of channels that do not belong together, offsets and intervals mean nothing
        found += _offsets(alignments, line.control.period_s)
        found += assess_excitation(recording, line, fits, predicted, wanted or Wanted())
    return Assessment(gravest_first(found), tuple(alignments), tuple(fits), predicted)


_BLIND = frozenset(("time", "time order", "duplicate", "period", "unit", "short", "jitter"))  #: after these, nothing


def _alone(finding: Finding) -> Assessment:
    return Assessment((finding,), (), (), {})


def _offsets(alignments: list[Alignment], period_s: float) -> list[Finding]:
    """Channels whose interval lies beyond what a model bears."""
    found: list[Finding] = []
    for alignment in alignments:
        beyond_s = max(alignment.low_s, -alignment.high_s)
        if not alignment.known or beyond_s <= OFFSET_WARNED_PERIODS * period_s:
            continue
        late = alignment.offset_s > 0.0
        interval = f"{1e3 * alignment.low_s:.1f} to {1e3 * alignment.high_s:.1f} ms"
        if alignment.channel.startswith("torque") and not late:
            limit_s = DELAY_REFUSED_PERIODS * period_s
            what = f"it acts {-1e3 * alignment.offset_s:.1f} ms later than the line's latency says ({interval})"
            mend = "let the model have a torque lag, or correct control.latency_s in the line's file"
        else:
            limit_s = OFFSET_REFUSED_PERIODS * period_s
            what = f"it is {abs(1e3 * alignment.offset_s):.1f} ms {'late' if late else 'early'} ({interval})"
            mend = "align it (identify --align), or take the times where the channel is sampled"
        severity = Severity.REFUSAL if beyond_s > limit_s else Severity.WARNING
        found.append(Finding("offset", severity, what, alignment.channel, alignment.offset_s, limit_s, mend))
    return found
