"""A simulated drive that no longer hears the SYNC: driver and device meet on the wire, torque has to go off."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drivers.registry import build_links
from gateway.core.signals import DriveRequest, DriveState, Inputs, Outputs
from sim_plant.devices.drive import Drive
from sim_plant.faces.canopen import CanopenFace
from sim_plant.faces.canopen_bus import open_bus
from sim_plant.plant import load_plant
from sim_plant.recorder import Recorder
from sim_plant.world import World
from tests.protocol.driver_support import GROUP, line
from tests.support.ports import free_port

PLANT = load_plant(Path(__file__).parents[2] / "sim_plant/plants/s_real.toml")


@pytest.mark.parametrize("hears_nmt", [True, False])
def test_a_drive_that_is_deaf_to_sync_loses_its_torque(hears_nmt: bool) -> None:
    """Its RPDOs still come in, and each would renew its watchdog of 100 ms."""

    async def run() -> None:
        loop = asyncio.get_running_loop()
        begin_s = loop.time()
        world = World(PLANT, 1)
        recorder = Recorder(world)
        drives = [Drive(k, world, recorder, 80.0, 80.0) for k in range(2)]
        bus = {"interface": "udp_multicast", "channel": GROUP, "port": free_port()}
        wire = open_bus(**bus)
        face = CanopenFace(wire.bus, drives, 1, lambda: loop.time() - begin_s)
        face.boot()
        face.attach(loop)
        link = build_links(line(can_bus=bus))[0]
        inputs, outputs = Inputs(2), Outputs(2)

        async def cycles_until(condition: Callable[[], bool], torque_nm: float) -> None:
            async with asyncio.timeout(5.0):
                while not condition():
                    face.poll()
                    world.advance(loop.time() - begin_s)
                    now_s = loop.time()
                    link.trigger(now_s)
                    await link.collect(inputs, now_s + 0.02)
                    outputs.drive_request[:], outputs.torque_nm[:] = DriveRequest.ENABLE, torque_nm
                    link.write(outputs)
                    await asyncio.sleep(0.01)

        async def live() -> None:
            while True:
                face.poll()
                await asyncio.sleep(0.01)

        living = asyncio.create_task(live())
        try:
            await link.open()
            await link.prepare()
            await cycles_until(lambda: bool(np.all(world.torque_nm[:2] == 8.0)), 8.0)
            deaf = face.nodes[0]
            deaf.on_sync = lambda now_s: None
            if not hears_nmt:
                deaf.on_nmt = lambda command, now_s: True
            await cycles_until(lambda: world.torque_nm[0] == 0.0, 8.0)
            assert inputs.drive_state[1] == DriveState.ENABLED and world.torque_nm[1] == 8.0
            causes = [event["cause"] for event in recorder.events if event["kind"] == "drive_state"]
            assert causes[-1] == ("nmt" if hears_nmt else "watchdog")
        finally:
            living.cancel()
            await asyncio.gather(living, return_exceptions=True)
            await link.close()
            face.detach()
            wire.close()

    asyncio.run(run())
