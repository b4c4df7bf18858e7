#!/bin/sh
# Installs huddle as a service: sudo deploy/install.sh lab.toml
# Own user, own environment in /opt/huddle, bench file in /etc/huddle, recordings in /var/lib/huddle.
# Packages come from a folder of deploy/wheelhouse.sh (WHEELHOUSE=FOLDER, or wheelhouse beside this
# one; made if it is missing), without the network, each with its hash.
# Can be run again, for another bench or a newer version. ROOT=FOLDER installs below that folder, for
# a test or an image, and starts nothing.
set -eu
bench=${1:?expected a bench file: deploy/install.sh lab.toml}
name=$(basename "$bench" .toml)
here=$(cd "$(dirname "$0")/.." && pwd)
root=${ROOT:-}

[ -n "$root" ] || [ "$(id -u)" = 0 ] || { echo "expected root: sudo $0 $*" >&2; exit 2; }
[ -f "$bench" ] || { echo "$bench: expected a bench file" >&2; exit 2; }
case $name in *[!A-Za-z0-9_-]*) echo "$name: expected letters, digits, - and _" >&2; exit 2 ;; esac

if [ -z "$root" ] && ! id huddle >/dev/null 2>&1; then
    useradd --system --home-dir /var/lib/huddle --shell /usr/sbin/nologin --user-group huddle
fi
mkdir -p "$root/opt/huddle/docs" "$root/etc/huddle" "$root/etc/systemd/system"
python3 -m venv "$root/opt/huddle/venv"
wheelhouse=${WHEELHOUSE:-$here/wheelhouse}
[ -f "$wheelhouse/requirements.txt" ] || \
    PYTHON="$root/opt/huddle/venv/bin/python" "$here/deploy/wheelhouse.sh" "$wheelhouse"
"$root/opt/huddle/venv/bin/pip" install --quiet --no-index --find-links "$wheelhouse" \
    --require-hashes -r "$wheelhouse/requirements.txt"
cp "$here/docs/service.md" "$root/opt/huddle/docs/"
cp "$here/deploy/huddle@.service" "$root/etc/systemd/system/"
# Recordings go where the service may write; a directory of the bench file's own must be absolute.
sed 's#^directory *= *"recordings".*#directory = "/var/lib/huddle/'"$name"'"#' "$bench" \
    > "$root/etc/huddle/$name.toml"
"$root/opt/huddle/venv/bin/huddle" check "$root/etc/huddle/$name.toml" --no-devices
if [ -z "$root" ]; then
    chown -R root:huddle /etc/huddle && chmod 750 /etc/huddle && chmod 640 /etc/huddle/*.toml
    systemctl daemon-reload
    systemctl enable --now "huddle@$name"
    systemctl --no-pager status "huddle@$name"
fi
