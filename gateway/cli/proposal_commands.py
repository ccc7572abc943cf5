"""`r2rgate propose`, `proposals`, `approve`, `reject`, `rollback`: changes, and what people say of them."""

import asyncio
import json
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from pydantic import ValidationError
from rich.console import Console

from gateway.cli.operate_commands import REFUSED, UNREACHABLE, Json, RunFolder
from gateway.cli.proposal_view import print_list, print_shown
from gateway.cli.waiting import interruptible, progress
from gateway.core.controller import ControllerRefused, config_hash, parse_controller
from gateway.core.decisions import (
    Confirm,
    Decide,
    ListProposals,
    ProposalList,
    ProposalShown,
    RollBackNow,
    ShowProposal,
)
from gateway.core.experiment import ExperimentRefused, parse_experiment
from gateway.core.line_model import ModelRefused, parse_model
from gateway.core.messages import Reply
from gateway.core.proposal import (
    ExperimentChange,
    GainsChange,
    ModelChange,
    Proposal,
    ProposalRefused,
    canonical,
    parse_proposal,
    proposal_hash,
)
from gateway.core.topics import GATEWAY_DECISION, GATEWAY_PROPOSALS, GATEWAY_PROPOSE, Topic
from gateway.files import MOST_BYTES, read_bytes
from gateway.mailbox.inbox import come_again_s
from gateway.mailbox.listener import PathTooLong
from gateway.mailbox.paths import GATEWAY_SOCKET
from gateway.mailbox.port import Unreachable
from gateway.mailbox.unix import UnixMailbox

REPLY_TIME_S = 20.0  #: a deployment is built and read back before it is answered
POLL_S = 0.25
JUDGED_WITHIN_S = 240.0
AGAIN_WITHIN_S = 30.0  #: for which a full inbox is waited for
LONG_S = 30.0  #: hardly a verdict takes that long once the judge has begun

Which = Annotated[str, typer.Argument(help="The proposal's hash, or its first letters (at least 6).")]
Comment = Annotated[str, typer.Option("--comment", help="Why; it stands in the audit.")]
Yes = Annotated[bool, typer.Option("--yes", help="Do not ask again.")]
Script = Annotated[
    str,
    typer.Option(
        "--script",
        help="Name of a program that decides in a person's place: it stands in the audit, as no person's word.",
    ),
]


def propose(
    what: Annotated[
        str,
        typer.Argument(
            metavar="FILE",
            help="A controller, an experiment, a model, or a whole proposal, as JSON; or a controller that is stored: "
            "its version, hash or name (r2rgate configurations list).",
        ),
    ],
    reason: Annotated[str, typer.Option("--reason", help="Why; whoever decides reads it.")] = "",
    author: Annotated[str, typer.Option("--author", help="Of those that the line's file allows.")] = "engineer",
    hours: Annotated[float, typer.Option("--hours", min=0.01, help="For how long it stands.")] = 8.0,
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Until it has been judged.")] = True,
    run_dir: RunFolder = None,
    as_json: Json = False,
) -> None:
    """Put a change before the gate. Nothing reaches the line before it is accepted there and approved by a person.

    Example: r2rgate propose controller.json --reason "redesigned on model v3"

    Example, back to an earlier one: r2rgate propose v2 --reason "as it was before the reel was changed"
    """
    file = Path(what)
    content = _read(file) if _names_file(file) else _stored(run_dir, what)
    listed = _listed(run_dir)
    payload = content if _is_proposal(content) else canonical(_made(file, content, reason, author, hours, listed))
    reply = _proposed(run_dir, payload)
    if not reply.ok or not wait:
        _end_with(reply, as_json)
        return
    with interruptible(f"`r2rgate proposals {_hash_of(payload)[:12]}` shows the verdict"), progress() as show:
        found = asyncio.run(_judged(run_dir, _hash_of(payload), show))
    _show(found, as_json)
    if found.verdict is not None and not found.verdict.accepted:
        if not as_json and isinstance(found.proposal.change, GainsChange):
            typer.echo(_way_on(file, config_hash(found.proposal.change.controller)))
        raise typer.Exit(REFUSED)


def _way_on(file: Path, refused: str) -> str:
    """After a refusal of a configuration: the next of the design beside its file, where there is one."""
    from gateway.cli.design_result import DesignResult

    others = ""
    with suppress(OSError, ValidationError):  # there is none, or it is none
        result = DesignResult.model_validate_json(read_bytes(file.with_suffix(".design.json"), MOST_BYTES))
        left = [one.architecture for one in result.candidates if one.can_be_chosen and one.hash != refused]
        others = f"the next of its design is {left[0]} (r2rgate design --law {left[0]}); " if left else ""
    return (
        f"the way on: {others}`r2rgate design LINE.toml --model newest` chooses among what the gate lets through, "
        "`r2rgate commission LINE.toml` goes on by itself"
    )


def proposals(
    which: Annotated[str | None, typer.Argument(help="One of them, in full; its hash or the first letters.")] = None,
    run_dir: RunFolder = None,
    as_json: Json = False,
) -> None:
    """Proposals and what became of them, the newest first; one of them in full.

    Example: r2rgate proposals 3f2a91
    """
    if which is not None:
        _show(_shown(run_dir, which), as_json)
        return
    found = _listed(run_dir)
    if as_json:
        typer.echo(found.model_dump_json(indent=2))
    else:
        print_list(found, Console(highlight=False))


def approve(
    which: Which,
    comment: Comment = "",
    yes: Yes = False,
    script: Script = "",
    run_dir: RunFolder = None,
    as_json: Json = False,
) -> None:
    """Approve a proposal that the gate has accepted: it is carried out at once, and watched before it is kept.

    Example: r2rgate approve 3f2a91 --comment "as discussed with the night shift"
    """
    _decide(which, True, comment, yes, script, run_dir, as_json)


def reject(
    which: Which,
    comment: Comment = "",
    yes: Yes = False,
    script: Script = "",
    run_dir: RunFolder = None,
    as_json: Json = False,
) -> None:
    """Reject a proposal.

    Example: r2rgate reject 3f2a91 --comment "not during this order"
    """
    _decide(which, False, comment, yes, script, run_dir, as_json)


def rollback(comment: Comment = "", run_dir: RunFolder = None, as_json: Json = False) -> None:
    """Back to the last known good configuration, at once.

    Example: r2rgate rollback --comment "tension 3 hums"
    """
    command = RollBackNow(comment=comment)
    _end_with(Reply.model_validate_json(_ask(run_dir, GATEWAY_DECISION, command.model_dump_json().encode())), as_json)


def confirm(
    which: Annotated[str, typer.Argument(help="Hash of what is in service, or its beginning.")],
    because: Annotated[str, typer.Option("--because", help="How it came to be there, for the record.")],
    run_dir: RunFolder = None,
    as_json: Json = False,
) -> None:
    """Answer for a configuration that nobody has judged: a first one, or one that no record explains.

    A first one is guarded as such no more, once it has followed a move of a tension and a change of the speed in RUN;
    one that no record explains may be armed. Either goes no further than a first configuration until another one is
    approved. Where the line has a list of people, a person says it, as their own user of this computer.

    Example: r2rgate confirm 3f2a91 --because "exchanged by hand after the repair"
    """
    found = ProposalList.model_validate_json(
        _ask(run_dir, GATEWAY_PROPOSALS, ListProposals().model_dump_json().encode())
    )
    if found.in_service is None or not found.in_service.startswith(which):
        _refuse(
            f"in service is {(found.in_service or 'nothing that is known')[:12]}, not {which}: nothing is confirmed"
        )
    command = Confirm(configuration=found.in_service, because=because)
    _end_with(Reply.model_validate_json(_ask(run_dir, GATEWAY_DECISION, command.model_dump_json().encode())), as_json)


def _decide(
    which: str, approve: bool, comment: str, yes: bool, script: str, run_dir: Path | None, as_json: bool
) -> None:
    found = _shown(run_dir, which)
    if found.shown is None:
        why = f" ({found.why})" if found.why else ""
        _refuse(f"proposal {found.proposal_hash[:12]} is {found.stage}{why}: there is nothing to decide")
    if not yes:
        print_shown(found, Console(highlight=False, stderr=True))
        typer.confirm("approve it?" if approve else "reject it?", abort=True, err=True)
    command = Decide(proposal=found.proposal_hash, shown=found.shown, approve=approve, comment=comment, script=script)
    _end_with(Reply.model_validate_json(_ask(run_dir, GATEWAY_DECISION, command.model_dump_json().encode())), as_json)


def _read(file: Path) -> bytes:
    try:
        return read_bytes(file, MOST_BYTES)
    except OSError as error:
        _refuse(f"{file} cannot be read: {error.strerror}")


def _names_file(file: Path) -> bool:
    return file.exists() or file.suffix == ".json" or len(file.parts) > 1


def _stored(run_dir: Path | None, which: str) -> bytes:
    """The configuration with this version, hash or name, out of the store of the line that runs."""
    from gateway.cli.status_commands import ask_status, choose_run_folder
    from gateway.core.controller import canonical as canonical_controller
    from gateway.supervisor.configurations import FILE_NAME, ConfigurationsError, open_configurations

    try:
        status = asyncio.run(ask_status(choose_run_folder(run_dir)))
    except (Unreachable, PathTooLong) as error:
        _refuse(str(error), UNREACHABLE)
    try:
        with open_configurations(Path(status.historian.path).parent / FILE_NAME) as configurations:
            found = configurations.find(which, status.site, status.line)
    except ConfigurationsError as error:
        _refuse(f"{which} is no file, and of the stored configurations: {error}")
    if found.controller is None:
        _refuse(f"configuration {which} is damaged in the store: {found.damage}")
    return canonical_controller(found.controller)


def _is_proposal(content: bytes) -> bool:
    try:
        document: Any = json.loads(content)
    except (ValueError, RecursionError):
        return False
    return isinstance(document, dict) and "change" in document


def _proposed(run_dir: Path | None, payload: bytes) -> Reply:
    """Where others have filled the inbox, asked again once it is time to; for a while."""
    began_s = time.monotonic()
    while True:
        reply = Reply.model_validate_json(_ask(run_dir, GATEWAY_PROPOSE, payload))
        again_s = come_again_s(reply)
        if again_s is None or time.monotonic() + again_s - began_s > AGAIN_WITHIN_S:
            return reply
        time.sleep(again_s)


def _made(file: Path, content: bytes, reason: str, author: str, hours: float, listed: ProposalList) -> Proposal:
    """A proposal of what is in a file, on what is in service now."""
    if not reason.strip():
        _refuse("--reason is missing: whoever decides wants to know why")
    if listed.in_service is None:
        _refuse("the loop has not said yet what controls the line: is it running? `r2rgate status`")
    now = datetime.now(UTC)
    fields = {
        "format": 1,
        "site": listed.site,
        "line": listed.line,
        "change": _change(file, content),
        "base": listed.in_service,
        "model": listed.model,
        "reason": reason,
        "author": author,
        "created": now.isoformat(timespec="seconds"),
        "expires": (now + timedelta(hours=hours)).isoformat(timespec="seconds"),
    }
    try:
        return Proposal.model_validate(fields)
    except ValidationError as error:
        _refuse("; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()))


def _change(file: Path, content: bytes) -> GainsChange | ExperimentChange | ModelChange:
    refusals: list[str] = []
    for what, read in (
        ("controller", lambda: GainsChange(controller=parse_controller(content))),
        ("experiment", lambda: ExperimentChange(experiment=parse_experiment(content))),
        ("model", lambda: ModelChange(model=parse_model(content))),
    ):
        try:
            return read()
        except (ControllerRefused, ExperimentRefused, ModelRefused) as refused:
            refusals.append(f"  as a {what}: {str(refused)[:200]}")
    _refuse(f"{file} is neither controller, experiment, model nor proposal:\n" + "\n".join(refusals))


def _hash_of(payload: bytes) -> str:
    try:
        return proposal_hash(parse_proposal(payload, len(payload)))
    except ProposalRefused as refused:
        _refuse(str(refused))


async def _judged(run_dir: Path | None, hash_: str, show: Callable[[str], None]) -> ProposalShown:
    """Once it is. Ends the program where that takes too long."""
    clock = asyncio.get_running_loop().time
    mailbox, began_s = _mailbox(run_dir), clock()
    try:
        while (waited_s := clock() - began_s) < JUDGED_WITHIN_S:
            first = ""
            if waited_s > LONG_S:
                first = ": near a limit it is drawn again; on a new machine the judge compiles once, a minute"
            show(f"proposal {hash_[:12]} is being judged, {waited_s:.0f} s{first}")
            query = ShowProposal(proposal=hash_).model_dump_json().encode()
            found = _parsed_shown(await mailbox.request(GATEWAY_PROPOSALS, query, REPLY_TIME_S))
            if found.stage != "received":
                return found
            await asyncio.sleep(POLL_S)
    except Unreachable as error:
        _refuse(str(error), UNREACHABLE)
    finally:
        await mailbox.close()
    _refuse(f"it has not been judged within {JUDGED_WITHIN_S:g} s: `r2rgate proposals {hash_[:12]}` shows it later")


def _mailbox(run_dir: Path | None) -> UnixMailbox:
    from gateway.cli.status_commands import choose_run_folder

    mailbox = UnixMailbox()
    mailbox.connect((GATEWAY_PROPOSE, GATEWAY_PROPOSALS, GATEWAY_DECISION), choose_run_folder(run_dir) / GATEWAY_SOCKET)
    return mailbox


def _ask(run_dir: Path | None, topic: Topic, payload: bytes) -> bytes:
    async def asked() -> bytes:
        mailbox = _mailbox(run_dir)
        try:
            return await mailbox.request(topic, payload, REPLY_TIME_S)
        finally:
            await mailbox.close()

    try:
        return asyncio.run(asked())
    except (Unreachable, PathTooLong) as error:
        _refuse(str(error), UNREACHABLE)


def _listed(run_dir: Path | None) -> ProposalList:
    answer = _ask(run_dir, GATEWAY_PROPOSALS, ListProposals().model_dump_json().encode())
    try:
        return ProposalList.model_validate_json(answer)
    except ValidationError:
        _refuse_as(answer)


def _shown(run_dir: Path | None, which: str) -> ProposalShown:
    try:
        query = ShowProposal(proposal=which.lower())
    except ValidationError:
        _refuse(f"{which} is no hash; allowed: 6 to 64 of 0-9 and a-f, as `r2rgate proposals` shows them")
    return _parsed_shown(_ask(run_dir, GATEWAY_PROPOSALS, query.model_dump_json().encode()))


def _parsed_shown(answer: bytes) -> ProposalShown:
    try:
        return ProposalShown.model_validate_json(answer)
    except ValidationError:
        _refuse_as(answer)


def _refuse_as(answer: bytes) -> NoReturn:
    """The answer is a refusal in place of what was asked for."""
    try:
        reply = Reply.model_validate_json(answer)
    except ValidationError:
        _refuse("what answers there is of another version than this command", UNREACHABLE)
    _refuse("\n".join([reply.text, *(f"  - {reason}" for reason in reply.reasons)]))


def _show(found: ProposalShown, as_json: bool) -> None:
    if as_json:
        typer.echo(found.model_dump_json(indent=2))
        return
    print_shown(found, Console(highlight=False))
    if found.shown is not None:
        short = found.proposal_hash[:12]
        typer.echo(f"decide: r2rgate approve {short}   or   r2rgate reject {short}")


def _end_with(reply: Reply, as_json: bool) -> None:
    if as_json:
        typer.echo(reply.model_dump_json(indent=2))
    elif reply.ok:
        typer.echo(reply.text)
    else:
        typer.echo(f"refused: {reply.text}" if reply.known else reply.text, err=True)
        for reason in reply.reasons:
            typer.echo(f"  - {reason}", err=True)
    if not reply.ok:
        raise typer.Exit(REFUSED)


def _refuse(text: str, code: int = REFUSED) -> NoReturn:
    typer.echo(text, err=True)
    raise typer.Exit(code)
