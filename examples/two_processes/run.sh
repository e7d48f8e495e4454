#!/bin/sh
# Two processes, the same declaration: sensor and filter in one, control in the other. The deadline
# is judged where its sink runs. On two computers, run one of these commands on each.
cd "$(dirname "$0")" || exit 1
mddag=${MDDAG:-mddag}
$mddag run graph.yaml --node nodes:Sensor --node nodes:Filter --duration 3s >/dev/null &
upstream=$!
$mddag run graph.yaml --node nodes:Control --duration 3s "$@"
status=$?
wait $upstream && exit $status
