#!/bin/bash
# PID 1 of the guest: mounts, the real systemd-udevd, then run.sh of the share, whose results go back through it.
# Whatever run.sh does, the machine ends by powering off, with the exit code in share/rc (written last, by rename).
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C TERM=dumb
share=/mnt/share
mount -t sysfs sys /sys
mount -t tmpfs run /run
mount -t tmpfs -o mode=1777,size=60% tmp /tmp
mkdir -p /dev/shm /dev/pts $share /run/udev /etc/udev/rules.d
mount -t tmpfs -o mode=1777 shm /dev/shm
mount -t devpts pts /dev/pts
ln -sf /proc/self/fd /dev/fd
hostname bench
ip link set lo up
modprobe -a 9pnet_virtio 9p
mount -t 9p -o trans=virtio,version=9p2000.L,msize=524288 share $share
cp $share/rules/*.rules /etc/udev/rules.d/ 2>/dev/null
/lib/systemd/systemd-udevd --daemon
udevadm trigger --action=add --subsystem-match=block --subsystem-match=tty
modprobe -a vhci_hcd uvcvideo cdc_acm ftdi_sio
udevadm settle
echo "bench: ready after $(cut -d' ' -f1 /proc/uptime) s" >/dev/kmsg

# Programs and results live in the guest's memory: 9p costs a round trip to the host for every read and write.
mkdir -p /tmp/bench/out
cp -r $share/in/. /tmp/bench/
cd /tmp/bench
timeout -k 5 "$(cat $share/limit)" bash ./run.sh >/tmp/out.log 2>&1 </dev/null
rc=$?
cp /tmp/out.log $share/out.log
dmesg >$share/dmesg.log
cp -r /tmp/bench/out/. $share/out/
sync
echo $rc >$share/rc.part
mv $share/rc.part $share/rc
echo o >/proc/sysrq-trigger
sleep 30
