"""How far a model is with a question, and what a task may cost."""

import asyncio

from agents.process import MOST_TASKS, Budgets
from agents.progress import told
from tests.unit.language_model_support import QUESTION, virtually


def of_run(number: int):
    return QUESTION.model_copy(update={"run": f"{number:016x}"})


def test_a_model_that_takes_its_time_is_told_of_with_its_newest_words():
    lines: list[str] = []

    async def story() -> None:
        async with told(QUESTION, lines.append, every_s=10.0) as said:
            await asyncio.sleep(15.0)
            said.hear("Span 3 swings,\n\x1b[31mso ")
            said.hear("torque " * 100)
            await asyncio.sleep(10.0)
        await asyncio.sleep(100.0)

    virtually(story())
    assert lines[0] == "adaptation, adapt.change: 10 s, not a word yet"
    assert lines[1].startswith("adaptation, adapt.change: 20 s, 723 letters until now, ... ")
    assert lines[1].endswith("torque torque") and "\x1b" not in lines[1] and len(lines) == 2


def test_a_task_has_its_tokens_however_long_it_takes_and_another_has_its_own():
    budgets = Budgets(1000)
    budgets.of(of_run(1)).spend(900)
    assert budgets.of(of_run(2)).spent_tokens == 0 and budgets.of(of_run(1)).spent_tokens == 900
    for number in range(2, MOST_TASKS + 1):
        budgets.of(of_run(number))
        assert budgets.of(of_run(1)).spent_tokens == 900  # asked for last: not forgotten
    for number in range(MOST_TASKS + 1, 3 * MOST_TASKS):
        budgets.of(of_run(number))
    assert budgets.of(of_run(1)).spent_tokens == 0
