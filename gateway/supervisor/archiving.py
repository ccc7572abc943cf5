"""A configuration kept under a name: recorded before it is done, like everything that changes a store."""

import asyncio
from collections.abc import Mapping
from typing import Any, Protocol

from gateway.core.audit_record import Who
from gateway.core.decisions import Archive
from gateway.core.messages import Reply
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.configurations import Configurations, ConfigurationsError, require_name
from gateway.supervisor.proposal_records import done, refused

ARCHIVED, NOT_ARCHIVED = "archived", "not-archived"


class Appends(Protocol):
    async def append(self, kind: str, who: Who, what: Mapping[str, Any]) -> object:
        """Raises AuditUnavailable."""
        ...


async def archive(
    audit: Appends, storage: Configurations, site: str, line: str, command: Archive, who: Who, now_s: float
) -> Reply:
    """Of a line's configurations, each step of the store in a thread. Puts nothing into service."""
    try:
        require_name(command.name)
        one = await asyncio.to_thread(storage.find, command.configuration, site, line)
        if one.controller is None:
            raise ConfigurationsError(f"version {one.version} is damaged: {one.damage}")
        what = {"configuration": one.id, "version": one.version, "name": command.name, "because": command.because}
        await audit.append(ARCHIVED, who, what)
    except (ConfigurationsError, AuditUnavailable) as error:
        return refused("nothing was archived", [str(error)])
    try:
        given = one.id, command.name, now_s, who.name, command.because
        await asyncio.to_thread(storage.archive, site, line, *given)
    except ConfigurationsError as error:
        try:
            await audit.append(NOT_ARCHIVED, who, {**what, "because": str(error)[:1000]})
        except AuditUnavailable as unrecorded:
            return refused("nothing was archived", [str(error), f"nor could that be recorded: {unrecorded}"])
        return refused("nothing was archived", [str(error)])
    return done(f"{command.name}: version {one.version} of {site}/{line}, {one.id[:12]}")
