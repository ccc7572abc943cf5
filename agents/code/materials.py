"""Where the things that a call names come from: the line as it is now."""

from collections.abc import Callable, Sequence
from typing import Protocol

from agents.code.calls import (
    IN_SERVICE,
    NEWEST,
    NOMINAL,
    OF_A_CALL,
    AnyCall,
    CallRefused,
    Compare,
    Design,
    Identify,
    Margins,
    Simulate,
    Spectrum,
    Tune,
)
from agents.code.job import Believed, Job, Named
from gateway.core.controller import Controller, config_hash
from gateway.core.controller_fit import misfits
from gateway.core.line import Line
from gateway.core.line_model import LineModel, model_hash
from gateway.core.recording import Recording

SHOWN = 12  #: letters of a hash


class Materials(Protocol):
    """Each may raise whatever it likes; the text of it goes into the call's result."""

    async def model(self) -> LineModel | None:
        """The accepted one; None: none is accepted yet."""
        ...

    async def controller(self) -> Controller:
        """The one in service."""
        ...

    async def recordings(self) -> list[Recording]:
        """The newest first."""
        ...


class Given:
    """`Materials` that somebody has: from files, or none at all."""

    def __init__(
        self, model: LineModel | None = None, controller: Controller | None = None, recordings: Sequence[Recording] = ()
    ) -> None:
        self._model = model
        self._controller = controller
        self._recordings = list(recordings)

    async def model(self) -> LineModel | None:
        return self._model

    async def controller(self) -> Controller:
        if self._controller is None:
            raise CallRefused(["no controller is known to be in service; design one by an earlier call and name that"])
        return self._controller

    async def recordings(self) -> list[Recording]:
        return list(self._recordings)


async def job_of(call: AnyCall, line: Line, materials: Materials, designed: Callable[[int], Controller]) -> Job:
    """`call` with all that it names.

    `designed`: the controller of an earlier call; raises CallRefused where there is none. Raises CallRefused, and what
    `materials` raise.
    """
    return Job(
        call, line,
        models=tuple([await _model(name, line, materials) for name in _models(call)]),
        controllers=tuple([await _controller(name, line, materials, designed) for name in _controllers(call)]),
        recordings=tuple(await _recordings(_recordings_named(call), line, materials)),
    )  # fmt: skip


def _models(call: AnyCall) -> list[str]:
    if isinstance(call, Identify):
        return []
    return call.models if isinstance(call, Compare) and call.models else [call.model]


def _controllers(call: AnyCall) -> list[str]:
    if isinstance(call, Compare):
        return call.controllers
    return [call.controller] if isinstance(call, Simulate | Margins) else []


def _recordings_named(call: AnyCall) -> list[str]:
    match call:
        case Identify():
            return call.recordings
        case Spectrum():
            return [call.recording]
        case Compare() if call.models:
            return [call.recording]
        case Compare() | Design() | Margins() | Simulate() | Tune():
            return []


async def _model(name: str, line: Line, materials: Materials) -> Believed:
    if name == NOMINAL:
        return Believed("the nominal model of the line's file", None)
    found = await materials.model()
    if found is None:
        if name != IN_SERVICE:
            raise CallRefused([f"model {name} is not known; allowed: {NOMINAL}: no model is accepted yet"])
        return Believed("the nominal model of the line's file, as none is accepted yet", None)
    whole = model_hash(found)
    if name != IN_SERVICE and not whole.startswith(name):
        raise CallRefused([f"model {name} is not known; allowed: {IN_SERVICE} ({whole[:SHOWN]}), {NOMINAL}"])
    if found.n != line.n:
        raise CallRefused([f"the accepted model has {found.n} spans, the line {line.n}; allowed: {NOMINAL}"])
    return Believed(f"the accepted model {whole[:SHOWN]}", found)


async def _controller(name: str, line: Line, materials: Materials, designed: Callable[[int], Controller]) -> Named:
    if name == IN_SERVICE:
        found = await materials.controller()
    else:
        found = designed(int(name.removeprefix(OF_A_CALL)))
    if against := misfits(found, line):
        raise CallRefused([f"controller {name} does not fit the line: {reason}" for reason in against])
    return Named(f"{name} ({found.kind} {config_hash(found)[:SHOWN]})", found)


async def _recordings(names: Sequence[str], line: Line, materials: Materials) -> list[Recording]:
    if not names:
        return []
    there = await materials.recordings()
    numbers = [1 if name == NEWEST else int(name) for name in names]
    if not there:
        raise CallRefused(["there is no recording of this line"])
    if beyond := [str(number) for number in numbers if number > len(there)]:
        raise CallRefused([f"there is no recording {', '.join(beyond)}; allowed: 1 (the newest) to {len(there)}"])
    if len(set(numbers)) < len(numbers):
        raise CallRefused([f"recordings names the same twice: {NEWEST} is 1"])
    found = [there[number - 1] for number in numbers]
    if wrong := [one for one in found if one.n != line.n]:
        raise CallRefused([f"{one.source} is of {one.n} spans, the line has {line.n}" for one in wrong])
    return found
