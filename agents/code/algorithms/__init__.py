"""The calls, carried out by the algorithms that there are. Loaded in a worker alone: nothing else here knows them."""

from collections.abc import Callable
from typing import Any

from agents.code.algorithms import comparing, control, identifying, spectrum
from agents.code.calls import CallRefused, Compare, Design, Identify, Margins, Simulate, Spectrum, Tune
from agents.code.job import Job, Outcome
from gateway.control.design import DesignRefused
from gateway.control.prediction import Unpredictable
from gateway.identification.identify import NotIdentified

_CARRIED_OUT: dict[type[Any], Callable[[Any, Job], Outcome]] = {
    Simulate: control.simulated,
    Margins: control.margins_of,
    Design: control.designed,
    Tune: control.tuned,
    Identify: identifying.identified,
    Spectrum: spectrum.spectrum_of,
    Compare: comparing.compared,
}
_DATA: tuple[type[Any], ...] = (Identify, Compare)


def carry_out(job: Job) -> Outcome:
    """Of a call that cannot be carried out on what it names, the reasons. Whatever else goes wrong is raised."""
    try:
        return _CARRIED_OUT[type(job.call)](job.call, job)
    except (CallRefused, NotIdentified) as refused:
        return Outcome(refused=[reason[:600] for reason in refused.reasons[:10]])
    except (DesignRefused, Unpredictable) as refused:
        return Outcome(refused=[str(refused)[:600]])


def warm_up(job: Job) -> None:
    """Load what the job needs, and compile it where that has not been done on this machine."""
    if job.recordings and isinstance(job.call, _DATA):
        identifying.warm_up(job)
    else:
        control.warm_up(job)
