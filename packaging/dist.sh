#!/usr/bin/env bash
# Builds a release in target/dist: static binaries for x86_64 and aarch64, man pages, completions,
# packages, a bill of materials for each binary, and checksums of all files.
#
#   packaging/dist.sh           build and check
#   packaging/dist.sh --again   build a second time in another directory, sharing only the toolchain
#                               and the crates with this machine, and compare the checksums
#
# The bytes depend only on the sources, Cargo.lock and the version of rustc: not on the directory,
# user, time, or other installed software. Needs the tools that `.ci/prerequisites.sh dist` installs.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd -P)
cd "$root"

step() { printf '\n== %s\n' "$*" >&2; }
die() {
    printf 'dist: %s\n' "$*" >&2
    exit 1
}

# The builder's settings must not change the result.
for variable in $(compgen -e); do
    case $variable in
    CARGO_TARGET_DIR | CARGO_BUILD_JOBS) ;;
    RUSTFLAGS | CARGO_ENCODED_RUSTFLAGS | CARGO_PROFILE_* | CARGO_BUILD_* | CARGO_TARGET_* | CARGO_INCREMENTAL)
        unset "$variable"
        ;;
    esac
done
export CC_x86_64_unknown_linux_musl=clang CC_aarch64_unknown_linux_musl=clang
export CARGO_INCREMENTAL=0 LC_ALL=C TZ=UTC
umask 022

target=$(realpath -m "${CARGO_TARGET_DIR:-target}")
out=$target/dist
version=$(sed -n '/^\[workspace.package\]/,/^\[/s/^version = "\(.*\)"/\1/p' Cargo.toml)
architectures="x86_64 aarch64"

# Time of the latest change of the sources, for files that contain a time.
source_date() {
    git log -1 --format=%ct 2>/dev/null && return
    local date
    date=$(sed -n 's/^## .* - \([0-9-]*\)$/\1/p' CHANGELOG.md | head -1)
    date --date="${date:-2026-01-01}" +%s
}
SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(source_date)}
export SOURCE_DATE_EPOCH

# Panic messages contain paths: remap them to the same names everywhere.
flags() {
    local sysroot commit registry
    sysroot=$(rustc --print sysroot)
    commit=$(rustc -vV | sed -n 's/^commit-hash: //p')
    printf '%s\n' "-Clinker=rust-lld" \
        "--remap-path-prefix=$root=/ros2probe" "--remap-path-prefix=$target=/ros2probe/target" \
        "--remap-path-prefix=$sysroot/lib/rustlib/src/rust=/rustc/$commit"
    # A name that begins with a dash is of a registry that `cargo package` makes for itself. Another
    # set of flags would compile all crates again.
    for registry in "${CARGO_HOME:-$HOME/.cargo}"/registry/src/[!-]*/; do
        printf '%s\n' "--remap-path-prefix=${registry%/}=/crates"
    done
}

binaries() {
    local architecture started=$SECONDS targets=()
    for architecture in $architectures; do targets+=(--target "$architecture-unknown-linux-musl"); done
    CARGO_ENCODED_RUSTFLAGS=$(flags | paste -sd $'\x1f') \
        cargo build --locked --release --package ros2probe --bin rp "${targets[@]}"
    printf 'took %s s\n' $((SECONDS - started)) >&2
    for architecture in $architectures; do
        install -m 755 "$target/$architecture-unknown-linux-musl/release/rp" "$out/rp-$version-$architecture"
    done
}

# Builds a copy of the sources without their history, with a separate CARGO_HOME.
again() {
    local copy there
    [ -f "$out/SHA256SUMS" ] || die "$out/SHA256SUMS is missing: run this without --again first"
    copy=$(mktemp -d)
    # shellcheck disable=SC2064
    trap "rm -rf '$copy'" EXIT
    there=$copy/elsewhere/with-another-name
    mkdir -p "$there" "$copy/cargo"
    git ls-files -z --cached --others --exclude-standard | tar -c --null --files-from=- | tar -x -C "$there"
    # The sources of crates are a setting of the user.
    cp "${CARGO_HOME:-$HOME/.cargo}"/config* "$copy/cargo" 2>/dev/null || true
    step "building again in $there"
    env -u CARGO_TARGET_DIR CARGO_HOME="$copy/cargo" RUSTUP_HOME="${RUSTUP_HOME:-$HOME/.rustup}" \
        SOURCE_DATE_EPOCH="$SOURCE_DATE_EPOCH" "$there/packaging/dist.sh"
    step "comparing both builds"
    diff "$out/SHA256SUMS" "$there/target/dist/SHA256SUMS" || die "the two builds differ"
    sha256sum "$out/SHA256SUMS" "$there/target/dist/SHA256SUMS"
}

release() {
    step "building ros2probe $version with $(rustc --version), sources of $(date --date="@$SOURCE_DATE_EPOCH" +%F)"
    local native debian architecture
    rm -rf "$out"
    mkdir -p "$out"
    cargo fetch --locked --quiet

    step "release binaries for: $architectures (static, musl, linked by rust-lld)"
    binaries

    step "manual pages and completions"
    native=$out/rp-$version-$(uname -m)
    mkdir "$out/man" "$out/completions"
    "$native" man "$out/man"
    "$native" completions bash >"$out/completions/rp.bash"
    "$native" completions zsh >"$out/completions/_rp"
    "$native" completions fish >"$out/completions/rp.fish"

    step "Debian packages"
    for architecture in $architectures; do
        case $architecture in
        x86_64) debian=amd64 ;;
        aarch64) debian=arm64 ;;
        esac
        RP=$native packaging/build.sh "$debian" "$out/rp-$version-$architecture" "$out"
    done

    step "bills of materials"
    for architecture in $architectures; do
        packaging/bill.py "$architecture" "$out/rp-$version-$architecture" >"$out/rp-$version-$architecture.cdx.json"
    done

    step "checksums"
    (cd "$out" && find . -type f ! -name SHA256SUMS -printf '%P\n' | sort | xargs sha256sum >SHA256SUMS)
    find "$out" -maxdepth 1 -type f -printf '%10s %f\n' | sort -k2 >&2
}

# bash reads this line to its end before it runs: the file may change during the build.
case ${1-} in
'') release ;;
--again) again ;;
*) die "usage: packaging/dist.sh [--again]" ;;
esac; exit
