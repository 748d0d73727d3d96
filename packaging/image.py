#!/usr/bin/env python3
"""Makes an OCI image of Debian packages, one for each architecture, without a container engine.

    image.py FILE COMMIT PACKAGE...

writes FILE, a tar archive in the OCI image layout, with one index over all packages. The image has
the files of the package that every form of rp contains. It has no shell, and its user is not root.
The capabilities of the binary are those that the unit grants: a container's user other than root
gets none otherwise. The same packages give the same bytes: all times are SOURCE_DATE_EPOCH. Needs
Python 3.8.
"""
import gzip
import hashlib
import io
import json
import os
import re
import struct
import sys
import tarfile
from datetime import datetime, timezone
from pathlib import Path

from deb import CONFIGURATION, COPYRIGHT, LIBRARIES, PROGRAM, Package
from sources import LICENCE, REPOSITORY, ROOT

TIME = int(os.environ["SOURCE_DATE_EPOCH"])
CREATED = datetime.fromtimestamp(TIME, timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")
USER = 65532
# Numbers of capabilities in linux/capability.h.
CAPABILITIES = {"CAP_NET_ADMIN": 12, "CAP_NET_RAW": 13, "CAP_PERFMON": 38, "CAP_BPF": 39}
VERSION_2 = 0x02000000
OCI = "application/vnd.oci.image."


def capabilities():
    """Returns security.capability (struct vfs_cap_data, version 2), with the capabilities of both sources.

    They are the unit's, for the host's sockets, and CAP_NET_RAW for interfaces. They are permitted and not effective: otherwise the kernel refuses to start the program where a
    container grants fewer. The program makes them effective itself.
    """
    unit = (ROOT / "systemd/ros2probe.service").read_text()
    names = re.search(r"^CapabilityBoundingSet=(.*)$", unit, re.M).group(1).split()
    permitted = sum(1 << CAPABILITIES[name] for name in {*names, "CAP_NET_RAW"})
    return struct.pack("<5I", VERSION_2, permitted & 0xFFFFFFFF, 0, permitted >> 32, 0)


def archive(entries):
    """Returns a tar archive of (path, content or None for a directory, mode, owner, attributes)."""
    bytes_ = io.BytesIO()
    with tarfile.open(fileobj=bytes_, mode="w", format=tarfile.PAX_FORMAT) as tar:
        for path, content, mode, owner, attributes in entries:
            entry = tarfile.TarInfo(path)
            entry.mode, entry.mtime, entry.uid, entry.gid = mode, TIME, owner, owner
            # Bytes of a value that are not UTF-8: tarfile marks the header as binary.
            entry.pax_headers = {
                f"SCHILY.xattr.{name}": value.decode("utf-8", "surrogateescape") for name, value in attributes.items()}
            if content is None:
                entry.type = tarfile.DIRTYPE
                tar.addfile(entry)
            else:
                entry.size = len(content)
                tar.addfile(entry, io.BytesIO(content))
    return bytes_.getvalue()


def layer(package):
    """Returns the image's only layer."""
    files = {path: package.read(path) for path in (PROGRAM, CONFIGURATION, COPYRIGHT, LIBRARIES)}
    own = ["var/lib/ros2probe", "run/ros2probe"]
    directories = {str(parent) for path in [*files, *own] for parent in Path(path).parents if str(parent) != "."}
    entries = [(path, None, 0o755, 0, {}) for path in directories]
    entries += [(path, None, 0o770, USER, {}) for path in own]
    for path, content in files.items():
        program = path == PROGRAM
        attributes = {"security.capability": capabilities()} if program else {}
        entries.append((path, content, 0o755 if program else 0o644, 0, attributes))
    return archive(sorted(entries))


class Layout:
    """The blobs of an OCI image layout, named by their checksums."""

    def __init__(self):
        self.blobs = {}

    def add(self, content, media_type, **more):
        """Adds a blob and returns its descriptor. Values other than bytes become JSON."""
        if not isinstance(content, bytes):
            content = json.dumps(content, separators=(",", ":"), sort_keys=True).encode()
        digest = hashlib.sha256(content).hexdigest()
        self.blobs[digest] = content
        return {"mediaType": media_type, "digest": "sha256:" + digest, "size": len(content), **more}

    def write(self, path, index):
        """Writes the layout as a tar archive with this descriptor in its index."""
        files = {"blobs/sha256/" + digest: content for digest, content in self.blobs.items()}
        files["oci-layout"] = json.dumps({"imageLayoutVersion": "1.0.0"}).encode()
        files["index.json"] = json.dumps(
            {"schemaVersion": 2, "mediaType": OCI + "index.v1+json", "manifests": [index]}).encode()
        entries = [(name, None, 0o755, 0, {}) for name in ("blobs", "blobs/sha256")]
        entries += [(name, content, 0o644, 0, {}) for name, content in files.items()]
        Path(path).write_bytes(archive(sorted(entries)))


def manifest(layout, package, annotations):
    """Adds the image of one architecture, and returns the descriptor of its manifest."""
    content = layer(package)
    platform = {"architecture": package.architecture, "os": "linux"}
    if package.architecture == "arm64":
        platform["variant"] = "v8"
    config = {
        **platform, "created": CREATED,
        "config": {
            "User": f"{USER}:{USER}", "Entrypoint": ["/usr/bin/rp"],
            "Cmd": ["run", "--config", "/etc/ros2probe/ros2probe.yaml"],
            "Env": ["PATH=/usr/bin", "container=oci"], "WorkingDir": "/", "Labels": annotations,
        },
        "rootfs": {"type": "layers", "diff_ids": ["sha256:" + hashlib.sha256(content).hexdigest()]},
        "history": [{"created": CREATED, "created_by": "packaging/image.py"}],
    }
    image = {
        "schemaVersion": 2, "mediaType": OCI + "manifest.v1+json", "annotations": annotations,
        "config": layout.add(config, OCI + "config.v1+json"),
        "layers": [layout.add(gzip.compress(content, 9, mtime=0), OCI + "layer.v1.tar+gzip")],
    }
    return layout.add(image, image["mediaType"], platform=platform)


def main(path, commit, *packages):
    packages = [Package(package) for package in sorted(packages)]
    version = packages[0].version
    annotations = {
        "org.opencontainers.image." + name: value
        for name, value in {
            "created": CREATED, "description": packages[0].fields["Description"].splitlines()[0],
            "documentation": REPOSITORY + "/blob/main/docs/containers.md", "licenses": LICENCE,
            "revision": commit, "source": REPOSITORY, "title": "ros2probe", "version": version,
        }.items()}
    layout = Layout()
    index = {
        "schemaVersion": 2, "mediaType": OCI + "index.v1+json", "annotations": annotations,
        "manifests": [manifest(layout, package, annotations) for package in packages],
    }
    # podman names the loaded image after this annotation.
    name = {"org.opencontainers.image.ref.name": f"ros2probe:{version}"}
    layout.write(path, layout.add(index, index["mediaType"], annotations=name))


main(*sys.argv[1:])
