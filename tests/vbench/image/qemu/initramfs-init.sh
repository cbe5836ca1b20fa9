#!/bin/sh
# /init of the initramfs: the disk is read-only under a tmpfs, so that every boot starts from the same bytes.
export PATH=/bin
mount -t proc proc /proc
mount -t devtmpfs dev /dev
while read -r module; do insmod "/modules/$module"; done </modules/order
mkdir -p /mnt/lower /mnt/upper
tries=0
while [ ! -b /dev/vda ] && [ $tries -lt 200 ]; do sleep 0.05; tries=$((tries + 1)); done
mount -t ext4 -o ro /dev/vda /mnt/lower
mount -t tmpfs -o size=40% upper /mnt/upper
mkdir /mnt/upper/files /mnt/upper/work
mount -t overlay -o lowerdir=/mnt/lower,upperdir=/mnt/upper/files,workdir=/mnt/upper/work root /root
mount --move /dev /root/dev
mount --move /proc /root/proc
exec switch_root /root /usr/sbin/bench-init
