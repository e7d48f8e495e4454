#!/bin/sh
# Run installed programs that know nothing of this executor, as `ros2 run` finds them. install/ stands
# for a colcon workspace; with one of your own, source its setup file instead of the next line.
here=$(cd "$(dirname "$0")" && pwd) || exit 1
export AMENT_PREFIX_PATH="$here/install${AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH}"
exec ${MDDAG:-mddag} run "$here/graph.yaml" --duration 3s \
    --node their_robot/talker.py --node their_robot/listener.py "$@"
