#!/usr/bin/env bash
# Installs the missing tools of a Makefile target, printing each of them first.
#
#   prerequisites.sh demo|test|fast|dist|release|vm|ebpf|fuzz|miri|book|deny...   install the tools of those targets
#   prerequisites.sh types                    install the type checker of the dashboards
#   prerequisites.sh page                     install the browser of the page's tests
#   prerequisites.sh --nightly                print the nightly toolchain that builds the kernel part
#   prerequisites.sh --left-out               print the tests that `make test` omits, with the reason
#   prerequisites.sh --ros2                   print the directory of each installed ROS 2 distribution
#   prerequisites.sh --ros2-selection PREFIX  print the tests that a distribution can run, as a filter
#   prerequisites.sh --ros2-summary           print what is left out if no distribution is installed
#
# Supports Debian 12 and Ubuntu 22.04 or newer. It starts no service, adds no package source and
# changes no system setting. If a tool is unavailable, it fails with a line on how to install it.
set -euo pipefail
cd "$(dirname "$0")/.."

tools=$PWD/target/tools
# The newest nightly whose LLVM is the 22 that bpf-linker is built with.
pinned_nightly=nightly-2026-05-20

say() { printf '%s\n' "$*" >&2; }
die() {
    say "$@"
    exit 1
}

as_root() {
    if [ "$(id -u)" = 0 ]; then
        "$@"
    else
        command -v sudo >/dev/null || die "root is needed for: $*"
        sudo "$@"
    fi
}

installed() { dpkg-query -W -f='${db:Status-Status}\n' "$1" 2>/dev/null | grep -qx installed; }
available() { [ -n "$(apt-cache show --no-all-versions "$1" 2>/dev/null)" ]; }

refreshed=
refresh() {
    [ -n "$refreshed" ] && return
    as_root apt-get update -qq
    refreshed=yes
}

packages() {
    local missing=() package
    for package; do installed "$package" || missing+=("$package"); done
    [ ${#missing[@]} -eq 0 ] && return
    command -v apt-get >/dev/null ||
        die "apt-get is missing: install the equivalents of these Debian packages: ${missing[*]}"
    refresh
    for package in "${missing[@]}"; do
        available "$package" ||
            die "no package source has $package (on Ubuntu: sudo add-apt-repository universe)"
    done
    say "installing Debian packages: ${missing[*]}"
    as_root env DEBIAN_FRONTEND=noninteractive \
        apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
}

# Unpacks only the programs: the packages would start servers and enable them at boot.
engine() { # package program...
    local package=$1 program missing=
    shift
    for program; do
        command -v "$program" >/dev/null || [ -x "$tools/usr/bin/$program" ] || missing=yes
    done
    [ "$missing" ] || return 0
    refresh
    say "unpacking $* into target/tools (nothing is installed or started)"
    mkdir -p "$tools"
    (cd "$tools" && apt-get -o APT::Sandbox::User=root download -qq "$package" &&
        dpkg-deb -x "$package"_*.deb . && rm "$package"_*.deb)
}

prometheus() {
    engine prometheus prometheus promtool
}

# The receivers of remote write beside Prometheus, and its alerts.
engines() {
    prometheus
    engine victoria-metrics victoria-metrics
    engine prometheus-alertmanager prometheus-alertmanager amtool
}

# The type checker of the dashboards. Without it one test fails and names it.
types() {
    local directory=$tools/grafana lock=agent/cli/tests/dashboard/types/package-lock.json
    cmp -s "$lock" "$directory/package-lock.json" && [ -d "$directory/node_modules/typescript" ] && return
    command -v npm >/dev/null || packages npm
    say "installing @grafana/schema and typescript into target/tools/grafana"
    mkdir -p "$directory"
    cp agent/cli/tests/dashboard/types/package.json "$lock" "$directory"
    (cd "$directory" && npm ci --ignore-scripts --no-audit --no-fund --silent) ||
        { rm -f "$directory/package-lock.json"; say "npm failed: the dashboards cannot be type-checked"; }
}

# Node 20 or newer runs the page's tests and drives the browser. Debian 12 has 18 and Ubuntu 22.04
# has 12: there Node's own build is installed from npm into a separate directory.
nodejs() {
    local place=$tools/node version=20.20.2 architecture found
    [ -x "$place/bin/node" ] && return
    found=$(node_version || true)
    [ "${found:-0}" -ge 20 ] && return
    case $(uname -m) in
    x86_64) architecture=x64 ;;
    aarch64) architecture=arm64 ;;
    *) die "node 20 or newer is needed: install it, then run this again" ;;
    esac
    command -v npm >/dev/null || packages npm
    say "installing node $version from npm into target/tools/node (here is ${found:-none})"
    mkdir -p "$place"
    (cd "$place" && npm pack --silent "node-linux-$architecture@$version" >/dev/null &&
        tar -xzf node-linux-*.tgz --strip-components 1 && rm node-linux-*.tgz) ||
        die "npm cannot download node: install node 20 or newer, then run this again"
}

node_version() { command node --version 2>/dev/null | sed -E 's/v([0-9]+).*/\1/'; }

# A real browser, its driver, and the accessibility rules. Debian packages Chromium's headless shell.
# On Ubuntu playwright downloads its own build into target/tools.
page() {
    local place=$tools/page tests=agent/cli/tests/page
    nodejs
    [ -x "$tools/node/bin/node" ] && export PATH=$tools/node/bin:$PATH
    if ! cmp -s "$tests/package-lock.json" "$place/package-lock.json" ||
        [ ! -d "$place/node_modules/playwright-core" ]; then
        command -v npm >/dev/null || packages npm
        say "installing $(sed -nE 's/^ *"([@a-z/-]+)": "([0-9.]+)",?$/\1 \2/p' $tests/package.json |
            paste -sd ' ') from npm into target/tools/page"
        mkdir -p "$place"
        cp "$tests/package.json" "$tests/package-lock.json" "$place"
        (cd "$place" && npm ci --ignore-scripts --no-audit --no-fund --silent) || {
            rm -f "$place/package-lock.json"
            die "npm failed: the page's tests need the packages in $tests/package-lock.json"
        }
    fi
    [ -x /usr/bin/chromium-headless-shell ] && return
    refresh
    if available chromium-headless-shell; then
        packages chromium-headless-shell
        return
    fi
    compgen -G "$place/browsers/chromium_headless_shell-*/INSTALLATION_COMPLETE" >/dev/null && return
    say "installing Chromium's headless shell with playwright-core into target/tools/page/browsers," \
        "and the libraries it needs (this system has no package chromium-headless-shell)"
    as_root env PATH="$PATH" PLAYWRIGHT_BROWSERS_PATH="$place/browsers" \
        node "$place/node_modules/playwright-core/cli.js" install --with-deps chromium-headless-shell ||
        die "no browser: put a chromium-headless-shell at /usr/bin/chromium-headless-shell"
}

# The OpenTelemetry receiver of the tests; it is linked against libpython of the interpreter's version.
rotel() {
    local place=$tools/rotel version
    compgen -G "$place/lib/python3*/site-packages/rotel-0.0.1a15.dist-info" >/dev/null && return
    packages python3 python3-venv
    version=$(python3 -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    packages "libpython$version"
    say "installing rotel 0.0.1a15 from PyPI into target/tools/rotel"
    rm -rf "$place"
    python3 -m venv "$place"
    "$place/bin/pip" install --quiet --disable-pip-version-check rotel==0.0.1a15
}

# Real sessions and routers of Zenoh, and the hash of rmw_zenoh's GIDs.
zenoh() { python_packages zenoh "eclipse-zenoh==1.10.2" "xxhash==4.1.0"; }

# A second decoder of RTPS.
scapy() { python_packages scapy "scapy==2.8.0"; }

# The newest Cyclone DDS, for the peers of the interoperability matrix.
cyclonedds() { python_packages cyclonedds "cyclonedds==11.0.1"; }

# Generates requests to the control API; installed in a separate Python environment. The newest version
# for Python 3.10, which Ubuntu 22.04 has.
schemathesis() {
    local place=$tools/schemathesis version=4.30.1
    [ "$("$place/bin/st" --version 2>/dev/null)" = "st, version $version" ] && return
    packages python3 python3-venv
    say "installing schemathesis $version into target/tools (a Python environment of its own)"
    rm -rf "$place"
    python3 -m venv "$place"
    "$place/bin/pip" install --quiet --disable-pip-version-check "schemathesis==$version"
}

# Other implementations that read bags, for comparison.
bags() { python_packages bags "mcap==1.6.0" "rosbags==0.11.9"; }

# Installs packages of PyPI into a Python environment of this name.
python_packages() {
    local place=$tools/$1
    local versions=("${@:2}")
    [ "$(cat "$place/versions" 2>/dev/null)" = "${versions[*]}" ] && return
    packages python3 python3-venv
    say "installing ${versions[*]} from PyPI into target/tools/$1"
    rm -rf "$place"
    python3 -m venv "$place"
    "$place/bin/pip" install --quiet --disable-pip-version-check "${versions[@]}"
    echo "${versions[*]}" >"$place/versions"
}

# Validates the workflows, the action and the compose file against the schemas that this package contains.
# The newest version for Python 3.10, which Ubuntu 22.04 has.
workflows() { python_packages workflows "check-jsonschema==0.38.2"; }

# Validates the bills of materials against the schema of CycloneDX.
bills() {
    local place=$tools/bills version=11.12.0
    compgen -G "$place/lib/python3*/site-packages/cyclonedx_python_lib-$version.dist-info" >/dev/null && return
    packages python3 python3-venv
    say "installing cyclonedx-python-lib $version from PyPI into target/tools/bills"
    rm -rf "$place"
    python3 -m venv "$place"
    "$place/bin/pip" install --quiet --disable-pip-version-check "cyclonedx-python-lib[json-validation]==$version"
}

# Runs the aarch64 binary on other machines; called by name, without binfmt registration.
qemu() {
    [ "$(uname -m)" = aarch64 ] && return
    command -v qemu-aarch64-static >/dev/null && return
    [ -x "$tools/usr/bin/qemu-aarch64-static" ] && return
    refresh
    available qemu-user-static ||
        die "no package source has qemu-user-static (on Ubuntu: sudo add-apt-repository universe)"
    say "unpacking qemu-aarch64-static into target/tools (nothing is installed or registered)"
    mkdir -p "$tools"
    (cd "$tools" && apt-get -o APT::Sandbox::User=root download -qq qemu-user-static &&
        dpkg-deb --fsys-tarfile qemu-user-static_*.deb | tar -x ./usr/bin/qemu-aarch64-static &&
        rm qemu-user-static_*.deb)
}

# Standard libraries for static binaries; rust-lld, a part of Rust, links for both architectures.
musl() {
    local architecture target
    for architecture; do
        target=$architecture-unknown-linux-musl
        [ -d "$(rustc --print target-libdir --target "$target")" ] && continue
        command -v rustup >/dev/null || die "rustup is needed to add the Rust target $target"
        say "adding the Rust target $target"
        rustup target add "$target"
    done
}

# A fresh Debian for installing the package: its containers do not modify it. Ansible needs python3-apt,
# and wheels python3-venv.
debian() {
    local place=$tools/debian more=dbus,python3-apt,python3-venv,systemd,systemd-sysv
    [ "$(cat "$place/complete" 2>/dev/null)" = "$more" ] && return
    packages debootstrap debian-archive-keyring systemd-container man-db
    say "making a Debian 12 system in target/tools/debian (as root, 340 MB)"
    as_root rm -rf "$place"
    mkdir -p "$place"
    as_root debootstrap --variant=minbase --include=$more bookworm "$place" >"$tools/debian.log" ||
        { tail "$tools/debian.log" >&2; die "debootstrap failed"; }
    as_root sh -c 'rm -rf "$0"/var/cache/apt/archives/*.deb "$0"/var/lib/apt/lists/*; echo "$1" >"$0/complete"' \
        "$place" $more
}

# Renders the chart with Helm's own library, and validates the result against the API of Kubernetes.
# The library is published for x86-64 only.
helm() {
    [ "$(uname -m)" = x86_64 ] && python_packages helm "helm-python-sdk==0.2.2" "kubernetes-validate==1.37.0"
    return 0
}

# Builds the packages for ROS, as users and the build farm of ROS do. Debian has ament_cmake.
ros() {
    packages ament-cmake cmake make
    python_packages ros "colcon-core==0.21.3" "colcon-bash==0.5.0" "colcon-ros==0.5.0" "catkin-pkg==1.1.1" "setuptools==79.0.1"
}

# Unpacks only the program: the package would enable and start a service of podman.
podman() {
    type -P podman >/dev/null && return
    [ -x "$tools/usr/bin/podman" ] && return
    refresh
    local needed
    needed=$(apt-cache depends podman | sed -n 's/^  Depends: \([a-z0-9.+-]*\)$/\1/p')
    [ -n "$needed" ] || die "no package source has podman (on Ubuntu: sudo add-apt-repository universe)"
    # shellcheck disable=SC2086
    packages ca-certificates $needed
    say "unpacking podman into target/tools (nothing is started)"
    mkdir -p "$tools"
    (cd "$tools" && apt-get -o APT::Sandbox::User=root download -qq podman &&
        dpkg-deb --fsys-tarfile podman_*.deb | tar -x ./usr/bin/podman && rm podman_*.deb)
}

# Built without optimization and without its own copy of xz, in a third of the time; it calls xz.
cargo_deb() {
    packages binutils xz-utils
    command -v cargo-deb >/dev/null && return
    say "installing cargo-deb 3.8.0"
    cargo install cargo-deb --version 3.8.0 --locked --debug --no-default-features
}

# Built without optimization in two minutes: it mostly waits for tests.
nextest() {
    cargo nextest --version >/dev/null 2>&1 && return
    say "installing cargo-nextest 0.9.151"
    cargo install cargo-nextest --version 0.9.151 --locked --debug --no-default-features --features default-no-update
}

# Checks the spelling of all files, with the exceptions in _typos.toml: the crate typos-cli, which
# PyPI has built.
spelling() {
    local place=$tools/typos version=1.52.0
    [ "$("$place/bin/typos" --version 2>/dev/null)" = "typos-cli $version" ] && return
    packages python3 python3-venv
    say "installing typos $version from PyPI into target/tools/typos"
    rm -rf "$place"
    python3 -m venv "$place"
    "$place/bin/pip" install --quiet --disable-pip-version-check "typos==$version"
}

# Prints the directory of each installed ROS 2 distribution: ROS2PROBE_ROS2, or all below /opt/ros.
distributions() {
    local prefix
    for prefix in ${ROS2PROBE_ROS2:-/opt/ros/*}; do
        if [ -e "$prefix/setup.bash" ]; then echo "$prefix"; fi
    done
}

# Prints a line for each test with real ROS 2: its name, and the packages of ROS that it needs.
ros2_tests() {
    find agent/cli/tests/ros2 -name '*.rs' -print | sort | xargs awk '
        match($0, /#\[ignore = "needs ROS 2[^:]*/) {
            needs = substr($0, RSTART + 23, RLENGTH - 23)
            sub(/^ with /, " ", needs); gsub(/,/, "", needs)
            waiting = 1
            next
        }
        waiting && match($0, /fn [a-z0-9_]+/) {
            name = FILENAME
            sub(/^agent\/cli\/tests\/ros2\//, "", name); sub(/\.rs$/, "", name); gsub(/\//, "::", name)
            print name "::" substr($0, RSTART + 3, RLENGTH - 3) needs
            waiting = 0
        }'
}

# Prints each test that `make test-ros2` omits, as this distribution lacks a package that it needs, to
# standard error. Prints the expression that selects the others to standard output.
ros2_selection() {
    local name needs package selection='binary(ros2) and not test(/^cost::/)'
    while read -r name needs; do
        for package in $needs; do
            [ -e "$1/share/$package/package.xml" ] && continue
            say "left out with $1: $name: needs $package"
            selection+=" and not test(=$name)"
            break
        done
    done < <(ros2_tests)
    printf '%s\n' "$selection"
}

# Names what `make test` cannot prove without ROS 2.
ros2_summary() {
    [ -n "$(distributions)" ] && return
    say "left out: $(ros2_tests | wc -l) tests with real ROS 2 (make test-ros2), because neither /opt/ros/*" \
        "nor ROS2PROBE_ROS2 has a distribution"
}

# Prints each test that `make test` omits, with the reason, to standard error. Prints the arguments
# that omit tests which this system cannot run to standard output.
left_out() {
    local version elsewhere="started by another test" tests="all()"
    # `make test` runs these if the corpus exists.
    [ -d "${ROS2PROBE_FIXTURES:-../shared/fixtures}" ] && elsewhere+="|make test-corpus"
    [ -n "$(distributions)" ] && elsewhere+="|make test-ros2"
    say "omitted tests:"
    find agent wire -name target -prune -o -name '*.rs' -print | sort | xargs awk -v elsewhere="$elsewhere" '
        /#\[ignore = / { sub(/.*#\[ignore = "/, ""); sub(/"\].*/, ""); reason = $0 ~ elsewhere ? "" : $0; next }
        reason != "" && match($0, /fn [a-z0-9_]+/) {
            file = FILENAME
            gsub(/^agent\/(cli\/(tests|src)|daemon\/src)\/|\.rs$/, "", file)
            printf "  %s::%s: %s\n", file, substr($0, RSTART + 3, RLENGTH - 3), reason
            reason = ""
        }' >&2
    # Ubuntu 22.04 has version 249.
    version=$(systemd-analyze --version 2>/dev/null | awk 'NR == 1 { print $2 + 0 }')
    if [ "${version:-0}" -lt 250 ]; then
        say "  dist/systemd::the_exposure_level_*: need systemd 250, here is ${version:-none}"
        tests+="-test(/the_exposure_level_/)"
    fi
    if [ "$(uname -m)" != x86_64 ]; then
        say "  dist/chart::*: need Helm's library, which is published for x86-64 only"
        tests+="-test(/^chart::/)"
    fi
    if [ "$tests" != "all()" ]; then echo "--filterset $tests"; fi
}

rust() {
    command -v cargo >/dev/null || die "Rust is missing: install it with rustup, then run this again"
    local version
    version=$(rustc --version | sed -E 's/rustc 1\.([0-9]+).*/\1/')
    [ "$version" -ge 95 ] || die "rustc 1.95 or newer is needed, here is $(rustc --version): rustup update stable"
    cargo clippy --version >/dev/null 2>&1 || component clippy
    cargo fmt --version >/dev/null 2>&1 || component rustfmt
}

component() {
    say "adding the Rust component $1"
    rustup component add "$1"
}

nightly() {
    if rustc +nightly -vV 2>/dev/null | grep -q '^LLVM version: 22'; then
        echo nightly
    else
        echo "$pinned_nightly"
    fi
}

nightly_toolchain() {
    local toolchain
    toolchain=$(nightly)
    command -v rustup >/dev/null || die "rustup is needed to install $toolchain"
    if ! rustc "+$toolchain" --version >/dev/null 2>&1; then
        say "installing the Rust toolchain $toolchain"
        rustup toolchain install "$toolchain" --profile minimal
    fi
    if [ ! -d "$(rustc "+$toolchain" --print sysroot)/lib/rustlib/src/rust/library" ]; then
        say "adding rust-src to the Rust toolchain $toolchain"
        rustup component add rust-src --toolchain "$toolchain"
    fi
}

ebpf() {
    nightly_toolchain
    if bpf-linker --version >/dev/null 2>&1; then
        [ -x /usr/lib/llvm-22/bin/llvm-strip ] || command -v llvm-strip >/dev/null || packages llvm
        return
    fi
    command -v apt-get >/dev/null && refresh
    if installed llvm-22-dev || available llvm-22-dev; then
        packages llvm-22-dev g++
        say "installing bpf-linker 0.13.0 with LLVM 22"
        LLVM_PREFIX=/usr/lib/llvm-22 cargo install bpf-linker --version 0.13.0 --locked \
            --no-default-features --features llvm-22
    elif [ "$(uname -m)" = x86_64 ]; then
        # rustup ships LLVM as a shared library for this architecture only; version 0.10.2 can use it.
        packages llvm g++
        say "installing bpf-linker 0.10.2 with the LLVM of $(nightly)"
        cargo "+$(nightly)" install bpf-linker --version 0.10.2 --locked
    else
        die "bpf-linker needs llvm-22-dev, which no package source has: add LLVM's own package source"
    fi
}

network_tools=(iproute2 nftables ethtool util-linux procps curl ca-certificates tcpdump)

if [ "${1:-}" = --ros2-selection ]; then
    ros2_selection "${2:?the directory of a distribution}"
    exit
fi

for need; do
    case $need in
    --nightly) nightly ;;
    --left-out) left_out ;;
    --ros2) distributions ;;
    --ros2-summary) ros2_summary ;;
    demo)
        packages "${network_tools[@]}" gcc libc6-dev
        rust
        ;;
    fleet)
        packages "${network_tools[@]}" gcc libc6-dev
        engines
        rust
        ;;
    test)
        packages "${network_tools[@]}" clang gcc g++ make tshark systemd strace \
            libfastrtps-dev libfastcdr-dev cyclonedds-dev cyclonedds-tools faketime
        engines
        schemathesis
        rotel
        zenoh
        scapy
        cyclonedds
        bags
        workflows
        types
        page
        helm
        packages ansible-core
        ros
        rust
        nextest
        spelling
        musl aarch64
        qemu
        debian
        cargo_deb
        ebpf
        ;;
    fast)
        packages curl ca-certificates gcc libc6-dev systemd
        prometheus
        rotel
        bags
        workflows
        rust
        nextest
        ;;
    dist)
        packages clang gcc libc6-dev python3
        rust
        musl x86_64 aarch64
        bills
        helm
        workflows
        packages ansible-core
        ros
        qemu
        debian
        cargo_deb
        ;;
    release)
        packages git gnupg minisign apt-utils skopeo libcap2-bin
        # A robot of Fast DDS, and the containers around it.
        packages "${network_tools[@]}" g++ make libfastrtps-dev libfastcdr-dev crun jq
        podman
        qemu
        debian
        python_packages wheels "twine==7.0.0" "check-wheel-contents==0.6.3" "uv==0.13.9" "pipx==1.18.4"
        ;;
    vm)
        other=aarch64
        [ "$(dpkg --print-architecture)" = amd64 ] || other=x86-64
        packages clang mmdebstrap arch-test qemu-system-arm qemu-system-x86 qemu-user-static e2fsprogs make \
            g++ "g++-$other-linux-gnu" libfastrtps-dev cyclonedds-dev cyclonedds-tools gnupg apt-utils
        rust
        musl x86_64 aarch64
        ;;
    types) types ;;
    page) page ;;
    pictures)
        packages webp
        page
        ;;
    ebpf)
        rust
        ebpf
        ;;
    fuzz)
        packages g++
        rust
        nightly_toolchain
        command -v cargo-fuzz >/dev/null || {
            say "installing cargo-fuzz"
            cargo install cargo-fuzz --locked
        }
        ;;
    miri)
        rust
        nightly_toolchain
        cargo "+$(nightly)" miri --version >/dev/null 2>&1 || {
            say "adding miri to the Rust toolchain $(nightly)"
            rustup component add miri --toolchain "$(nightly)"
        }
        ;;
    book)
        rust
        mdbook --version >/dev/null 2>&1 || {
            packages gcc libc6-dev
            say "installing mdbook 0.5.4"
            cargo install mdbook --version 0.5.4 --locked
        }
        ;;
    deny)
        rust
        cargo deny --version 2>/dev/null | grep -q '^cargo-deny 0\.20\.' || {
            packages gcc libc6-dev
            say "installing cargo-deny 0.20.2"
            cargo install cargo-deny --version 0.20.2 --locked
        }
        ;;
    *) die "prerequisites.sh: unknown target $need: use demo, test, fast, dist, release, types, page, pictures, ebpf, fuzz, miri, book or deny" ;;
    esac
done
