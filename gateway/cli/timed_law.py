"""What a control law costs: each step timed, in the process that runs it."""

import time
from typing import Generic, TypeVar

from gateway.control.deviation import Measured
from gateway.control.law import Decision, Law
from gateway.control.reference import Reference
from gateway.core.signals import FloatArray

State = TypeVar("State")


class TimedLaw(Generic[State]):
    """A law that notes what each step has taken: asking and committing, on this computer."""

    def __init__(self, law: Law[State]) -> None:
        self.n = law.n
        self.step_s: list[float] = []
        self._law = law
        self._asking_s = 0.0

    def engage(self, measured: Measured, reference: Reference, applied_nm: FloatArray) -> State:
        return self._law.engage(measured, reference, applied_nm)

    def ask(self, state: State, measured: Measured, reference: Reference) -> Decision:
        began_s = time.perf_counter()
        decision = self._law.ask(state, measured, reference)
        self._asking_s = time.perf_counter() - began_s
        return decision

    def commit(self, state: State, decision: Decision, applied_nm: FloatArray) -> State:
        began_s = time.perf_counter()
        following = self._law.commit(state, decision, applied_nm)
        self.step_s.append(self._asking_s + time.perf_counter() - began_s)
        return following
