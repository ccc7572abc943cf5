"""A decider that always answers, in time, and with what answers the question, whoever is behind it."""

from queue import Empty, SimpleQueue
from threading import Lock

from gateway.cli.background import in_background
from gateway.commissioning.decisions import RULES, Decided, Decider
from gateway.core.questions import Question, usual_choice, wrong_with


class InTime:
    """`Decider`, for any number of threads: one question at a time.

    Who has not answered within `within_s` is not asked again. An error of theirs, or an answer to another question,
    leaves this one to the rules.
    """

    def __init__(self, decider: Decider, within_s: float) -> None:
        self._decider = decider
        self._within_s = within_s
        self._asking = Lock()
        self._late = False

    def decide(self, question: Question) -> Decided:
        with self._asking:
            if self._late:
                return _rules(question, "there was no answer in time to a question before")
            box: SimpleQueue[Decided] = SimpleQueue()
            in_background(lambda: box.put(_asked(self._decider, question)))
            try:
                return box.get(timeout=self._within_s)
            except Empty:
                self._late = True
                return _rules(question, f"no answer in {self._within_s:g} s")


def _asked(decider: Decider, question: Question) -> Decided:
    try:
        decided = decider.decide(question)
    except Exception as error:  # whatever goes wrong where somebody is asked, a phase goes on
        return _rules(question, f"asking failed: {error or type(error).__name__}")
    if against := wrong_with(decided.choice, question):
        return _rules(question, f"{decided.by} is not understood: {'; '.join(against)}")
    return decided


def _rules(question: Question, why: str) -> Decided:
    return Decided(usual_choice(question), RULES, why)
