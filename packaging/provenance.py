#!/usr/bin/env python3
"""Prints the provenance of a release: an in-toto statement with SLSA's predicate, version 1.

    provenance.py COMMIT DIRECTORY

It has the checksum of each file below the directory, the commit of the sources, and the versions of
the programs that made the files. The same files give the same bytes. Needs Python 3.8.
"""
import hashlib
import json
import os
import subprocess
import sys
import zlib
from pathlib import Path

from sources import REPOSITORY, ROOT


def output(*command):
    return subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout


def sha256(path):
    return {"sha256": hashlib.sha256(path.read_bytes()).hexdigest()}


def main(commit, directory):
    directory = Path(directory)
    rustc = dict(line.split(": ", 1) for line in output("rustc", "-vV").splitlines() if ": " in line)
    subjects = sorted(path for path in directory.rglob("*") if path.is_file())
    statement = {
        "_type": "https://in-toto.io/Statement/v1",
        "subject": [{"name": str(path.relative_to(directory)), "digest": sha256(path)} for path in subjects],
        "predicateType": "https://slsa.dev/provenance/v1",
        "predicate": {
            "buildDefinition": {
                "buildType": REPOSITORY + "/blob/main/docs/release.md",
                "externalParameters": {"repository": REPOSITORY, "command": "make release"},
                "internalParameters": {
                    "SOURCE_DATE_EPOCH": int(os.environ["SOURCE_DATE_EPOCH"]),
                    "programs": {
                        "cargo": output("cargo", "--version").split()[1],
                        "cargo-deb": output("cargo-deb", "--version").split()[-1],
                        "clang": output("clang", "--version").splitlines()[0],
                        "gzip": output("gzip", "--version").splitlines()[0],
                        "xz": output("xz", "--version").splitlines()[0],
                        "zlib of Python": zlib.ZLIB_RUNTIME_VERSION,
                    },
                },
                "resolvedDependencies": [
                    {"uri": f"git+{REPOSITORY}@{commit}", "digest": {"gitCommit": commit}},
                    {"name": "Cargo.lock", "digest": sha256(ROOT / "Cargo.lock")},
                    {"uri": "pkg:generic/rustc@" + rustc["release"], "digest": {"gitCommit": rustc["commit-hash"]}},
                ],
            },
            "runDetails": {"builder": {"id": os.environ.get("RELEASE_BUILDER", REPOSITORY + "/blob/main/docs/release.md")}},
        },
    }
    json.dump(statement, sys.stdout, indent=2)
    print()


main(*sys.argv[1:])
