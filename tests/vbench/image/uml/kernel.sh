#!/bin/bash
# kernel.sh OUT LOG: OUT/linux, Linux as a process, and OUT/modules (the folder of /lib/modules), from Debian's package of the
# kernel's source. On failure the reason is printed in one line, and what make printed is in LOG. Needs no root.
#
# Built here and not shipped: Debian's own package of User-Mode Linux has neither USB nor virtual time, and a binary of the GPL in
# the repository would oblige whoever passes it on to pass on its source. The series is pinned and not the version, because
# security updates remove versions from the archive. It does not have to be the host's, nor that of the guest's Debian.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
out=$1 log=$2
readonly package=linux-source-6.1
export PATH=$PATH:/sbin:/usr/sbin

# The exit code is 4 for what will not be otherwise the next time.
fail() { echo "$*"; exit 1; }
never() { echo "$*"; exit 4; }
made() { "$@" >>"$log" 2>&1 || never "$* failed: see $log"; }

: >"$log"
[ "$(uname -m)" = x86_64 ] || never "it runs on x86-64 processors, and this is $(uname -m)"
for tool in gcc make flex bison bc xz depmod; do command -v "$tool" >/dev/null || fail "$tool is missing"; done
work=$(mktemp -d "$out/../source.XXXXXX")
trap 'rm -rf "$work"' EXIT

# From the sources of this host where they have it, otherwise from Debian's own mirror.
fetch() {
  cd "$work"
  if apt-cache show "$package" >/dev/null 2>&1; then
    apt-get -qq -o APT::Sandbox::User=root download "$package"
  else
    # shellcheck disable=SC2016  # for the hook's shell
    PACKAGE=$package mmdebstrap --quiet --variant=custom --customize-hook='set -e
      export APT_CONFIG=$MMDEBSTRAP_APT_CONFIG
      mkdir -p "$1/source" && cd "$1/source" && apt-get -qq -o APT::Sandbox::User=root download "$PACKAGE"' \
      --customize-hook='sync-out /source .' bookworm /dev/null
  fi
}
(fetch) >>"$log" 2>&1 || fail "no package $package could be fetched: see $log"

# What is not compiled fills a gigabyte; the configuration reads the Kconfig files of all folders.
dpkg-deb --fsys-tarfile "$work"/*.deb | tar -xO --wildcards './usr/src/linux-source-*.tar.xz' \
  | tar -xJ -C "$work" --wildcards --exclude='*/drivers/gpu/*.[ch]' --exclude='*/drivers/net/ethernet/*.[ch]' \
    --exclude='*/drivers/net/wireless/*.[ch]' --exclude='*/sound/*.[ch]' --exclude='*/Documentation/*/*' --exclude='*/tools/testing/*' \
    >>"$log" 2>&1 || fail "$package could not be unpacked: see $log"
rm "$work"/*.deb
cd "$work"/linux-source-*/

# Room for the floating-point state of a process: a processor with AMX has 11,008 bytes of it, and this kernel expects at most 2,696.
sed -i 's/DEFINE_LONGS(HOST_FP_SIZE, 2696)/DEFINE_LONGS(HOST_FP_SIZE, 12288)/' arch/x86/um/user-offsets.c
grep -q 'HOST_FP_SIZE, 12288' arch/x86/um/user-offsets.c || never "$package has another HOST_FP_SIZE than 2696"
made make -s ARCH=um KCONFIG_ALLCONFIG="$here/kernel.config" allnoconfig
# An option that this kernel lacks, or whose condition is missing, is dropped without a word.
while read -r option; do
  grep -qx "$option" .config || never "$package does not take the option $option"
done < <(grep '^CONFIG_' "$here/kernel.config")

compile() { make -s ARCH=um -j"$1" linux modules; }
# The patch only makes guests faster: a version of the series whose lines around a change differ, or that does not compile with it,
# is built without it. Twice, because a compiler may have been ended for want of memory.
compile_patched() {
  patch -p1 -s -F0 --dry-run -i "$here/kernel.patch" || return
  patch -p1 -s -F0 -i "$here/kernel.patch" || exit
  compile "$(nproc)" || compile 1 || { patch -p1 -s -R -i "$here/kernel.patch" || exit; return 1; }
}
compile_patched >>"$log" 2>&1 || {
  echo "vbench image: $package is built without kernel.patch, so guests take longer (why: $log)" >&2
  made compile "$(nproc)"
}
made make -s ARCH=um INSTALL_MOD_PATH="$work/installed" modules_install
version=$(make -s ARCH=um kernelrelease)
rm -f "$work/installed/lib/modules/$version"/{build,source}
made depmod -b "$work/installed" "$version"
mv "$work/installed/lib/modules" "$out/modules"
strip -o "$out/linux" linux
echo "vbench image: kernel $version, $(stat -c %s "$out/linux") bytes" >&2
