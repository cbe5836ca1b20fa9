#!/bin/bash
# root.sh WORK: WORK/root, the root folder of a guest in User-Mode Linux, from WORK/rootfs.tar. It is seen through hostfs and never
# written to. All of it belongs to who runs this: that user's processes are the guest, whose root can read nothing else.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
root=$1/root
mkdir "$root"
# The kernel fills /dev; a user cannot make device nodes.
tar -xf "$1/rootfs.tar" -C "$root" --no-same-owner --same-permissions --exclude='./dev/*'
# A program with the bit would run as that user, who is not root in the guest: an ordinary user's guest could not even mount.
find "$root" -type f -perm /6000 -exec chmod ug-s {} +
rm -rf "$root"/var/cache/apt/* "$root"/var/lib/apt/lists/*
# The kernel's modules are mounted here.
mkdir -p "$root/usr/lib/modules"
install -m 755 "$here/../guest-init.sh" "$root/usr/sbin/bench-init"
chmod 755 "$root"
