"""docs/alarms.md, written from the table: `python -m gateway.supervisor.alarms_page`. A test holds it."""

from pathlib import Path

from gateway.core.alarms import ALARMS, LONGEST_SHELVED_S, MOST_ALARMS, Alarm
from gateway.supervisor.alarm_states import RESTORED_S, TOGETHER_S

PAGE = Path("docs/alarms.md")

_HEAD = f"""# Alarms

What calls for a person at the line, and what to do. This page is written from `ALARMS` in `gateway/core/alarms.py`
(`python -m gateway.supervisor.alarms_page`); a test holds it. There are at most {MOST_ALARMS}: what asks for no action
is no alarm but an event, and a proposal that waits is a prompt. None of them acts on the line; what must act at once
does so in the loop, before an alarm is told.

    r2rgate alarms                                                         # what is wrong, why, what to do
    r2rgate alarms acknowledge load-cell --comment "seen, fitter called"   # you have seen it
    r2rgate alarms shelve load-cell --for 2h --because "being exchanged"   # out of the way; back by itself

- **Acknowledged** means seen, not mended. What ended before anybody saw it stays in the list until it is acknowledged.
- **Shelved** for {LONGEST_SHELVED_S / 3600.0:g} h at most, with a reason. It is still listed. `--for 0` brings
  it back at once. Without an audit nothing is shelved.
- **First of several**: of alarms that began within {TOGETHER_S:g} s the one that began first. Look there first.
- Both are on record with who and why (`r2rgate audit show --kind acknowledged`, `--kind shelved`). They outlive a
  restart of the gateway: what comes again within {RESTORED_S:g} s of it is the same alarm. What the file
  `alarms.json` has on the shelf and no record explains shows again, as the event `alarm-not-shelved` tells.
- Through OPC UA and the page it takes an operator.
- An alarm comes when its condition has held for the time under "after", and ends when it has not for that under
  "gone", so that nothing flickers.
"""


def text() -> str:
    """The whole page."""
    table = ["| alarm | priority | means | after | gone |", "| --- | --- | --- | --- | --- |"]
    table += [
        f"| [`{one.name}`](#{one.name}) | {one.priority} | {one.means} | {one.after_s:g} s | {one.gone_s:g} s |"
        for one in ALARMS
    ]
    return "\n".join([_HEAD, *table, "", *(_part(one) for one in ALARMS)])


def _part(one: Alarm) -> str:
    return (
        f"## {one.name}\n\n{_sentence(one.means)}\n\n- Cause: {one.cause}.\n- Of doing nothing: {one.consequence}.\n"
        f"- Do: {one.action}.\n"
    )


def _sentence(means: str) -> str:
    return f"{means[0].upper()}{means[1:]}."


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
