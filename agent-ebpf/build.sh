#!/usr/bin/env bash
# Builds the kernel filter's object from its sources, or checks that the committed one is current.
#
#   build.sh           rebuild filter.bpf.o and filter.bpf.sha256
#   build.sh --check   fail when the committed object is not what the sources give
#   build.sh --stale   fail when the sources have changed since the object was built (no toolchain)
#
# Needs nightly (or what NIGHTLY names) with rust-src, and bpf-linker: `make prerequisites` installs
# them. LLVM_PREFIX says where LLVM's tools are, if they are not where Debian puts LLVM 22 or in PATH.
set -euo pipefail
cd "$(dirname "$0")"

nightly=${NIGHTLY:-nightly}
strip=${LLVM_PREFIX:-/usr/lib/llvm-22}/bin/llvm-strip
[ -x "$strip" ] || strip=llvm-strip

sources() {
    cat Cargo.toml Cargo.lock build.sh src/*.rs ../wire/Cargo.toml \
        ../wire/src/{cursor,filter,guid,host,lib,record,time,walk}.rs
}
hash_sources() { sources | sha256sum | cut -d' ' -f1; }
# Another compiler may order instructions differently without anything being wrong.
toolchain() { echo "$(rustc "+$nightly" --version), $(bpf-linker --version)"; }

if [ "${1:-}" = --stale ]; then
    [ "$(hash_sources)" = "$(head -n 1 filter.bpf.sha256)" ] && exit 0
    echo "agent-ebpf/filter.bpf.o is older than its sources: run 'make ebpf' and commit the result" >&2
    exit 1
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
built=target/bpfel-unknown-none/release/filter
# The linker needs the debug information to write BTF; nobody needs it afterwards.
"$strip" --strip-debug "$built"

if [ "${1:-}" = --check ]; then
    ./build.sh --stale
    if [ "$(toolchain)" != "$(tail -n 1 filter.bpf.sha256)" ]; then
        echo "agent-ebpf/filter.bpf.o: sources unchanged and they build here; the bytes are not compared,"
        echo "    because it was built with $(tail -n 1 filter.bpf.sha256), here is $(toolchain)"
    elif cmp -s "$built" filter.bpf.o; then
        echo "agent-ebpf/filter.bpf.o is current"
    else
        echo "agent-ebpf/filter.bpf.o is not what its sources build: run 'make ebpf' and commit it" >&2
        exit 1
    fi
else
    cp "$built" filter.bpf.o
    { hash_sources; toolchain; } > filter.bpf.sha256
    echo "agent-ebpf/filter.bpf.o: $(stat -c %s filter.bpf.o) bytes"
fi
