"""Something for a person to decide on: a change that the gate lets through, and that nobody has approved."""

import asyncio
from collections.abc import Iterator, Sequence

from gateway.cli.commission_live import TOPICS, LiveGate
from gateway.cli.commission_side import CannotGoOn, put
from gateway.cli.demo_line import Setup
from gateway.cli.demo_operator import Operator
from gateway.commissioning.candidates import FIRST_LAWS, NotOffered, configuration
from gateway.core.controller import Controller, config_hash
from gateway.core.decisions import ProposalShown
from gateway.core.messages import SelectRecipe
from gateway.core.proposal import GainsChange
from gateway.mailbox.paths import GATEWAY_SOCKET
from gateway.mailbox.unix import UnixMailbox

JUDGED_WITHIN_S = 60.0


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
    live = LiveGate(setup.line, mailbox, tell, operator.watch)
    try:
        for controller, reason in _candidates(setup, shown):
            await live.ready()
            if config_hash(controller) != config_hash((await live.now()).in_service):
                proposal = await put(setup.line, live, GainsChange(controller=controller), reason, [])
                if await _waits(live, operator, proposal):
                    return proposal
    except CannotGoOn as stopped:
        tell(f"  {stopped}")
    finally:
        await mailbox.close()
    return ""


def _candidates(setup: Setup, shown: Sequence[ProposalShown]) -> Iterator[tuple[Controller, str]]:
    """What was kept before, the newest first; on a line that has been adapted by nobody, first configurations."""
    kept = [one.proposal for one in shown if one.stage == "kept" and isinstance(one.proposal.change, GainsChange)]
    for one in reversed(kept[:-1]):
        assert isinstance(one.change, GainsChange)
        yield one.change.controller, f"the demonstration: back to what was kept earlier ({one.reason})"
    for law in () if kept else FIRST_LAWS:
        try:
            controller = configuration(setup.line, None, setup.line.gate.first_speed_max_m_per_s, law)
        except NotOffered:
            continue
        yield controller, f"the demonstration: {law.text} on the line's file, in place of the first one"


async def _waits(live: LiveGate, operator: Operator, proposal: str) -> bool:
    """Once it has been judged; False: it was refused."""
    clock = asyncio.get_running_loop().time
    began_s = clock()
    while clock() - began_s < JUDGED_WITHIN_S:
        stage = next(one.stage for one in await live.proposals() if one.proposal_hash == proposal)
        if stage != "received":
            return stage == "waiting"
        await operator.watch(0.5)
    raise CannotGoOn(f"the gate has not judged {proposal[:12]} within {JUDGED_WITHIN_S:g} s")
