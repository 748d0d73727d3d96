#!/usr/bin/env bash
# Boots whole systems under qemu, installs the package in each as docs/install.md says, and checks it
# beside a small robot. Prints one table; logs and tables stay in target/vm.
#
#   packaging/vm.sh [--disks] [SYSTEM...]   the systems of the table below; all without an argument.
#                                           --disks only builds the disks.
#
# Needs root, the packages of `make dist`, and the tools that `.ci/prerequisites.sh vm` installs. Root
# file systems come from Debian's packages and are kept in target/vm. Guests have no network. While it
# builds for another architecture, binfmt_misc runs that architecture's programs with qemu.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd -P)
cd "$root"
target=$(realpath -m "${CARGO_TARGET_DIR:-target}")
out=$target/vm
# Seconds that a guest may take.
patience=${VM_SECONDS:-1800}

# name, architecture, suite and meta package of the kernel, expected source, kernel options
systems() {
    cat <<'END'
arm64-5.10 arm64 bullseye linux-image-arm64 host
arm64-5.10-cgroup1 arm64 bullseye linux-image-arm64 wire systemd.unified_cgroup_hierarchy=0
arm64-6.1 arm64 bookworm linux-image-arm64 host
arm64-6.1-rt arm64 bookworm linux-image-rt-arm64 host
arm64-6.12 arm64 trixie linux-image-arm64 host
arm64-6.12-16k arm64 trixie linux-image-arm64-16k host
amd64-5.10 amd64 bullseye linux-image-amd64 host
amd64-6.1 amd64 bookworm linux-image-amd64 host
amd64-6.1-rt amd64 bookworm linux-image-rt-amd64 host
amd64-6.12 amd64 trixie linux-image-amd64 host
END
}
packages=systemd,systemd-sysv,dbus,udev,adduser,iproute2,nftables,curl,kmod,initramfs-tools,rt-tests,procps

step() { printf '\n== %s\n' "$*" >&2; }
die() {
    printf 'vm: %s\n' "$*" >&2
    exit 1
}

machine() { case $1 in arm64) echo aarch64 ;; amd64) echo x86_64 ;; esac; }
native() { [ "$(dpkg --print-architecture)" = "$1" ]; }

cleanup=()
finish() {
    local command
    for command in "${cleanup[@]}"; do eval "$command"; done
}
trap finish EXIT

# Debian's mirror in the sources of this machine.
mirror() {
    # shellcheck disable=SC2016
    apt-get indextargets --format '$(SITE) $(ORIGIN)' | awk '$2 == "Debian" { print $1; exit }'
}

# Lets this kernel run programs of the architecture, until the end of the script.
emulate() {
    local registry=/proc/sys/fs/binfmt_misc
    native "$1" && return
    [ -e $registry/register ] || mount -t binfmt_misc none $registry
    [ -e "$registry/qemu-$(machine "$1")" ] && return
    [ "$1" = arm64 ] || die "cannot build $1 on $(dpkg --print-architecture)"
    # The magic number of an ELF program for AArch64. F opens the emulator now: also for a chroot.
    printf '%s' ':qemu-aarch64:M::\x7fELF\x02\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x02\x00\xb7\x00:\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff:'"$(command -v qemu-aarch64-static)"':F' >$registry/register
    cleanup+=("echo -1 >$registry/qemu-aarch64")
}

# base ARCHITECTURE: Debian 12 without a kernel, as an archive.
base() {
    local archive=$out/base-$1.tar
    [ -f "$archive" ] && return
    step "root file system for $1 (kept in $archive)"
    mmdebstrap --quiet --format=tar --mode=root --architectures="$1" --variant=minbase --include=$packages \
        bookworm "$archive.part" "deb $(mirror) bookworm main"
    mv "$archive.part" "$archive"
}

# kernel ARCHITECTURE SUITE PACKAGE: downloads the kernel of a meta package and prints its file.
kernel() {
    local place=$out/kernels/$2-$1 name file
    mkdir -p "$place"/{lists,archives}/partial
    echo "deb $(mirror) $2 main" >"$place/sources.list"
    cat >"$place/apt.conf" <<END
Dir::State::lists "$place/lists";
Dir::State::status "/dev/null";
Dir::Cache::archives "$place/archives";
Dir::Cache::pkgcache "";
Dir::Cache::srcpkgcache "";
Dir::Etc::sourcelist "$place/sources.list";
Dir::Etc::sourceparts "$place/none";
APT::Architecture "$1";
APT::Architectures { "$1"; };
APT::Sandbox::User "root";
END
    export APT_CONFIG=$place/apt.conf
    apt-get update -qq
    name=$(apt-cache show "$3" | sed -n 's/^Depends: *\(linux-image-[^ ,]*\).*/\1/p' | head -1)
    [ -n "$name" ] || die "$2 has no $3 for $1"
    file=$(find "$place" -maxdepth 1 -name "${name}_*.deb" | head -1)
    if [ -z "$file" ]; then
        (cd "$place" && apt-get download -qq "$name")
        file=$(find "$place" -maxdepth 1 -name "${name}_*.deb" | head -1)
    fi
    unset APT_CONFIG
    echo "$file"
}

# disk NAME ARCHITECTURE SUITE PACKAGE: a disk with its kernel and initial file system beside it.
disk() {
    local place=$out/$1 tree file release
    file=$(kernel "$2" "$3" "$4")
    [ "$(cat "$place/kernel" 2>/dev/null)" = "$file" ] && return
    step "disk of $1 with $(basename "$file")"
    rm -rf "$place"
    mkdir -p "$place"
    tree=$(mktemp -d -p "$out")
    cleanup+=("umount '$tree/proc' '$tree/sys' '$tree/dev' 2>/dev/null || true" "rm -rf --one-file-system '$tree'")
    tar xf "$out/base-$2.tar" -C "$tree"
    dpkg-deb --fsys-tarfile "$file" | tar x -C "$tree" --keep-directory-symlink
    release=$(ls "$tree/lib/modules")
    sed -i 's/^MODULES=.*/MODULES=list/' "$tree/etc/initramfs-tools/initramfs.conf"
    printf '%s\n' virtio_pci virtio_blk ext4 >"$tree/etc/initramfs-tools/modules"
    for directory in proc sys dev; do mount --bind "/$directory" "$tree/$directory"; done
    chroot "$tree" depmod "$release"
    chroot "$tree" mkinitramfs -o /boot/initrd "$release" 2>"$place/mkinitramfs.log"
    umount "$tree/proc" "$tree/sys" "$tree/dev"
    mv "$tree/boot/initrd" "$place/initrd"
    cp "$tree/boot/vmlinuz-$release" "$place/vmlinuz"
    echo robot >"$tree/etc/hostname"
    : >"$tree/etc/machine-id"
    cat >"$tree/etc/systemd/system/vm-check.service" <<'END'
[Unit]
After=multi-user.target
[Service]
Type=oneshot
StandardOutput=tty
StandardError=tty
TTYPath=/dev/console
ExecStart=/bin/sh -c 'mkdir /opt/vm && tar x -f /dev/vdb -C /opt/vm && . /opt/vm/settings && sh /opt/vm/check.sh'
ExecStopPost=/bin/systemctl poweroff --force
END
    ln -s ../vm-check.service "$tree/etc/systemd/system/multi-user.target.wants/"
    mkfs.ext4 -q -d "$tree" "$place/disk" 3G
    rm -rf --one-file-system "$tree"
    echo "$file" >"$place/kernel"
}

# robot ARCHITECTURE: prints the demo robot, built static.
robot() {
    local triple
    # The robot replaces epoll_wait of the C library.
    triple=$(machine "$1")-unknown-linux-musl
    CARGO_TARGET_X86_64_UNKNOWN_LINUX_MUSL_LINKER=rust-lld CARGO_TARGET_AARCH64_UNKNOWN_LINUX_MUSL_LINKER=rust-lld \
        cargo rustc --quiet --release --package ros2probe --example robot --target "$triple" -- \
        -C link-arg=--allow-multiple-definition >&2
    echo "$target/$triple/release/examples/robot"
}

# boot NAME ARCHITECTURE SOURCE [KERNEL OPTION...]: runs the checks. Prints nothing.
boot() {
    local name=$1 architecture=$2 place=$out/$1 payload console options program
    program=$(robot "$architecture")
    payload=$(mktemp -d -p "$out")
    cleanup+=("rm -rf '$payload'")
    cp packaging/vm/check.sh "$target/dist"/ros2probe_*_"$architecture.deb" "$payload"
    cp "$program" "$payload/robot"
    printf 'export SOURCE=%s\n' "$3" >"$payload/settings"
    tar cf "$place/payload" -C "$payload" .
    shift 3
    case $architecture in
    arm64) console=ttyAMA0 options=(qemu-system-aarch64 -M virt -cpu "max,pauth-impdef=on") ;;
    amd64)
        console=ttyS0 options=(qemu-system-x86_64 -M q35 -cpu max)
        # Not by default: nested virtualization of some hosts hangs in the BIOS.
        if [ -n "${VM_KVM-}" ]; then options+=(-accel kvm -cpu host); fi
        ;;
    esac
    step "booting $name (at most $patience s; its console is in $place/console.log)"
    timeout "$patience" "${options[@]}" -smp "${VM_CPUS:-2}" -m 1536 -nographic -nic none -no-reboot \
        -kernel "$place/vmlinuz" -initrd "$place/initrd" \
        -append "root=/dev/vda rw quiet console=$console $*" \
        -drive if=none,id=disk,file="$place/disk",format=raw,snapshot=on -device virtio-blk-pci,drive=disk \
        -drive if=none,id=payload,file="$place/payload",format=raw,readonly=on \
        -device virtio-blk-pci,drive=payload </dev/null >"$place/console.log" 2>&1 ||
        printf 'CHECK\tend of the guest\tFAILED\tqemu ended with %s\n' $? >>"$place/console.log"
}

# Prints the checks of one system as rows of a table.
table() {
    tr -d '\r' <"$out/$1/console.log" | awk -F '\t' -v system="$1" '
        $1 ~ /CHECK$/ { printf "| %s | %s | %s | %s |\n", system, $2, $3, $4 }'
}

main() {
    local chosen name architecture suite package source options failed=0 disks=
    [ "$(id -u)" = 0 ] || die "root is needed: it makes file systems"
    mkdir -p "$out"
    [ "${1-}" != --disks ] || { disks=yes && shift; }
    chosen=${*:-$(systems | cut -d' ' -f1)}
    for name in $chosen; do
        systems | grep -q "^$name " || die "no system $name; the systems are: $(systems | cut -d' ' -f1 | paste -sd ' ')"
    done
    while read -r name architecture suite package source options; do
        case " $chosen " in *" $name "*) ;; *) continue ;; esac
        [ -n "$disks" ] || ls "$target/dist"/ros2probe_*_"$architecture.deb" >/dev/null 2>&1 ||
            die "no package for $architecture in $target/dist: run make dist"
        emulate "$architecture"
        base "$architecture"
        disk "$name" "$architecture" "$suite" "$package"
        [ -z "$disks" ] || continue
        # shellcheck disable=SC2086
        boot "$name" "$architecture" "$source" $options
        table "$name" >"$out/$name/table.md"
        cat "$out/$name/table.md" >&2
        grep -q 'FAILED' "$out/$name/table.md" && failed=1
        grep -q '| purge |' "$out/$name/table.md" || failed=1
    done < <(systems)
    [ -z "$disks" ] || return 0
    printf '\n| system | check | outcome | figure |\n| --- | --- | --- | --- |\n'
    for name in $chosen; do cat "$out/$name/table.md"; done
    return $failed
}

main "$@"
