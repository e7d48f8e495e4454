#!/bin/sh
# Run the fusion for three seconds and print for each sink how its deadline was met.
cd "$(dirname "$0")" || exit 1
exec ${MDDAG:-mddag} run graph.yaml --node nodes:pulse --node nodes:stages --duration 3s "$@"
