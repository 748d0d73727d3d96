"""Prints what scapy decodes of each RTPS message in captures (see ../second_decoders.rs).

    scapy_lines.py CAPTURE

One line per message: the GUID prefix, then the submessages, each as fields with single spaces. The
line ends where scapy leaves the bytes undecoded.
"""

import sys
import zlib

from scapy.all import UDP, IPSession, conf, sniff
from scapy.contrib.rtps import rtps

# Messages with more than 100 submessages are rare, but valid.
conf.max_list_count = 10_000

# Bytes of a DATA before its payload, if it has no inline QoS.
HEADER = 20


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


def lines(capture):
    for packet in sniff(offline=capture, session=IPSession, store=True):
        if UDP not in packet:
            continue
        message = bytes(packet[UDP].payload)
        if message[:4] != b"RTPS":
            continue
        decoded = rtps.RTPS(message)
        parts = [message[8:20].hex()]
        for part in decoded[rtps.RTPSMessage].submessages if rtps.RTPSMessage in decoded else []:
            fields = submessage(part)
            if not fields:
                break
            parts.append(fields)
        yield ";".join(parts)


for line in lines(sys.argv[1]):
    print(line)
