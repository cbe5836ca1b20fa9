//! The installed rules and unit, and `rapid` without root: an ordinary user of the groups that the rules name does all that
//! root does, one of no such group reads what is missing, and the unit's restrictions let it work.

use vbench::check::{assert_lines, assert_whole, play};
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::entries::{camera, registry, scalars};
use vbench::outcome::{Outcome, json_lines};
use vbench::recording::{Recording, falls, rises};
use vbench::scenario::Scenario;

const WRIST: &str = "/rapid/camera/wrist";
const TOF: &str = "/rapid/tof";

const SCRIPT: &str = r#"
config=/tmp/bench/devices.toml
chmod -R a+rX /tmp/bench
program=("${rapid[@]}")
# be USER: from here on rapid is run by this user, in the user's groups, without any capability.
be() { rapid=(env HOME=/tmp setpriv --reuid="$1" --regid="$1" --init-groups --inh-caps=-all --bounding-set=-all "${program[@]}"); }
mine() { mkdir -p $out/$1; chown $1: $out/$1; }
# The bus is one user's; what it leaves is in the next one's way.
bus_gone() { rm -rf /tmp/iceoryx2* /dev/shm/iox2_*; }
linked() { [ -e /dev/rapid/cam_wrist ] && [ -e /dev/rapid/tof ]; }
kept() { cp $out/rapid.jsonl $out/$1.jsonl; cp $out/rapid.log $out/$1.log; cp $out/rapid.rc $out/$1.rc; }

# As root: rules, unit and descriptors; links come and go with the devices.
"${rapid[@]}" artifacts --install --config $config >$out/install.txt 2>&1 || fail 'rapid artifacts --install'
find /etc/rapid /etc/udev/rules.d /etc/systemd/system -name '*rapid*' -o -path '*/descriptors/*' >$out/installed
emu plug 0 1
wait_for 60 linked || fail 'no links'
stat -L -c '%n %U:%G %a' /dev/rapid/* >$out/nodes
emu unplug 0 1
wait_for 30 detached 0 1
udevadm settle
ls /dev/rapid >$out/left 2>/dev/null
emu plug 0 1
wait_for 60 linked || fail 'no links after the return'

# An ordinary user of the rules' groups.
groups=$(sed -n 's/.*GROUP="\([a-z]*\)".*/\1/p' /etc/udev/rules.d/99-rapid.rules | sort -u | paste -sd,)
useradd --no-create-home --groups "$groups" keeper || fail 'no user'
mine keeper
be keeper
"${rapid[@]}" devices --json --config $config >$out/devices.jsonl 2>$out/devices.err || fail 'rapid devices'
rapid_start --headless --record --out $out/keeper --config $config --json
await_rapid 60 '"device":"cam_wrist"' '"state":"streaming"' || fail 'cam_wrist does not stream'
await_rapid 60 '"device":"tof"' '"state":"streaming"' || fail 'tof does not stream'
stat -c '%n %U %a' /dev/shm/rapid_hardware_mask /dev/shm/rapid_hardware_mask.json >$out/published
awk '/^(Uid|CapEff|NoNewPrivs)/' /proc/$rapid_pid/status >$out/status
emu sleep 500
emu unplug 0
emu sleep 1000
emu plug 0
useradd --no-create-home stranger || fail 'no stranger'
be stranger
"${rapid[@]}" mask --json >$out/mask.json 2>&1 || fail 'rapid mask as another user'
"${rapid[@]}" --headless --duration 1s --config $config >$out/second.txt 2>&1
echo $? >$out/second.rc
wait_for 60 states 2 cam_wrist streaming || fail 'cam_wrist does not stream again'
sleep 1
rapid_stop
kept keeper

# A user of none of these groups, first while iceoryx2's folder is the other user's: that does not matter.
"${rapid[@]}" --headless --duration 1s --config $config >$out/bus.txt 2>&1
echo $? >$out/bus.rc
stat -c '%n %U' /tmp/iceoryx2* >$out/buses
bus_gone
rapid_start --headless --config $config --json
for device in cam_wrist tof; do
  wait_for 60 states 1 $device failed || fail "$device does not fail"
done
rapid_stop
kept stranger

bus_gone

# What root's rapid left behind when it was killed is not this user's to remove.
rapid=("${program[@]}")
rapid_start --headless --config $config --json
wait_for 30 test -e /dev/shm/rapid_hardware_mask
kill -KILL $rapid_pid
wait $rapid_pid
be keeper
"${rapid[@]}" --headless --duration 1s --config $config >$out/foreign.txt 2>&1
echo $? >$out/foreign.rc
rm -f /dev/shm/rapid_hardware_mask*
bus_gone

# The unit, as far as there is no systemd here: its user, groups, limits, read-only system, command line and stop signal.
unit=/etc/systemd/system/rapid.service
key() { sed -n "s/^$1=//p" $unit; }
eval "$(sed -n 's/^# *\(useradd .*\)/\1/p; s/^# *\(install .*\)/\1/p' $unit)" || fail 'the preparations that the unit names'
{ echo '#!/bin/sh'; printf 'exec %s "$@"\n' "$(printf "'%s' " "${program[@]}")"; } >/usr/local/bin/rapid
chmod 755 /usr/local/bin/rapid
cat >/tmp/as-unit.sh <<END
set -e
# Holds the namespace, with the recordings in it, beyond the program's end.
sleep 600 &
echo \$! >$out/holder
mkdir -p /var/lib/rapid
mount -t tmpfs -o mode=755 state /var/lib/rapid
chown $(key User): /var/lib/rapid
mount -o remount,bind,ro /
touch /etc/written 2>/dev/null && { echo 'the system is not read-only'; exit 1; }
cd /
exec prlimit --rtprio=$(key LimitRTPRIO) env -i PATH=/usr/bin --default-signal=INT \
  setpriv --reuid=$(key User) --regid=$(key User) --groups="$(getent group $(key SupplementaryGroups) | cut -d: -f3 | paste -sd,)" \
  --inh-caps=-all --bounding-set=-all --no-new-privs $(key ExecStart) --json
END
: >$out/rapid.jsonl
unshare --mount bash /tmp/as-unit.sh >$out/rapid.jsonl 2>$out/rapid.log & rapid_pid=$!
await_rapid 60 '"device":"cam_wrist"' '"state":"streaming"' || fail 'cam_wrist does not stream under the unit'
await_rapid 60 '"device":"tof"' '"state":"streaming"' || fail 'tof does not stream under the unit'
awk '/^(Uid|CapEff|NoNewPrivs)/' /proc/$rapid_pid/status >$out/unit.status
for task in /proc/$rapid_pid/task/*; do [ "$(cat $task/comm)" = mask ] && chrt -p ${task##*/}; done >$out/unit.sched
# It records when its group asks for it.
setpriv --reuid=$(key User) --regid=$(key User) --init-groups "${program[@]}" episode start >$out/asked.txt 2>&1 ||
  fail "rapid episode start: $(cat $out/asked.txt)"
sleep 1
kill -$(key KillSignal) $rapid_pid
rapid_wait
mkdir -p $out/unit
cp /proc/$(cat $out/holder)/root/var/lib/rapid/* $out/unit/
kill $(cat $out/holder)
kept unit
emu_quit
exit 0
"#;

#[test]
fn an_ordinary_user_of_the_named_groups_needs_no_root() {
    let outcome = play(
        Scenario::new("unprivileged")
            .device(DeviceSpec::uvc(0x046d, 0x0825).serial("CAM00A1").mode(Format::Mjpg, 320, 240, &[30]))
            .device(DeviceSpec::acm(0x2e8a, 0x000a, 100.0).serial("TOF1"))
            .registry(&registry(&[
                camera("cam_wrist", WRIST, 0, Some("CAM00A1"), (320, 240)),
                scalars("tof", TOF, 1, "2e8a:000a", "TOF1"),
            ]))
            .script(SCRIPT),
    );
    assert_eq!(outcome.code, 0, "{}", outcome.log);
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());

    println!("{}{}", outcome.file("install.txt"), outcome.file("nodes"));
    for path in ["/etc/udev/rules.d/99-rapid.rules", "/etc/systemd/system/rapid.service", "/descriptors/cam_wrist.yaml"]
    {
        assert!(outcome.file("installed").contains(path), "{path} not in:\n{}", outcome.file("installed"));
    }
    let nodes: Vec<String> = outcome.file("nodes").lines().map(str::to_owned).collect();
    assert_eq!(nodes, ["/dev/rapid/cam_wrist root:video 660", "/dev/rapid/tof root:dialout 660"]);
    assert_eq!(outcome.file("left"), "", "links outlived their devices");

    ordinary_user(&outcome);
    stranger(&outcome);
    unit(&outcome);
}

/// Discovers, opens, streams, records, survives an unplug; what it cannot have is a warning.
fn ordinary_user(outcome: &Outcome) {
    let entries: Vec<_> =
        json_lines(&outcome.file("devices.jsonl")).into_iter().map(|line| line["entry"].clone()).collect();
    assert!(
        entries.iter().any(|entry| entry == "cam_wrist") && entries.iter().any(|entry| entry == "tof"),
        "{entries:?}"
    );
    println!("{}{}{}", outcome.file("status"), outcome.file("published"), outcome.file("keeper.log"));
    assert!(outcome.file("status").contains("CapEff:\t0000000000000000"), "{}", outcome.file("status"));
    assert_eq!(outcome.file("keeper.rc").trim(), "0", "{}", outcome.file("keeper.log"));
    for line in ["/dev/shm/rapid_hardware_mask keeper 644", "/dev/shm/rapid_hardware_mask.json keeper 644"] {
        assert!(outcome.file("published").lines().any(|found| found == line), "{}", outcome.file("published"));
    }
    assert!(outcome.file("keeper.log").contains("no real-time priority"), "{}", outcome.file("keeper.log"));

    let episode = recording(outcome, "keeper");
    let edges = episode.mask_edges();
    assert_eq!((falls(&edges, 0).len(), falls(&edges, 1).len()), (1, 0), "{edges:?}");
    let fell = falls(&edges, 0)[0];
    assert!(rises(&edges, 0).iter().any(|rose| *rose > fell), "the camera did not return");
    assert_whole(&episode, WRIST, ..fell);
    assert_whole(&episode, WRIST, fell..);
    assert_lines(&episode, TOF);
}

/// Reads the mask, and gets the reason why there is nothing more; so does a user who meets what another one holds or left.
fn stranger(outcome: &Outcome) {
    let mask: serde_json::Value = serde_json::from_str(&outcome.file("mask.json")).expect("the mask");
    assert_eq!(mask["stale"], false, "{mask}");
    for (file, words) in
        [("second", "another rapid (pid "), ("foreign", "another user's rapid left it behind; remove it: rm ")]
    {
        let text = outcome.file(&format!("{file}.txt"));
        println!("{text}");
        assert_eq!(outcome.file(&format!("{file}.rc")).trim(), "1", "{text}");
        assert!(text.contains(words), "{words} not in: {text}");
    }
    // Each has a bus of its own.
    assert_eq!(outcome.file("bus.rc").trim(), "0", "{}", outcome.file("bus.txt"));
    assert_eq!(outcome.file("buses").lines().count(), 2, "{}", outcome.file("buses"));
    let lines = json_lines(&outcome.file("stranger.jsonl"));
    for (device, group) in [("cam_wrist", "video"), ("tof", "dialout")] {
        let failed = lines.iter().find(|line| line["device"] == device && line["state"] == "failed");
        let detail = failed.unwrap_or_else(|| panic!("{device} has not failed"))["detail"].as_str().unwrap_or_default();
        println!("{device}: {detail}");
        assert!(detail.contains(&format!("usermod -aG {group}")), "{detail}");
    }
}

/// The unit's user, groups, limits and read-only system are enough, and its stop signal ends the episode.
fn unit(outcome: &Outcome) {
    println!("{}{}{}", outcome.file("unit.status"), outcome.file("unit.sched"), outcome.file("unit.log"));
    assert_eq!(outcome.file("unit.rc").trim(), "0", "{}", outcome.file("unit.log"));
    for line in ["CapEff:\t0000000000000000", "NoNewPrivs:\t1"] {
        assert!(outcome.file("unit.status").contains(line), "{}", outcome.file("unit.status"));
    }
    assert!(outcome.file("unit.sched").contains("SCHED_FIFO"), "the mask's thread: {}", outcome.file("unit.sched"));
    let episode = recording(outcome, "unit");
    assert_whole(&episode, WRIST, ..);
}

/// The one finished file of a folder.
fn recording(outcome: &Outcome, folder: &str) -> Recording {
    let files = std::fs::read_dir(outcome.share.join("out").join(folder)).expect("the folder");
    let files: Vec<_> = files
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| path.extension().is_some_and(|end| end == "mcap"))
        .collect();
    assert_eq!(files.len(), 1, "{files:?}");
    Recording::open(&files[0]).unwrap_or_else(|error| panic!("{error}"))
}
