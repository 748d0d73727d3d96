#!/usr/bin/env bash
# Makes the archive of the files that install the agent elsewhere: manifests for Kubernetes, the
# Ansible role, the compose file with its dashboards, configurations for fleets, and the action for
# pipelines. Paths within it are those of the repository.
#
#   deploy.sh DIRECTORY   write DIRECTORY/ros2probe-VERSION-deploy.tar.gz
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
# The packages for ROS have an archive of their own. The recipe of an image needs the repository.
cp --recursive deploy dashboards LICENSE-APACHE LICENSE-MIT "$private/$name"
rm -r "$private/$name"/deploy/{ros,Dockerfile,Dockerfile.dockerignore}
tar --create --directory "$private" --sort=name --mtime="@$SOURCE_DATE_EPOCH" --owner=0 --group=0 \
    --numeric-owner --mode=u=rwX,go=rX "$name" | gzip -9n >"$out/$name-deploy.tar.gz"
