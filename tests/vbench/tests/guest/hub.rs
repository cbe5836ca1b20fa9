//! A hub loses its cable and gets it back: every device goes in one go and returns, to other ports.
//!
//! `vhci_hcd` knows devices in ports of its root hub and none behind a hub of their own, so there is no emulated hub: all ports
//! are emptied within a millisecond or so, which is what the kernel makes of a hub that left.

use vbench::check::{assert_accounted, assert_whole, episode, ms, only, recorded_with, rises_after, takes};
use vbench::emu::log::Moment;
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::entries::{camera, registry, scalars};
use vbench::proto;
use vbench::recording::{falls, holes};
use vbench::scenario::Scenario;

const WRIST: &str = "/rapid/camera/wrist";
const SIDE: &str = "/rapid/camera/side";
const TOF: &str = "/rapid/tof";
const FORCE: &str = "/rapid/force";
/// A device's numbers start at this times its place.
const NUMBERS: f64 = 1_000_000.0;

#[test]
fn a_pulled_hub_takes_all_bits_and_brings_them_back() {
    let small = |serial| DeviceSpec::uvc(0x046d, 0x0825).serial(serial).mode(Format::Mjpg, 320, 240, &[30]);
    // The kernel reports the ports one after the other, and the driver of FTDI chips no sooner.
    let waits = |reason: &str| reason.starts_with("force: no sample for ");
    let outcome = recorded_with(
        Scenario::new("hub")
            .device(small("CAM00A1"))
            .device(small("CAM00B2"))
            .device(DeviceSpec::acm(0x2e8a, 0x000a, 100.0).serial("TOF1"))
            .device(DeviceSpec::ftdi(0x0403, 0x6001, 50.0).serial("FT1"))
            .registry(&registry(&[
                camera("cam_wrist", WRIST, 0, Some("CAM00A1"), (320, 240)),
                camera("cam_side", SIDE, 1, Some("CAM00B2"), (320, 240)),
                scalars("tof", TOF, 2, "2e8a:000a", "TOF1"),
                scalars("force", FORCE, 3, "0403:6001", "FT1"),
            ]))
            .record(6, &["cam_wrist", "cam_side", "tof", "force"])
            .at(2_000, "hub out")
            .at(2_000, "port 0 1")
            .at(2_000, "port 1 0")
            .at(2_000, "port 2 6")
            .at(2_000, "port 3 5")
            .when("is 0x00 published mask")
            .at(3_000, "hub in")
            .until("states 2 cam_wrist streaming")
            .until("states 2 cam_side streaming")
            .until("states 2 tof streaming")
            .until("states 2 force streaming")
            .until("is 0x0f published mask"),
        waits,
    );
    let episode = episode(&outcome);
    let edges = episode.mask_edges();
    let act = |action, device| -> Moment { outcome.actions(action, device)[usize::from(action == "plug")] };
    let (first_out, last_out) = (act("unplug", 0).real_ns, act("unplug", 3).real_ns);
    let back = act("plug", 0).real_ns;
    println!("four devices pulled within {} us", (last_out - first_out) / 1_000);

    let topics = [WRIST, SIDE, TOF, FORCE];
    let mut gone = Vec::new();
    for (bit, topic) in (0..).zip(topics) {
        let fell = only(&falls(&edges, bit));
        assert!(fell >= first_out && fell < back, "bit {bit} fell {} ms after the pull", ms(fell, first_out));
        let rose = only(&rises_after(&edges, bit, fell));
        let replugged = act("plug", bit as usize).real_ns;
        assert!(rose >= replugged, "bit {bit} rose before its device was back");
        // The kernel empties the ports one after the other; uvcvideo reports the end of its stream, if it is not the first, then.
        let waited = 200.0 * f64::from(bit);
        takes(&outcome, &format!("{topic}: hub out to bit"), first_out, fell, (waited - 20.0).max(0.0)..=waited + 20.0);
        takes(&outcome, &format!("{topic}: hub in to bit"), replugged, rose, 2_100.0..=2_180.0);
        assert_eq!(episode.channels(topic).len(), 1, "{topic} came back on another channel");
        gone.push((fell, replugged));
    }

    // Each device returned to its own entry, though to another port.
    for (device, (name, ports)) in [
        ("cam_wrist", ["1-1", "1-2"]),
        ("cam_side", ["1-2", "1-1"]),
        ("tof", ["1-3", "1-7"]),
        ("force", ["1-4", "1-6"]),
    ]
    .into_iter()
    .enumerate()
    {
        let attached = outcome.rapid.iter().filter(|line| line["event"] == "attach" && line["device"] == name);
        assert_eq!(attached.map(|line| line["port"].as_str().unwrap()).collect::<Vec<_>>(), ports, "{name}");
        let (fell, replugged) = gone[device];
        if device < 2 {
            let topic = topics[device];
            let ids = episode.frames(topic).into_iter().map(|frame| frame.id.expect("a whole frame").device());
            assert!(ids.into_iter().all(|id| id == device), "{topic} has frames of another camera");
            assert_whole(&episode, topic, ..fell);
            assert_whole(&episode, topic, replugged..);
        } else {
            let rows: Vec<(u64, f64)> = episode
                .topic(topics[device])
                .map(|message| (message.log_time, proto::doubles(&message.data, 2)[0]))
                .collect();
            assert!(
                rows.iter().all(|(_, number)| (number / NUMBERS) as usize == device),
                "{name}: lines of another device"
            );
            let span = |within: &dyn Fn(u64) -> bool| {
                let numbers = rows.iter().filter(|(time, _)| within(*time)).map(|(_, number)| *number as u64);
                numbers.collect::<Vec<_>>()
            };
            for numbers in [span(&|time| time < fell), span(&|time| time >= replugged)] {
                assert_accounted(&episode, topics[device], numbers);
            }
        }
    }

    // Nothing waited for anything: no tick and no publication of the mask is missing, the empty time included.
    let ticks: Vec<u64> = episode.topic("/rapid/frame").map(|message| proto::number(&message.data, 2)).collect();
    assert!(!ticks.is_empty());
    assert_eq!(holes(ticks), [], "ticks are missing");
    let mut published: Vec<(u64, u64)> =
        episode.topic("/rapid/mask").map(|message| (proto::number(&message.data, 3), message.log_time)).collect();
    published.sort_unstable();
    assert_accounted(&episode, "/rapid/mask", published.iter().map(|(sequence, _)| *sequence).collect());
    let empty_from = gone.iter().map(|(fell, _)| *fell).max().expect("four devices");
    let quarter = (back - empty_from) / 4;
    for begun in (0..4).map(|part| empty_from + part * quarter) {
        let count = published.iter().filter(|(_, time)| (begun..begun + quarter).contains(time)).count();
        println!("{count} masks published in {} ms while nothing was plugged", quarter / 1_000_000);
        let least = if outcome.is_virtual { quarter as usize / 2_000_000 - 1 } else { 1 };
        assert!(count >= least, "{count} masks in a quarter of the time in which nothing was plugged");
    }
    for name in ["cam_wrist", "cam_side", "tof", "force"] {
        assert!(!outcome.states(name).contains(&"failed"), "{name}: {:?}", outcome.states(name));
    }
}
