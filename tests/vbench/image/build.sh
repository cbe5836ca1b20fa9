#!/bin/bash
# Builds the guest of the virtual USB bench: a small Debian with the real systemd-udevd, and a kernel for it.
#
#   build.sh uml | qemu       builds this one, if it is missing, and describes it
#   build.sh --check [KIND]   describes it when it is built, otherwise names what to run and exits 3. Without KIND it is User-Mode
#                             Linux, or QEMU where a build has found that there can be none
#
# A description is lines `KEY VALUE`: `backend uml`, and where its parts are. Every part is one folder of the cache, named by
# the hash of what it is made of, so that it is either whole or absent and a second call does nothing. The kernel of User-Mode
# Linux is a part of its own: it takes minutes, and a change of the Debian in it does not rebuild it.
#
# uml:  Linux as a process, its time is virtual (uml/kernel.sh). Needs uml/packages.txt, and ptrace.
# qemu: an emulated machine with the distribution's own kernel, for a second opinion. Needs qemu/packages.txt.
# Both need root, or unprivileged user namespaces with a range of ids, or sudo.
set -euo pipefail
# Ordinary users of the guest read its root.
umask 022
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
cache=${RAPID_VBENCH_DIR:-${XDG_CACHE_HOME:-$HOME/.cache}/rapid/vbench}
export PATH=$PATH:/sbin:/usr/sbin

# The guest runs binaries built on this host, so it is the same Debian where the host is one.
suite=$(. /etc/os-release; [ "${ID:-}" = debian ] && echo "${VERSION_CODENAME:-bookworm}" || echo bookworm)
# shellcheck disable=SC2068  # with the pattern qemu/*
key() { (cd "$here" && sha256sum $@ | sha256sum | cut -c1-12); }
readonly root=$cache/root-$suite-$(key rootfs.sh uml/root.sh guest-init.sh guest-packages.txt)
readonly kernel=$cache/kernel-$(key uml/kernel.sh uml/kernel.config uml/kernel.patch)
readonly machine=$cache/qemu-$suite-$(key rootfs.sh guest-init.sh guest-packages.txt 'qemu/*')
# Why there is no User-Mode Linux on this machine. What may be otherwise later (a network that is down) counts for an hour.
readonly impossible=$cache/no-${kernel##*/} for_now=$cache/no-${kernel##*/}-now

step() { echo "vbench image: $*" >&2; }
die() { step "error: $*"; exit 1; }

[[ $cache != *[[:space:]]* ]] || die "the kernel's command line takes no folder with a space: set RAPID_VBENCH_DIR to another one than $cache"

has_uml() { [ -d "$root" ] && [ -d "$kernel" ]; }
has_qemu() { [ -d "$machine" ]; }

describe() {
  case $1 in
    # A part that is used is not one of the oldest.
    uml) touch "$root" "$kernel" && printf 'backend uml\nsuite %s\nroot %s\nkernel %s\nmodules %s\nmemory %s\n' "$suite" "$root" "$kernel/linux" "$kernel/modules" "$(memory)" ;;
    qemu) printf 'backend qemu\nsuite %s\ndirectory %s\n' "$suite" "$machine" ;;
  esac
}

# Where the memory of a guest is a file: programs are mapped from it, and 160 MB of it are used.
memory() {
  local folder
  for folder in /dev/shm /tmp; do
    [ -d $folder ] && [[ ,$(findmnt -no OPTIONS -T $folder), != *,noexec,* ]] || continue
    [ "$(df --output=avail -k $folder | tail -n 1)" -ge 400000 ] && { echo $folder; return; }
  done
  echo "${TMPDIR:-/tmp}"
}

# Why there is none, if that is known and still holds.
why_not() { cat "$impossible" 2>/dev/null || { [ -n "$(find "$for_now" -mmin -60 2>/dev/null)" ] && cat "$for_now"; }; }
# Which kind is meant without a name.
usual() { if why_not >/dev/null; then echo qemu; else echo uml; fi; }

if [ "${1:-}" = --check ]; then
  kind=${2:-${RAPID_VBENCH_BACKEND:-$(usual)}}
  case $kind in uml | qemu) ;; *) die "no such guest: $kind (uml or qemu)" ;; esac
  if "has_$kind"; then
    [ -n "${2:-}${RAPID_VBENCH_BACKEND:-}" ] || [ "$kind" = uml ] || step "QEMU is used: $(why_not | head -n 1)"
    describe "$kind"
    exit 0
  fi
  target=setup
  [ "$kind" = uml ] || [ "$kind" = "$(usual)" ] || target=setup-all
  echo "the guest of the virtual bench ($kind) is not built: run \`make $target\` (or $here/build.sh $kind)" >&2
  exit 3
fi

require() {
  local list=$1 tool; shift
  for tool in "$@"; do
    command -v "$tool" >/dev/null || die "$tool is missing: install the packages of $here/$list"
  done
}

# `as_root` runs a command that must see root-owned files, `bootstrap` one that makes a system of many owners: plainly as
# root, inside user namespaces (the second kind wants a range of ids of the user's own), or through sudo.
as_root=() bootstrap=()
rights() {
  [ "$(id -u)" != 0 ] || return 0
  if unshare -r true 2>/dev/null && command -v newuidmap >/dev/null && grep -q "^$(id -un):" /etc/subuid 2>/dev/null; then
    as_root=(unshare -r)
  elif command -v sudo >/dev/null; then as_root=(sudo) bootstrap=(sudo)
  else die "needs sudo, or user namespaces: package uidmap and a line for $(id -un) in /etc/subuid"; fi
}

# The newest two of a part stay: another checkout may be one step behind this one.
keep_two() { ls -1dt "$cache/$1"-* 2>/dev/null | tail -n +3 | while read -r old; do "${as_root[@]}" rm -rf "$old"; done; }

# Errors are passed on by hand from here to `refuse`: bash does not end a script for them where a caller looks at the code.
build_root() {
  step "installing Debian $suite ($(tr '\n' ' ' <"$here/guest-packages.txt"))"
  "${bootstrap[@]}" "$here/rootfs.sh" "$suite" "$work" && "$here/uml/root.sh" "$work" && mv -T "$work/root" "$root" && keep_two root
}

# Prints why there is none; the exit code is 4 if that does not change.
build_kernel() {
  step "building the kernel of User-Mode Linux (some minutes, once; $cache/kernel.log)"
  mkdir "$work/kernel"
  "$here/uml/kernel.sh" "$work/kernel" "$cache/kernel.log" && mv -T "$work/kernel" "$kernel" && keep_two kernel
}

# Starts it with a program that ends at once: a machine may forbid ptrace, or lack what it was linked with.
kernel_starts() {
  local console why code=0
  console=$(timeout -s KILL 120 env TMPDIR="$(memory)" "$kernel/linux" mem=128M uml_dir="$work" \
    root=/dev/root rootfstype=hostfs rootflags="$root" ro init=/bin/true con=null con0=null,fd:1 panic=-1 2>&1 </dev/null) || code=$?
  [[ $console != *"exitcode=0x00000000"* ]] || return 0
  tail -n 5 <<<"$console" >&2
  why=${console##*$'\n'}
  [ $code != 137 ] || why="it did not end within 120 s"
  echo "the kernel does not start: ${why:-it ended with code $code}"
  return 1
}

build_uml() {
  local why code=0
  rm -f "$impossible" "$for_now"
  require uml/packages.txt mmdebstrap
  # Beside the kernel: one takes processors, the other the network.
  [ -d "$root" ] || { build_root >&2 & making=$!; }
  [ -d "$kernel" ] || why=$(build_kernel) || code=$?
  if [ $code != 0 ]; then
    [ -z "$making" ] || wait "$making" || true
    refuse "$([ $code = 4 ] && echo "$impossible" || echo "$for_now")" "${why:-building its kernel failed: see $cache/kernel.log}"
    return 4
  fi
  [ -z "$making" ] || wait "$making" || die "the guest's Debian could not be installed"
  why=$(kernel_starts) || { refuse "$for_now" "$why"; return 4; }
}

# refuse FILE REASON: remembered, so that the next run does not compile for minutes to find the same.
refuse() {
  echo "$2" >"$1"
  step "no User-Mode Linux on this machine (${2%%$'\n'*}): QEMU is used instead, which is slower; remove $1 to try again"
}

build_qemu() {
  require qemu/packages.txt qemu-system-x86_64 busybox mmdebstrap modprobe depmod cpio mke2fs xz
  mkdir "$work/out"
  step "installing Debian $suite with its kernel ($(tr '\n' ' ' <"$here/guest-packages.txt"))"
  "${bootstrap[@]}" "$here/rootfs.sh" "$suite" "$work" kernel
  step "unpacking the kernel"
  local version
  version=$("$here/qemu/kernel.sh" "$work")
  step "packing the disk and the initramfs (kernel $version)"
  "${as_root[@]}" "$here/qemu/disk.sh" "$version" "$work"
  chmod 755 "$work/out"
  mv -T "$work/out" "$machine"
  keep_two qemu
}

mkdir -p "$cache"
exec 9>"$cache/.lock"
flock -n 9 || { step "another build is running, waiting for it"; flock 9; }
kind=${1:-}
case $kind in uml | qemu) ;; *) die "which guest: uml or qemu?" ;; esac
if "has_$kind"; then step "up to date ($kind)"; describe "$kind"; exit 0; fi
rights
# A build that was cut off leaves only such a directory; holding the lock, every one of them is dead.
"${as_root[@]}" rm -rf "$cache"/.build.*
work=$(mktemp -d "$cache/.build.XXXXXX")
# What is made in the background ends before its folder goes.
making=
trap '[ -z "$making" ] || { kill "$making" && wait "$making"; } 2>/dev/null || true; "${as_root[@]}" rm -rf "$work"' EXIT
started=$SECONDS
"build_$kind"
step "done in $((SECONDS - started)) s ($kind)"
describe "$kind"
