#!/bin/sh
# Source distribution and wheel, in dist/ once the wheel has been tried in an environment of its own. Publishes nothing.
set -eu
root=$(cd "$(dirname "$0")/.." && pwd)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

"${PYTHON:-python3}" -m venv "$folder/build"
"$folder/build/bin/pip" install --quiet build
"$folder/build/bin/python" -m build --outdir "$folder/dist" "$root"

"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet "$folder"/dist/*.whl

cd "$folder"
try() {
    echo "lidarslam $*"
    "$folder/venv/bin/lidarslam" "$@" > log 2>&1 || { cat log; exit 1; }
}
try --version
cat log
try simulate -o office --world office --scans 20
try run office -o run

mkdir -p "$root/dist"
for file in "$folder"/dist/*; do
    mv "$file" "$root/dist"
    echo "tried, and written to dist/${file##*/}"
done
