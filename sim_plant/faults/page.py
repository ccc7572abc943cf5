"""docs/faults.md, written from the table of faults.

python -m sim_plant.faults.page > docs/faults.md
"""

from math import inf

from sim_plant.faults.parse import ranged, shown
from sim_plant.faults.table import FAULTS, NUMBERED, WIRES, Choice, Fault, Kind, Lasting, Number

_HEAD = """# Faults by name

What can go wrong on the simulated line, by name. This page is written from `sim_plant/faults/table.py`
(`python -m sim_plant.faults.page`); a test holds it.

A fault is asked for in these words:

    TARGET [NUMBER] FAULT [NAME=VALUE ...] [at SECONDS] [for SECONDS]

- `at` is the line's time, which begins with 0; without it the fault comes at once. `for` is how long it lasts; without
  it, until it is cleared. Numbers are decimal or `0x` hexadecimal, in the unit that is part of their name.
- `r2rgate sim PLANT.toml --fault "..."` plans faults from the start. `r2rgate fault inject --control PATH "..."` brings
  one into a line that runs, `r2rgate fault clear` ends it, `r2rgate fault list` shows what there is. PATH is the folder
  of the recording, which `r2rgate sim` and `r2rgate run --plant` name at their start. Put the words in quotes.
- The recording has an event `fault-injected` for each, and one `fault-cleared`, which tells of frames how many were
  affected.
- A fault that stops the line is one record of the audit (`line-stopped`, [audit.md](audit.md)) with what was found.
- The same fault of the same target cannot be there twice at one time, nor two that change the same reading. Others act
  together; on frames in the order in which they came.
- Faults of frames may be asked of a whole wire, of one address on it, or of a device. Devices that share an address
  suffer together: a rack is one unit (`modbus-tcp 3 mute`), and so is a load-cell amplifier. On CAN, what is sent to
  all nodes (SYNC) is touched by faults of the whole wire only. Bytes that are no frames pass.
- In stepped time there are no wires: there are the other faults, but for those of a communication watchdog. Fault, STO
  and restart of a drive are one there: torque goes off, until the drive has been told off and is enabled anew.
- The first line on a machine to which faults can come compiles the full model of the physics, for some seconds, before
  its time begins.
- A web that is missing at a start is `web 3 web-break` before it, one that hangs `web 3 slack length_m=0.2`; what the
  gateway does about them stands in [starting.md](starting.md).
- What a fault does is judged as all else: a `web-break` by itself is a tension out of its band and counts as
  `tension-band`, whatever the gateway does. A restart, a fault or STO of a drive leads to `tension-after-trip`.

"""


def page() -> str:
    """The whole page as Markdown."""
    return "".join([_HEAD, _targets(), "\n", _faults()])


def _targets() -> str:
    rows = ["| target | number |\n", "| --- | --- |\n"]
    for kind in Kind:
        word = ", ".join(f"`{wire}`" for wire in WIRES) if kind is Kind.WIRE else f"`{kind.value}`"
        rows.append(f"| {word} | {NUMBERED[kind] or 'none'} |\n")
    return "".join(rows)


def _faults() -> str:
    rows = ["| fault | of | what it does | parameters | lasts | example |\n", "| --- | --- | --- | --- | --- | --- |\n"]
    for fault in FAULTS:
        of = ", ".join(kind.value for kind in fault.kinds)
        parameters = "; ".join(f"`{p.name}` {parameter_words(p)}" for p in fault.parameters) or "-"
        rows.append(f"| `{fault.name}` | {of} | {fault.does} | {parameters} | {_lasts(fault)} | `{fault.example}` |\n")
    return "".join(rows)


def _lasts(fault: Fault) -> str:
    return "once" if fault.lasting is Lasting.ONCE else "until cleared"


def parameter_words(parameter: Number | Choice) -> str:
    """What a parameter may be, and what it is where it is left out."""
    if isinstance(parameter, Choice):
        return f"{', '.join(parameter.words)} (default {parameter.words[0]})"
    default = "needed" if parameter.default is None else f"default {_default(parameter.default)}"
    return f"{ranged(parameter)} ({default})"


def _default(value: float) -> str:
    return "no end" if value == inf else shown(value)


if __name__ == "__main__":
    print(page(), end="")
