#!/usr/bin/env bash
# Builds the Debian package of one binary. The same binary and sources give the same bytes.
#
#   packaging/build.sh amd64|arm64 BINARY DIRECTORY [OPTION OF cargo-deb...]
#
# writes DIRECTORY/ros2probe_VERSION_ARCHITECTURE.deb. The binary generates manual pages and
# completions; if it cannot run here, RP names a binary of the same sources that can. The content of
# the package is listed in agent/cli/Cargo.toml, [package.metadata.deb].
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)

die() {
    printf 'build.sh: %s\n' "$*" >&2
    exit 1
}

[ $# -ge 3 ] || die "usage: build.sh amd64|arm64 BINARY DIRECTORY [OPTION OF cargo-deb...]"
case $1 in
amd64) target=x86_64-unknown-linux-musl ;;
arm64) target=aarch64-unknown-linux-musl ;;
*) die "$1 is neither amd64 nor arm64" ;;
esac
architecture=$1 binary=$2
mkdir -p "$3"
directory=$(cd "$3" && pwd)
shift 3
[ -f "$binary" ] || die "$binary does not exist: build it first"
rp=$(realpath "${RP:-$binary}")
command -v cargo-deb >/dev/null || die "cargo-deb is missing: cargo install cargo-deb --locked"

version=$(sed -n '/^\[workspace.package\]/,/^$/s/^version = "\(.*\)"/\1/p' "$root/Cargo.toml")
# Time of the latest commit; in an unpacked archive without git, of the changelog.
export SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git -C "$root" log -1 --format=%ct 2>/dev/null ||
    stat -c %Y "$root/CHANGELOG.md")}
export LC_ALL=C TZ=UTC
umask 022

# cargo-deb expects the binaries in this place, where cargo would put them.
stage=$(mktemp -d)
trap 'rm -rf "$stage"' EXIT
built=$stage/$target/release
parts=$built/package
mkdir -p "$parts/man" "$parts/pages"
cp "$binary" "$built/rp"
chmod 755 "$built/rp"

"$rp" man "$parts/man"
gzip -9n "$parts"/man/*
for shell in bash zsh fish; do "$rp" completions "$shell" >"$parts/rp.$shell"; done
sed '1s|\$schema=|&/usr/share/ros2probe/|' "$root/config/ros2probe.yaml" >"$parts/ros2probe.yaml"
mkdir -p "$parts/pages/docs"
cp "$root/README.md" "$root/SECURITY.md" "$parts/pages"
cp "$root"/docs/*.md "$parts/pages/docs"
gzip -9n <"$root/CHANGELOG.md" >"$parts/CHANGELOG.md.gz"
cat >"$parts/changelog" <<END
ros2probe ($version) stable; urgency=medium

  * See CHANGELOG.md.gz.

 -- The ros2probe contributors <ros2probe@users.noreply.github.com>  $(date -R -d "@$SOURCE_DATE_EPOCH")
END
gzip -9n "$parts/changelog"

# Lists the linked libraries with their licences; each licence text is included once.
libraries() {
    local sources=${CARGO_HOME:-$HOME/.cargo}/registry/src name number licence file sum
    declare -A library users texts
    local files=() sums=()
    printf 'Libraries that are linked into rp %s, and their licences\n\n' "$version"
    while read -r name number licence; do
        number=${number#v}
        printf '%s %s: %s\n' "$name" "$number" "$licence"
        for file in "$sources"/*/"$name-$number"/{LICEN[CS]E,COPYING,COPYRIGHT,NOTICE}*; do
            [ -f "$file" ] || continue
            files+=("$file")
            library[$file]=$name
        done
    done < <(cd "$root" && cargo tree --locked --package ros2probe --edges normal --target "$target" \
        --prefix none --format '{p} {l}' | sed 's| (\*)$||; s| ([^)]*)||g' | grep -v '^ros2probe' | sort -u)
    while read -r sum file; do
        [ -n "${texts[$sum]-}" ] || sums+=("$sum")
        texts[$sum]=$file
        name=${library[$file]}
        case " ${users[$sum]-} " in
        *" $name "*) ;;
        *) users[$sum]="${users[$sum]-}${users[$sum]+ }$name" ;;
        esac
    done < <(sha256sum "${files[@]}")
    for sum in "${sums[@]}"; do
        printf '\n\n==== %s\n\n' "${users[$sum]}"
        cat "${texts[$sum]}"
    done
}
libraries | gzip -9n >"$parts/libraries.gz"

package=$directory/ros2probe_${version}_$architecture.deb
cd "$root/agent/cli"
CARGO_TARGET_DIR=$stage cargo deb --quiet --locked --no-build --no-strip --no-dbgsym --compress-system \
    --target "$target" --deb-version "$version" --output "$package" "$@" >/dev/null
printf '%s\n' "$package"
