#!/bin/bash
# PID 1 of the guest: mounts, the real systemd-udevd, then run.sh of the share, whose results go back through it.
# Whatever run.sh does, the machine ends by powering off, with the exit code in share/rc (written last, by rename).
# With `bench.systemd` on the kernel's command line systemd takes over as PID 1 after the mounts: it starts udevd, and
# then this script once more, as a service.
#
# In User-Mode Linux (`bench.share=FOLDER` on the command line) the root is the host's folder, and every boot puts a tmpfs over it.
# In QEMU the initramfs has done that, and before the share is mounted this waits for a line on ttyS1: here the machine is saved,
# and guests continue from here.
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C TERM=dumb
share=/mnt/share

# argument NAME: what the kernel's command line says after NAME=.
argument() { sed -n "s/.*\bbench\.$1=\([^ ]*\).*/\1/p" /proc/cmdline; }
is_uml() { grep -qw bench.share /proc/cmdline; }

overlay() {
  mount -t proc proc /proc
  mount -t sysfs sys /sys
  mountpoint -q /dev || mount -t devtmpfs dev /dev
  mount -t tmpfs upper /mnt
  mkdir /mnt/files /mnt/work /mnt/root
  mount -t overlay -o lowerdir=/,upperdir=/mnt/files,workdir=/mnt/work root /mnt/root || { echo "bench: no overlay"; off; }
  exec switch_root /mnt/root /usr/sbin/bench-init moved
}

mounts() {
  mountpoint -q /sys || mount -t sysfs sys /sys
  mount -t tmpfs -o mode=755 run /run
  mount -t tmpfs -o mode=1777,size=60% tmp /tmp
  mkdir -p /dev/shm /dev/pts $share /run/udev /etc/udev/rules.d
  mount -t tmpfs -o mode=1777 shm /dev/shm
  mount -t devpts pts /dev/pts
  ln -sf /proc/self/fd /dev/fd
  hostname bench
  ip link set lo up
  is_uml || modprobe -a 9pnet_virtio 9p
}

# Folders of the host, by the paths that they have there.
mount_hostfs() {
  mount -t hostfs -o "$(argument share)" share $share || { echo "bench: no share"; off; }
  mount -t hostfs -o "$(argument modules)" modules /lib/modules
}

# The clock of a saved machine continues from the moment it was saved. Without `now` the host stops sending lines.
mount_9p() {
  mount -t 9p -o trans=virtio,version=9p2000.L,msize=524288 share $share
  date -s "@$(cat $share/now)" >/dev/null
  rm $share/now
}

# In User-Mode Linux they are in the kernel.
drivers() {
  is_uml || modprobe -a vhci_hcd uvcvideo cdc_acm ftdi_sio
  udevadm settle
}

wait_for_the_host() {
  local line
  exec 5</dev/ttyS1
  echo "bench: waiting" >/dev/console
  read -r line <&5
  exec 5<&-
}

# Units of no use here; each costs time. Without an id systemd would set the machine up first.
as_systemd() {
  echo 5c0f1e0d9a6b4d1e8f2a3b4c5d6e7f80 >/etc/machine-id
  local unit
  for unit in systemd-udev-trigger systemd-random-seed systemd-update-utmp systemd-update-utmp-runlevel systemd-logind \
    systemd-journal-flush systemd-journal-catalog-update systemd-timesyncd systemd-networkd systemd-resolved systemd-hwdb-update \
    systemd-sysctl systemd-binfmt systemd-pstore systemd-user-sessions getty@tty0 getty@tty1 serial-getty@ttyS0 console-getty \
    kmod-static-nodes e2scrub_reap modprobe@; do
    ln -sf /dev/null "/etc/systemd/system/$unit.service"
  done
  for unit in dev-hugepages.mount dev-mqueue.mount sys-kernel-debug.mount sys-kernel-tracing.mount sys-fs-fuse-connections.mount \
    sys-kernel-config.mount proc-sys-fs-binfmt_misc.automount timers.target getty.target remote-fs.target systemd-ask-password-wall.path \
    systemd-initctl.socket; do
    ln -sf /dev/null "/etc/systemd/system/$unit"
  done
  cat >/etc/systemd/system/bench.service <<END
[Unit]
Requires=multi-user.target
After=multi-user.target
[Service]
Type=oneshot
ExecStart=/usr/sbin/bench-init script
END
  exec /lib/systemd/systemd --unit=bench.service
}

udev_alone() {
  /lib/systemd/systemd-udevd --daemon
  udevadm trigger --action=add --subsystem-match=block --subsystem-match=tty
}

# User-Mode Linux has no SysRq; systemctl powers off without a running systemd, too.
off() { if is_uml; then systemctl --force --force poweroff; else echo o >/proc/sysrq-trigger; fi; sleep 30; }

script() {
  echo "bench: ready after $(cut -d' ' -f1 /proc/uptime) s" >/dev/kmsg

  # Programs and results live in the guest's memory: 9p costs a round trip to the host for every read and write. Through hostfs
  # programs are read at once, as far as they are used.
  mkdir -p /tmp/bench/out
  local file
  for file in $share/in/*; do
    case ${file##*/} in
      bin | lib) if is_uml; then ln -s $file /tmp/bench/; continue; fi ;;
    esac
    cp -r $file /tmp/bench/
  done
  cd /tmp/bench
  timeout -k 5 "$(cat $share/limit)" bash ./run.sh >/tmp/out.log 2>&1 </dev/null
  rc=$?
  cut -d' ' -f1 /proc/uptime >$share/uptime
  cp /tmp/out.log $share/out.log
  dmesg >$share/dmesg.log
  cp -r /tmp/bench/out/. $share/out/
  sync
  echo $rc >$share/rc.part
  mv $share/rc.part $share/rc
  off
}

case ${1:-} in
  script) drivers ;;
  moved)
    mounts
    mount_hostfs
    ! grep -qw bench.systemd /proc/cmdline || as_systemd
    udev_alone
    drivers ;;
  *)
    [ -e /proc/cmdline ] || overlay
    mounts
    if grep -qw bench.systemd /proc/cmdline; then mount_9p; as_systemd; fi
    udev_alone
    drivers
    wait_for_the_host
    mount_9p ;;
esac
script
