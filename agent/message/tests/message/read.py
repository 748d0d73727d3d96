"""Decodes payloads with PyPI `rosbags`: lines of JSON (type, hexadecimal payload) to JSON values.

usage: read.py DEFINITIONS, a directory with package/msg/Type.msg that rosbags does not have.
Floats are printed as the hexadecimal digits of their 64 bits, and a type without fields as an empty
list.
"""

import json
import struct
import sys
from pathlib import Path

import numpy
from rosbags.typesys import Stores, get_types_from_msg, get_typestore


def plain(value):
    if isinstance(value, str):
        return value
    if isinstance(value, (bool, numpy.bool_)):
        return bool(value)
    if isinstance(value, (float, numpy.floating)):
        return "f" + struct.pack(">d", float(value)).hex()
    if isinstance(value, (int, numpy.integer)):
        return int(value)
    if isinstance(value, (list, numpy.ndarray)):
        return [plain(item) for item in value]
    names = [name for name, _ in store.fielddefs[value.__msgtype__][1]]
    return [plain(getattr(value, name)) for name in names if name != "structure_needs_at_least_one_member"]


store = get_typestore(Stores.ROS2_HUMBLE)
own = {}
for path in Path(sys.argv[1]).glob("*/msg/*.msg"):
    package, name = path.parts[-3], path.stem
    own.update(get_types_from_msg(path.read_text(), f"{package}/msg/{name}"))
store.register(own)
for line in sys.stdin:
    name, payload = json.loads(line)
    print(json.dumps(plain(store.deserialize_cdr(bytes.fromhex(payload), name))))
