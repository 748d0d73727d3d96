"""A ROS 2 publisher, subscriber or router over Zenoh, announced as rmw_zenoh does.

    peer.py --role router [--connect ENDPOINT]...
    peer.py --role pub|sub [--topic /t] [--size BYTES] [--rate HZ] [--count N] [--depth N] ...

The command line and the log of `pub` and `sub` equal those of the DDS peers (../peer.hpp). Options
that only DDS has are accepted and ignored. Each node is a separate session, which connects to the
router of its host, and directly to the other sessions there. A busy machine makes Zenoh drop
messages before they are sent, except with `--reliable`. `--linger` keeps a publisher running after
its last message. With `--buffers` it announces backends of buffers, and uses further keys, as
rmw_zenoh of Lyrical does.
"""

import argparse
import json
import os
import select
import signal
import struct
import sys
import threading
import time
import traceback

import xxhash
import zenoh

TYPE = "std_msgs::msg::dds_::UInt8MultiArray_/TypeHashNotSupported"
# Bytes of the encapsulation, the layout without dimensions, and the length of the data.
OVERHEAD = 16
ROUTER = "tcp/localhost:7447"

# The last chunk of a token.
BACKENDS = {"cpu": ["backends:cpu:"], "cuda": ["backends:cuda:device=0;cpu:"]}

stopped = threading.Event()


def options():
    parser = argparse.ArgumentParser()
    parser.add_argument("--role", choices=["pub", "sub", "router"], required=True)
    parser.add_argument("--connect", action="append", default=[])
    parser.add_argument("--topic", default="/points")
    parser.add_argument("--size", type=int, default=320)
    parser.add_argument("--rate", type=float, default=20.0)
    parser.add_argument("--count", type=int, default=0)
    parser.add_argument("--depth", type=int, default=10)
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--peers", type=int, default=1)
    parser.add_argument("--stretch", type=int, default=0)
    parser.add_argument("--linger", type=float, default=1.0)
    parser.add_argument("--node", action="append", default=[])
    parser.add_argument("--log")
    parser.add_argument("--hold", action="store_true")
    parser.add_argument("--reliable", action="store_true")
    parser.add_argument("--best-effort", action="store_true")
    parser.add_argument("--receive-buffer", type=int)
    parser.add_argument("--buffers", choices=["cpu", "cuda"])
    return parser.parse_args()


def config(mode, listen, connect):
    """Returns the settings in which the default files of rmw_zenoh differ from Zenoh's own."""
    settings = {
        "mode": mode,
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {
            "period_init_ms": 1000,
            "period_max_ms": 4000,
            "period_increase_factor": 2,
        },
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": 60000,
        "transport/link/tx/keep_alive": 2,
    }
    if mode == "peer":
        target = {"router": ["router", "peer"], "peer": ["router"]}
        settings["scouting/gossip/target"] = target
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def gid_of(token):
    hash = xxhash.xxh3_128_intdigest(token.encode())
    return struct.pack("<QQ", hash & (1 << 64) - 1, hash >> 64)


def say(line):
    print(line, flush=True)


class Log:
    def __init__(self, path):
        self.file = open(path, "w", buffering=1) if path else None
        self.write(ev="start", stack="zenoh", pid=os.getpid())

    def write(self, **event):
        if self.file:
            self.file.write(json.dumps({"t": time.time_ns(), **event}) + "\n")


def wait_for_line():
    while not stopped.is_set():
        if select.select([sys.stdin], [], [], 0.05)[0]:
            # Reads one line without a buffer, so that `select` sees the next line.
            while (byte := os.read(0, 1)) != b"\n":
                if not byte:
                    sys.exit("standard input ended before the start")
            return


def sleep_until(due):
    while not stopped.is_set() and (left := due - time.monotonic()) > 0:
        time.sleep(min(left, 0.05))


class Session:
    """The session of one process, with its nodes."""

    def __init__(self, options):
        self.options = options
        self.session = zenoh.open(config("peer", ["tcp/localhost:0"], [ROUTER]))
        self.zid = str(self.session.zid())
        self.tokens = []
        self.others = set()

    def token(self, *chunks):
        return "/".join(["@ros2_lv", str(self.options.domain), self.zid, *chunks])

    def nodes(self, kind):
        """Returns the names of the nodes, and for each the last chunks of its token."""
        names = self.options.node or ["/publisher" if kind == "MP" else "/subscriber"]
        for name in names:
            namespace, _, base = name.rpartition("/")
            yield ["%", namespace.replace("/", "%") or "%", base]

    def endpoint(self, kind):
        """Returns the token of the endpoint, which the first node has."""
        where = next(self.nodes(kind))
        qos = f"::,{self.options.depth}:,:,:,,"
        topic = self.options.topic.replace("/", "%")
        backends = BACKENDS.get(self.options.buffers, [])
        return self.token("0", "10", kind, *where, topic, *TYPE.split("/"), qos, *backends)

    def announce(self, kind):
        """Announces the nodes. Returns the GID of the endpoint, which the first node has."""
        key = self.endpoint(kind)
        tokens = [self.token(str(n), str(n), "NN", *where) for n, where in enumerate(self.nodes(kind))]
        for token in [tokens[0], key, *tokens[1:]]:
            self.tokens.append(self.session.liveliness().declare_token(token))
        other = "MS" if kind == "MP" else "MP"
        pattern = f"@ros2_lv/{self.options.domain}/*/*/*/{other}/**"
        topic = f"/{self.options.topic.replace('/', '%')}/"

        def seen(sample):
            key = str(sample.key_expr)
            if topic in key:
                is_put = sample.kind == zenoh.SampleKind.PUT
                (self.others.add if is_put else self.others.discard)(key)

        self.tokens.append(self.session.liveliness().declare_subscriber(pattern, seen, history=True))
        return gid_of(key)

    def key(self):
        return f"{self.options.domain}{self.options.topic}/{TYPE}"

    def keys_of_message(self):
        """Returns the key of each sample for the next message, and whether it is the message."""
        base = self.key()
        tokens = list(self.others)
        if not self.options.buffers or any("/backends:" not in token for token in tokens):
            return [(base, True)]
        accelerated = sorted(token for token in tokens if "cuda" in token)
        keys = [(f"{base}/_buf/{gid_of(token).hex()}", False) for token in accelerated]
        if len(accelerated) < len(tokens):
            keys.insert(0, (f"{base}/_buf_cpu", True))
        return keys

    def wait_matched(self):
        while not stopped.is_set() and len(self.others) < self.options.peers:
            time.sleep(0.01)
        say("matched")


def publish(options, log):
    session = Session(options)
    publishers = {}
    control = zenoh.CongestionControl

    def publisher(key):
        if key not in publishers:
            publishers[key] = session.session.declare_publisher(
                key,
                congestion_control=control.BLOCK if options.reliable else control.DROP,
                reliability=zenoh.Reliability.RELIABLE,
            )
        return publishers[key]

    publisher(session.key())
    gid = session.announce("MP")
    say("ready")
    session.wait_matched()
    if options.hold:
        wait_for_line()
    start, first, number, samples = time.monotonic(), 0, 0, 0
    data = bytearray(options.size - OVERHEAD)
    header = struct.pack("<BBBBIII", 0, 1, 0, 0, 0, 0, len(data))
    while not stopped.is_set() and (options.count == 0 or number < options.count):
        if options.stretch and number == first + options.stretch:
            wait_for_line()
            start, first = time.monotonic(), number
        sleep_until(start + (number - first) / options.rate)
        if stopped.is_set():
            break
        now = time.time_ns()
        data[:16] = struct.pack("<Qq", number, now)
        for key, is_message in session.keys_of_message():
            samples += 1
            attachment = struct.pack("<qqB", samples, now, 16) + gid
            payload = header + bytes(data if is_message else data[:16])
            publisher(key).put(payload, attachment=attachment)
        log.write(ev="pub", seq=number, len=options.size)
        number += 1
    log.write(ev="stop")
    say("done")
    sleep_until(time.monotonic() + options.linger)


def subscribe(options, log):
    session = Session(options)

    def receive(sample):
        payload = bytes(sample.payload)
        number, stamp = struct.unpack_from("<Qq", payload, OVERHEAD)
        log.write(ev="sub", seq=number, len=len(payload), stamp_ns=stamp)

    keys = [session.key()]
    if options.buffers == "cpu":
        keys.append(f"{session.key()}/_buf_cpu")
    elif options.buffers:
        keys.append(f"{session.key()}/_buf/{gid_of(session.endpoint('MS')).hex()}")
    kept = [session.session.declare_subscriber(key, receive) for key in keys]
    session.announce("MS")
    say("ready")
    session.wait_matched()
    stopped.wait()
    for each in kept:
        each.undeclare()


def route(options):
    router = zenoh.open(config("router", ["tcp/[::]:7447"], options.connect))
    say("ready")
    stopped.wait()
    router.close()


def main():
    for number in [signal.SIGINT, signal.SIGTERM]:
        signal.signal(number, lambda *_: stopped.set())
    selected = options()
    status = 1
    try:
        if selected.role == "router":
            route(selected)
        else:
            act = publish if selected.role == "pub" else subscribe
            act(selected, Log(selected.log))
        status = 0
    except Exception:
        traceback.print_exc()
    # Threads of Zenoh do not delay the end.
    os._exit(status)


main()
