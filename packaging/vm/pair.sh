#!/bin/sh
# Checks losses between two robots: runs in both guests of a pair of packaging/vm.sh, whose network
# cards face each other. Each sends to the other in turn, and the receiver's link drops frames.
cd "$(dirname "$0")" || exit 1
. ./lib.sh

# A frame of each twentieth message is dropped before the receiver's network stack.
dropping() {
    nft -f - <<END
table netdev vm { chain ingress { type filter hook ingress device "$card" priority 0;
    udp length 1100-1400 numgen inc mod 20 == 7 counter drop; }; }
END
}
sent() {
    timeout 600 ./robot --role pub --topic "/$1" --size 1200 --rate 50 --count 500 --best-effort \
        --linger 8 --log pub.jsonl >pub.log 2>&1
    messages=$(sum ros2_topic_messages_total "topic=\"/$1\"")
    figure="sent $(grep -c '"ev":"pub"' pub.jsonl), counted $messages"
    [ "$messages" = 500 ]
}
received() {
    rm -f sub.jsonl
    dropping
    ./robot --role sub --topic "/$1" --size 1200 --best-effort --log sub.jsonl >sub.log 2>&1 &
    subscriber=$!
    is_last() {
        last=$(grep '"ev":"sub"' sub.jsonl 2>/dev/null | tail -1 | jq .seq)
        [ "${last:-0}" -ge 498 ]
    }
    wait_until 600 is_last
    sleep 5
    label="topic=\"/$1\""
    got=$(grep '"ev":"sub"' sub.jsonl | jq -rs 'length')
    missing=$(grep '"ev":"sub"' sub.jsonl | jq -rs '[.[].seq] | max - min + 1 - length')
    delivered=$(sum ros2_topic_delivered_messages_total "$label")
    lost=$(sum ros2_topic_delivery_lost_messages_total "$label")
    before=$(sum ros2_topic_delivery_lost_messages_total "$label" 'cause="before_host"')
    figure="received $got, missing $missing; delivered $delivered, lost $lost, of which before_host $before"
    kill -INT $subscriber
    wait $subscriber
    nft delete table netdev vm
    [ "$missing" -gt 0 ] && [ "$got" = "$delivered" ] && [ "$missing" = "$lost" ] && [ "$lost" = "$before" ]
}

ip link set lo up
card=$(ls /sys/class/net | grep -v lo | head -1)
ip addr add "10.8.0.$NUMBER/24" dev "$card"
within "$card"
describe
check install installed
if [ "$NUMBER" = 1 ]; then
    check "messages to the other" sent one
    check "messages from the other" received two
else
    check "messages from the other" received one
    check "messages to the other" sent two
fi
journalctl -b --no-pager -p warning -o cat | grep -v '^audit' | tail -30 | sed 's/^/LOG\t/'
