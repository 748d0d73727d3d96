#!/usr/bin/env bash
# Boots whole systems under qemu, installs the package in each as docs/install.md says, and checks it
# beside a small robot. Prints one table; logs and tables stay in target/vm.
#
#   packaging/vm.sh [--disks] [SYSTEM...]   the systems of the table below; all without an argument.
#                                           --disks only builds the disks.
#
# Needs root, the packages of `make dist`, and the tools that `.ci/prerequisites.sh vm` installs. Root
# file systems come from Debian's packages and are kept in target/vm. Guests have no network, but the two
# of `pair` have one with each other. While it builds for another architecture, binfmt_misc runs that
# architecture's programs with qemu.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd -P)
cd "$root"
target=$(realpath -m "${CARGO_TARGET_DIR:-target}")
out=$target/vm
# Seconds that a guest may take.
patience=${VM_SECONDS:-1800}

# name, architecture, suite and meta package of the kernel, expected source, kernel options; with
# `nobtf`, the guest hides the kernel's type information, since no packaged kernel lacks it
systems() {
    cat <<'END'
arm64-5.10 arm64 bullseye linux-image-arm64 host
arm64-5.10-cgroup1 arm64 bullseye linux-image-arm64 wire systemd.unified_cgroup_hierarchy=0 systemd.legacy_systemd_cgroup_controller=1
arm64-5.10-rt arm64 bullseye linux-image-rt-arm64 host
arm64-6.1 arm64 bookworm linux-image-arm64 host
arm64-6.1-nobtf arm64 bookworm linux-image-arm64 host nobtf
arm64-6.1-rt arm64 bookworm linux-image-rt-arm64 host
arm64-6.12-16k arm64 trixie linux-image-arm64-16k host
arm64-newest arm64 trixie-backports linux-image-arm64 host
amd64-5.10 amd64 bullseye linux-image-amd64 host
amd64-6.1 amd64 bookworm linux-image-amd64 host
amd64-6.1-rt amd64 bookworm linux-image-rt-amd64 host
amd64-newest amd64 trixie-backports linux-image-amd64 host
END
}
packages=systemd,systemd-sysv,dbus,udev,adduser,iproute2,nftables,curl,kmod,initramfs-tools,rt-tests,procps,jq
# Middlewares of the peers in C++.
packages+=,libfastrtps2.9,libddsc0debian

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

# peers ARCHITECTURE: builds the test peers in C++ against the libraries of the root file system, into
# a directory that it prints.
peers() {
    local place=$out/peers-$1 libraries=$out/libraries-$1 gnu headers
    gnu=$(machine "$1")-linux-gnu
    # The generated ones of this machine's packages are the same for all architectures.
    headers="-idirafter /usr/include/$(gcc -print-multiarch)"
    if [ ! -d "$libraries" ]; then
        mkdir -p "$libraries.part"
        tar x -f "$out/base-$1.tar" -C "$libraries.part" --wildcards "./usr/lib/$gnu/*.so*"
        ln -s libfastrtps.so.2.9 "$libraries.part/usr/lib/$gnu/libfastrtps.so"
        ln -s libfastcdr.so.1 "$libraries.part/usr/lib/$gnu/libfastcdr.so"
        ln -s "$(basename "$(find "$libraries.part" -name 'libddsc.so.*' | head -1)")" "$libraries.part/usr/lib/$gnu/libddsc.so"
        mv "$libraries.part" "$libraries"
    fi
    make --silent -C agent/cli/tests/peers OUT="$place" CC="$gnu-gcc" CXX="$gnu-g++" \
        CFLAGS="-O2 $headers" \
        CXXFLAGS="-std=c++17 -O2 $headers -L$libraries/usr/lib/$gnu -Wl,-rpath-link,$libraries/usr/lib/$gnu" \
        "$place/fastdds" "$place/cyclonedds" >&2
    # Calls the functions of rclcpp, as the tests of `rp why` describe.
    "$gnu-gcc" -O2 -shared -fPIC -Wl,-soname,libtracetools.so -o "$place/libtracetools.so" agent/testing/tracetools/tracetools.c >&2
    "$gnu-gcc" -O2 -pthread -DPLACE=248 -o "$place/traced" agent/testing/tracetools/process.c \
        "$place/libtracetools.so" -Wl,-rpath,'$ORIGIN' >&2
    echo "$place"
}

# kernel ARCHITECTURE SUITE PACKAGE: downloads the kernel of a meta package and prints its files.
kernel() {
    local place=$out/kernels/$2-$1 image name file
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
    dependency() { apt-cache show "$1" | sed -n 's/^Depends: *//p' | grep -oE "$2[0-9][^ ,]*" | head -1 || true; }
    image=$(dependency "$3" linux-image-)
    [ -n "$image" ] || die "$2 has no $3 for $1"
    # Newer ones are several packages.
    for name in "$image" $(for part in modules binary base; do dependency "$image" linux-$part-; done); do
        file=$(find "$place" -maxdepth 1 -name "${name}_*.deb" | head -1)
        if [ -z "$file" ]; then
            (cd "$place" && apt-get download -qq "$name")
            file=$(find "$place" -maxdepth 1 -name "${name}_*.deb" | head -1)
        fi
        echo "$file"
    done
    unset APT_CONFIG
}

# disk NAME ARCHITECTURE SUITE PACKAGE: a disk with its kernel and initial file system beside it.
disk() {
    local place=$out/$1 tree files file release
    files=$(kernel "$2" "$3" "$4")
    [ "$(cat "$place/kernel" 2>/dev/null)" = "$files" ] && return
    step "disk of $1 with $(basename "${files%%$'\n'*}")"
    rm -rf "$place"
    mkdir -p "$place"
    tree=$(mktemp -d -p "$out")
    cleanup+=("umount '$tree/proc' '$tree/sys' '$tree/dev' 2>/dev/null || true" "rm -rf --one-file-system '$tree'")
    tar xf "$out/base-$2.tar" -C "$tree"
    for file in $files; do dpkg-deb --fsys-tarfile "$file" | tar x -C "$tree" --keep-directory-symlink; done
    release=$(ls "$tree/lib/modules")
    # Where newer packages have them.
    for file in config vmlinuz; do
        [ -e "$tree/boot/$file-$release" ] || cp "$tree/lib/modules/$release/$file" "$tree/boot/$file-$release"
    done
    sed -i 's/^MODULES=.*/MODULES=list/' "$tree/etc/initramfs-tools/initramfs.conf"
    printf '%s\n' virtio_pci virtio_blk ext4 >"$tree/etc/initramfs-tools/modules"
    for directory in proc sys dev; do mount --bind "/$directory" "$tree/$directory"; done
    chroot "$tree" depmod "$release"
    chroot "$tree" mkinitramfs -o /boot/initrd "$release" 2>"$place/mkinitramfs.log" ||
        die "no initial file system: $(tail -1 "$place/mkinitramfs.log")"
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
ExecStart=/bin/sh -c 'mkdir /opt/vm && tar x -f /dev/vdb -C /opt/vm && . /opt/vm/settings && sh /opt/vm/main.sh'
ExecStopPost=/bin/systemctl poweroff --force
END
    ln -s ../vm-check.service "$tree/etc/systemd/system/multi-user.target.wants/"
    mkfs.ext4 -q -d "$tree" "$place/disk" 3G
    rm -rf --one-file-system "$tree"
    echo "$files" >"$place/kernel"
}

# robot ARCHITECTURE: prints the demo robot, built static.
robot() {
    local triple
    # The robot replaces epoll_wait of the C library.
    triple=$(machine "$1")-unknown-linux-musl
    CC_x86_64_unknown_linux_musl=clang CC_aarch64_unknown_linux_musl=clang \
        CARGO_TARGET_X86_64_UNKNOWN_LINUX_MUSL_LINKER=rust-lld CARGO_TARGET_AARCH64_UNKNOWN_LINUX_MUSL_LINKER=rust-lld \
        cargo rustc --quiet --release --package ros2probe --example robot --target "$triple" -- \
        -C link-arg=--allow-multiple-definition >&2
    echo "$target/$triple/release/examples/robot"
}

# The repository for apt of a release, with the packages of `make dist`. Its key is deleted.
repository() {
    step "repository for apt, signed for a trial"
    # The package's time is that of its sources.
    SOURCE_DATE_EPOCH=$(stat -c %Y "$target/dist/SHA256SUMS") \
        packaging/repository.sh --trial "$out/apt" "$target/dist"/ros2probe_*.deb
}

# payload NAME ARCHITECTURE SCRIPT [SETTING=VALUE...]: what a guest reads from its second disk.
payload() {
    local place=$out/$1 architecture=$2 script=$3 tree program
    program=$(robot "$architecture")
    tree=$(mktemp -d -p "$out")
    cleanup+=("rm -rf '$tree'")
    cp packaging/vm/*.sh "$target/dist"/ros2probe_*_"$architecture.deb" "$tree"
    cp -r "$out/apt" "$tree"
    cp "$program" "$tree/robot"
    cp "$(peers "$architecture")"/{fastdds,cyclonedds,traced,libtracetools.so} "$tree"
    mv "$tree/$script" "$tree/main.sh"
    # The broker's user reads libraries there.
    chmod 755 "$tree"
    shift 3
    printf 'export %s\n' "$@" >"$tree/settings"
    tar cf "$place/payload" -C "$tree" .
}

# boot NAME ARCHITECTURE NETWORK [KERNEL OPTION...]: runs the payload. Prints nothing.
boot() {
    local name=$1 architecture=$2 network=$3 place=$out/$1 console options
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
    # shellcheck disable=SC2086
    timeout "$patience" "${options[@]}" -smp "${VM_CPUS:-2}" -m 1536 -nographic $network -no-reboot \
        -kernel "$place/vmlinuz" -initrd "$place/initrd" \
        -append "root=/dev/vda rw quiet console=$console $*" \
        -drive if=none,id=disk,file="$place/disk",format=raw,snapshot=on -device virtio-blk-pci,drive=disk \
        -drive if=none,id=payload,file="$place/payload",format=raw,readonly=on \
        -device virtio-blk-pci,drive=payload </dev/null >"$place/console.log" 2>&1 ||
        printf 'CHECK\tend of the guest\tFAILED\tqemu ended with %s\n' $? >>"$place/console.log"
}

# Two robots of different architectures on one network.
pair() {
    local systems=("arm64-6.1 arm64" "amd64-6.1 amd64") number=0 system name architecture wire=$out/wire
    rm -f "$wire"
    for system in "${systems[@]}"; do
        read -r name architecture <<<"$system"
        number=$((number + 1))
        mkdir -p "$out/pair-$architecture"
        ln -sf "../$name"/{disk,vmlinuz,initrd} "$out/pair-$architecture"
        payload "pair-$architecture" "$architecture" pair.sh NUMBER=$number
        boot "pair-$architecture" "$architecture" "-netdev stream,id=net,server=$([ $number = 1 ] && echo on || echo off),addr.type=unix,addr.path=$wire -device virtio-net-pci,netdev=net,mac=52:54:00:00:00:0$number" &
        until [ -e "$wire" ] || ! kill -0 $! 2>/dev/null; do sleep 0.2; done
    done
    wait
}

# table NAME CHECK: writes and shows the checks of one system as rows of a table. Fails if one failed, or
# if the last one did not run.
table() {
    tr -d '\r' <"$out/$1/console.log" | awk -F '\t' -v guest="$1" '
        $1 ~ /CHECK$/ { printf "| %s | %s | %s | %s |\n", guest, $2, $3, $4 }' >"$out/$1/table.md"
    cat "$out/$1/table.md" >&2
    grep -q "| $2 |" "$out/$1/table.md" && ! grep -q FAILED "$out/$1/table.md"
}

main() {
    local chosen all name architecture suite package source options failed=0 disks=
    [ "$(id -u)" = 0 ] || die "root is needed: it makes file systems"
    mkdir -p "$out"
    [ "${1-}" != --disks ] || { disks=yes && shift; }
    all="$(systems | cut -d' ' -f1 | paste -sd ' ') pair"
    chosen=${*:-$all}
    for name in $chosen; do
        case " $all " in *" $name "*) ;; *) die "no system $name; the systems are: $all" ;; esac
    done
    [ -n "$disks" ] || ls "$target/dist"/ros2probe_*.deb >/dev/null 2>&1 || die "no package in $target/dist: run make dist"
    [ -n "$disks" ] || repository
    while read -r name architecture suite package source options; do
        case " ${chosen/pair/pair arm64-6.1 amd64-6.1} " in *" $name "*) ;; *) continue ;; esac
        [ -n "$disks" ] || step "$(cd "$target/dist" && date -r ros2probe_*_"$architecture.deb" '+the package of %F %T'), from make dist"
        emulate "$architecture"
        base "$architecture"
        disk "$name" "$architecture" "$suite" "$package"
        [ -z "$disks" ] || continue
        # Only a disk for the pair.
        case " $chosen " in *" $name "*) ;; *) continue ;; esac
        payload "$name" "$architecture" check.sh "SOURCE=$source" \
            "HIDE_BTF=$(case $options in *nobtf*) echo yes ;; esac)" "REAL_TIME=$(case $name in *-rt) echo yes ;; esac)"
        # shellcheck disable=SC2086
        boot "$name" "$architecture" "-nic none" $options
        table "$name" purge || failed=1
    done < <(systems)
    [ -z "$disks" ] || return 0
    case " $chosen " in
    *" pair "*)
        pair
        table pair-arm64 "messages from the other" || failed=1
        table pair-amd64 "messages to the other" || failed=1
        ;;
    esac
    printf '\n| system | check | outcome | figure |\n| --- | --- | --- | --- |\n'
    for name in ${chosen/pair/pair-arm64 pair-amd64}; do cat "$out/$name/table.md"; done
    return $failed
}

main "$@"
