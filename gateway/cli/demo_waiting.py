"""Something for a person to decide on: a change that the gate lets through, and that nobody has approved."""

import asyncio
import contextlib
from collections.abc import Iterator, Sequence

from gateway.cli.commission_changes import LineNow, first_speed_m_per_s
from gateway.cli.commission_live import TOPICS, LiveGate
from gateway.cli.commission_side import CannotGoOn, put
from gateway.cli.demo_line import Setup
from gateway.cli.demo_operator import Operator
from gateway.commissioning.candidates import FIRST_LAWS, NotOffered, configuration, experiment
from gateway.commissioning.chain import first_legs
from gateway.core.decisions import ProposalShown
from gateway.core.messages import SelectRecipe
from gateway.core.proposal import Change, ExperimentChange, GainsChange
from gateway.mailbox.paths import GATEWAY_SOCKET
from gateway.mailbox.unix import UnixMailbox

JUDGED_WITHIN_S = 150.0  #: the first verdict on a computer compiles


async def leave_one_waiting(operator: Operator, setup: Setup, shown: Sequence[ProposalShown]) -> str:
    """From a line that runs at its first recipe. `shown`: what has been proposed, the oldest first.

    Returns the proposal's hash; empty: the gate lets nothing through of what there is. Raises DemoFailed.
    """
    recipe, tell = setup.line.recipes[0], operator.progress.step
    await operator.order(SelectRecipe(name=recipe.name))
    tell("back to the first set-points; then a change is proposed, for you to decide on")
    await operator.wait_settled(recipe.tension_n, recipe.speed_m_per_s)
    mailbox = UnixMailbox()
    mailbox.connect(TOPICS, operator.run_folder / GATEWAY_SOCKET)
    live = LiveGate(setup.line, mailbox, lambda _: None, operator.watch)  # what became of all others has been told
    try:
        await live.ready()
        for change, reason in _candidates(setup, shown, await live.now()):
            await live.ready()
            proposal = await put(setup.line, live, change, f"the demonstration: {reason}", [])
            if await _waits(live, operator, proposal):
                return proposal
    except CannotGoOn as stopped:
        tell(f"  {stopped}")
    finally:
        await mailbox.close()
    return ""


def _candidates(setup: Setup, shown: Sequence[ProposalShown], now: LineNow) -> Iterator[tuple[Change, str]]:
    """What was kept before, the newest first; without a model first configurations; at last an experiment."""
    for one in reversed([one.proposal for one in shown if one.stage == "kept"]):
        if isinstance(one.change, GainsChange) and one.change.controller != now.in_service:
            yield one.change, f"back to what was kept earlier ({one.reason})"
    speed = first_speed_m_per_s(setup.line)
    for law in () if now.model is not None else FIRST_LAWS:
        with contextlib.suppress(NotOffered):
            controller = configuration(setup.line, None, speed, law)
            if controller != now.in_service:
                yield GainsChange(controller=controller), f"{law.text} on the line's file, in place of the first one"
    with contextlib.suppress(NotOffered):
        made = experiment(
            setup.line, now.model, now.in_service, now.tension_n, now.speed_m_per_s, first_legs(speed)
        )  # fmt: skip
        yield ExperimentChange(experiment=made), "an experiment, to identify the line once more"


async def _waits(live: LiveGate, operator: Operator, proposal: str) -> bool:
    """Once it has been judged; False: it was refused."""
    clock = asyncio.get_running_loop().time
    began_s = clock()
    while clock() - began_s < JUDGED_WITHIN_S:
        shown = next(one for one in await live.proposals() if one.proposal_hash == proposal)
        if shown.stage != "received":
            operator.progress.step(f"  {proposal[:12]} is {shown.stage}{f': {shown.why}' if shown.why else ''}")
            return shown.stage == "waiting"
        await operator.watch(0.5)
    raise CannotGoOn(f"the gate has not judged {proposal[:12]} within {JUDGED_WITHIN_S:g} s")
