# The functions used by guest scripts. The harness writes run.sh, which names the programs and sources this file.
# Results belong in $out; all files there when the script ends are copied to the host.
set -u
out=/tmp/bench/out

# In virtual time a limit is what it says. Emulated processors are slow, and there it only ends what hangs.
grep -q 'bench\.share=' /proc/cmdline && slowest=0 || slowest=900

# To start a process takes 15 ms of a processor in User-Mode Linux. So what is asked ten times a second, here and in scripts, is
# asked without one where it can be: no sleep, no grep.
exec {never}<> <(:)
pause() { read -rt "$1" -u $never || true; }

# wait_for SECONDS COMMAND...: until the command succeeds, which is tried ten times a second; `every=1 wait_for ..` each second.
wait_for() {
  local limit=$(($1 > slowest ? $1 : slowest)) start=$SECONDS; shift
  until "$@" >/dev/null 2>&1; do
    [ $((SECONDS - start)) -lt "$limit" ] || { echo "bench: gave up after $limit s: $*"; return 1; }
    pause ${every:-0.1}
  done
}

# read_lines FILE: its lines in $lines, none if there is no file.
read_lines() { lines=(); [ ! -e "$1" ] || mapfile -t lines <"$1"; }

# lines_with N FRAGMENT...: how many of the last lines contain every fragment, in $found, at most N; the last of them in $last. The last
# line may not be written whole yet. The first fragment should be one that few lines have: it costs 2 us a line.
lines_with() {
  local most=$1 at fragment; shift
  found=0 last=
  for ((at = ${#lines[@]} - 1; at >= ${after:-0}; at--)); do
    for fragment; do [[ ${lines[at]} == *"$fragment"* ]] || continue 2; done
    ((found++)) || last=${lines[at]}
    ((found < most)) || break
  done
}

# has_line FILE FRAGMENT...: one line of FILE contains every fragment. has_lines N FILE FRAGMENT...: N lines do.
has_line() { has_lines 1 "$@"; }
has_lines() { read_lines "$2"; lines_with "$1" "${@:3}"; ((found >= $1)); }

# emu_start SPEC...: the emulator. It also opens its FIFO for writing: at its end it would unplug everything and quit.
emu_start() {
  mkfifo /tmp/emu.ctl
  "${usbemu[@]}" "$@" 0<>/tmp/emu.ctl >"$out/emu.jsonl" 2>"$out/emu.err" &
  emu_pid=$!
  exec 7>/tmp/emu.ctl
  answered 30 '"action":"ready"' || fail "the emulator did not start: $(cat "$out/emu.err")"
}

# answered SECONDS FRAGMENT...: until the emulator's log has this line. Asked more often than others: times begin with its answers.
answered() { every=0.01 wait_for "$1" has_line "$out/emu.jsonl" "${@:2}"; }

# emu COMMAND...: one line to the emulator.
emu() { echo "$*" >&7; }

# emu_done SECONDS: until the emulator has done all its commands so far.
emu_done() {
  emu_asked=$((${emu_asked:-0} + 1))
  emu "say done-$emu_asked"
  answered "$1" "\"word\":\"done-$emu_asked\"" || fail "the emulator is not done: $(tail -n 1 "$out/emu.jsonl")"
}

# emu_quit: devices still plugged in are unplugged, and the log is complete.
emu_quit() { emu quit; wait "$emu_pid"; }

# attached PORT... / detached PORT...: the kernel has, or no longer has, a device in each of these ports.
attached() { local port; for port in "$@"; do [ -e "/sys/bus/usb/devices/1-$((port + 1))/bConfigurationValue" ] || return 1; done; }
detached() { local port; for port in "$@"; do [ ! -e "/sys/bus/usb/devices/1-$((port + 1))" ] || return 1; done; }

# property NODE KEY: a udev property of a device node.
property() { udevadm info --query=property --name="$1" | sed -n "s/^$2=//p"; }

# rapid_start ARGUMENT...: rapid in the background; its output in rapid.jsonl, its log in rapid.log.
rapid_start() {
  # Emptied here: the program may open it only after the first question about what it has printed.
  : >"$out/rapid.jsonl"
  "${rapid[@]}" "$@" >"$out/rapid.jsonl" 2>"$out/rapid.log" &
  rapid_pid=$!
}

# await_rapid SECONDS FRAGMENT...: until rapid has printed a line with all of them, or has ended.
await_rapid() {
  local limit=$1; shift
  printed_or_ended() { has_line "$out/rapid.jsonl" "$@" || ! kill -0 "$rapid_pid"; }
  wait_for "$limit" printed_or_ended "$@"
  has_line "$out/rapid.jsonl" "$@" || { kill -0 "$rapid_pid" 2>/dev/null || rapid_wait; echo "bench: no line of rapid, exit code $(cat $out/rapid.rc 2>/dev/null): $*"; return 1; }
}

# rapid_wait: waits for its end and stores its exit code.
rapid_wait() {
  wait "$rapid_pid"
  echo $? >"$out/rapid.rc"
}

# rapid_stop: asks it to end, as systemd and a user do.
rapid_stop() { kill -TERM "$rapid_pid"; rapid_wait; }

# published KEY: a value of the mask's JSON file, or the state of a device: `published mask`, `published cam_wrist`.
published() {
  local text=
  IFS= read -rd '' text 2>/dev/null </dev/shm/rapid_hardware_mask.json || true
  text=${text//[[:space:]]/}
  [[ $text =~ \"$1\":\"([^\"]*)\" || $text =~ \"name\":\"$1\"[^}]*\"state\":\"([^\"]*)\" ]] && echo "${BASH_REMATCH[1]}"
}

# is VALUE COMMAND...: the command prints exactly this.
is() { local value=$1; shift; [ "$("$@")" = "$value" ]; }

# can_up NAME: brings a CAN interface up at the bus's rate.
can_up() { ip link set "$1" up type can bitrate 1000000 || fail "$1 does not come up"; }

# lan_rule N ADDRESS/BITS: the interface of network adapter N gets this address at each plug, as from a DHCP client.
lan_rule() {
  local mac name='$name'
  printf -v mac '00:00:5e:00:53:%02x' "$1"
  echo "ACTION==\"add\", SUBSYSTEM==\"net\", ATTR{address}==\"$mac\", RUN+=\"/sbin/ip addr add $2 dev $name\", RUN+=\"/sbin/ip link set $name up\"" \
    >>/etc/udev/rules.d/90-bench-lan.rules
  udevadm control --reload
}

# mark WORD: writes the word to the emulator's log; later log lines come after it.
mark() {
  emu "say $1"
  answered 20 "\"word\":\"$1\"" || fail "the emulator did not log $1"
  marked=${#lines[@]}
}

# logged ACTION [FRAGMENT...]: since the last mark the emulator's log has a line of this action with all fragments.
logged() {
  local after=${marked:-0} action=$1; shift
  has_line "$out/emu.jsonl" "\"action\":\"$action\"" "$@"
}

# states N DEVICE STATE: rapid has reported this state of the device at least N times.
states() { has_lines "$1" $out/rapid.jsonl "\"state\":\"$3\"" "\"device\":\"$2\"" '"event":"state"'; }

# ordered enabled|disabled MOTOR...: the last that each of these motors was ordered, is this.
ordered() {
  local order=$1 motor on off; shift
  read_lines $out/emu.jsonl
  for motor; do
    last_order enabled; on=$at
    last_order disabled; off=$at
    case $order in enabled) ((on > off)) ;; *) ((off > on)) ;; esac || return 1
  done
}
last_order() {
  lines_with 1 "\"action\":\"motor_$1\"" "\"motor\":$motor,"
  [[ $last =~ \"mono_ns\":([0-9]+) ]] && at=${BASH_REMATCH[1]} || at=0
}

# held fd|task: number of rapid's descriptors or threads.
held() { ls "/proc/$rapid_pid/$1" | wc -l; }

# sample NAME [FDS THREADS]: rapid's resources, as a line of samples.jsonl; of descriptors and threads these, if given. Sizes in KiB; `anon` is private memory, `pss` its share of all.
sample() {
  local rollup status
  rollup=$(cat "/proc/$rapid_pid/smaps_rollup") status=$(cat "/proc/$rapid_pid/status")
  kib() { awk -v key="$2:" '$1 == key { print $2; found = 1 } END { if (!found) print 0 }' <<<"$1"; }
  echo "{\"sample\":\"$1\",\"fds\":${2:-$(held fd)},\"threads\":${3:-$(held task)},\"rss\":$(kib "$status" VmRSS),\"pss\":$(kib "$rollup" Pss),\"anon\":$(kib "$rollup" Pss_Anon),\"shm\":$(du -sk /dev/shm | cut -f1),\"files\":$(find /dev/shm /tmp/iceoryx2 | wc -l)}" >>"$out/samples.jsonl"
}

fail() { echo "bench: $*"; exit 1; }
