"""python-can's `udp_multicast` for devices that answer at once: a frame costs one call of the system, in or out.

python-can asks before each frame whether there is one. And a group hands every sender its own frames again: here they
are dropped before they are decoded, where a frame is not waited for.
"""

import socket

import can
from can.interfaces.udp_multicast import UdpMulticastBus
from can.interfaces.udp_multicast.utils import pack_message, unpack_message

from sim_plant.faces.kernel_stamp import STAMP_SPACE, stamp_of

_LONGEST_BYTES = 4096  #: of a datagram, as python-can has it


class MulticastBus(UdpMulticastBus):
    """Classic frames, which do not leave this machine. Raises OSError or CanError when it cannot be opened."""

    def __init__(self, channel: str, port: int) -> None:
        super().__init__(channel, port, hop_limit=0, fd=False)
        self._incoming = socket.socket(fileno=socket.dup(self.fileno()))
        # What goes out has a socket of its own: by its address it is known when it comes back.
        self._outgoing = socket.socket(self._incoming.family, socket.SOCK_DGRAM)
        try:
            if self._outgoing.family == socket.AF_INET6:
                self._outgoing.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, 0)
            else:
                self._outgoing.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            self._outgoing.connect((channel, port))
        except OSError:
            self.shutdown()
            raise
        self._own_address = self._outgoing.getsockname()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """As python-can's, to which waiting is left: who has been told by `fileno` gives a `timeout` of 0 s."""
        if timeout != 0.0:
            return super()._recv_internal(timeout)
        while True:
            try:
                datagram, stamps, _, sender = self._incoming.recvmsg(_LONGEST_BYTES, STAMP_SPACE, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return None, False
            except OSError as error:
                raise can.CanOperationError(f"cannot receive: {error}") from error
            if sender == self._own_address:
                continue
            try:
                stamp = stamp_of(stamps)
                came_s = 0.0 if stamp is None else stamp.timestamp
                message = unpack_message(datagram, replace={"timestamp": came_s}, check=True)
            except Exception as error:  # msgpack and Message raise whatever comes of what is in it
                raise can.CanOperationError("a datagram that is no frame") from error
            if not message.is_fd:
                return message, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """As python-can's; it never waits."""
        try:
            self._outgoing.send(pack_message(msg))
        except OSError as error:
            raise can.CanOperationError(f"cannot send: {error}") from error

    def shutdown(self) -> None:
        super().shutdown()
        self._incoming.close()
        self._outgoing.close()
