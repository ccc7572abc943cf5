"""However much is looked at, what a person says is heard."""

import asyncio

from gateway.core.line_past import RecordsTold, TensionsBetween
from gateway.core.messages import Reply, Stop
from gateway.core.people import Person
from gateway.core.topics import GATEWAY_FOR_PERSON, GATEWAY_PAST
from gateway.mailbox.unix import UnixMailbox
from gateway.operator.line_side import MOST_ASKED, READ, LineSide
from tests.unit.supervisor_support import short_folder, until

ANNA = Person(name="anna", role="operator", through="page")


def test_a_stop_is_heard_while_readers_fill_every_place_there_is():
    async def story(folder):
        asked, free = [], asyncio.Event()

        async def slow(payload):
            asked.append(payload)
            await free.wait()
            return RecordsTold(format=1, last=0, records=[]).model_dump_json().encode()

        async def heard(payload):
            return Reply(ok=True, state="STOP", text="stopping").model_dump_json().encode()

        gateway, reading, saying = UnixMailbox(), UnixMailbox(), UnixMailbox()
        gateway.serve(GATEWAY_PAST, slow)
        gateway.serve(GATEWAY_FOR_PERSON, heard)
        await gateway.listen(folder / "gateway.sock")
        reading.connect(READ, folder / "gateway.sock")
        saying.connect((GATEWAY_FOR_PERSON,), folder / "gateway.sock")
        side = LineSide(reading, saying)
        query = TensionsBetween(from_wall_s=0.0, to_wall_s=1.0)
        readers = [asyncio.create_task(side.tensions(query)) for _ in range(60)]
        await until(lambda: len(asked) >= MOST_ASKED)
        assert (await side.say(ANNA, Stop())).text == "stopping"
        assert len(asked) == MOST_ASKED
        for reader in readers:
            reader.cancel()
        await asyncio.gather(*readers, return_exceptions=True)
        for mailbox in (reading, saying, gateway):
            await mailbox.close()

    with short_folder() as folder:
        asyncio.run(story(folder))
