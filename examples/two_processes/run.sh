#!/bin/sh
# Two processes, the same declaration: sensor and filter in one, control in the other. The deadline
# is judged where its sink runs. The first runs until it gets a signal: the other waits for it and
# then takes 3 s. On two computers, run one of these commands on each.
cd "$(dirname "$0")" || exit 1
mddag=${MDDAG:-mddag}
$mddag run graph.yaml --node nodes:Sensor --node nodes:Filter >/dev/null &
upstream=$!
$mddag run graph.yaml --node nodes:Control --duration 3s "$@"
status=$?
kill $upstream
wait $upstream && exit $status
