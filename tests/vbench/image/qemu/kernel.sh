#!/bin/bash
# kernel.sh WORK: unpacks WORK/rootfs.tar:/kernel.deb into WORK/kernel, writes WORK/out/vmlinux, prints the kernel's version.
set -euo pipefail
work=$1
tar -xf "$work/rootfs.tar" -C "$work" ./kernel.deb
mkdir "$work/kernel"
dpkg-deb -x "$work/kernel.deb" "$work/kernel"
rm "$work/kernel.deb"
# From Debian 13 on modules live under /usr/lib; modprobe -d looks in /lib.
[ -d "$work/kernel/lib/modules" ] || ln -s usr/lib "$work/kernel/lib"
version=$(ls "$work/kernel/lib/modules")
bz=$work/kernel/boot/vmlinuz-$version

# The plain ELF inside the bzImage boots through PVH and spares 4 s of unpacking under software emulation. Its compressed
# data are found by their magic; where none fits, the bzImage itself boots as well, only slower.
unpack() { # MAGIC PROGRAM...
  local magic=$1 at; shift
  at=$(LC_ALL=C grep -abom1 -P "$magic" "$bz" | head -n 1 | cut -d: -f1 || true)
  [ -n "$at" ] || return 1
  # The data end before the file does, so the program complains about what follows them.
  tail -c +$((at + 1)) "$bz" | "$@" >"$work/out/vmlinux" 2>/dev/null || true
  [ "$(head -c 4 "$work/out/vmlinux" | od -An -tx1 | tr -d ' \n')" = 7f454c46 ]
}
unpack '\xfd7zXZ\x00' xz -dc --single-stream || unpack '\x28\xb5\x2f\xfd' zstd -dcq || cp "$bz" "$work/out/vmlinux"
echo "$version"
