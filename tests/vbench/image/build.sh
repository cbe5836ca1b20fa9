#!/bin/bash
# Builds the guest of the virtual USB bench: a stock Debian kernel, a small Debian with the real systemd-udevd, and an
# initramfs that joins them. Everything lands in one directory of the cache, named by the hash of these scripts, so that
# a build is either whole or absent and a second call does nothing.
#
#   build.sh           builds what is missing, prints the directory last
#   build.sh --check   prints the directory when it is built, otherwise names what to run and exits 3
#
# Needs the packages of packages.txt and root, or unprivileged user namespaces with a range of ids, or sudo.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
cache=${RAPID_VBENCH_DIR:-${XDG_CACHE_HOME:-$HOME/.cache}/rapid/vbench}

# The guest runs binaries built on this host, so it is the same Debian where the host is one.
suite=$(. /etc/os-release; [ "${ID:-}" = debian ] && echo "${VERSION_CODENAME:-bookworm}" || echo bookworm)
key=$(cd "$here" && sha256sum build.sh rootfs.sh kernel.sh disk.sh guest-init.sh initramfs-init.sh guest-packages.txt modules.txt \
  | sha256sum | cut -c1-12)
image=$cache/$suite-$key

if [ "${1:-}" = --check ]; then
  [ -f "$image/manifest" ] && { echo "$image"; exit 0; }
  echo "the guest image $image is not built: run \`make setup\` (or $here/build.sh)" >&2
  exit 3
fi

step() { echo "vbench image: $*" >&2; }
die() { step "error: $*"; exit 1; }

for tool in qemu-system-x86_64 busybox mmdebstrap modprobe depmod cpio mke2fs xz; do
  PATH=$PATH:/sbin:/usr/sbin command -v "$tool" >/dev/null || die "$tool is missing: install the packages of $here/packages.txt"
done
export PATH=$PATH:/sbin:/usr/sbin

mkdir -p "$cache"
exec 9>"$cache/.lock"
flock -n 9 || { step "another build is running, waiting for it"; flock 9; }
if [ -f "$image/manifest" ]; then
  step "up to date (kernel $(sed -n 's/^kernel //p' "$image/manifest"))"
  echo "$image"
  exit 0
fi

# `as_root` runs a command that must see root-owned files, `bootstrap` one that makes a system of many owners: plainly as
# root, inside user namespaces (the second kind wants a range of ids of the user's own), or through sudo.
as_root=() bootstrap=()
if [ "$(id -u)" != 0 ]; then
  if unshare -r true 2>/dev/null && command -v newuidmap >/dev/null && grep -q "^$(id -un):" /etc/subuid 2>/dev/null; then
    as_root=(unshare -r)
  elif command -v sudo >/dev/null; then as_root=(sudo) bootstrap=(sudo)
  else die "needs sudo, or user namespaces: package uidmap and a line for $(id -un) in /etc/subuid"; fi
fi

# A build that was cut off leaves only such a directory; holding the lock, every one of them is dead.
"${as_root[@]}" rm -rf "$cache"/.build.*
work=$(mktemp -d "$cache/.build.XXXXXX")
trap '"${as_root[@]}" rm -rf "$work"' EXIT
mkdir "$work/out"
started=$SECONDS

step "installing Debian $suite with its kernel ($(tr '\n' ' ' <"$here/guest-packages.txt"))"
"${bootstrap[@]}" "$here/rootfs.sh" "$suite" "$work"
step "unpacking the kernel"
kernel=$("$here/kernel.sh" "$work")
step "packing the disk and the initramfs (kernel $kernel)"
"${as_root[@]}" "$here/disk.sh" "$kernel" "$work"

printf 'suite %s\nkernel %s\nscripts %s\n' "$suite" "$kernel" "$key" >"$work/out/manifest"
chmod 755 "$work/out"
mv -T "$work/out" "$image"

# The newest two stay: another checkout may be one step behind this one.
ls -1dt "$cache"/*-*/manifest | tail -n +3 | while read -r old; do "${as_root[@]}" rm -rf "$(dirname "$old")"; done
step "done in $((SECONDS - started)) s: $(du -sh "$image" | cut -f1) in $image"
echo "$image"
