"""Of the sample times: order, duplicates, period, jitter, gaps, and how much of it is under control."""

import numpy as np

from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.core.signals import FloatArray
from gateway.identification.findings import Finding, Severity
from gateway.identification.regressions import stretches_of

PERIOD_OFF = 0.02  #: relative; more is another period
JITTER_WARNED, JITTER_REFUSED = 0.05, 0.2  #: standard deviation of intervals over the period
LOST_SHARE = 0.01  #: of all samples that should be there
DUPLICATE_SHARE = 0.005
LEAST_CONTROLLED_S = 1.0
_TIME_UNITS = {"ms": 1e3, "us": 1e6, "ns": 1e9, "minutes": 1.0 / 60.0}


def assess_time(recording: Recording, line: Line) -> list[Finding]:
    """A refusal for times out of order is the only finding: after it nothing else can be told."""
    t = recording.time_s
    unknown = np.flatnonzero(~np.isfinite(t))
    if len(unknown):
        return [_refusal("time", "the time is not a number", _sample(recording, int(unknown[0])), len(unknown), 0.0)]
    if len(t) < 2:
        return [_refusal("short", f"{len(t)} samples are no recording", recording.source, len(t), 2)]
    step = np.diff(t)
    back = np.flatnonzero(step < 0.0)
    if len(back):
        what = f"time goes back by {-step[back[0]]:.6g} s, at {len(back)} places in all"
        mend = "sort the samples, or read the files of two recordings as two recordings"
        return [_refusal("time order", what, _sample(recording, int(back[0]) + 1), len(back), 0.0, mend)]
    found = _duplicates(recording, step)
    period = _period(recording, line, step)
    return found + (period or _jitter(recording, step) + _gaps(recording, step) + _controlled(recording, line))


def _duplicates(recording: Recording, step: FloatArray) -> list[Finding]:
    """Times that occur twice, and samples that repeat the one before in every channel: noise never does."""
    twice = np.flatnonzero(step == 0.0)
    if len(twice):
        what = f"{len(twice)} times occur twice"
        mend = "remove the second of equal times; two files that overlap are joined where one ends"
        return [_refusal("duplicate", what, _sample(recording, int(twice[0]) + 1), len(twice), 0.0, mend)]
    rows = np.hstack((recording.tension_n, recording.speed_m_per_s, recording.torque_nm))
    rows = rows[:, ~np.isnan(rows).all(axis=0)]
    same = np.flatnonzero((rows[1:] == rows[:-1]).all(axis=1) & recording.controlled[1:])
    share = len(same) / len(step)
    if not len(same) or not rows.shape[1]:
        return []
    severity = Severity.REFUSAL if share > DUPLICATE_SHARE else Severity.WARNING
    what = f"{len(same)} samples ({share:.1%}) repeat the one before in every channel"
    where = _sample(recording, int(same[0]) + 1)
    mend = "record at the rate at which the line is sampled, without filling in"
    return [Finding("duplicate", severity, what, where, share, DUPLICATE_SHARE, mend)]


def _period(recording: Recording, line: Line, step: FloatArray) -> list[Finding]:
    """The period that the samples have, the recording says and the line's file says."""
    seen, wanted = float(np.median(step)), line.control.period_s
    if abs(recording.period_s / wanted - 1.0) > PERIOD_OFF and abs(seen / wanted - 1.0) <= PERIOD_OFF:
        what = f"its period is said to be {recording.period_s:.6g} s, the line's is {wanted:.6g} s"
        return [_refusal("period", what, recording.source, recording.period_s, wanted)]
    if abs(seen / wanted - 1.0) <= PERIOD_OFF:
        return []
    what = f"samples are {seen:.6g} s apart, the line's period is {wanted:.6g} s"
    named = [unit for unit, factor in _TIME_UNITS.items() if abs(seen / wanted / factor - 1.0) < 0.1]
    mend = f"time is in {named[0]}: give it in s" if named else f"record every {wanted:.6g} s"
    return [_refusal("unit" if named else "period", what, "time_s", seen, wanted, mend)]


def _jitter(recording: Recording, step: FloatArray) -> list[Finding]:
    """Of the intervals in which no sample was lost."""
    near = step[step < 1.5 * recording.period_s]
    jitter = float(np.std(near)) / recording.period_s if len(near) else 0.0
    if jitter <= JITTER_WARNED:
        return []
    severity = Severity.REFUSAL if jitter > JITTER_REFUSED else Severity.WARNING
    what = f"intervals between samples vary by {jitter:.0%} of the period (standard deviation)"
    mend = "take the times from the clock that samples the line, not from the one that writes the file"
    limit = JITTER_REFUSED if jitter > JITTER_REFUSED else JITTER_WARNED
    return [Finding("jitter", severity, what, "time_s", jitter, limit, mend)]


def _gaps(recording: Recording, step: FloatArray) -> list[Finding]:
    """Between two samples under control. What lies between is used as pieces; only much that is lost is a refusal."""
    inside = recording.controlled[1:] & recording.controlled[:-1]
    places = np.flatnonzero((step > 1.5 * recording.period_s) & inside)
    if not len(places):
        return []
    lost = np.round(step[places] / recording.period_s).astype(int) - 1
    longest, share = int(lost.max()), float(lost.sum()) / (len(step) + 1 + float(lost.sum()))
    refused = share > LOST_SHARE
    worst = int(places[np.argmax(lost)])
    what = f"{len(places)} gaps, {lost.sum()} samples lost ({share:.1%}), up to {longest} in a row"
    parts = sorted(recording.stretches(2), key=lambda part: -part.samples)
    mend = "the parts between them are used together" if not refused else "repeat the recording"
    if parts and refused:
        begin, end = float(parts[0].time_s[0]), float(parts[0].time_s[-1])
        mend = f"take the longest part without a gap, {begin:.6g} to {end:.6g} s, or repeat the recording"
    severity = Severity.REFUSAL if refused else Severity.WARNING
    return [Finding("gap", severity, what, _sample(recording, worst + 1), share, LOST_SHARE, mend)]


def _controlled(recording: Recording, line: Line) -> list[Finding]:
    found: list[Finding] = []
    share = float(np.mean(recording.controlled))
    if share < 0.5:
        what = f"{share:.0%} of the samples are under control (RUN or HOLD, nothing held)"
        mend = "choose a time in which the line runs"
        found.append(Finding("control", Severity.WARNING, what, recording.source, share, 0.5, mend))
    there_s = recording.period_s * sum(s.data.samples for s in stretches_of(recording, line))
    if there_s < LEAST_CONTROLLED_S:
        what = f"{there_s:.3g} s in a row under control, with every channel known, are all there is"
        text = "set-points moved at random for 5 s, under control"
        found.append(_refusal("short", what, recording.source, there_s, LEAST_CONTROLLED_S, "", text))
    return found


def _sample(recording: Recording, k: int) -> str:
    return f"{recording.source}, sample {k + 1}"


def _refusal(
    kind: str, what: str, where: str, value: float, limit: float, mend: str = "", experiment: str = ""
) -> Finding:
    return Finding(kind, Severity.REFUSAL, what, where, value, limit, mend, experiment)
