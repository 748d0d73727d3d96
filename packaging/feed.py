#!/usr/bin/env python3
"""Prints the feed of a release, which `rp upgrade --check` reads.

    feed.py VERSION COMMIT DIRECTORY

It names the version, its notes, and each file in the directory with its checksum. The same files
give the same bytes. Needs Python 3.8.
"""
import hashlib
import json
import sys
from pathlib import Path

from sources import REPOSITORY


def main(version, commit, directory):
    files = sorted(path for path in Path(directory).iterdir() if path.is_file())
    json.dump({
        "version": version,
        "commit": commit,
        "notes": f"{REPOSITORY}/releases/tag/v{version}",
        "files": {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files},
    }, sys.stdout, indent=2)
    print()


main(*sys.argv[1:])
