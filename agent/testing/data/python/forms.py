"""Writes forms.jsonl.gz: what Python, PyYAML and numpy print of strings, floats and arrays.

Run by hand where the forms are in doubt; the tests read what it wrote.
Made with Python 3.11, PyYAML 6.0.3, numpy 1.26.4 (that of Ubuntu 24.04).
"""

import gzip
import json
import random
import sys

import numpy
import yaml

random.seed(7)
PIECES = [
    "", " ", "  ", "\n", "\n\n", "\t", "\r", "\0", "\x07", "\x1b", "\x7f", "\x85", "\xa0", "\u2028",
    "\ufeff", "\ue000", "\U0001f600", "\U0010ffff", "é", "世界", "a", "B", "0", "1", "-", "--", "---",
    "...", ".", "+", ":", ": ", "::", "#", " #", "?", "? ", ",", "[", "]", "{", "}", "&", "*", "!", "|",
    ">", "'", '"', "''", "%", "@", "`", "~", "=", "<<", "\\", "/", "x", "0x", "0b", "_", "e+", "e-", "1e5",
    "1.5", ".5", "inf", ".inf", ".nan", "NaN", "-.inf", "yes", "Yes", "yEs", "YES", "no", "off", "On", "true",
    "TRUE", "tRue", "null", "Null", "nULL", "y", "n", "2020-01-02", "2020-1-2", "T10:20:30", " 10:20:30.5",
    "Z", "12:30", "190:20:30.15", "017", "08", "123_456", "robot1: battery", "Hello World: 1",
]


class Mapping(dict):
    """Is represented without a style of its own, as rosidl_runtime_py has messages represented."""


def represent_mapping(dumper, mapping):
    pairs = [(dumper.represent_data(key), dumper.represent_data(mapping[key])) for key in mapping]
    return yaml.MappingNode("tag:yaml.org,2002:map", pairs)


yaml.add_representer(Mapping, represent_mapping)


def yaml_of(value, flow):
    return yaml.dump(
        value, allow_unicode=True, width=sys.maxsize, default_flow_style=flow, sort_keys=False)


def strings():
    texts = set(PIECES)
    while len(texts) < 1500:
        texts.add("".join(random.choices(PIECES, k=random.randint(1, 5))))
    for text in sorted(texts):
        yield {
            "string": text,
            "repr": repr(text),
            "block": yaml_of({"data": text}, False),
            "flow": yaml_of(Mapping(a=Mapping(b=[Mapping(data=text), Mapping(data=text)])), True),
            "nested": yaml_of({"a": {"b": [{"data": text}, {"data": text}]}}, False),
            "listed": yaml_of({"a": {"data": [text, "x"]}}, False),
        }


def number():
    kind = random.random()
    if kind < 0.3:
        return float(random.randint(-50, 50))
    if kind < 0.5:
        return random.choice([0.0, -0.0, 0.1, 0.25, 1e-9, 1e-5, 1e4, 1e8, 3.14159265358979, 1e16, 2.5e-300])
    if kind < 0.55:
        return random.choice([float("nan"), float("inf"), float("-inf")])
    if kind < 0.8:
        return random.uniform(-1, 1)
    return random.uniform(-1, 1) * 10.0 ** random.randint(-12, 12)


def arrays():
    for turn in range(600):
        size = random.choice([1, 2, 3, 4, 9, 12, 36, 50])
        dtype = random.choice(["float64", "float64", "float32", "int8", "uint8", "int32", "int64", "uint64"])
        if dtype.startswith("float"):
            source = number if turn % 2 else lambda: round(random.uniform(-9, 9), random.randint(0, 4))
            values = [source() for _ in range(size)]
            with numpy.errstate(all="ignore"):
                array = numpy.array(values, dtype=dtype)
        else:
            info = numpy.iinfo(dtype)
            small = random.random() < 0.5
            low, high = (max(info.min, -20), 20) if small else (info.min, info.max)
            array = numpy.array([random.randint(low, high) for _ in range(size)], dtype=dtype)
        yield {"dtype": dtype, "bytes": array.tobytes().hex(), "str": str(array), "repr": repr(array)}
    long = numpy.arange(1500, dtype="int32")
    yield {"dtype": "int32", "bytes": long.tobytes().hex(), "str": str(long), "repr": repr(long)}


def floats():
    for _ in range(500):
        value = number()
        with numpy.errstate(all="ignore"):
            single = numpy.float32(value)
        yield {
            "bits": numpy.float64(value).tobytes().hex(),
            "repr": repr(value),
            "single_bits": single.tobytes().hex(),
            "single": str(single),
            "yaml": yaml_of({"data": value}, False),
        }


with gzip.GzipFile("forms.jsonl.gz", "wb", mtime=0) as out:
    for kind in [strings, arrays, floats]:
        for form in kind():
            out.write((json.dumps(form) + "\n").encode())
