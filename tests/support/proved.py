"""Lines whose wiring has been proved, for tests of what comes after: the stored proof that `start` asks for."""

from pathlib import Path

from drivers.registry import map_files
from gateway.cli.stepped import shown_as_described
from gateway.core.line import CanopenBus, Drive, Line, LinePlc, LoadCell
from gateway.core.wiring_proof import WiringProof, device_identities, devices_of, proof_hash, wiring_hash
from gateway.loop.wiring import FILE, Wiring
from gateway.mailbox.paths import GATEWAY_DATA, LOOP_DATA
from gateway.supervisor.audit import Audit
from gateway.supervisor.audit_file import FILE_NAME
from gateway.supervisor.lifecycle import WIRING_PROVED
from gateway.supervisor.peers import GATEWAY
from sim_plant.devices import amplifier, drive, line_plc
from sim_plant.faces import modbus_rack

SERIAL_OF_NODE_0 = 0x52520000  #: of a simulated CANopen node; its number is added


def proof_of_wiring(line: Line, *, serials: bool = True) -> WiringProof:
    """Of `line` on simulated devices. Without `serials`: in memory, where nothing has a number."""
    canopen = {bus.name for bus in line.buses if isinstance(bus, CanopenBus)}
    numbers = {each.name: _serial(each, on_canopen=each.bus in canopen) for each in devices_of(line) if serials}
    maps = map_files(line)
    drives, cells, watchdogs = shown_as_described(line)
    return WiringProof(
        wiring=wiring_hash(line, maps, numbers), wall_s=0.0, devices=device_identities(line, maps, numbers),
        drives=drives, cells=cells, watchdogs=watchdogs,
    )  # fmt: skip


def _serial(device: Drive | LoadCell | LinePlc, *, on_canopen: bool) -> str:
    if on_canopen:
        return f"{SERIAL_OF_NODE_0 + device.address:#x}"
    if device.map.startswith("r2r-rack"):
        return str(modbus_rack.RACK_SERIAL)
    if isinstance(device, Drive):
        return str(drive.FIRST_SERIAL + device.roller - 1)
    return str(amplifier.SERIAL if isinstance(device, LoadCell) else line_plc.SERIAL)


def store_proof(line: Line, data: Path) -> None:
    """For a loop that is not started yet; `data`: the line's."""
    own = data / LOOP_DATA
    own.mkdir(parents=True, exist_ok=True)
    (own / FILE).write_text(proof_of_wiring(line).model_dump_json())


def proved_wiring(line: Line, *, serials: bool = True) -> Wiring:
    """For a loop without a folder."""
    wiring = Wiring(line, map_files(line))
    wiring.write(proof_of_wiring(line, serials=serials))
    wiring.take_written()
    return wiring


def record_proof(line: Line, data: Path) -> None:
    """Into the audit of a gateway that is not started there yet: it explains the proof that `store_proof` stores."""
    own = data / GATEWAY_DATA
    if (own / FILE_NAME).exists():
        return
    own.mkdir(parents=True, exist_ok=True)
    proof, audit = proof_of_wiring(line), Audit(own)
    audit.start()
    what = {"wiring": proof.wiring, "wall_s": proof.wall_s, "answers": [], "proof": proof_hash(proof)}
    audit.append_and_wait(WIRING_PROVED, GATEWAY, what)
    audit.close()
