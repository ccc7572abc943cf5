"""Opening the CAN bus that the simulated drives sit on, and saying what to do when it cannot be opened."""

import errno
import socket
from dataclasses import dataclass

import can

from sim_plant.faces.canopen_multicast import MulticastBus


class FaceUnavailable(Exception):
    """A wire of the simulated line cannot be opened. The text says why and what to do."""


@dataclass(frozen=True, slots=True)
class OpenBus:
    """A python-can bus, and what keeps a second simulated line from answering on it too."""

    bus: can.BusABC
    guard: socket.socket | None = None

    def close(self) -> None:
        self.bus.shutdown()
        if self.guard is not None:
            self.guard.close()


def open_bus(interface: str, channel: str, port: int) -> OpenBus:
    """Open the bus. `port` separates the lines of `udp_multicast`; other interfaces have none.

    Nothing leaves the machine: `udp_multicast` is opened with a hop limit of 0. Raises FaceUnavailable.
    """
    if interface != "udp_multicast":
        try:
            return OpenBus(can.Bus(channel, interface, ignore_config=True))
        except (can.CanError, OSError, ValueError, ImportError) as error:
            raise FaceUnavailable(f"the CAN bus {interface}:{channel} cannot be opened: {error}") from error
    guard = _guard(channel, port)
    try:
        return OpenBus(MulticastBus(channel, port), guard)
    except (can.CanError, OSError, ValueError, ImportError) as error:
        guard.close()
        raise FaceUnavailable(explain(channel, port, error)) from error


def explain(channel: str, port: int, error: BaseException) -> str:
    """Why multicast on this machine does not work, from the error that python-can wraps, and what to do."""
    text = f"CAN over UDP multicast on {channel} port {port} does not work: {error}"
    number = next((e.errno for e in _causes(error) if isinstance(e, OSError)), None)
    if number in (errno.ENODEV, errno.ENETUNREACH, errno.EADDRNOTAVAIL):
        return f"{text}: no route for multicast. Add one with: ip route add 239.0.0.0/8 dev lo"
    if number == errno.EADDRINUSE:
        return f"{text}: another program or user has the port. Choose another port"
    return text


def _causes(error: BaseException | None) -> list[BaseException]:
    causes: list[BaseException] = []
    while error is not None:
        causes.append(error)
        error = error.__cause__ or error.__context__
    return causes


def _guard(channel: str, port: int) -> socket.socket:
    """Multicast groups are shared by design, so a second line would go unnoticed: this name is not."""
    guard = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        guard.bind(f"\0r2r-drives:{channel}:{port}")
    except OSError as error:
        guard.close()
        if error.errno != errno.EADDRINUSE:
            raise FaceUnavailable(explain(channel, port, error)) from error
        raise FaceUnavailable(
            f"CAN port {port} is taken: a simulated line already answers on {channel}. "
            "Stop it, or choose another port for this one"
        ) from None
    return guard
