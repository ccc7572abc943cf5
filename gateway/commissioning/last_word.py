"""What the rules propose before the chain ends, in the place of what agents have led to (decision 40). Pure."""

from collections.abc import Sequence

from gateway.commissioning.decisions import AGENTS, RULES
from gateway.commissioning.ladder import AS_IT_IS, BY_RULES, LADDERS, MOST_EXPERIMENTS, Ended, Next, on_ladder
from gateway.commissioning.past import Past, Step, experiments_since_model, is_done, last_done
from gateway.commissioning.redesign import RUNGS


def by_rules(past: Sequence[Past], ended: Ended) -> Next | Ended:
    """What the rules would have, once on a model, in the place of what agents have led to."""
    since = past[last_done(past, "gains") + 1 :]
    found: Next | Ended = ended
    if last_done(past, "model") >= 0 and ended.reached and _led_by_agents(past):
        found = on_ladder(Step.REDESIGN, since, BY_RULES, BY_RULES + RUNGS)
    elif quicker := _quicker_than_agents_began(past):
        found = on_ladder(Step.FIRST, since, BY_RULES, BY_RULES + quicker)
    return ended if isinstance(found, Ended) else Next(found.step, found.rung, own=0)


def _led_by_agents(past: Sequence[Past]) -> bool:
    """Whether they have chosen what is in service, or what the rules then had to be calmer than, on the same model.

    Not where the rules have had their last word on it.
    """
    model = last_done(past, "model")
    kept = [i for i, one in enumerate(past) if is_done(one, "gains") and one.rung != AS_IT_IS]
    on_model = [past[i] for i in kept if i > model] or [past[i] for i in kept[-1:]]
    others = [one.author for one in on_model if one.author != RULES]
    return others[-1:] == [AGENTS] and all(one.rung < BY_RULES for one in on_model)


def _quicker_than_agents_began(past: Sequence[Past]) -> int:
    """Candidates before the one that agents began with, where experiments have led to no model; 0: none, or not so."""
    at = last_done(past, "gains")
    if last_done(past, "model") >= 0 or experiments_since_model(past) < MOST_EXPERIMENTS:
        return 0
    began = past[at] if at >= 0 and past[at].step is Step.FIRST and past[at].author == AGENTS else None
    return began.rung if began is not None and began.rung < LADDERS[Step.FIRST] else 0
