#!/usr/bin/env bash
# Makes the source archive of the packages for ROS, with the checksums of the wheels that the package
# ros2probe downloads.
#
#   ros.sh DIRECTORY   write DIRECTORY/ros2probe-VERSION-ros.tar.gz for the wheels in DIRECTORY
#
# All times are SOURCE_DATE_EPOCH.
set -euo pipefail
out=$(realpath "$1")
cd "$(dirname "$0")/.."
export LC_ALL=C TZ=UTC
version=$(sed -n '/^\[workspace.package\]/,/^\[/s/^version = "\(.*\)"/\1/p' Cargo.toml)
name=ros2probe-$version
private=$(mktemp -d)
trap 'rm -rf "$private"' EXIT

mkdir "$private/$name"
# Licences and the configuration are links to files of the repository.
cp --recursive --dereference deploy/ros/ros2probe deploy/ros/ros2probe_cli "$private/$name"
find "$private" -name __pycache__ -prune -exec rm -r {} +
(cd "$out" && sha256sum "$name"-*.whl) >"$private/$name/ros2probe/wheels.sha256"
tar --create --directory "$private" --sort=name --mtime="@$SOURCE_DATE_EPOCH" --owner=0 --group=0 \
    --numeric-owner --mode=u=rwX,go=rX "$name" | gzip -9n >"$out/$name-ros.tar.gz"
