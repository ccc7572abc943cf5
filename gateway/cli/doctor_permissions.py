"""Whether this user may do what the processes of a line have to: write its folders, open its CAN interfaces."""

import os
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

from gateway.cli.data_before import moves
from gateway.cli.doctor_check import Check
from gateway.cli.doctor_machine import existing
from gateway.core.line import CanopenBus, Line
from gateway.mailbox.paths import AGENTS_DATA, GATEWAY_DATA, LOOP_DATA, OPERATOR_DATA
from gateway.mailbox.who_serves import owners, unsafe_place
from gateway.wording.catalogue import sentence

ROOT = Path("/")
_GROUP = "permissions"


def permissions(line: Line, run_folder: Path, data_folder: Path, root: Path = ROOT) -> Iterator[Check]:
    """`root` is where /sys is found."""
    yield _folder("run folder", run_folder, of_sockets=True)
    yield _folder("data folder", data_folder, of_sockets=False)
    if way_out := moves(data_folder):
        measured, wanted = "files of several processes lie side by side", "a folder for each process"
        yield Check(_GROUP, "data folder", "", "FAIL", measured, wanted, f"`{way_out}`")
    for own in (LOOP_DATA, GATEWAY_DATA, OPERATOR_DATA, AGENTS_DATA):
        if (folder := data_folder / own).is_dir() and folder.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
            yield _folder(f"data folder, {own}", folder, of_sockets=False)
    for bus in line.buses:
        if isinstance(bus, CanopenBus) and bus.interface == "socketcan":
            yield _can_interface(bus, root)


def _folder(subject: str, folder: Path, *, of_sockets: bool) -> Check:
    """It exists and may be written, or may be made; nobody else may put a socket into it, or read data in it."""
    there = existing(folder)
    wanted = f"may be written by this user, {'written' if of_sockets else 'read'} by no other"
    option = f"--{subject.split()[0]}-dir"
    found = there.stat()
    owner, mode = found.st_uid, stat.S_IMODE(found.st_mode)
    measured = (
        f"{folder}" + ("" if there == folder.absolute() else ", not made yet") + f" (owner {owner}, mode {mode:o})"
    )
    if not there.is_dir():
        return Check(_GROUP, subject, "", "FAIL", f"{there} is a file", wanted, f"move it away, or use {option}")
    if not os.access(there, os.W_OK | os.X_OK):
        todo = f"`chown {os.geteuid()} {there}`, or choose another with {option}"
        return Check(_GROUP, subject, "", "FAIL", f"{measured}: may not be written", wanted, todo)
    if of_sockets and (unsafe := unsafe_place(folder, owners(folder))) is not None:
        todo = f"`chmod 700 {unsafe.parameters['place']}` as its owner, or choose another with {option}"
        return Check(_GROUP, subject, "", "FAIL", sentence(unsafe), wanted, todo)
    if not of_sockets and there == folder.absolute() and mode & (stat.S_IRWXG | stat.S_IRWXO):
        todo = f"`chmod 700 {folder}` as its owner: whoever may read a database may also lock it"
        return Check(_GROUP, subject, "", "warning", f"{measured}: others may come in", wanted, todo)
    return Check(_GROUP, subject, "", "OK", measured, wanted)


def _can_interface(bus: CanopenBus, root: Path) -> Check:
    subject, wanted = f"CAN {bus.channel}", f"up, {bus.bitrate_bit_per_s} bit/s"
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_CLOEXEC, socket.CAN_RAW).close()
    except OSError as error:
        todo = "load the kernel's modules can and can_raw (`modprobe can_raw`)"
        return Check(_GROUP, subject, "", "FAIL", f"no CAN socket: {error.strerror}", wanted, todo)
    interface = root / "sys/class/net" / bus.channel
    if not interface.exists():
        return Check(
            _GROUP, subject, "", "FAIL", "there is no such interface", wanted, "see `ip link`; is the card in?"
        )
    if not int((interface / "flags").read_text(), 16) & 1:  # IFF_UP
        todo = f"`ip link set {bus.channel} up type can bitrate {bus.bitrate_bit_per_s}`"
        return Check(_GROUP, subject, "", "FAIL", "it is down", wanted, todo)
    return Check(_GROUP, subject, "", "OK", "up", wanted)
