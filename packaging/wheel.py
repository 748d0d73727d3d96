#!/usr/bin/env python3
"""Makes a Python wheel of a Debian package, so that `pip install ros2probe` installs rp.

    wheel.py PACKAGE DIRECTORY

writes DIRECTORY/ros2probe-VERSION-py3-none-PLATFORM.whl and prints its path. The wheel contains the
binary as a script and no Python code. The binary is static, so the wheel claims both manylinux and
musllinux. The same package gives the same bytes: all times are SOURCE_DATE_EPOCH. Needs Python 3.8.
"""
import base64
import gzip
import hashlib
import os
import re
import sys
import zipfile
from datetime import datetime, timezone
from pathlib import Path

from deb import COPYRIGHT, LIBRARIES, PROGRAM, Package
from sources import LICENCE, REPOSITORY, ROOT

MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}

METADATA = """\
Metadata-Version: 2.4
Name: ros2probe
Version: {version}
Summary: {summary}
Author-email: {maintainer}
License-Expression: {licence}
License-File: LICENSE-APACHE
License-File: LICENSE-MIT
License-File: copyright
License-File: libraries.txt
Keywords: ros2,dds,rtps,zenoh,observability,ebpf,prometheus
Classifier: Environment :: Console
Classifier: Operating System :: POSIX :: Linux
Classifier: Programming Language :: Rust
Classifier: Topic :: System :: Monitoring
Project-URL: Repository, {repository}
Project-URL: Documentation, {repository}/blob/main/docs/README.md
Project-URL: Changelog, {repository}/blob/main/CHANGELOG.md
Requires-Python: >=3.8
Description-Content-Type: text/markdown

{description}"""

WHEEL = """\
Wheel-Version: 1.0
Generator: packaging/wheel.py
Root-Is-Purelib: false
"""


def description():
    """Returns the README. Its links to files of the repository are absolute."""
    def absolute(match):
        mark, text, target = match.groups()
        kind = "raw" if mark else "blob"
        return f"{mark}[{text}]({REPOSITORY}/{kind}/main/{target})"
    return re.sub(r"(!?)\[([^\]]*)\]\((?!https?:|#)([^)]*)\)", absolute, (ROOT / "README.md").read_text())


def main(package, directory):
    package = Package(package)
    machine = MACHINES[package.architecture]
    platforms = [f"manylinux_2_17_{machine}", f"manylinux2014_{machine}", f"musllinux_1_2_{machine}"]
    name = f"ros2probe-{package.version}"
    tags = "".join(f"Tag: py3-none-{platform}\n" for platform in platforms)
    metadata = METADATA.format(
        version=package.version, licence=LICENCE, repository=REPOSITORY, maintainer=package.fields["Maintainer"],
        summary=package.fields["Description"].splitlines()[0], description=description())
    files = [
        (f"{name}.data/scripts/rp", package.read(PROGRAM), 0o755),
        (f"{name}.dist-info/METADATA", metadata.encode(), 0o644),
        (f"{name}.dist-info/WHEEL", (WHEEL + tags).encode(), 0o644),
        (f"{name}.dist-info/licenses/LICENSE-APACHE", (ROOT / "LICENSE-APACHE").read_bytes(), 0o644),
        (f"{name}.dist-info/licenses/LICENSE-MIT", (ROOT / "LICENSE-MIT").read_bytes(), 0o644),
        (f"{name}.dist-info/licenses/copyright", package.read(COPYRIGHT), 0o644),
        (f"{name}.dist-info/licenses/libraries.txt", gzip.decompress(package.read(LIBRARIES)), 0o644),
    ]
    # The record lists itself without a checksum, as the specification of wheels requires.
    record = "".join(
        "%s,sha256=%s,%d\n" % (path, base64.urlsafe_b64encode(hashlib.sha256(content).digest()).decode().rstrip("="),
                               len(content))
        for path, content, _ in files) + f"{name}.dist-info/RECORD,,\n"
    files.append((f"{name}.dist-info/RECORD", record.encode(), 0o644))

    time = datetime.fromtimestamp(int(os.environ["SOURCE_DATE_EPOCH"]), timezone.utc).timetuple()[:6]
    wheel = Path(directory) / f"{name}-py3-none-{'.'.join(platforms)}.whl"
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for path, content, mode in files:
            entry = zipfile.ZipInfo(path, time)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3  # Unix, so that the mode counts.
            entry.external_attr = (0o100000 | mode) << 16
            archive.writestr(entry, content)
    print(wheel)


main(*sys.argv[1:])
