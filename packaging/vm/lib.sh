# What the checks of packaging/vm share; a guest's shell reads it. A check prints one line: CHECK, its
# name, ok or FAILED or none, and the figure, separated by tabs.
# shellcheck shell=sh
config=/etc/ros2probe/ros2probe.yaml
package=$(ls ./ros2probe_*.deb)
here=$PWD
figure=

# check NAME COMMAND...: the command leaves its figure in $figure.
check() {
    name=$1 outcome=FAILED
    shift
    "$@" && outcome=ok
    printf 'CHECK\t%s\t%s\t%s\n' "$name" "$outcome" "$figure"
    figure=
}
report() { printf 'CHECK\t%s\tnone\t%s\n' "$1" "$2"; }

page() { curl -s --max-time 10 http://127.0.0.1:17400/metrics; }
# sum METRIC [PATTERN [PATTERN]]: of the samples whose labels match.
sum() {
    page | awk -v name="$1" -v a="${2-}" -v b="${3-}" \
        'index($0, name "{") == 1 && index($0, a) && index($0, b) { sum += $NF } END { printf "%d", sum }'
}
# wait_until SECONDS COMMAND...
wait_until() {
    limit=$1
    shift
    while [ "$limit" -gt 0 ]; do
        "$@" && return
        sleep 1
        limit=$((limit - 1))
    done
    return 1
}

is_ready() { [ "$(curl -s -o /dev/null -w '%{http_code}' --max-time 5 http://127.0.0.1:17400/readyz)" = 200 ]; }
restart() { systemctl restart ros2probe && wait_until 60 is_ready; }
# apt_from DIRECTORY COMMAND...: apt-get with that repository as its only source.
apt_from() {
    echo "deb [signed-by=$here/apt/ros2probe.asc] file:$here/$1 stable main" >"$here/repository.list"
    shift
    apt-get -o Dir::Etc::sourcelist="$here/repository.list" -o Dir::Etc::sourceparts=/nonexistent \
        -o APT::Update::Error-Mode=any "$@"
}
# Installs as docs/install.md does, from the repository of the release.
installed() {
    install_began=$(cut -d ' ' -f 1 /proc/uptime)
    apt_from apt update >install.log 2>&1 && apt_from apt install -y ros2probe >>install.log 2>&1 &&
        wait_until 60 is_ready
    status=$?
    [ $status = 0 ] || tail -5 install.log
    figure="$(systemctl show -P ActiveEnterTimestampMonotonic ros2probe | awk '{printf "started %.0f s after boot", $1 / 1e6}')"
    return $status
}
source_of() {
    figure=$(page | sed -n 's/^ros2probe_capture_source_info{source="\([a-z]*\)".*/\1/p')
    abilities=$(page | sed -n 's/^ros2probe_capture_ability{ability="\([a-z_]*\)"} 1$/\1/p' | paste -sd ' ' -)
    figure="$figure: $abilities"
    [ "${figure%%:*}" = "$1" ]
}
# within INTERFACE: multicast goes there.
within() {
    ip link set "$1" up multicast on
    ip route replace 224.0.0.0/4 dev "$1"
}
describe() {
    version=$(uname -v | grep -o 'PREEMPT[_A-Z]*' | head -1)
    report kernel "$(uname -r) ${version:+$version }$(getconf PAGESIZE) B pages, $(nproc) CPUs"
    report facts "$([ -e /sys/kernel/btf/vmlinux ] && echo BTF || echo 'no BTF'), cgroup $(stat -fc %T /sys/fs/cgroup), systemd $(systemctl --version | awk 'NR == 1 { print $2 }')"
}
# Nanoseconds on a CPU of all threads of a process.
ran() { cat /proc/"$1"/task/*/schedstat | awk '{ sum += $1 } END { printf "%.0f", sum }'; }
