"""What a gateway takes its records for: what one calls not done was not."""

import asyncio

from gateway.core.audit_record import Who
from gateway.supervisor.audit import Audit
from gateway.supervisor.audit_writer import NOT_DONE
from gateway.supervisor.book_file import book_in
from gateway.supervisor.lifecycle import Stage

ANNA = Who(name="anna", uid=1000, pid=1)
PROPOSED = {
    "proposal": "1" * 64, "change": "gains", "author": "rules", "base": "2" * 64, "changes": "3" * 64,
    "created": "2026-01-01T00:00:00+00:00", "expires": "2026-01-02T00:00:00+00:00", "expires_s": 1.8e9,
}  # fmt: skip


def test_an_approval_that_came_too_late_to_be_told_is_none_and_may_come_again(tmp_path):
    audit, one = Audit(tmp_path), {"proposal": "1" * 64}
    audit.start()

    async def written() -> None:
        await audit.append(
            "found-in-service", ANNA, {"configuration": "2" * 64, "last_known_good": "2" * 64, "epoch": 0}
        )
        await audit.append("proposed", ANNA, PROPOSED)
        await audit.append("accepted", ANNA, one)
        late = await audit.append("approved", ANNA, one)
        await audit.append(NOT_DONE, ANNA, {"sequences": [late.sequence], "because": "nobody waited any more"})

    asyncio.run(written())
    assert book_in(tmp_path).entries["1" * 64].stage is Stage.WAITING
    asyncio.run(audit.append("approved", ANNA, one))
    audit.close()
    assert book_in(tmp_path).entries["1" * 64].stage is Stage.APPROVED
