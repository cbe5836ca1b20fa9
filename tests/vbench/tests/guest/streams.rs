//! Depth cameras: devices with one camera for depth and one for colour behind one cable, each a capture node of its own.
//!
//! Two of them differ in the order of their nodes, so that only the formats tell a node's stream.

use std::ops::Range;

use serde_json::Value;
use vbench::check::{assert_accounted, ended, ms, only, play, rises_after};
use vbench::emu::frame::NUMBERS_PER_CAMERA;
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::entries::registry;
use vbench::outcome::{Outcome, json_lines};
use vbench::recording::{Recording, falls};
use vbench::scenario::Scenario;

/// One device, and its streams in the order of its cameras.
struct Unit {
    device: usize,
    name: &'static str,
    serial: &'static str,
    cameras: [Stream; 2],
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Stream {
    Colour,
    Depth,
}

const NEAR: Unit = Unit { device: 0, name: "near", serial: "D1", cameras: [Stream::Depth, Stream::Colour] };
const FAR: Unit = Unit { device: 1, name: "far", serial: "D2", cameras: [Stream::Colour, Stream::Depth] };

impl Unit {
    /// 64x48 at 15 fps in both streams; the colour camera could send JPEGs as well.
    fn spec(&self) -> DeviceSpec {
        let spec = DeviceSpec::uvc(0x8086, 0x0b07).serial(self.serial);
        if self.cameras[0] == Stream::Depth {
            spec.mode(Format::Z16, 64, 48, &[15]).also(Format::Yuyv, 64, 48, &[15]).mode(Format::Mjpg, 64, 48, &[15])
        } else {
            spec.mode(Format::Mjpg, 64, 48, &[15]).mode(Format::Yuyv, 64, 48, &[15]).also(Format::Z16, 64, 48, &[15])
        }
    }

    /// Its entry: colour, and the further stream `depth`.
    fn entry(&self) -> String {
        let Self { name, serial, .. } = self;
        let [colour, depth] = [Stream::Colour, Stream::Depth].map(|stream| self.bit(stream));
        // 15 fps give no sample at every tick.
        let verdict =
            |table: &str| format!("[{table}.verdict]\nvalid = \"off\"\n[{table}.verdict.bad]\nvalid = \"off\"\n");
        let camera = |table: &str, format: &str| {
            format!("[{table}.camera]\nwidth = 64\nheight = 48\nfps = 15\nformat = \"{format}\"\n{}", verdict(table))
        };
        let entry = format!("device.{name}");
        let further = format!("{entry}.stream.depth");
        format!(
            "[{entry}]\nvid = \"8086\"\npid = \"0b07\"\nserial = \"{serial}\"\nnode = \"camera\"\nbit = {colour}\n{}\
             [{further}]\nbit = {depth}\n{}",
            camera(&entry, "YUYV"),
            camera(&further, "Z16")
        )
    }

    fn bit(&self, stream: Stream) -> u32 {
        self.device as u32 * 2 + u32::from(stream == Stream::Depth)
    }

    fn modality(&self, stream: Stream) -> String {
        format!("{}{}", self.name, if stream == Stream::Depth { "_depth" } else { "" })
    }

    fn topic(&self, stream: Stream) -> String {
        format!("/rapid/camera/{}{}", self.name, if stream == Stream::Depth { "/depth" } else { "" })
    }
}

const SCRIPT: &str = r#"
config='--config /tmp/bench/devices.toml'
# capture PORT CAMERA: the node of this camera (0 or 1) of the device in the port; the second node of each has no pictures.
capture() {
  local node
  for node in /sys/bus/usb/devices/1-$(($1 + 1)):1.$(($2 * 2))/video4linux/video*; do
    [ "$(cat "$node/index" 2>/dev/null)" != 0 ] || echo "/dev/${node##*/}"
  done
}
have_nodes() { [ -e "$(capture 0 0)" ] && [ -e "$(capture 0 1)" ] && [ -e "$(capture 1 0)" ] && [ -e "$(capture 1 1)" ]; }
emu plug 0 1
wait_for 60 attached 0 1 || fail 'not attached'
wait_for 30 have_nodes || fail "not every camera has a node: $(ls /dev/video*)"
udevadm settle
for port in 0 1; do for camera in 0 1; do echo "$port $camera $(capture $port $camera)"; done; done >$out/nodes

# Without rapid: one camera is started and stopped twice while the other of its device sends.
mark reading
"${usbemu[@]}" --read "$(capture 0 0)" 150 >$out/first.json &
reader=$!
wait_for 60 logged stream_on '"endpoint":1' || fail 'the first camera does not send'
for time in 1 2; do
  "${usbemu[@]}" --read "$(capture 0 1)" 5 >$out/second_$time.json || fail 'the second camera does not send'
done
wait $reader || fail 'the first camera does not send on'

"${rapid[@]}" devices --json $config >$out/devices.jsonl || fail 'rapid devices'
rapid_start --headless --record --out $out/rec $config --json
await_rapid 60 '"event":"recording"' || fail 'not recording'
streaming() { wait_for 60 states "$@" streaming || fail "$2 does not stream"; }
for device in near near_depth far far_depth; do streaming 1 $device; done
sleep 3
emu unplug 0
for device in near near_depth; do wait_for 60 is absent published $device || fail "$device does not leave"; done
wait_for 60 is 0x0c published mask || fail "mask $(published mask)"
emu plug 0
for device in near near_depth; do streaming 2 $device; done
wait_for 60 is 0x0f published mask || fail "mask $(published mask)"
sleep 3
rapid_stop
emu_quit
exit 0
"#;

#[test]
fn the_streams_of_a_camera_come_and_go_with_its_cable_whatever_the_order_of_its_nodes() {
    let outcome = play(
        Scenario::new("streams")
            .device(NEAR.spec())
            .device(FAR.spec())
            .registry(&registry(&[NEAR.entry(), FAR.entry()]))
            .script(SCRIPT),
    );
    ended(&outcome);
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());
    assert_independent(&outcome);
    assert_named(&outcome);

    let episode = outcome.episode().unwrap_or_else(|error| panic!("{error}"));
    let unplugged = outcome.actions("unplug", 0)[0].real_ns;
    let replugged = outcome.actions("plug", 0)[1].real_ns;
    let edges = episode.mask_edges();
    for stream in NEAR.cameras {
        let fell = only(&falls(&edges, NEAR.bit(stream)));
        let rose = only(&rises_after(&edges, NEAR.bit(stream), fell));
        assert!(fell >= unplugged && fell < replugged && rose >= replugged, "{edges:?}");
        let (out, back) = (ms(fell, unplugged), ms(rose, replugged));
        println!("{}: bit cleared {out} ms after the unplug, set {back} ms after the replug", NEAR.modality(stream));
        assert_own(&episode, &NEAR, stream, &[0..fell, replugged..u64::MAX]);
    }
    for stream in FAR.cameras {
        assert_eq!(falls(&edges, FAR.bit(stream)), [0_u64; 0], "the other device stayed plugged");
        assert_own(&episode, &FAR, stream, std::slice::from_ref(&(0..u64::MAX)));
    }
}

/// A camera that starts and stops leaves the other one of its device sending, without a gap.
fn assert_independent(outcome: &Outcome) {
    let read = |name: &str| -> Value { serde_json::from_str(&outcome.file(name)).expect("JSON") };
    let [first, once, again] = ["first.json", "second_1.json", "second_2.json"].map(read);
    println!("{first}\n{once}\n{again}");
    assert_eq!((&first["format"], &first["frames"], &first["first"]), (&"Z16 ".into(), &150.into(), &0.into()));
    for second in [&once, &again] {
        assert_eq!((&second["format"], &second["frames"]), (&"YUYV".into(), &5.into()));
    }
    for camera in [&first, &once, &again] {
        assert_eq!([&camera["damaged"], &camera["holes"], &camera["repeats"]], [0, 0, 0], "{camera}");
    }
    assert_eq!(once["first"], NUMBERS_PER_CAMERA);
    assert!(once["last"].as_u64() < again["first"].as_u64(), "its numbers continue");

    let edges = outcome.emu.iter().filter(|line| line["device"] == NEAR.device).filter_map(|line| {
        let action = line["action"].as_str()?.strip_prefix("stream_")?;
        Some(format!("{action} {}", line["endpoint"]))
    });
    assert_eq!(edges.take(6).collect::<Vec<_>>(), ["on 1", "on 2", "off 2", "on 2", "off 2", "off 1"]);
}

/// `rapid devices` names the stream of each node.
fn assert_named(outcome: &Outcome) {
    let (nodes, listed) = (outcome.file("nodes"), json_lines(&outcome.file("devices.jsonl")));
    println!("{nodes}");
    for unit in [&NEAR, &FAR] {
        for (camera, stream) in unit.cameras.into_iter().enumerate() {
            let place = format!("{} {camera} ", unit.device);
            let node = nodes.lines().find_map(|line| line.strip_prefix(&place)).expect("its node");
            let entries: Vec<_> =
                listed.iter().filter(|line| line["node"] == node).map(|line| &line["entry"]).collect();
            assert_eq!(entries, [&Value::from(unit.modality(stream))], "{node}");
        }
    }
}

/// All pictures of a topic are of its stream's format and camera, and none is missing within these spans of the wall clock,
/// outside of which there are none.
fn assert_own(episode: &Recording, unit: &Unit, stream: Stream, spans: &[Range<u64>]) {
    let topic = unit.topic(stream);
    assert_eq!(episode.channels(&topic).len(), 1, "{topic} has one channel");
    let encoding: &[u8] = if stream == Stream::Depth { b"16UC1" } else { b"yuv422_yuy2" };
    let mut numbers = vec![Vec::new(); spans.len()];
    for picture in episode.pictures(&topic) {
        let id = picture.id.expect("a picture with a number");
        assert_eq!((picture.encoding, picture.data.len()), (encoding, 2 * 64 * 48), "{topic} {id:?}");
        assert_eq!((id.device(), unit.cameras[id.camera()]), (unit.device, stream), "{topic} {id:?}");
        let span = spans.iter().position(|span| span.contains(&picture.log_time));
        numbers[span.expect("a picture of a device that is plugged")].push(id.number.into());
    }
    numbers.into_iter().for_each(|numbers| assert_accounted(episode, &topic, numbers));
}
