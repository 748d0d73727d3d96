#!/bin/sh
# Checks the package on one system, from inside: runs in a guest of packaging/vm.sh, which passes a
# directory with the package, the demo robot and this file. It prints one line per check:
# CHECK, name, ok or FAILED or none, and the figure, separated by tabs.
cd "$(dirname "$0")" || exit 1
package=$(ls ./ros2probe_*.deb)
config=/etc/ros2probe/ros2probe.yaml
override=/etc/systemd/system/ros2probe.service.d

check() {
    name=$1 outcome=FAILED
    shift
    "$@" && outcome=ok
    printf 'CHECK\t%s\t%s\t%s\n' "$name" "$outcome" "$figure"
    figure=
}
report() { printf 'CHECK\t%s\tnone\t%s\n' "$1" "$2"; }

page() { curl -s --max-time 10 http://127.0.0.1:17400/metrics; }
# Sums the samples whose name and labels match all patterns.
sum() {
    page | awk -v name="$1" -v a="${2-}" -v b="${3-}" \
        'index($0, name "{") == 1 && index($0, a) && index($0, b) { sum += $NF } END { printf "%d", sum }'
}
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
installed() {
    apt-get install -y "$package" >install.log 2>&1 && wait_until 60 is_ready
    status=$?
    [ $status = 0 ] || tail -5 install.log
    figure="$(systemctl show -P ActiveEnterTimestampMonotonic ros2probe | awk '{printf "started %.0f s after boot", $1 / 1e6}')"
    return $status
}
active() {
    figure=$(systemctl is-active ros2probe)
    [ "$figure" = active ]
}

# Threads hold no capability but those that SECURITY.md names, and each has a filter of system calls.
confined() {
    pid=$(systemctl show -P MainPID ros2probe)
    figure= bad=0
    for task in /proc/"$pid"/task/*; do
        thread=$(cat "$task/comm") effective=$(sed -n 's/^CapEff:\t0*//p' "$task/status")
        filters=$(sed -n 's/^Seccomp:\t//p' "$task/status")
        case $thread in
        capture | cgroup | shm | exact) ;;
        *) [ -z "$effective" ] || bad=1 ;;
        esac
        [ "$filters" = 2 ] || bad=1
        figure="$figure $thread:${effective:-0}"
    done
    return $bad
}
exposed() {
    figure=$(systemd-analyze security --no-pager ros2probe.service 2>/dev/null | sed -n 's/.*exposure level for .*: \([0-9.]*\) .*/\1/p')
    [ -n "$figure" ] && [ "${figure%%.*}" -le 4 ]
}
source_of() {
    figure=$(page | sed -n 's/^ros2probe_capture_source_info{source="\([a-z]*\)".*/\1/p')
    abilities=$(page | sed -n 's/^ros2probe_capture_ability{ability="\([a-z_]*\)"} 1$/\1/p' | paste -sd ' ' -)
    figure="$figure: $abilities"
    [ "${figure%%:*}" = "$1" ]
}

# Publishes to a subscriber in another process, and compares the page with both logs.
# counted TOPIC SIZE RATE COUNT [OPTION OF THE ROBOT...]
counted() {
    topic=$1 size=$2 rate=$3 count=$4
    shift 4
    rm -f pub.jsonl sub.jsonl
    $there ./robot --role sub --topic "/$topic" --size "$size" "$@" --log sub.jsonl >sub.log 2>&1 &
    subscriber=$!
    timeout 240 ./robot --role pub --topic "/$topic" --size "$size" --rate "$rate" --count "$count" "$@" \
        --linger 3 --log pub.jsonl >pub.log 2>&1
    sleep 2
    kill -INT $subscriber 2>/dev/null
    wait $subscriber
    if ! [ -s pub.jsonl ] || ! [ -s sub.jsonl ]; then
        figure="no robot: $(tail -1 pub.log) $(tail -1 sub.log)"
        return 1
    fi
    published=$(grep -c '"ev":"pub"' pub.jsonl)
    received=$(grep -c '"ev":"sub"' sub.jsonl)
    label="topic=\"/$topic\""
    settled() { [ "$(sum ros2_topic_messages_total "$label")" -ge "$published" ]; }
    wait_until 10 settled
    messages=$(sum ros2_topic_messages_total "$label")
    delivered=$(sum ros2_topic_delivered_messages_total "$label")
    lost=$(sum ros2_topic_delivery_lost_messages_total "$label")
    figure="sent $published, counted $messages; received $received, delivered $delivered, lost $lost"
    [ "$published" = "$count" ] && [ "$messages" = "$published" ]
}
at_sockets() { counted "$@" && [ "$delivered" = "$received" ] && [ "$received" = "$published" ]; }
with_loss() {
    nft -f - <<END
table inet vm { chain input { type filter hook input priority 0;
    udp length > 1000 numgen inc mod 20 == 7 counter drop; }; }
END
    counted "$@"
    status=$?
    nft delete table inet vm
    before=$(sum ros2_topic_delivery_lost_messages_total "$label" 'cause="before_host"')
    figure="$figure, of which before_host $before"
    [ $status = 0 ] && [ "$delivered" = "$received" ] && [ $((published - received)) = "$lost" ] && [ "$lost" -gt 0 ]
}

restarted() {
    # A publisher that announced itself long ago: only the state has its name.
    ./robot --role pub --topic /kept --size 64 --rate 20 --best-effort >kept.log 2>&1 &
    publisher=$!
    ./robot --role sub --topic /kept --size 64 --best-effort >kept_sub.log 2>&1 &
    subscriber=$!
    has_topic() { [ "$(sum ros2_topic_messages_total 'topic="/kept"')" -gt 0 ]; }
    wait_until 30 has_topic
    sleep 8
    systemctl restart ros2probe
    begun=$(cut -d. -f1 /proc/uptime)
    wait_until 30 has_topic
    status=$?
    figure="known $(($(cut -d. -f1 /proc/uptime) - begun)) s after the restart"
    kill -INT $publisher $subscriber
    wait $publisher $subscriber
    return $status
}

explained() {
    rp doctor >doctor.txt 2>&1
    figure="exit code $?, $(wc -l <doctor.txt) lines"
    ! grep -q panicked doctor.txt
}
upgraded() {
    apt-get install -y --reinstall "$package" >upgrade.log 2>&1 && wait_until 60 is_ready
}
purged() {
    apt-get purge -y ros2probe >purge.log 2>&1
    figure=$(find /etc/ros2probe /var/lib/ros2probe /usr/bin/rp /lib/systemd/system/ros2probe.service 2>/dev/null | wc -l)
    figure="$figure files left"
    [ "${figure%% *}" = 0 ]
}

# Wake-up latency of a real-time thread beside a loaded robot: without, with, without, with the agent.
wakeups() {
    ./robot --role sub --topic /load --size 64000 --best-effort >load_sub.log 2>&1 &
    subscriber=$!
    ./robot --role pub --topic /load --size 64000 --rate 50 --best-effort >load_pub.log 2>&1 &
    publisher=$!
    sleep 5
    for agent in stop start stop start; do
        systemctl $agent ros2probe
        sleep 3
        cyclictest -q -m -p 80 -i 1000 -D "${WAKEUP_SECONDS:-20}" -h 20000 >cyclictest.txt 2>&1
        worst=$(sed -n 's/^# Max Latencies: 0*\([0-9]\)/\1/p' cyclictest.txt)
        tail=$(awk '/^[0-9]/ { count[NR] = $2; at[NR] = $1; all += $2; last = NR }
            END { for (n = 1; n <= last; n++) { sum += count[n]; if (sum >= all * 0.999) { print at[n] + 0; exit } } }' cyclictest.txt)
        printf 'CHECK\twake-up latency, agent %s\tnone\tp99.9 %s us, maximum %s us\n' "$agent" "$tail" "$worst"
    done
    kill -INT $publisher $subscriber
    wait $publisher $subscriber
}

there=
ip link set lo up multicast on
ip route add 224.0.0.0/4 dev lo 2>/dev/null
report kernel "$(uname -r) $(uname -v | grep -o 'PREEMPT[_A-Z]*' | head -1), $(getconf PAGESIZE) B pages, $(nproc) CPUs"
report facts "$([ -e /sys/kernel/btf/vmlinux ] && echo BTF || echo 'no BTF'), cgroup $(stat -fc %T /sys/fs/cgroup), systemd $(systemctl --version | awk 'NR == 1 { print $2 }')"
check install installed
check active active
check "source at the sockets" source_of "${SOURCE:-host}"
check threads confined
check systemd-analyze exposed
if [ "${SOURCE:-host}" = host ]; then
    check "counts at the sockets" at_sockets small 320 100 1000 --reliable
    ip link set lo mtu 1500
    check "fragments at MTU 1500" at_sockets large 100000 10 100 --reliable
    check "loss by nftables" with_loss lossy 4000 50 500 --best-effort
    ip link set lo mtu 65536
fi
check "rp doctor" explained
check "restart with state" restarted

# Two hosts: a network namespace at the other end of a virtual cable.
ip netns add other
ip link add there type veth peer name eth0 netns other
ip addr add 10.9.0.1/24 dev there
ip link set there up
ip -n other addr add 10.9.0.2/24 dev eth0
ip -n other link set eth0 up
ip -n other link set lo up
ip route replace 224.0.0.0/4 dev there
ip -n other route add 224.0.0.0/4 dev eth0
cp $config config.before
sed -i 's/^  # source: auto .*/  source: wire/' $config
systemctl restart ros2probe
wait_until 60 is_ready
check "source on the wire" source_of wire
there='ip netns exec other'
check "counts on the wire" counted wired 320 100 1000 --reliable
check "fragments on the wire" counted wired_large 100000 10 100 --reliable
cp config.before $config
there=
ip link del there
ip route replace 224.0.0.0/4 dev lo
systemctl restart ros2probe
wait_until 60 is_ready
check upgrade upgraded
if command -v cyclictest >/dev/null; then wakeups; fi
check purge purged
sed 's/^/DOCTOR\t/' doctor.txt
journalctl -b --no-pager -p warning -o cat | grep -v '^audit' | tail -30 | sed 's/^/LOG\t/'
