#!/bin/sh
# Make a drive, run the tracker and the brake on it, change a constant, and find what that changes.
here=$(cd "$(dirname "$0")" && pwd) || exit 1
mddag=${MDDAG:-mddag}
work=$(mktemp -d) || exit 1
trap 'rm -r "$work"' EXIT
cp "$here/graph.yaml" "$here/robot.py" "$work" && cd "$work" || exit 1

# The drive: what the lidar publishes in ten virtual seconds.
$mddag simulate graph.yaml --duration 10s --trace releases.mcap > simulated.txt
$mddag rerun releases.mcap graph.yaml --node robot:Lidar -o drive.mcap > drive.txt

echo 'The nodes as they are:'
$mddag rerun drive.mcap graph.yaml --node robot:Tracker --node robot:Brake -o before.mcap

echo 'With another gain of the tracker:'
sed -i.old 's/^GAIN = .*/GAIN = 0.31/' robot.py
$mddag rerun drive.mcap graph.yaml --node robot:Tracker --node robot:Brake \
    --expect before.mcap && exit 1

echo 'With a tracker that takes 3 ms longer:'
mv robot.py.old robot.py
sed -i.old 's/execution_time: 8ms/execution_time: 11ms/' graph.yaml
$mddag rerun drive.mcap graph.yaml --node robot:Tracker --node robot:Brake \
    --expect before.mcap && exit 1
exit 0
