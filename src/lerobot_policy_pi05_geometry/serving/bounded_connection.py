"""A connection that ends when its client makes the server write and does not read."""

from websockets.asyncio.server import ServerConnection

from .limits import MIB

_UNREAD = MIB // 4  # bytes; answers are smaller, and only one of them is written at a time


class BoundedConnection(ServerConnection):
    """Every ping is answered at once, without waiting for the client to read.

    A client that sends pings only would fill the server's memory, and long before that keep its event loop busy: asyncio adds up
    all that is not yet written at every write.
    """

    def data_received(self, data: bytes) -> None:
        if self.transport.get_write_buffer_size() > _UNREAD:
            self.transport.abort()
        else:
            super().data_received(data)
