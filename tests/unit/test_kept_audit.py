"""Proposals and verdicts beside the records: at hand for whoever looks, and never read in the gateway's event loop."""

import asyncio
import threading

import pytest

from gateway.core.audit_record import Who, head_of
from gateway.supervisor.audit import Audit
from gateway.supervisor.audit_file import AuditFile
from gateway.supervisor.deployer_sides import NotAtHand
from gateway.supervisor.kept_audit import MOST_BYTES, MOST_KEPT, KeptAudit

GATEWAY = Who(name="gateway")


def test_what_was_stored_or_fetched_is_at_hand_and_read_in_a_thread(tmp_path, monkeypatch):
    where: list[bool] = []
    opened = AuditFile.__init__

    def noted(self, *words, **named):
        where.append(threading.current_thread() is threading.main_thread())
        opened(self, *words, **named)

    audit = Audit(tmp_path)
    audit.start()

    async def story():
        kept = KeptAudit(tmp_path, audit)
        blobs = {"proposal": b"a proposal", "verdict": b"a verdict", "data-1": b"a recording"}
        await kept.append("proposed", GATEWAY, {}, blobs)
        monkeypatch.setattr(AuditFile, "__init__", noted)
        assert kept.blob(head_of(b"a proposal")) == b"a proposal" and not where
        after = KeptAudit(tmp_path, audit)  # as after a start
        await after.fetch([head_of(content) for content in blobs.values()] + ["0" * 64])
        assert [after.blob(head_of(content)) for content in blobs.values()] == list(blobs.values())
        assert where == [False]
        await after.fetch([head_of(b"a verdict")])
        assert where == [False]  # known
        assert after.blob("0" * 64) is None and where == [False]  # there is none
        for id_ in (head_of(b"another"), "1" * 64):
            with pytest.raises(NotAtHand):
                after.blob(id_)
        assert where == [False]

    asyncio.run(story())
    audit.close()


def test_what_is_kept_at_hand_is_bounded(tmp_path):
    audit = Audit(tmp_path)
    audit.start()

    async def story():
        kept = KeptAudit(tmp_path, audit)
        larger = [bytes(MOST_BYTES // 2 + k) for k in range(2)]
        for content in larger:
            await kept.append("proposed", GATEWAY, {}, {"proposal": content})
        assert kept.blob(head_of(larger[1])) == larger[1]
        for number in range(MOST_KEPT + 3):
            await kept.append("proposed", GATEWAY, {}, {"proposal": b"%d" % number})
        assert len(kept._blobs) == MOST_KEPT  # noqa: SLF001 (nothing else tells)
        for content in (*larger, b"0"):
            with pytest.raises(NotAtHand):
                kept.blob(head_of(content))
            await kept.fetch([head_of(content)])
            assert kept.blob(head_of(content)) == content

    asyncio.run(story())
    audit.close()
