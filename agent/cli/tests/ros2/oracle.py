"""Prints messages of every installed type with the code of `ros2 topic echo`.

Needs the environment of an installed ROS 2 (Python of Debian 12 or Ubuntu 22.04). Values are
random, but equal in every run. Each line is one JSON document: type, case, the payload as the
middleware serializes it, and the standard output of `echo` for each list of options.

    oracle.py PART PARTS    every PARTS-th type, beginning with PART
"""

import argparse
import array
import contextlib
import inspect
import io
import json
import math
import random
import struct
import sys
from pathlib import Path

import numpy
from ament_index_python.packages import get_packages_with_prefixes
from rclpy.serialization import deserialize_message, serialize_message
from ros2topic.verb import echo
from rosidl_parser.definition import (
    AbstractNestedType, AbstractString, AbstractWString, Array, BasicType, BoundedSequence,
    NamespacedType, UnboundedSequence)
from rosidl_runtime_py.utilities import get_message

CASES = 7
# Lengths of strings and arrays. `echo` truncates above 128, and numpy above 1000.
LENGTHS = [0, 1, 2, 3, 4, 7, 31]
LONG = [127, 128, 129, 1000, 1001]

OPTIONS = [
    [], ["--full-length"], ["--truncate-length", "0"], ["--truncate-length", "1"],
    ["--truncate-length", "3"], ["--no-arr"], ["--no-str"], ["--no-arr", "--no-str"],
    ["--flow-style"], ["--flow-style", "--full-length"],
    ["--flow-style", "--truncate-length", "2"], ["--flow-style", "--no-arr"],
    ["--flow-style", "--no-str"], ["--csv"], ["--csv", "--full-length"],
    ["--csv", "--truncate-length", "0"], ["--csv", "--truncate-length", "3"],
    ["--csv", "--no-arr"], ["--csv", "--no-str"], ["--csv", "--no-arr", "--no-str"],
    ["--full-length", "--no-str"], ["--raw"],
]
FIELD_OPTIONS = [[], ["--csv"], ["--flow-style"], ["--no-arr", "--truncate-length", "2"]]

WORDS = [
    "", " ", "yes", "No", "TRUE", "off", "null", "Null", "~", "y", "n", "=", "<<", "-", "--", "---",
    "--- a", "...", "... a", "-a", "- a", "?", "? a", "?a", ":", ": a", ":a", "a:", "a: b", "a:b",
    "a #b", "a#b", "#", "&a", "*a", "!a", "|", ">", "%", "@", "`", "{", "}", "[", "]", "{a}", "[a]",
    ",", "a,b", "a, b", "'", "\"", "it's", "say \"so\"", "it's \"so\"", "\\", "\\n", "\n", "a\nb",
    "a\n", "\na", "a\n\nb", "a \nb", "a\n b", " a", "a ", "\t", "a\tb", "\r", "a\r\nb", "\x01",
    "\x1b[0m", "\x7f", "\x80", "\x85", "\xa0", "\xad", "\u00e9", "\u65e5\u672c", "\u2028", "\u2029",
    "\u200b", "\ufeff", "\ufeffa", "\ufffd", "\ue000", "\ufffe", "\U0001f600", "\U0010ffff", "0",
    "1", "-1", "+1", "007", "08", "0x1F", "0b11", "1_000", "1.0", "1.", ".5", "1e5", "1.0e+5",
    "1e+5", ".inf", "-.INF", ".nan", "nan", "inf", "12:30", "12:30:45.6", "2001-01-01",
    "2001-01-01 10:00:00", "2001-1-1T1:1:1Z", "map", "base_link", "/a/b", "camera_1 (left)", "a%b",
    "a" * 127, "b" * 128, "c" * 129, "\u00e9" * 129, "d\n" * 70,
]
DOUBLES = [
    0.0, -0.0, 1.0, -1.0, 0.1, 0.5, 1 / 3, 1e-5, 1e-4, 123456.789, 1e15, 1e16, 1e17, 1e22, 1e23,
    9007199254740993.0, 5e-324, 2.2250738585072014e-308, 1.7976931348623157e308, math.inf,
    -math.inf, math.nan, math.pi, 2.0 ** -44, 2.0 ** 53, 2.0 ** 89,
]
# Values of float32: ties of the shortest digits as a double, and limits. rclpy accepts values up
# to 3.402823466e38.
SINGLES = [
    540.92608642578125, 0.0, -0.0, 1.0, 0.1, 16777216.0, 1e-7, 1e-45, 3.4028232635611926e38,
    1.1754943508222875e-38, math.inf, -math.inf, math.nan, 33554432.0, 8.5e9, 123456789.0,
]


def single(bits):
    return struct.unpack("<f", struct.pack("<I", bits))[0]


def real(rng, is_single):
    if rng.random() < 0.3:
        return rng.choice(SINGLES if is_single else DOUBLES)
    kind = rng.randrange(4)
    if kind == 0:
        value = rng.uniform(-1000, 1000)
    elif kind == 1:
        value = round(rng.uniform(-100, 100), rng.randrange(5))
    elif kind == 2:
        # Few bits after the binary point lead to exact ties in decimal digits.
        value = rng.randrange(-2 ** 24, 2 ** 24) / 2.0 ** rng.randrange(25)
    elif is_single:
        value = single(rng.getrandbits(32))
    else:
        value = struct.unpack("<d", struct.pack("<Q", rng.getrandbits(64)))[0]
    return struct.unpack("<f", struct.pack("<f", value))[0] if is_single else value


def number(rng, typename):
    if typename in ("float", "double", "long double"):
        return real(rng, typename == "float")
    if typename == "boolean":
        return rng.random() < 0.5
    if typename == "octet":
        return bytes([rng.choice([0, 1, 0x27, 0x22, 0x5c, 0x7f, 0x80, 0x85, 0xff,
                                  rng.randrange(256)])])
    if typename in ("char", "wchar"):
        return rng.randrange(256)
    is_signed = not typename.startswith("u")
    bits = int(typename.lstrip("uint"))
    low, high = (-2 ** (bits - 1), 2 ** (bits - 1) - 1) if is_signed else (0, 2 ** bits - 1)
    if rng.random() < 0.3:
        return rng.choice([low, high, 0, 1])
    return rng.randrange(low, high + 1) >> rng.randrange(bits)


def text(rng, of):
    bound = of.maximum_size if of.has_maximum_size() else None
    if rng.random() < 0.8:
        value = rng.choice(WORDS)
    else:
        parts = [rng.choice(WORDS) for _ in range(rng.randrange(4))]
        value = rng.choice(["", " ", "\n", ": ", " #"]).join(parts)
    if isinstance(of, AbstractWString):
        # Each character must be one code unit.
        value = "".join(one for one in value if ord(one) < 0x10000)
    return value if bound is None else value.encode()[:bound].decode(errors="ignore")


def value_of(rng, of, depth, is_long):
    if isinstance(of, BasicType):
        return number(rng, of.typename)
    if isinstance(of, (AbstractString, AbstractWString)):
        return text(rng, of)
    if isinstance(of, NamespacedType):
        return message_of(rng, get_message("/".join(of.namespaced_name())), depth + 1, is_long)
    assert isinstance(of, AbstractNestedType), of
    element = of.value_type
    is_plain = not isinstance(element, NamespacedType)
    if isinstance(of, Array):
        length = of.size
    else:
        lengths = LENGTHS[:4] if depth > 0 or not is_plain else LENGTHS
        if is_long and depth < 2:
            lengths = LONG if is_plain else LONG[1:3]
        if depth > 2:
            lengths = LENGTHS[:3]
        length = rng.choice(lengths)
        if isinstance(of, BoundedSequence):
            length = min(length, of.maximum_size)
    if not is_plain and length > 4:
        # A long sequence of few different values needs little time.
        few = [value_of(rng, element, depth + 2, False) for _ in range(3)]
        return [rng.choice(few) for _ in range(length)]
    typename = getattr(element, "typename", None)
    if typename in ("float", "double") and rng.random() < 0.5:
        # numpy prints values of one order of magnitude without exponents.
        values = [round(rng.uniform(-50, 50), rng.randrange(9)) for _ in range(length)]
        if values and rng.random() < 0.2:
            values[0] = rng.choice([math.nan, math.inf, -math.inf, -0.0, 0.0])
        return values
    return [value_of(rng, element, depth, False) for _ in range(length)]


def message_of(rng, message_class, depth=0, is_long=False):
    message = message_class()
    for slot, of in zip(message.__slots__, message.SLOT_TYPES):
        value = value_of(rng, of, depth, is_long)
        present = getattr(message, slot)
        if isinstance(present, numpy.ndarray):
            value = numpy.array(value, dtype=present.dtype)
        elif isinstance(present, array.array):
            value = array.array(present.typecode, value)
        # Some setters reject values that a node in another language may send.
        try:
            setattr(message, slot.lstrip("_"), value)
        except AssertionError:
            setattr(message, slot, value)
    return message


def fields(message):
    # Since Jazzy, the last slot is no field.
    for name in message.get_fields_and_field_types():
        yield name
        value = getattr(message, name)
        if hasattr(value, "__slots__"):
            for below in list(fields(value))[:3]:
                yield f"{name}.{below}"


class Verb(echo.EchoVerb):
    """The verb of ros2cli, with messages of this script instead of a subscription."""

    def choose_qos(self, node, args):
        return None

    def subscribe_and_spin(self, node, topic, message_class, qos, no_lost, raw):
        payload = self.payload
        message = payload if raw else deserialize_message(payload, message_class)
        # Since Jazzy, the callback has the information about the message, too.
        has_info = len(inspect.signature(self._subscriber_callback).parameters) > 1
        self._subscriber_callback(message, *([{}] if has_info else []))


def printed(type_name, payload, options):
    verb = Verb()
    verb.payload = payload
    parser = argparse.ArgumentParser()
    verb.add_arguments(parser, "ros2")
    args = parser.parse_args(["/topic", type_name, *options])
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        verb.main(args=args)
    return out.getvalue()


def types():
    for package, prefix in sorted(get_packages_with_prefixes().items()):
        for path in sorted(Path(prefix, "share", package, "msg").glob("*.msg")):
            # Without an .idl file, no code was generated.
            if path.with_suffix(".idl").exists():
                yield f"{package}/msg/{path.stem}"


def main():
    part, parts = (int(argument) for argument in sys.argv[1:])
    echo.NodeStrategy = contextlib.nullcontext
    for index, type_name in enumerate(types()):
        if index % parts != part:
            continue
        message_class = get_message(type_name)
        for case in range(CASES):
            rng = random.Random(f"{type_name} {case}")
            message = message_class()
            if case > 0:
                message = message_of(rng, message_class, is_long=case == 1)
            payload = serialize_message(message)
            prints = [(options, printed(type_name, payload, options)) for options in OPTIONS]
            if case > 1:
                paths = list(fields(deserialize_message(payload, message_class)))
                for path in rng.sample(paths, min(len(paths), 6)):
                    for options in FIELD_OPTIONS:
                        options = ["--field", path, *options]
                        prints.append((options, printed(type_name, payload, options)))
            print(json.dumps({
                "type": type_name, "case": case, "payload": payload.hex(), "prints": prints}))


main()
