#!/bin/sh
# The commands with the lowest version of each library that pyproject.toml allows, in an environment of their own.
set -eu
root=$(cd "$(dirname "$0")/.." && pwd)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

"${PYTHON:-python3}" -m venv "$folder/uv"
"$folder/uv/bin/pip" install --quiet uv
"$folder/uv/bin/uv" venv --quiet --python "${PYTHON:-python3}" "$folder/venv"
"$folder/uv/bin/uv" pip install --quiet --python "$folder/venv/bin/python" --resolution lowest-direct "$root"

cd "$folder"
try() {
    echo "lidarslam $*"
    "$folder/venv/bin/lidarslam" "$@" > log 2>&1 || { cat log; exit 1; }
}
try simulate -o room --world office --scans 20
try simulate -o bag --world office --scans 8 --format rosbag1
try info room
try run room -o run --pose-graph --map-format laz --rerun save
try run bag -o loam --mapping loam
try evaluate run --reference-map room/map.ply
try compare room -o comparison --methods learned+map,kiss-icp
try view run --picture picture.png
try export-bag run -o exported
try export-mesh run -o mesh.ply
try export-grid run -o grid.yaml
