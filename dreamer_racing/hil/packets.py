"""Packets over UDP, little endian: four bytes that name the kind, the content, and a CRC-32 u32 of all before it."""

from __future__ import annotations

import struct
import zlib
from typing import Any


class PacketFormat:
    """A kind of packet.

    Args:
        kind: Four bytes that name it.
        content: The content's fields, as `struct` writes them.

    Attributes:
        size: Bytes of a packet.

    Example:
        >>> packet = PacketFormat(b"DRX1", "Id")
        >>> packet.unpack(packet.pack(7, 0.5)), packet.unpack(b"DRX1")
        ((7, 0.5), None)
    """

    def __init__(self, kind: bytes, content: str) -> None:
        self._kind, self._content = kind, struct.Struct(f"<{content}")
        self.size = len(kind) + self._content.size + 4

    def pack(self, *content: Any) -> bytes:
        """Return the bytes of a packet."""
        body = self._kind + self._content.pack(*content)
        return body + zlib.crc32(body).to_bytes(4, "little")

    def unpack(self, data: bytes) -> tuple[Any, ...] | None:
        """Return a packet's content; None if it has another size or kind, or is damaged."""
        body, check = data[:-4], data[-4:]
        if len(data) != self.size or not body.startswith(self._kind) or zlib.crc32(body).to_bytes(4, "little") != check:
            return None
        return self._content.unpack_from(body, len(self._kind))
