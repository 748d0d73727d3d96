#!/usr/bin/env bash
# Builds the objects with the kernel programs, or checks that the committed ones are current.
#
#   build.sh           rebuild each object (OBJECT.bpf.o) and its list (OBJECT.bpf.sha256)
#   build.sh --check   fail if the sources do not build the committed objects
#   build.sh --stale   fail if a source has changed since an object was built (no toolchain)
#
# A list names the toolchain and every file that the compiler read, with its checksum.
#
# Needs bpf-linker and nightly (or the toolchain in NIGHTLY) with rust-src: `make prerequisites`
# installs them. LLVM_PREFIX names the directory of LLVM's tools, unless they are in PATH or where
# Debian installs LLVM 22.
set -euo pipefail
cd "$(dirname "$0")"

objects="filter inside"
nightly=${NIGHTLY:-nightly}
strip=${LLVM_PREFIX:-/usr/lib/llvm-22}/bin/llvm-strip
[ -x "$strip" ] || strip=llvm-strip

if [ "${1:-}" = --stale ]; then
    for object in $objects; do
        sha256sum --check --quiet --strict "$object.bpf.sha256" && continue
        echo "agent-ebpf/$object.bpf.o is older than its sources: run 'make ebpf' and commit it" >&2
        exit 1
    done
    exit 0
fi

separator=$'\x1f'
flags="--cfg=bpf_target_arch=\"x86_64\"${separator}-Cdebuginfo=2${separator}-Clink-arg=--btf"
flags+="${separator}--remap-path-prefix=$(cd .. && pwd)=/ros2probe"
flags+="${separator}--remap-path-prefix=${CARGO_HOME:-$HOME/.cargo}=/cargo"
for registry in "${CARGO_HOME:-$HOME/.cargo}"/registry/src/*; do
    flags+="${separator}--remap-path-prefix=$registry=/cargo"
done
flags+="${separator}--remap-path-prefix=$(rustc "+$nightly" --print sysroot)=/rust"
CARGO_ENCODED_RUSTFLAGS="$flags" cargo "+$nightly" build --quiet --release --locked \
    --target bpfel-unknown-none -Z build-std=core
# Cargo's dep-info names the compiled files; each file's manifest is the nearest one above it.
sources() {
    local file directory
    echo build.sh
    echo Cargo.lock
    sed 's/^[^:]*: //; s/\([^\\]\) /\1\n/g; s/\\ / /g' "$built.d" | while read -r file; do
        realpath --relative-to=. "$file"
        directory=$(dirname "$file")
        until [ -e "$directory/Cargo.toml" ]; do directory=$(dirname "$directory"); done
        realpath --relative-to=. "$directory/Cargo.toml"
    done
}
# Another compiler may order instructions differently in a correct object.
toolchain() { echo "# $(rustc "+$nightly" --version), $(bpf-linker --version)"; }
list() {
    toolchain
    sources | LC_ALL=C sort -u | xargs -d '\n' sha256sum
}

for object in $objects; do
    built=target/bpfel-unknown-none/release/$object
    committed=$object.bpf
    # The linker needs the debug information to write BTF; the object does not contain it.
    "$strip" --strip-debug "$built"
    if [ "${1:-}" = --check ]; then
        if [ "$(toolchain)" != "$(head -n 1 "$committed.sha256")" ]; then
            ./build.sh --stale
            echo "agent-ebpf/$committed.o: sources unchanged and they build here; the bytes are not compared,"
            echo "    because another toolchain built it: $(head -n 1 "$committed.sha256"), here $(toolchain)"
        elif ! cmp -s "$built" "$committed.o"; then
            echo "agent-ebpf/$committed.o does not match its sources: run 'make ebpf' and commit it" >&2
            exit 1
        elif ! list | cmp -s - "$committed.sha256"; then
            echo "agent-ebpf/$committed.o is current; its list of sources is not ('make ebpf' renews it)"
        else
            echo "agent-ebpf/$committed.o is current"
        fi
    else
        # A mangled name contains a hash of the checkout's path: another checkout builds other bytes.
        if grep --text -oE '_R(N|I|Y)[A-Za-z0-9_]+' "$built"; then
            echo "agent-ebpf: the names above, in $object, depend on the checkout's path:" \
                "inline these functions, or give each an export_name" >&2
            exit 1
        fi
        cp "$built" "$committed.o"
        list > "$committed.sha256"
        echo "agent-ebpf/$committed.o: $(stat -c %s "$committed.o") bytes"
    fi
done
