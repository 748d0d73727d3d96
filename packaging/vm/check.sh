#!/bin/sh
# Checks the package on one system, from inside: runs in a guest of packaging/vm.sh, which passes a
# directory with the package, the demo robot, peers in C++ and the scripts.
cd "$(dirname "$0")" || exit 1
. ./lib.sh
source=${SOURCE:-host}

active() {
    figure=$(systemctl is-active ros2probe)
    [ "$figure" = active ]
}
# refuses FILE: apt accepts no package of a copy of the repository in which that file has another byte.
refuses() {
    rm -rf changed lists
    mkdir -p lists/partial
    cp -r apt changed
    for each in changed/$1; do
        if [ -f "$each" ]; then
            printf '~' | dd of="$each" bs=1 seek=$(($(stat -c %s "$each") / 2)) conv=notrunc status=none
        fi
        case $each in */Packages) gzip -9nkf "$each" ;; esac
    done
    ! { apt_from changed -o Dir::State::lists="$here/lists" update &&
        (cd lists && apt_from changed -o Dir::State::lists="$here/lists" download ros2probe); } >>refused.log 2>&1
}
tampering_refused() {
    if refuses nothing; then
        figure="an equal copy is refused: $(tail -1 refused.log)"
        return 1
    fi
    for file in pool/main/r/ros2probe/*.deb dists/stable/main/binary-*/Packages dists/stable/InRelease; do
        if ! refuses "$file"; then
            figure="accepted a changed $file"
            return 1
        fi
    done
    figure="package, index and InRelease"
}
# Threads hold no capability but those that SECURITY.md names, and each has a filter of system calls.
confined() {
    pid=$(systemctl show -P MainPID ros2probe)
    figure= bad=0
    for task in /proc/"$pid"/task/*; do
        thread=$(cat "$task/comm") effective=$(sed -n 's/^CapEff:\t0*//p' "$task/status")
        filters=$(sed -n 's/^Seccomp:\t//p' "$task/status")
        # CAP_BPF, before Linux 5.19.
        case $thread:$effective in
        *: | capture:8000000000 | inside:8000000000) ;;
        *) bad=1 ;;
        esac
        [ "$filters" = 2 ] || bad=1
        figure="$figure $thread:${effective:-0}"
    done
    return $bad
}
exposed() {
    figure=$(systemd-analyze security --no-pager ros2probe.service 2>/dev/null | sed -n 's/.*exposure level for .*: \([0-9.]*\) .*/\1/p')
    # The drop-in for interfaces adds 0.3.
    most=$([ "$source" = host ] && echo 1.5 || echo 1.8)
    awk -v level="$figure" -v most="$most" 'BEGIN { exit !(level != "" && level <= most) }'
}

# counted PEER TOPIC SIZE RATE COUNT [OPTION OF THE PEER...]: publishes to a subscriber in another
# process, and compares the page with both logs.
counted() {
    peer=$1 topic=$2 size=$3 rate=$4 count=$5
    shift 5
    rm -f pub.jsonl sub.jsonl
    $there "$peer" --role sub --topic "/$topic" --size "$size" "$@" --log sub.jsonl >sub.log 2>&1 &
    subscriber=$!
    timeout 240 "$peer" --role pub --topic "/$topic" --size "$size" --rate "$rate" --count "$count" "$@" \
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
at_both_ends() { counted "$@" && [ "$received" = "$published" ]; }
at_sockets() { counted "$@" && [ "$delivered" = "$received" ] && [ "$received" = "$published" ]; }
# A best-effort publisher may fail to send a message that its log has: it counts as lost, too.
with_loss() {
    nft -f - <<END
table inet vm { chain input { type filter hook input priority 0;
    udp length > 1000 numgen inc mod 20 == 7 counter drop; }; }
END
    counted "$@"
    nft delete table inet vm
    causes=$(page | awk -v a="$label" 'index($0, "ros2_topic_delivery_lost_messages_total{") == 1 && index($0, a) && $NF > 0 {
        match($0, /cause="[a-z_]*"/); print substr($0, RSTART + 7, RLENGTH - 8), $NF }' | paste -sd ' ' -)
    figure="$figure: ${causes}"
    [ "$published" = 500 ] && [ "$delivered" = "$received" ] && [ $((published - received)) = "$lost" ] &&
        [ "$lost" -ge 75 ] && [ "$causes" = "before_host $lost" ]
}

# Fast DDS with TCP only, on one host. The publisher listens first.
by_tcp() {
    rm -f pub.jsonl sub.jsonl
    timeout 60 ./fastdds --role pub --topic /tcp --size 100000 --rate 10 --count 60 --reliable --linger 5 \
        --tcp-listen 127.0.0.1:5100 --log pub.jsonl >pub.log 2>&1 &
    publisher=$!
    sleep 2
    ./fastdds --role sub --topic /tcp --size 100000 --reliable --tcp-peer 127.0.0.1:5100 --log sub.jsonl >sub.log 2>&1 &
    subscriber=$!
    wait $publisher
    kill -INT $subscriber
    wait $subscriber
    published=$(grep -c '"ev":"pub"' pub.jsonl) received=$(grep -c '"ev":"sub"' sub.jsonl)
    messages=$(sum ros2_topic_messages_total 'topic="/tcp"')
    delivered=$(sum ros2_topic_delivered_messages_total 'topic="/tcp"')
    figure="sent $published, counted $messages; received $received, delivered $delivered"
    [ "$published" = 60 ] && [ "$messages" = 60 ] && [ "$received" = 60 ] && [ "$delivered" = 60 ]
}

# How many messages the recorder's report names as missing.
named_as_missing() {
    sed -n 's/^.*: \([0-9]*\) of \([0-9]*\) messages recorded.*/\2 \1/p' record.log |
        awk '{ missing += $1 - $2 } END { print missing + 0 }'
}
# A recording has every message of Fast DDS's shared memory, with the packaged configuration: the
# broker attaches for the agent. Of messages in several pieces, sampling misses most.
recorded() {
    rm -rf bag
    rp bag record -o bag "/$1" >record.log 2>&1 &
    recorder=$!
    begun() { grep -q 'Recording' record.log; }
    wait_until 20 begun
    before=$(ticks)
    counted ./fastdds "$@" --transport default
    status=$?
    busy=$(busy_since "$before")
    kill -INT $recorder
    wait $recorder
    missing=$(named_as_missing)
    in_bag=$(rp bag info bag | sed -n 's/^Messages: *\([0-9]*\).*/\1/p')
    in_bag=${in_bag:-0}
    figure="CPUs $busy % busy, sent $published, received $received, in the bag $in_bag, named as missing $missing"
    sed 's/^/RECORD\t/' record.log
    [ $status = 0 ] && [ "$in_bag" = "$published" ]
}
# The same with a large message. An emulated CPU may be too slow for a rate: then each message is in the
# bag or named, and a fifth of the rate is complete.
recorded_large() {
    recorded "$1" "$2" "$3" "$4" --reliable && return
    if [ "$busy" -ge $BUSY ] && [ $((in_bag + missing)) = "$published" ]; then
        first=$figure
        recorded "$1_slow" "$2" 1 20 --reliable
        status=$?
        figure="$first; at 1 Hz: $figure"
        return $status
    fi
    return 1
}
# `rp topic echo` prints every message of Fast DDS's shared memory.
echoed() {
    rp topic echo "/$1" sensor_msgs/msg/PointCloud2 --no-arr >echo.log 2>&1 &
    echo=$!
    sleep 3
    counted ./fastdds "$@" --transport default
    status=$?
    kill -INT $echo
    wait $echo
    printed=$(grep -c '^---' echo.log)
    figure="sent $published, received $received, printed $printed"
    [ $status = 0 ] && [ "$printed" = "$published" ]
}
# Percentage from which on the CPUs of a guest are too slow for what it runs.
BUSY=85
# busy_since TICKS: percentage of the time since then in which the CPUs were not idle.
busy_since() { echo "$1 $(ticks)" | awk '{ printf "%.0f", 100 - 100 * ($4 - $2) / ($3 - $1) }'; }
# Clock ticks of all CPUs: all of them, and the idle ones.
ticks() { awk '/^cpu / { for (n = 2; n <= 9; n++) sum += $n; print sum, $5 + $6 }' /proc/stat; }
# A default robot of Fast DDS with six topics, small and frequent to large and rare, in one recording: in
# the bag is what each publisher sent. `six_topics PARTS`: at rates divided by that number. An emulated
# machine may lack the CPU for the full rates. The robot then has priority over the agent, which must
# name each missing message. At lower rates none may be missing.
six_topics() {
    parts=$1
    # Longer at lower rates, but not for minutes.
    seconds=$((parts > 1 ? 60 : 20))
    rm -rf bag6 six_*.jsonl
    set -- 64:250 320:100 4000:50 150000:10 700000:5 2700000:1
    topics= peers=
    for each; do topics="$topics /six_${each%:*}"; done
    # shellcheck disable=SC2086
    rp bag record -o bag6 $topics >record.log 2>&1 &
    recorder=$!
    begun() { grep -q 'Recording' record.log; }
    wait_until 20 begun
    before=$(ticks)
    for each; do
        size=${each%:*} rate=${each#*:}
        stream="--topic /six_$size --size $size --reliable --transport default"
        # shellcheck disable=SC2086
        ./fastdds --role sub $stream --log "six_sub_$size.jsonl" >/dev/null 2>&1 &
        peers="$peers $!"
        # shellcheck disable=SC2086
        timeout 120 ./fastdds --role pub $stream --rate "$(awk "BEGIN { print $rate / $parts }")" \
            --count $((rate * seconds / parts)) --linger 10 --log "six_pub_$size.jsonl" >/dev/null 2>&1 &
        peers="$peers $!"
    done
    all_sent() {
        for each; do
            [ "$(grep -c '"ev":"pub"' "six_pub_${each%:*}.jsonl" 2>/dev/null)" = $((${each#*:} * seconds / parts)) ] || return 1
        done
    }
    wait_until $((60 + 2 * seconds)) all_sent "$@"
    status=$?
    busy=$(busy_since "$before")
    sleep 3
    kill -INT $recorder
    wait $recorder
    missing=$(named_as_missing)
    sed 's/^/RECORD\t/' record.log
    figure="rates / $parts: CPUs $busy % busy, named as missing $missing"
    absent=0
    for each; do
        size=${each%:*}
        published=$(grep -c '"ev":"pub"' "six_pub_$size.jsonl")
        in_bag=$(rp bag info bag6 | sed -n "s/.*Topic: \/six_$size |.*Count: \([0-9]*\).*/\1/p")
        absent=$((absent + published - ${in_bag:-0}))
        figure="$figure, $size B: ${in_bag:-0} of $published"
    done
    [ $absent = "$missing" ] || status=1
    # Machines that are too slow name what they miss.
    [ $absent = 0 ] || [ "$busy" -ge $BUSY ] || status=1
    # shellcheck disable=SC2086
    kill -INT $peers 2>/dev/null
    # shellcheck disable=SC2086
    wait $peers
    return $status
}
# The same at rates that these CPUs can carry: complete.
six_topics_calm() {
    for each_parts in 3 9 27; do
        six_topics $each_parts || return 1
        [ $absent != 0 ] || return 0
    done
    return 1
}
# The broker's unit ends when nothing is read.
broker_rests() {
    rests() { ! systemctl --quiet is-active ros2probe-attach.service; }
    wait_until 30 rests
    status=$?
    level=$(systemd-analyze security --no-pager ros2probe-attach.service 2>/dev/null | sed -n 's/.*exposure level for .*: \([0-9.]*\) .*/\1/p')
    figure="$(systemctl is-active ros2probe-attach.socket), $(systemctl is-active ros2probe-attach.service), exposure level ${level:-unknown}"
    return $status
}
# With a masked socket, shared memory is sampled and the reason is reported.
masked() {
    systemctl --quiet mask --now ros2probe-attach.socket 2>/dev/null
    restart
    reason=$(page | grep '^ros2probe_capture_ability{.*shared_memory_exact' | head -1)
    figure="$reason"
    systemctl --quiet unmask ros2probe-attach.socket 2>/dev/null
    systemctl start ros2probe-attach.socket
    restart
    [ "${reason##* }" = 0 ]
}

stop_peers() {
    kill -INT $publisher $subscriber
    wait $publisher $subscriber
}

# From the first command of the installation to the first metric of a robot, which starts when the
# agent is ready.
first_metric() {
    ./robot --role sub --topic /first --size 320 --best-effort >first_sub.log 2>&1 &
    subscriber=$!
    ./robot --role pub --topic /first --size 320 --rate 50 --best-effort >first_pub.log 2>&1 &
    publisher=$!
    is_counted() { [ "$(sum ros2_topic_messages_total 'topic="/first"')" -gt 0 ]; }
    wait_until 120 is_counted
    status=$?
    figure=$(awk -v began="$install_began" '{ printf "%.0f s from the first command", $1 - began }' /proc/uptime)
    stop_peers
    return $status
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
    wait_until 90 has_topic
    status=$?
    figure="known $(($(cut -d. -f1 /proc/uptime) - begun)) s after the restart"
    stop_peers
    return $status
}

# Injected causes of late calls. Before Linux 5.15, and without types, a blocked call has no system call.
late_causes() {
    sed -i 's/^capture:$/capture:\n  inside: full\n  late: on/' $config
    restart
    rm -f commands answers
    mkfifo commands
    # A user's workspace, below a directory that only this user may enter.
    install -d -m 0700 -o daemon /home/rover
    install -o daemon -t /home/rover traced libtracetools.so
    setpriv --reuid daemon --clear-groups /home/rover/traced <commands >answers &
    traced=$!
    exec 3>commands
    echo init >&3
    observed() {
        echo 'sleep 2 100' >&3
        why=$(curl -s --max-time 5 'http://127.0.0.1:17401/why?above_ms=15')
        [ "$(sum ros2_callback_duration_seconds_count)" -gt 0 ]
    }
    wait_until 60 observed
    # The bounds of the question hold from the next round on.
    sleep 3
    printf '%s\n' 'sleep 5 30000' 'lock 5 60000' >&3
    ended() { grep -q lock answers; }
    wait_until 30 ended
    sleep 3
    why=$(curl -s --max-time 5 'http://127.0.0.1:17401/why?above_ms=15')
    exec 3>&-
    wait $traced
    rm -r /home/rover
    figure=$(echo "$why" | jq -r '[.causes[] | "\(.late_calls) \(.cause)"] | join(", ")')
    reason=$(echo "$why" | jq -r '.reason // empty')
    figure="$figure${reason:+: $reason}"
    missing=$(curl -s --max-time 5 http://127.0.0.1:17401/health |
        jq -r '.abilities[] | select(.ability == "late_causes") | .reason // empty')
    cp config.before $config
    restart
    if [ -n "$reason" ]; then
        [ "$missing" = "$reason" ] && echo "$figure" | grep -q blocked
    else
        echo "$figure" | grep sleep | grep -q lock
    fi
}

# Each statement of `rp doctor` about this system, against what the system itself says.
explained() {
    rp doctor >doctor.txt 2>&1
    rp doctor --json >doctor.json 2>/dev/null
    true=0 wrong=
    # says AREA PATTERN
    says() {
        if jq -r --arg area "$1" '.findings[] | select(.area == $area) | .sentence' doctor.json | grep -q -e "$2"; then
            true=$((true + 1))
        else
            wrong="$wrong; nothing of $1 says '$2'"
        fi
    }
    is() { [ "$(cat "$1" 2>/dev/null)" = "$2" ] && echo "$3" || echo "$4"; }
    says agent 'is running'
    says agent '0.*same as this rp'
    says kernel "^Linux $(uname -r)"
    says kernel "^pages of $(($(getconf PAGESIZE) / 1024)) KiB"
    says kernel "$([ -e /sys/kernel/btf/vmlinux ] && echo 'is available' || echo 'the kernel has no type information')"
    says kernel "BPF programs are $(is /proc/sys/net/core/bpf_jit_enable 0 interpreted compiled)"
    says kernel "$(is /proc/sys/kernel/unprivileged_bpf_disabled 0 'any user can load' 'unprivileged BPF is disabled')"
    if [ "$(stat -fc %T /sys/fs/cgroup)" = cgroup2fs ]; then
        says kernel 'v2 hierarchy.*at /sys/fs/cgroup'
    else
        says kernel 'no cgroup v2 hierarchy is mounted'
    fi
    says sight "$([ "$source" = host ] && echo 'the agent observes the sockets' || echo 'the agent observes interfaces')"
    says interfaces 'lo is up, with multicast'
    says privileges 'running and enabled'
    says clock 'not synchronised'
    figure="$true statements true${wrong}"
    [ -z "$wrong" ] && ! grep -q panicked doctor.txt
}
# What `rp doctor` advises without cgroup v2.
remedied() {
    remedy=$(jq -r '.findings[] | select(.check == "cgroup") | .remedies[0].line' doctor.json)
    figure=$remedy
    sh -c "$(echo "$remedy" | sed 's/sudo //g')" && restart && source_of host && source=host
}
upgraded() {
    apt-get install -y --reinstall "$package" >upgrade.log 2>&1 && wait_until 60 is_ready
}
# The agent's own counters of what it had to leave out since its start.
complete() {
    page | grep -E '^ros2probe_(capture_dropped_packets|records_dropped|dropped_datagrams|contended_datagrams|missed_messages)_total' >blind.txt
    figure=$(awk '{ sum += $NF } END { print sum + 0, "packets, records or datagrams not seen" }' blind.txt)
    [ -s blind.txt ] && [ "${figure%% *}" = 0 ]
}
# The kernel complains about nothing that the agent made it do.
silent() {
    figure=$(dmesg | grep -E 'WARNING:|BUG:|Oops|Call trace' | head -1 | sed 's/^\[[ 0-9.]*\] //')
    dmesg | grep -A 12 -E 'WARNING:|BUG:|Oops' | head -40 >warnings.txt
    [ -z "$figure" ]
}
# The kernel may refuse the programs for TCP alone.
zenoh_observed() {
    figure=$(journalctl -u ros2probe --no-pager -o cat | grep 'Zenoh are not observed' | head -1)
    [ -z "$figure" ]
}
# Each path with type, mode, owner and target, and the checksum of each file in /etc. Left out are file
# systems in memory, files of these checks, logs, and caches of apt. So are locks and backups of dpkg,
# and what systemd writes while it runs.
paths() {
    {
        find / -xdev \( -path /proc -o -path /sys -o -path /dev -o -path /run -o -path /tmp -o -path "$here" \
            -o -path /var/tmp -o -path /var/log -o -path /var/cache/apt -o -path /var/lib/apt \
            -o -path '/var/lib/systemd/[!d]*' -o -path /var/lib/private -o -path '/var/lib/dpkg/*-old' \
            -o -path '/var/lib/dpkg/*lock*' -o -path '/etc/*-' \) -prune -o -printf '%p %y %m %U:%G %l\n'
        find /etc -type f ! -name '*-' -exec sha256sum {} +
    } | LC_ALL=C sort
}
# The removal that docs/install.md describes leaves the paths of before the installation.
purged() {
    apt-get purge -y ros2probe >purge.log 2>&1 && deluser --system ros2probe >>purge.log 2>&1
    status=$?
    paths >paths.after
    LC_ALL=C comm -13 paths.before paths.after >left.txt
    figure="$(wc -l <left.txt) paths left or changed $(cut -d ' ' -f 1-3 left.txt | head -3 | paste -sd ' ' -)"
    [ $status = 0 ] && ! [ -s left.txt ]
}

# CPU of the agent and of a subscriber in C++ beside it, for the same messages.
cost() {
    ./fastdds --transport udp --role sub --topic /cost --size "$1" --best-effort >cost_sub.log 2>&1 &
    subscriber=$!
    ./fastdds --transport udp --role pub --topic /cost --size "$1" --rate "$2" --best-effort >cost_pub.log 2>&1 &
    publisher=$!
    measured() { [ "$(sum ros2_topic_messages_total 'topic="/cost"')" -gt 0 ]; }
    wait_until 60 measured
    agent=$(systemctl show -P MainPID ros2probe)
    before=$(ran "$agent") theirs=$(ran $subscriber) messages=$(sum ros2_topic_messages_total 'topic="/cost"')
    sleep 20
    after=$(ran "$agent") their=$(ran $subscriber)
    messages=$(($(sum ros2_topic_messages_total 'topic="/cost"') - messages))
    stop_peers
    report "CPU beside $1 B at $2 Hz" "$(awk -v a=$((after - before)) -v s=$((their - theirs)) -v n=$messages \
        'BEGIN { if (n) printf "a message: agent %.0f us, subscriber in C++ %.0f us, ratio %.2f, of %d", a / n / 1e3, s / n / 1e3, a / s, n }')"
}

# Wake-up latency of a real-time thread beside a loaded robot: without, with, without, with the agent.
wakeups() {
    ./robot --role sub --topic /load --size 64000 --best-effort >load_sub.log 2>&1 &
    subscriber=$!
    ./robot --role pub --topic /load --size 64000 --rate 50 --best-effort >load_pub.log 2>&1 &
    publisher=$!
    sleep 5
    for agent in stop start stop start stop start; do
        systemctl $agent ros2probe
        sleep 3
        cyclictest -q -m -p 80 -i 1000 -D "${WAKEUP_SECONDS:-20}" -h 400000 >cyclictest.txt 2>&1
        worst=$(sed -n 's/^# Max Latencies: 0*\([0-9]\)/\1/p' cyclictest.txt)
        tail=$(awk '/^[0-9]/ { count[NR] = $2; at[NR] = $1; all += $2; last = NR }
            END { for (n = 1; n <= last; n++) { sum += count[n]; if (sum >= all * 0.999) { print at[n] + 0; exit } } }' cyclictest.txt)
        report "wake-up latency, agent $agent" "p99.9 $tail us, maximum $worst us"
        # Powers of two of microseconds, and how many wake-ups took so long.
        awk -v agent="$agent" '/^[0-9]/ && $2 > 0 { bin = 1; while (bin * 2 <= $1) bin *= 2; bins[bin] += $2 }
            END { printf "HISTOGRAM\tagent %s", agent; for (bin = 1; bin <= 262144; bin *= 2) printf "\t%d", bins[bin]; print "" }' cyclictest.txt
    done
    stop_peers
}

there=
[ -z "${HIDE_BTF-}" ] || mount -t tmpfs none /sys/kernel/btf
within lo
describe
paths >paths.before
check "a changed repository is refused" tampering_refused
check install installed
if ! is_ready; then
    journalctl -u ros2probe --no-pager -o cat | tail -30 | sed 's/^/LOG\t/'
    exit 1
fi
[ "$source" != host ] || check "first metric" first_metric
check active active
check "source" source_of "$source"
check threads confined
check systemd-analyze exposed
report memory "$(systemctl show -P MemoryCurrent ros2probe | awk '{printf "%.1f MB", $1 / 1e6}')"
cp $config config.before
if [ "$source" = host ]; then
    check "programs for Zenoh" zenoh_observed
    check "counts at the sockets" at_sockets ./robot small 320 100 1000 --reliable
    ip link set lo mtu 1500
    check "DATA_FRAGs at MTU 1500" at_sockets ./robot large 100000 10 100 --reliable
    check "IP fragments at MTU 1500" at_sockets ./fastdds whole 100000 10 100 --reliable --transport udp
    check "loss by nftables" with_loss ./robot lossy 4000 50 500 --best-effort
    ip link set lo mtu 65536
    check "Fast DDS, UDP" at_sockets ./fastdds fast 320 100 1000 --reliable --transport udp
    check "Cyclone DDS" at_sockets ./cyclonedds cyclone 320 100 1000 --reliable
    check "nothing missed at the sockets" complete
    check "Fast DDS, TCP" by_tcp
    check "Fast DDS, shared memory, recorded" recorded exact 150000 10 100 --reliable
    check "Fast DDS, shared memory, 2.7 MB, recorded" recorded_large large_exact 2700000 5 50
    check "Fast DDS by default, six topics, recorded" six_topics 1
    check "Fast DDS by default, six topics at lower rates, recorded" six_topics_calm
    check "Fast DDS, shared memory, echoed" echoed printed 64 250 5000 --reliable
    check "Fast DDS, shared memory, 700 KB, echoed" echoed large_printed 700000 5 50 --reliable
    check "causes of late calls" late_causes
    check "the broker rests" broker_rests
    check "the broker masked" masked
fi
check "rp doctor" explained
if [ "$(stat -fc %T /sys/fs/cgroup)" = tmpfs ]; then
    check "remedy of rp doctor" remedied
    check "counts at the sockets" at_sockets ./robot small 320 100 1000 --reliable
fi
check "restart with state" restarted
cost 320 200
cost 100000 20

# Two hosts: a network namespace at the other end of a virtual cable.
ip netns add other
ip link add there type veth peer name eth0 netns other
ip addr add 10.9.0.1/24 dev there
ip -n other addr add 10.9.0.2/24 dev eth0
ip -n other link set eth0 up
ip -n other link set lo up
within there
ip -n other route add 224.0.0.0/4 dev eth0
sed -i 's/^  # source: auto .*/  source: wire/' $config
install -D -m 0644 -t /run/systemd/system/ros2probe.service.d /usr/share/ros2probe/interfaces.conf
systemctl daemon-reload
restart
check "source on the wire" source_of wire
there='ip netns exec other'
check "counts on the wire" counted ./robot wired 320 100 1000 --reliable
check "DATA_FRAGs on the wire" counted ./robot wired_large 100000 10 100 --reliable
check "IP fragments on the wire" at_both_ends ./fastdds wired_whole 100000 10 100 --reliable --transport udp
check "nothing missed on the wire" complete
cp config.before $config
rm /run/systemd/system/ros2probe.service.d/interfaces.conf
systemctl daemon-reload
there=
ip link del there
within lo
restart
check upgrade upgraded
[ -z "${REAL_TIME-}" ] || wakeups
check "the kernel's log" silent
check purge purged
sed 's/^/DOCTOR\t/' doctor.txt
sed 's/^/BLIND\t/' blind.txt
sed 's/^/DMESG\t/' warnings.txt
journalctl -b --no-pager -p warning -o cat | grep -v '^audit' | tail -30 | sed 's/^/LOG\t/'
