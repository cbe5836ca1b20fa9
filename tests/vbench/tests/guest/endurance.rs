//! Many unplugs and replugs, some faster than the cooldown: what `rapid` reports at the end is what is plugged, what it recorded
//! is what happened, and it holds no more than before.

use std::fmt::Write;

use vbench::check::{episode, ms, recorded_with};
use vbench::emu::log::Moment;
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::entries::{camera, registry, scalars};
use vbench::outcome::{Outcome, json_lines};
use vbench::recording::{Edge, falls, rises};
use vbench::scenario::Scenario;

/// `rig.cooldown` unless a registry has another.
const COOLDOWN_NS: u64 = 2_000_000_000;
/// Cycles of one device in each of six bursts.
const CYCLES: u64 = 5;
const SEED: u64 = 0x5eed_2026;

/// 90 cycles over three devices in three stretches after a warm-up; two of the devices end plugged, one unplugged.
#[test]
// Too long for every day.
#[ignore = "run by make test-all"]
fn ninety_cycles_leave_a_correct_mask_and_nothing_else() {
    let mut random = Random(SEED);
    let script = (1..=6).fold(SCRIPT.to_owned(), |script, number| {
        // One device's cycles of each burst begin with a rest longer than the cooldown.
        script.replace(&format!("BURST_{number}"), &burst(&mut random, number % 3))
    });
    let small = |serial| DeviceSpec::uvc(0x046d, 0x0825).serial(serial).mode(Format::Mjpg, 320, 240, &[30]);
    // While one port of a hub bounces, the kernel reports no unplug in another.
    let waits = |reason: &str| reason.contains(": no sample for ");
    let outcome = recorded_with(
        Scenario::new("endurance")
            .device(small("CAM00A1"))
            .device(small("CAM00B2"))
            .device(DeviceSpec::acm(0x2e8a, 0x000a, 100.0).serial("TOF1"))
            .registry(&registry(&[
                camera("cam_wrist", "/rapid/camera/wrist", 0, Some("CAM00A1"), (320, 240)),
                camera("cam_side", "/rapid/camera/side", 1, Some("CAM00B2"), (320, 240)),
                scalars("tof", "/rapid/tof", 2, "2e8a:000a", "TOF1"),
            ]))
            .script(&script),
        waits,
    );

    let printed: serde_json::Value = serde_json::from_str(&outcome.file("mask.json")).expect("rapid mask --json");
    println!("{printed}");
    assert_eq!(printed["mask"], "0x05");
    let online: Vec<_> = printed["devices"].as_array().unwrap().iter().map(|device| device["online"] == true).collect();
    assert_eq!(online, [true, false, true]);
    assert_eq!(outcome.file("states").split_whitespace().collect::<Vec<_>>(), ["streaming", "absent", "streaming"]);

    let edges = episode(&outcome).mask_edges();
    let mut cycles = 0;
    for (device, bit) in [(0, 0), (1, 1), (2, 2)] {
        cycles += assert_true_edges(&outcome, &edges, device, bit);
    }
    assert!(cycles >= 90, "only {cycles} cycles");
    // Nothing but plugs and unplugs happened: no device was given up or found silent.
    for name in ["cam_wrist", "cam_side", "tof"] {
        assert!(!outcome.states(name).contains(&"failed"), "{name}: {:?}", outcome.states(name));
    }
    assert_flat(&outcome);
}

const SCRIPT: &str = r#"
# settled NAME: the same, with the fewest descriptors and threads of some time. A thread of the pool that looks at the disk or
# opened a device ends after ten seconds without work, and what it opened for a moment is not a loss either.
settled() {
  local fds=$(held fd) threads=$(held task) now
  for _ in {1..14}; do
    sleep 1
    now=$(held fd); ((now < fds)) && fds=$now
    now=$(held task); ((now < threads)) && threads=$now
  done
  sample $1 $fds $threads
}
# agreed MASK: this is plugged once the emulator has done its commands, and rapid reports it soon after.
agreed() {
  emu_done 120
  wait_for 90 is $1 published mask || fail "the mask is $(published mask) instead of $1"
  # In the recording, too, it must be so at this moment.
  sleep 0.2
  emu say agreed
  emu_done 10
}
# One arena: what the allocator keeps for each thread that ever was is none of what a cycle loses.
export MALLOC_ARENA_MAX=1
rapid_start --headless --record --duration 10m --out $out/rec --config /tmp/bench/devices.toml --json
await_rapid 60 '"event":"recording"' || fail 'not recording'
wait_for 30 test -e /dev/shm/rapid_hardware_mask.json
settled idle
emu plug 0 1 2
agreed 0x07
emu unplug 1
emu unplug 0
emu sleep 300
emu plug 0
emu unplug 2
emu sleep 2500
emu plug 2
agreed 0x05
settled warm
emu plug 1
BURST_1
agreed 0x07
BURST_2
emu unplug 1
agreed 0x05
settled first
emu plug 1
BURST_3
agreed 0x07
BURST_4
emu unplug 1
agreed 0x05
settled second
emu plug 1
BURST_5
agreed 0x07
BURST_6
emu unplug 1
agreed 0x05
"${rapid[@]}" mask --json >$out/mask.json
for device in cam_wrist cam_side tof; do published $device; done >$out/states
settled end
rapid_stop
emu_quit
exit 0
"#;

/// The emulator's commands of one burst, by time: quick cycles of all devices, across one another. All start and end plugged.
fn burst(random: &mut Random, rested: u64) -> String {
    let mut actions = Vec::new();
    for device in 0..3 {
        let mut at = random.between(100, 600);
        for cycle in 0..CYCLES {
            let out_ms = if device == rested && cycle == 0 { 2_300 } else { random.between(60, 700) };
            actions.extend([(at, "unplug", device), (at + out_ms, "plug", device)]);
            at += out_ms + random.between(100, 600);
        }
    }
    actions.sort_unstable();
    let mut text = String::new();
    let mut now = 0;
    for (at, action, device) in actions {
        // What takes longer than planned delays all that follows and shortens nothing.
        writeln!(text, "emu sleep {}\nemu {action} {device}", at - now).expect("writing to a string cannot fail");
        now = at;
    }
    text
}

/// The mask's edges of one device agree with what was done to it; the number of its cycles.
fn assert_true_edges(outcome: &Outcome, edges: &[Edge], device: usize, bit: u32) -> usize {
    let real = |moments: Vec<Moment>| moments.iter().map(|moment| moment.real_ns).collect::<Vec<_>>();
    let (plugs, unplugs) = (real(outcome.actions("plug", device)), real(outcome.actions("unplug", device)));
    // The emulator pulls at its end what is still plugged, after the recording.
    let stays: Vec<(u64, u64)> = plugs.iter().copied().zip(unplugs.iter().copied().chain([u64::MAX])).collect();
    let (up, down) = (rises(edges, bit), falls(edges, bit));
    let mut used = None;
    let mut quick_returns = 0;
    for (place, rise) in up.iter().enumerate() {
        let stay = stays.iter().rposition(|(plug, _)| plug <= rise).expect("a rise before any plug");
        assert!(used.is_none_or(|used| used < stay), "device {device}: bit rose twice in one stay");
        used = Some(stay);
        let Some(fall) = down.get(place) else { continue };
        assert!(
            *fall >= stays[stay].1,
            "device {device}: the bit fell {} ms before the unplug",
            ms(stays[stay].1, *fall)
        );
        // A returned device waits for the end of the cooldown. Removals that came and went unnoticed start none.
        if let Some(next) = up.get(place + 1) {
            assert!(next - fall >= COOLDOWN_NS, "device {device}: back after {} ms", ms(*next, *fall));
        }
    }
    let agreed = outcome.emu.iter().filter(|line| line["word"] == "agreed").filter_map(|line| line["real_ns"].as_u64());
    for moment in agreed {
        let stay = stays.iter().position(|(plug, unplug)| (*plug..*unplug).contains(&moment));
        let set =
            up.iter().filter(|rise| **rise <= moment).count() > down.iter().filter(|fall| **fall <= moment).count();
        assert_eq!(set, stay.is_some(), "device {device}: the recorded bit is not the truth when all had settled");
        let bounced = |stay: usize| stay > 0 && stays[stay].0 - stays[stay - 1].1 < COOLDOWN_NS;
        quick_returns += usize::from(stay.is_some_and(bounced));
    }
    // Where the device ends unplugged it stays only after the first burst of each stretch.
    println!(
        "device {device}: {} plugs, {} rises, {} falls, {quick_returns} quick returns that stayed",
        plugs.len(),
        up.len(),
        down.len()
    );
    assert!(quick_returns >= 2, "device {device}: the timeline has no quick return that stays");
    plugs.len()
}

/// At the end `rapid` holds as many descriptors and files as after the first stretch, and as many threads as before any device came:
/// the pool's threads end when they have been idle, and the script takes the least of some time.
///
/// Memory has no such zero: what was in use once stays with the allocator, and the file's index grows with the recording. But
/// what every cycle lost would be missing after each stretch of 30. What is made once comes in some stretch or other; so the
/// one that grew least may have grown by at most 10 KiB a cycle, less than any buffer of a device, the index included. Memory
/// is read at rest: a living thread of the pool has some of it.
fn assert_flat(outcome: &Outcome) {
    let samples = json_lines(&outcome.file("samples.jsonl"));
    samples.iter().for_each(|sample| println!("{sample}"));
    let [idle, warm, first, second, end] = &samples[..] else { panic!("{} samples", samples.len()) };
    assert_eq!(first["fds"], end["fds"], "descriptors");
    assert_eq!(idle["threads"], end["threads"], "threads");
    assert_eq!(first["files"], end["files"], "files in shared memory");
    let anonymous = |sample: &serde_json::Value| sample["anon"].as_i64().expect("KiB");
    let stretches = [(warm, first), (first, second), (second, end)];
    let grown = stretches.map(|(from, to)| anonymous(to) - anonymous(from));
    println!("own memory grew by {grown:?} KiB in the three stretches");
    assert!(grown.iter().any(|grown| *grown <= 10 * 30), "memory grew by {grown:?} KiB, some in every stretch");
}

/// xorshift64*: the same timeline each time.
struct Random(u64);

impl Random {
    fn between(&mut self, low: u64, high: u64) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        low + (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) % (high - low)
    }
}
