"""What was asked of the agents, as a reader follows it: question, options, notes, choice, what came of it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from shlex import quote

from gateway.cli.agents_view import as_story
from gateway.cli.demo_result import AskedResult, ChangeResult, FigureResult, OptionResult, RuleResult
from gateway.cli.report import Fold, Section, Story, Table
from gateway.core.interactions import Interaction

RULES = "rules"
MOST_OPTIONS = 6  #: in a table; all stand in the details
MOST_FIGURES = 4


def asked_section(
    asked: Sequence[AskedResult], changes: Sequence[ChangeResult], interactions: Sequence[Interaction], data: Path
) -> Section:
    """`changes`: what followed from it; `data`: the folder in which the agents' log is."""
    title = "What was asked of the agents"
    if not asked:
        return Section(title, ("Nothing: every step had one candidate.",))
    whole = {one.id: one for one in interactions}
    followed = {one.proposal: one for one in changes if one.proposal}
    stories = tuple(
        _story(number, one, followed, whole.get(one.interaction), data) for number, one in enumerate(asked, 1)
    )
    return Section(title, (f"{in_short(asked)}.",), stories=stories)


def in_short(asked: Sequence[AskedResult]) -> str:
    """How many questions, who answered them, and why not somebody else."""
    if not asked:
        return "nothing was asked of the agents"
    models = sorted({one.model for one in asked if one.model})
    by_agents = sum(one.by != RULES for one in asked)
    failed = sum(bool(one.instead) for one in asked)
    text = f"{len(asked)} questions over the agents' bus: {len(asked) - by_agents} answered by the rules"
    text += f", {by_agents} by agents with {' and '.join(_model(one) for one in models)}" if by_agents else ""
    return f"{text}; in {failed} of them the rules stood in for an agent" if failed else text


def story_of(one: AskedResult, changes: Mapping[str, ChangeResult]) -> Story:
    """Without the details."""
    return Story(
        _sentence(one.task),
        (f"{_clock(one.at)}, agent {one.agent}, {one.decision}. {_looked_up(one)}",),
        tuple(_tables(one)),
        _choice(one),
        one.reason,
        (came_of(one, changes),),
    )


def came_of(one: AskedResult, changes: Mapping[str, ChangeResult]) -> str:
    """Of the proposal that followed."""
    if one.proposal not in changes:
        return "No proposal followed from it."
    change = changes[one.proposal]
    what = f"{change.step}, {change.name} ({one.proposal[:12]})"
    return f"What became of it: {what}: {verdict_words(change)}. {result_words(change)}"


def verdict_words(change: ChangeResult) -> str:
    """By how many rules, and the one that decided, with its number and margin."""
    if not change.rules:
        return "not judged"
    verdict = f"refused by {len(change.against)} of {change.rules} rules" if change.against else (
        f"accepted by {change.rules} rules"
    )  # fmt: skip
    if change.closest is None:
        return verdict
    what = "the first that failed" if change.against else "the closest"
    return f"{verdict}; {what}: {_rule(change.closest)}"


def result_words(change: ChangeResult) -> str:
    """What came of a candidate after its verdict, as far as there is anything to say."""
    parts = [change.stage.capitalize(), f": {change.why}" if change.why and change.why != change.measured else ""]
    parts.append(f", up to {change.speed_m_per_s:.3g} m/s" if change.speed_m_per_s is not None else "")
    measured = f" Measured: {change.measured}." if change.measured else ""
    return f"{''.join(parts)}.{measured}"


def _story(
    number: int, one: AskedResult, changes: Mapping[str, ChangeResult], whole: Interaction | None, data: Path
) -> Story:
    story = story_of(one, changes)
    command = f"r2rgate log {one.interaction} --data-dir {quote(str(data))}"
    folds = () if whole is None else (Fold(f"Word by word ({command})", as_story(whole)),)
    return replace(story, title=f"{number}. {story.title}", folds=folds)


def _choice(one: AskedResult) -> str:
    option = next((option.title for option in one.options if option.id == one.chosen), "")
    turned = ", ".join(f"{name} times {factor:g}" for name, factor in one.factors.items() if factor != 1.0)
    by = "the rules" if one.by == RULES else f"agent {one.by} with {_model(one.model)} in {one.seconds:.1f} s"
    instead = f" The rules, because {one.instead}." if one.instead else ""
    other = "" if one.chosen == one.usual else f" The rules would have chosen {one.usual}."
    return (
        f"Chosen by {by}: {one.chosen}{f', {turned}' if turned else ''} ({option}).{other}{instead} The reason given:"
    )


def _looked_up(one: AskedResult) -> str:
    if not one.notes:
        return "Nothing was found in what is known."
    notes = "; ".join(f"{note.title} (tier {note.tier}, {note.score:.2f})" for note in one.notes)
    return f"Looked up: {notes}."


def _tables(one: AskedResult) -> list[Table]:
    """The options, with the figures in which they differ."""
    shown = _shown(one)
    names = _telling(one.options)
    heads = ("Option", "What it is", *(_head(one.options, name) for name in names))
    rows = tuple((_mark(option, one), option.title, *(_value(option, name) for name in names)) for option in shown)
    left = len(one.options) - len(shown)
    note = f"And {left} more, in the details." if left else ""
    return [Table("What was offered.", heads, rows, frozenset(range(2, len(heads))), note=note)]


def _shown(one: AskedResult) -> list[OptionResult]:
    """The first, and in any case what was chosen."""
    first = one.options[:MOST_OPTIONS]
    return first + [option for option in one.options[MOST_OPTIONS:] if option.id == one.chosen]


def _telling(options: Sequence[OptionResult]) -> list[str]:
    """Names of the first figures that are not the same for all."""
    names = list(dict.fromkeys(figure.name for option in options for figure in option.figures))
    return [name for name in names if len({_value(option, name) for option in options}) > 1 or len(options) == 1][
        :MOST_FIGURES
    ]


def _figure(option: OptionResult, name: str) -> FigureResult | None:
    return next((figure for figure in option.figures if figure.name == name), None)


def _head(options: Sequence[OptionResult], name: str) -> str:
    found = next(figure for option in options if (figure := _figure(option, name)))
    return f"{name.capitalize()}{f', {found.unit}' if found.unit else ''}"


def _value(option: OptionResult, name: str) -> str:
    found = _figure(option, name)
    return "-" if found is None else "none" if found.value is None else f"{found.value:.4g}"


def _mark(option: OptionResult, one: AskedResult) -> str:
    marks = [name for name, here in (("chosen", one.chosen), ("the rules'", one.usual)) if option.id == here]
    return f"{option.id} ({', '.join(marks)})" if marks else option.id


def _rule(one: RuleResult) -> str:
    unit = f" {one.unit}" if one.unit else ""
    if one.value is None or one.limit is None:
        return one.rule
    margin = "" if one.margin is None else f", margin {one.margin:.3g}{unit}"
    return f"{one.rule}, {one.value:.4g} for a limit of {one.limit:.4g}{unit}{margin}"


def _model(named: str) -> str:
    """Model and the beginning of its digest."""
    name, _, digest = named.partition(" ")
    return f"{name} {digest[:12]}".strip()


def _clock(at: str) -> str:
    return f"{datetime.fromisoformat(at):%H:%M:%S}"


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}"
