"""What a command beside the line goes by: what is in service as the records have it, not what the loop began with."""

from pathlib import Path

from gateway.cli.line_in_service import context_of, in_service
from gateway.core.controller import canonical, config_hash
from gateway.core.deployment import Region
from gateway.mailbox.paths import CONTROLLER, GATEWAY_DATA, LOOP_DATA
from gateway.supervisor.configurations import FILE_NAME, Origin, begin_configurations
from tests.unit.deployer_support import FIRST, LINE, controller, proposal
from tests.unit.test_line_records import AT_S, BASE, Recording


def kept(folder: Path, *numbers: int, archived: str = "") -> None:
    """An audit in which these controllers were kept one after the other, and the store that has them."""
    own = folder / GATEWAY_DATA
    own.mkdir(mode=0o700)
    recording, base = Recording(own), BASE
    with begin_configurations(own / FILE_NAME) as store:
        for epoch, number in enumerate(numbers, start=1):
            hash_ = recording.proposed(proposal(number, base, AT_S))
            recording.judged(hash_)
            recording.deployed(hash_, epoch)
            recording.step("keeping", hash_, epoch=epoch)
            recording.step("kept", hash_, epoch=epoch)
            base = config_hash(controller(number))
            store.store(LINE.site, LINE.line, controller(number), Origin(AT_S, "rules", "a test"))
        if archived:
            store.archive(LINE.site, LINE.line, archived, "phi_stable", AT_S + 60.0, "anna", "it holds")
    recording.close()


def test_what_was_kept_last_is_in_service_and_the_first_for_as_much_the_baseline(tmp_path):
    kept(tmp_path, 1, 2)
    found = in_service(LINE, tmp_path)
    assert found is not None and (found.controller, found.region.speed_max_m_per_s) == (controller(2), 0.05)
    assert (found.baseline, found.baseline_region.speed_max_m_per_s) == (controller(1), 0.05)
    context = context_of(LINE, None, found, None)
    assert (context.in_service, context.baseline, context.region) == (controller(2), controller(1), found.region)
    assert context.state.tension_n == LINE.recipes[0].tension_n


def test_what_was_archived_is_the_baseline_before_any_other(tmp_path):
    kept(tmp_path, 1, 2, 3, archived=config_hash(controller(2)))
    found = in_service(LINE, tmp_path)
    assert found is not None and (found.baseline, found.baseline_region) == (controller(2), Region())


def test_where_nothing_was_ever_changed_it_is_what_the_loop_keeps_or_nothing(tmp_path):
    assert in_service(LINE, tmp_path) is None
    (tmp_path / LOOP_DATA).mkdir()
    (tmp_path / LOOP_DATA / CONTROLLER).write_bytes(canonical(FIRST))
    found = in_service(LINE, tmp_path)
    assert found is not None and found.controller == FIRST and found.baseline is None
