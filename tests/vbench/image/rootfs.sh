#!/bin/bash
# rootfs.sh SUITE WORK [kernel]: WORK/rootfs.tar, a minimal Debian. With `kernel` it contains /kernel.deb, the suite's stock kernel,
# not installed: its own set-up would build an initramfs of 40 MB that nothing here uses.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
suite=$1 work=$2 hook=()

# Only the distribution's own sources of this host: extra lists may name packages or keys the guest cannot have. On a host
# that is not Debian there are none, and mmdebstrap takes its built-in mirror, checked against debian-archive-keyring.
sources=()
if (. /etc/os-release; [ "${ID:-}" = debian ]); then
  for list in /etc/apt/sources.list.d/debian.sources /etc/apt/sources.list; do
    [ -s "$list" ] && { sources=("$list"); break; }
  done
fi
[ "${3:-}" != kernel ] || hook=(--customize-hook='set -e
  export APT_CONFIG=$MMDEBSTRAP_APT_CONFIG
  package=$(apt-cache depends linux-image-amd64 | sed -n "s/^ *Depends: \(linux-image-[0-9]\)/\1/p" | head -n 1)
  folder=$(mktemp -d)
  cd "$folder"
  apt-get -qq -o APT::Sandbox::User=root download "$package"
  mv ./*.deb "$1/kernel.deb"
  cd /
  rmdir "$folder"')

# A frozen mirror (a snapshot, a company's copy) has release files past their date; they are signed all the same.
include=$(paste -sd, "$here/guest-packages.txt")
mmdebstrap --quiet --variant=minbase --include="$include" \
  --aptopt='Acquire::Check-Valid-Until "false"' --aptopt='Acquire::Languages "none"' \
  --dpkgopt='path-exclude=/usr/share/man/*' --dpkgopt='path-exclude=/usr/share/doc/*' \
  --dpkgopt='path-exclude=/usr/share/locale/*' --dpkgopt='path-exclude=/usr/share/i18n/*' \
  "${hook[@]}" "$suite" "$work/rootfs.tar" "${sources[@]}"
