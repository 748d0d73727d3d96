"""Prints what scapy decodes of RTPS messages in captures (see ../second_decoders.rs).

    scapy_lines.py CAPTURE...

One line per message: its CRC, then for some messages the GUID prefix and the submessages, each as
fields with single spaces. The line ends where scapy leaves the bytes undecoded. A line `--` ends
each capture.
"""

import sys
import zlib
from collections import Counter

from scapy.all import IP, UDP, CookedLinux, Ether, IPSession, IPv6, conf, sniff
from scapy.contrib.rtps import rtps
from scapy.layers.l2 import CookedLinuxV2

# Messages with more than 100 submessages are rare, but valid.
conf.max_list_count = 10_000

# Layers of a datagram.
LAYERS = [Ether, CookedLinux, CookedLinuxV2, IP, IPv6, UDP]

# Bytes of a DATA before its payload, if it has no inline QoS.
HEADER = 20

# Messages of one layout that are decoded, because scapy needs a millisecond for each.
SAMPLES = 2

# Offset of the two entities in a submessage.
ENTITIES = {0x06: 4, 0x07: 4, 0x08: 4, 0x12: 4, 0x13: 4, 0x15: 8, 0x16: 8}


def entity(value):
    return value if isinstance(value, str) else value.hex()


def number(high, low):
    return high << 32 | low


def submessage(part):
    """Returns the fields of a submessage, or nothing if scapy does not decode it."""
    if "submessageId" not in part.fields:
        return None
    kind = part.submessageId
    fields = [f"{kind:02x}", f"{int(part.submessageFlags):02x}", part.octetsToNextHeader]
    if kind == 0x09 and int(part.submessageFlags) & 2 == 0:
        fields.append(number(part.ts_seconds, part.ts_fraction))
    elif kind == 0x0E:
        fields.append(bytes(part.guidPrefix).hex())
    elif kind in (0x06, 0x07):
        # The names of builtin entities hide their bytes.
        fields += [entity(part.getfieldval(name)) for name in ("reader_id", "writer_id")]
        if kind == 0x07:
            fields.append(number(part.firstAvailableSeqNumHi, part.firstAvailableSeqNumLow))
            fields.append(number(part.lastSeqNumHi, part.lastSeqNumLow))
        fields.append(part.count)
    elif kind == 0x15:
        fields.append(f"{part.readerEntityIdKey:06x}{part.readerEntityIdKind:02x}")
        fields.append(f"{part.writerEntityIdKey:06x}{part.writerEntityIdKind:02x}")
        fields.append(number(part.writerSeqNumHi, part.writerSeqNumLow))
        # scapy ends a payload after inline QoS too early.
        if part.submessageFlags & 2 == 0:
            content = part.fields.get("data") or part.fields.get("key")
            content = bytes(content) if content else b""
            # scapy takes what follows an announcement of a participant as a part of it.
            if len(content) + HEADER > part.octetsToNextHeader:
                fields.append("...")
            else:
                fields += [len(content), f"{zlib.crc32(content):08x}"]
    return " ".join(map(str, fields))


def layout(message):
    """Returns id, flags, length and entities of each submessage."""
    found, at = [], 20
    while at + 4 <= len(message):
        kind, flags = message[at], message[at + 1]
        octets = int.from_bytes(message[at + 2 : at + 4], "little" if flags & 1 else "big")
        entities = at + ENTITIES.get(kind, len(message))
        found.append((kind, flags, octets, message[entities : entities + 8]))
        # Without a length, the last submessage ends with the message.
        at += 4 + octets if octets or kind in (0x01, 0x09) else len(message)
    return tuple(found)


def decoded(message):
    """Returns the fields of a message."""
    packet = rtps.RTPS(message)
    parts = [message[8:20].hex()]
    for part in packet[rtps.RTPSMessage].submessages if rtps.RTPSMessage in packet else []:
        fields = submessage(part)
        if not fields:
            break
        parts.append(fields)
    return ";".join(parts)


def messages(capture):
    """Returns the messages in a capture."""
    # Without a filter, scapy tries every protocol on each payload.
    conf.layers.filter(LAYERS)
    packets = sniff(offline=capture, session=IPSession, store=True)
    conf.layers.unfilter()
    payloads = [bytes(packet[UDP].payload) for packet in packets if UDP in packet]
    return [payload for payload in payloads if payload[:4] == b"RTPS"]


def lines(capture):
    seen = Counter()
    for message in messages(capture):
        kind = layout(message)
        seen[kind] += 1
        content = f" {decoded(message)}" if seen[kind] <= SAMPLES else ""
        yield f"{zlib.crc32(message):08x}{content}"


for capture in sys.argv[1:]:
    for line in lines(capture):
        print(line)
    print("--")
