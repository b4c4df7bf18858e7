#!/bin/sh
# Makes a folder from which deploy/install.sh installs without the network: deploy/wheelhouse.sh FOLDER
# Run it on a computer with the network and the same system, processor and Python as the other one.
# Packages must have the hashes of deploy/requirements.txt. huddle itself is built from this folder, by
# tools with the hashes of deploy/build-requirements.txt, which go into an environment of their own.
set -eu
folder=${1:?expected a folder: deploy/wheelhouse.sh wheelhouse}
here=$(cd "$(dirname "$0")/.." && pwd)
python=${PYTHON:-python3}

mkdir -p "$folder"
"$python" -m pip download --quiet --require-hashes --only-binary :all: --dest "$folder" \
    -r "$here/deploy/requirements.txt"
rm -f "$folder"/huddle_bench-*.whl
tools=$(mktemp -d)
trap 'rm -rf "$tools"' EXIT
"$python" -m venv "$tools"
"$tools/bin/python" -m pip install --quiet --require-hashes --only-binary :all: \
    -r "$here/deploy/build-requirements.txt"
"$tools/bin/python" -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir "$folder" "$here"
wheel=$(basename "$folder"/huddle_bench-*.whl)
version=$(echo "$wheel" | cut -d- -f2)
{
    cat "$here/deploy/requirements.txt"
    echo "huddle-bench[fast,metrics,report,signing,web]==$version \\"
    echo "    --hash=sha256:$(sha256sum "$folder/$wheel" | cut -d' ' -f1)"
} > "$folder/requirements.txt"
