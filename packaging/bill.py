#!/usr/bin/env python3
"""Prints the components of a binary of rp as a CycloneDX 1.5 bill of materials.

    bill.py ARCHITECTURE BINARY

It lists the crates along normal edges with the features of this build, the standard library, the
kernel object and the page's JavaScript libraries, but no tools of build or tests. The same sources
give the same bytes: no serial number, and the time is SOURCE_DATE_EPOCH. Needs only Python 3.8.

cargo-cyclonedx 0.5.9 is unsuitable: it adds 58 crates that are not in the binary (macros, and
features that this build does not have) and the current path, and omits the binary's checksum.
"""
import hashlib
import json
import os
import re
import subprocess
import sys
from base64 import b64decode
from datetime import datetime, timezone
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LINE = re.compile(r"^(\d+)\t(\S+) v(\S+)(?: \(([^)]*)\))?(?: \(proc-macro\))?\t(.*?)(?: \(\*\))?$")


def output(*command):
    return subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout


def sha256(path):
    return [{"alg": "SHA-256", "content": hashlib.sha256(Path(path).read_bytes()).hexdigest()}]


def checksums():
    """Returns the checksum of each crate's archive in Cargo.lock, by name and version."""
    lock = (ROOT / "Cargo.lock").read_text()
    entry = re.compile(r'name = "(.*)"\nversion = "(.*)"\nsource = ".*"\nchecksum = "(.*)"')
    return {(name, version): checksum for name, version, checksum in entry.findall(lock)}


def crates(target):
    """Returns licences and dependencies of the linked crates, by name and version."""
    tree = output("cargo", "tree", "--locked", "--package", "ros2probe", "--edges", "normal,no-proc-macro",
                "--target", target, "--prefix", "depth", "--format", "\t{p}\t{l}")
    licences, edges, path = {}, {}, []
    for line in tree.splitlines():
        depth, name, version, _, licence = LINE.match(line).groups()
        crate = (name, version)
        licences[crate] = licence
        edges.setdefault(crate, set())
        del path[int(depth):]
        if path:
            edges[path[-1]].add(crate)
        path.append(crate)
    return licences, edges


def purl(crate):
    return "pkg:cargo/%s@%s" % crate


def vendored():
    """Returns the page's libraries, with the checksums of npm's archives and of the vendored files."""
    found = {}
    for line in (ROOT / "agent/page/vendor/VERSIONS").read_text().splitlines():
        if line.startswith("#"):
            continue
        file, name, version, licence, _, _, integrity = line.split("\t")
        if file.endswith(".LICENSE"):
            continue
        reference = "pkg:npm/%s@%s" % (name, version)
        path = "agent/page/vendor/" + file
        component = found.setdefault(reference, {
            "type": "library", "bom-ref": reference, "name": name, "version": version,
            "hashes": [{"alg": "SHA-512", "content": b64decode(integrity[len("sha512-"):]).hex()}],
            "licenses": [{"expression": licence}], "purl": reference, "components": []})
        component["components"].append(
            {"type": "file", "bom-ref": path, "name": path, "hashes": sha256(ROOT / path)})
    return [found[reference] for reference in sorted(found)]


def main(architecture, binary):
    target = architecture + "-unknown-linux-musl"
    licences, edges = crates(target)
    sums = checksums()
    program = next(crate for crate in licences if crate[0] == "ros2probe")
    compiler = re.search(r"^release: (.*)$", output("rustc", "-vV"), re.M).group(1)
    components = []
    for crate in sorted(set(licences) - {program}):
        component = {"type": "library", "bom-ref": purl(crate), "name": crate[0], "version": crate[1]}
        if crate in sums:
            component["hashes"] = [{"alg": "SHA-256", "content": sums[crate]}]
        component["licenses"] = [{"expression": re.sub(r" */ *", " OR ", licences[crate])}]
        component["purl"] = purl(crate)
        components.append(component)
    standard = "pkg:generic/rust-std@%s?target=%s" % (compiler, target)
    kernel = ["agent-ebpf/filter.bpf.o", "agent-ebpf/inside.bpf.o"]
    components += [
        {"type": "library", "bom-ref": standard, "name": "rust-std", "version": compiler,
         "description": "Rust's standard library for this target, with the musl and libunwind that come with it",
         "licenses": [{"expression": "MIT OR Apache-2.0"}], "purl": standard},
    ]
    components += [
        {"type": "file", "bom-ref": name, "name": name, "hashes": sha256(ROOT / name),
         "description": "kernel programs, committed as built"}
        for name in kernel]
    page = vendored()
    components += page
    dependencies = [{"ref": purl(crate), "dependsOn": sorted(map(purl, edges[crate]))} for crate in sorted(edges)]
    for dependency in dependencies:
        if dependency["ref"] == purl(program):
            dependency["dependsOn"] = sorted(
                dependency["dependsOn"] + [standard] + kernel + [library["bom-ref"] for library in page])
    time = datetime.fromtimestamp(int(os.environ["SOURCE_DATE_EPOCH"]), timezone.utc)
    bill = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {
            "timestamp": time.strftime("%Y-%m-%dT%H:%M:%SZ"),
            "component": {
                "type": "application", "bom-ref": purl(program), "name": "rp", "version": program[1],
                "hashes": sha256(binary), "licenses": [{"expression": licences[program]}], "purl": purl(program),
                "properties": [{"name": "target", "value": target}],
            },
        },
        "components": components,
        "dependencies": dependencies,
    }
    json.dump(bill, sys.stdout, indent=2)
    print()


main(*sys.argv[1:])
