#!/usr/bin/env bash
# Try a wheel where it will live: in bare Debian systems that have python3-venv and nothing else. As root:
#
#   packaging/test_wheel.sh FOLDER dist/geokit_nanovdb-*-cp311-*.whl bookworm
#   packaging/test_wheel.sh FOLDER dist/geokit_nanovdb-*-cp312-abi3-*.whl trixie
#
# FOLDER keeps the system between calls (300 MB, 2 GB with what pip installs). Needs debootstrap and a network.
# BESIDE="torch open3d" also loads those wheels beside geokit. Prints a transcript; the exit status is 0 if all works.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
folder=$(realpath -m "$1") wheel=$(realpath "$2") suite=$3
root=$folder/$suite

if [[ ! -x $root/usr/bin/python3 ]]; then
  mkdir -p "$folder"
  debootstrap --variant=minbase --include=python3-venv,ca-certificates "$suite" "$root" >"$folder/$suite.log"
fi
cp /etc/resolv.conf "$root/etc/"
# Where the network has a certificate of its own, this machine knows it.
cp /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/"
mkdir -p "$root/root/wheels" "$root/root/data"
cp "$wheel" "$root/root/wheels/"
cp -r "$here/data/samples" "$root/root/data/"
cp "$here/packaging/try_wheel.py" "$root/root/"
# The first example of the README, as it stands there.
sed -n '/^```py$/,/^```$/p' "$here/README.md" | sed '/^```/d' >"$root/root/readme.py"

mounted=()
trap 'for at in "${mounted[@]}"; do umount "$at"; done' EXIT
for at in proc sys; do
  mountpoint -q "$root/$at" || { mount --bind "/$at" "$root/$at" && mounted+=("$root/$at"); }
done
if ! mountpoint -q "$root/dev"; then
  mount --bind /dev "$root/dev" && mounted+=("$root/dev")
fi

inside() {
  printf '$ %s\n' "$*"
  chroot "$root" env -i PATH=/opt/geokit/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C.UTF-8 \
    DEBIAN_FRONTEND=noninteractive OMP_NUM_THREADS="${OMP_NUM_THREADS:-2}" bash -c "cd /root && $*"
}

inside "cat /etc/debian_version; ldd --version | head -1"
inside "[ -x /opt/geokit/bin/python ] || python3 -m venv /opt/geokit"
inside "pip install --quiet --disable-pip-version-check wheels/$(basename "$wheel")"
inside "pip install --quiet --disable-pip-version-check --force-reinstall --no-deps wheels/$(basename "$wheel")"
inside "du -sh /opt/geokit/ | cut -f1"
inside "geokit doctor"
inside "geokit info --help | grep -A1 Examples:"
inside "python try_wheel.py ${BESIDE:-}"
inside "BROWSER=true python readme.py && ls torus.ply"
# Figures need their extra and an OpenGL library: without them, errors name the command; then they are drawn.
inside "geokit render torus.ply -o torus.png 2>&1 | tail -1"
inside "pip install --quiet --disable-pip-version-check 'wheels/$(basename "$wheel")[figures]'"
if ! chroot "$root" dpkg -s libegl1 >/dev/null 2>&1; then
  inside "geokit render torus.ply -o torus.png 2>&1 | tail -1"
  inside "apt-get update -qq && apt-get install -y -qq --no-install-recommends libegl1 libgl1 >/dev/null 2>&1"
fi
inside "geokit render torus.ply -o torus.png --force && ls -l torus.png"
