#!/bin/bash
# disk.sh KERNEL_VERSION WORK: WORK/out/root.ext4 (read-only root with the wanted modules) and WORK/out/boot.cpio.
# Sees itself as root; every file becomes root's, which is all a guest with one user needs.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
version=$1 work=$2 kernel=$work/kernel root=$work/root boot=$work/boot

depmod -b "$kernel" "$version"
# Module files with their dependencies, in load order, as paths.
closure() {
  local module
  for module in "$@"; do modprobe -d "$kernel" -S "$version" --show-depends "$module" | awk '$1 == "insmod" { print $2 }'; done \
    | awk '!seen[$0]++'
}
mapfile -t early < <(awk '$1 == "boot" { print $2 }' "$here/modules.txt")
mapfile -t all < <(awk '!/^#/ && NF { print $NF }' "$here/modules.txt")

mkdir "$root"
# Device nodes cannot be made in a user namespace and are not wanted: the kernel fills /dev.
tar -xf "$work/rootfs.tar" -C "$root" --no-same-owner --exclude='./dev/*' --exclude=./kernel.deb
rm -rf "$root"/var/cache/apt/* "$root"/var/lib/apt/lists/* "$root/usr/lib/modules"
target=$root/usr/lib/modules/$version
for file in $(closure "${all[@]}"); do install -D -m 644 "$file" "$target/${file#*/lib/modules/"$version"/}"; done
cp "$kernel/lib/modules/$version"/modules.{builtin,builtin.modinfo,order} "$target/"
depmod -b "$root" "$version"
install -m 755 "$here/../guest-init.sh" "$root/usr/sbin/bench-init"
# A third of slack over what the files take: names and small files cost whole blocks.
size=$(du -sm "$root" | cut -f1)
mke2fs -q -t ext4 -O ^has_journal -m 0 -d "$root" "$work/out/root.ext4" "$((size * 4 / 3 + 32))M" >/dev/null

mkdir -p "$boot"/{bin,dev,proc,mnt,root,modules}
install -m 755 "$(command -v busybox)" "$boot/bin/busybox"
for applet in sh mount umount insmod switch_root mkdir sleep; do ln -s busybox "$boot/bin/$applet"; done
for file in $(closure "${early[@]}"); do
  name=$(basename "$file")
  case $name in
    *.xz) xz -dc "$file" >"$boot/modules/${name%.xz}" ;;
    *.zst) zstd -dcq "$file" >"$boot/modules/${name%.zst}" ;;
    *) cp "$file" "$boot/modules/" ;;
  esac
  name=${name%.xz}
  echo "${name%.zst}" >>"$boot/modules/order"
done
install -m 755 "$here/initramfs-init.sh" "$boot/init"
(cd "$boot" && find . | cpio -o -H newc --quiet) >"$work/out/boot.cpio"
chmod 644 "$work"/out/*
