use std::collections::BTreeSet;
use std::path::PathBuf;

use proptest::prelude::*;

use super::*;

/// One camera by serial, one by port, two interchangeable, and a composite of camera and tty.
fn registry() -> Registry {
    let text = r#"
        [device.by_serial]
        vid = "0001"
        pid = "0001"
        serial = "A"
        node = "camera"
        bit = 0
        [device.by_port]
        vid = "0001"
        pid = "0001"
        port = "1-9"
        node = "camera"
        bit = 1
        [device.any_low]
        vid = "0002"
        pid = "0002"
        node = "camera"
        bit = 2
        [device.any_high]
        vid = "0002"
        pid = "0002"
        node = "camera"
        bit = 3
        [device.both_camera]
        vid = "0003"
        pid = "0003"
        serial = "C"
        node = "camera"
        bit = 4
        [device.both_tty]
        vid = "0003"
        pid = "0003"
        serial_number = "C"
        node = "serial"
        bit = 5
        [device.both_tty.tty]
        channels = 1
    "#;
    Registry::parse(text, None).unwrap().registry
}

fn id(bit: u8) -> ModalityId {
    ModalityId::new(bit).unwrap()
}

fn entry(bit: u8) -> Assignment {
    Assignment::Entry(id(bit))
}

fn unit(model: u16, serial: Option<&str>, port: &str) -> UsbIdentity {
    UsbIdentity {
        vid: model,
        pid: model,
        serial: serial.map(str::to_owned),
        port: port.to_owned(),
        ..UsbIdentity::default()
    }
}

fn video(number: u32, usb: UsbIdentity) -> Attachment {
    let syspath = PathBuf::from(format!("/sys/devices/usb1/{}/video4linux/video{number}", usb.port));
    Attachment {
        syspath,
        node: DeviceNode::Video(format!("/dev/video{number}").into()),
        unit: usb.into(),
        driver: None,
        formats: Vec::new(),
    }
}

fn tty(usb: UsbIdentity) -> Attachment {
    let syspath = PathBuf::from(format!("/sys/devices/usb1/{}/tty/ttyACM0", usb.port));
    Attachment {
        syspath,
        node: DeviceNode::Tty("/dev/ttyACM0".into()),
        unit: usb.into(),
        driver: None,
        formats: Vec::new(),
    }
}

fn device_path(port: &str) -> PathBuf {
    PathBuf::from(format!("/sys/devices/usb1/{port}"))
}

fn waits(assignment: &Assignment) -> bool {
    matches!(assignment, Assignment::Waiting { .. })
}

/// Two cameras of one model, each with a stream of colours and one of depth.
fn with_streams() -> Registry {
    let camera = |name: &str, serial: &str, bits: [u8; 2]| {
        format!(
            "[device.{name}]\nvid = \"8086\"\npid = \"0b07\"\nserial = \"{serial}\"\nnode = \"camera\"\nbit = {}\n\
             [device.{name}.camera]\nformat = \"YUYV\"\n[device.{name}.stream.depth]\nbit = {}\n\
             [device.{name}.stream.depth.camera]\nformat = \"Z16\"\n",
            bits[0], bits[1]
        )
    };
    let text = camera("left", "L", [3, 0]) + &camera("right", "R", [1, 2]);
    Registry::parse(&text, None).unwrap().registry
}

#[test]
fn the_streams_of_a_camera_are_told_apart_by_their_formats() {
    let registry = with_streams();
    assert!(registry.devices.iter().all(|device| registry.shares_unit(device)));
    let node = |number, serial: &str, port: &str, formats: &[&str]| {
        let formats = formats.iter().map(|format| (*format).to_owned()).collect();
        let usb = UsbIdentity { vid: 0x8086, pid: 0x0b07, ..unit(0, Some(serial), port) };
        let syspath = device_path(port).join(format!("video4linux/video{number}"));
        Attachment { syspath, formats, ..video(number, usb) }
    };
    let (depth, colour) = (["Z16"], ["YUYV", "MJPG"]);
    // In either order, and a node that offers neither is left alone.
    let mut assigner = Assigner::new(&registry);
    assert_eq!(assigner.attach(&node(4, "L", "1-1", &colour)), entry(3));
    assert!(matches!(assigner.attach(&node(2, "L", "1-1", &["GREY"])), Assignment::WrongNode { .. }));
    assert_eq!(assigner.attach(&node(0, "L", "1-1", &depth)), entry(0));
    assert_eq!(assigner.attach(&node(6, "R", "1-2", &depth)), entry(2));
    assert_eq!(assigner.attach(&node(8, "R", "1-2", &colour)), entry(1));
    // One cable: both are gone, and come back, in another port too.
    assert_eq!(assigner.detach(&device_path("1-1")).freed, [id(0), id(3)]);
    assert_eq!(assigner.attach(&node(0, "L", "1-4", &depth)), entry(0));
    assert!(waits(&assigner.attach(&node(9, "L", "1-4", &depth))), "a second node of a taken stream");
    assert_eq!(assigner.attach(&node(4, "L", "1-4", &colour)), entry(3));
    // A node that does not answer is not a stream, and does not take that of another.
    let mut assigner = Assigner::new(&registry);
    assert!(matches!(assigner.attach(&node(0, "R", "1-2", &[])), Assignment::WrongNode { .. }));
    assert_eq!(assigner.attach(&node(2, "R", "1-2", &depth)), entry(2));
}

#[test]
fn a_serial_number_decides_before_a_port() {
    let mut assigner = Assigner::new(&registry());
    assert_eq!(assigner.attach(&video(0, unit(1, Some("A"), "1-9"))), entry(0));
    assert_eq!(assigner.detach(&device_path("1-9")).freed, [id(0)]);
    assert_eq!(assigner.attach(&video(0, unit(1, Some("B"), "1-9"))), entry(1));
}

#[test]
fn an_unknown_unit_of_a_known_model_names_the_difference() {
    let mut assigner = Assigner::new(&registry());
    let Assignment::Unregistered { reason } = assigner.attach(&video(0, unit(1, Some("B\n"), "1-2"))) else {
        panic!("it must not match");
    };
    assert_eq!(
        reason,
        "vid:pid match [device.by_serial], but its serial is \"A\" and this unit reports \"B\\n\"; \
         vid:pid match [device.by_port], but its port is 1-9 and this unit is at \"1-2\""
    );
    assert_eq!(
        assigner.attach(&video(1, unit(7, None, "1-3"))),
        Assignment::Unregistered { reason: "no entry has vid:pid 0007:0007".to_owned() }
    );
}

#[test]
fn an_added_entry_gets_the_unit_that_is_plugged_in_and_takes_none_from_others() {
    let mut assigner = Assigner::new(&registry());
    let (known, spare, other) = (unit(1, Some("A"), "1-1"), unit(7, Some("S"), "1-2"), unit(7, Some("T"), "1-3"));
    assert_eq!(assigner.attach(&video(0, known.clone())), entry(0));
    for (number, unit) in [(1, &spare), (2, &spare), (3, &other)] {
        assert!(matches!(assigner.attach(&video(number, unit.clone())), Assignment::Unregistered { .. }));
    }
    let text = "[device.new]\nvid = \"0007\"\npid = \"0007\"\nserial = \"S\"\nnode = \"camera\"\nbit = 9\n";
    let added = Registry::parse(text, None).unwrap().registry;
    assert_eq!(assigner.add(&added.devices[0]), [(id(9), video(1, spare.clone()))]);
    assert_eq!(assigner.attached_as(id(0)), Some(&video(0, known)));
    // Its second node waits, and takes its place when the first is gone.
    assert_eq!(assigner.nodes().count(), 4);
    let first = video(1, spare.clone()).syspath;
    assert_eq!(assigner.detach(&first), Detached { freed: vec![id(9)], assigned: vec![(id(9), video(2, spare))] });
    assert_eq!(assigner.detach(&device_path("1-3")), Detached::default());
}

#[test]
fn a_device_in_a_new_port_waits_until_its_old_port_is_seen_empty() {
    let mut assigner = Assigner::new(&registry());
    assert_eq!(assigner.attach(&video(0, unit(1, Some("A"), "1-2"))), entry(0));
    let moved = video(1, unit(1, Some("A"), "1-3"));
    assert_eq!(
        assigner.attach(&moved),
        Assignment::Waiting { reason: "[device.by_serial] is taken by a unit at port \"1-2\"".to_owned() }
    );
    let expected = Detached { freed: vec![id(0)], assigned: vec![(id(0), moved.clone())] };
    assert_eq!(assigner.detach(&device_path("1-2")), expected);
    assert_eq!(assigner.attached_as(id(0)), Some(&moved));
}

#[test]
fn interchangeable_units_take_entries_in_order_and_return_to_their_own() {
    let mut assigner = Assigner::new(&registry());
    assert_eq!(assigner.attach(&video(0, unit(2, None, "1-5"))), entry(2));
    assert_eq!(assigner.attach(&video(1, unit(2, None, "1-4"))), entry(3));
    let third = video(2, unit(2, None, "1-6"));
    assert!(waits(&assigner.attach(&third)));
    assert_eq!(assigner.detach(&third.syspath), Detached::default());
    assigner.detach(&device_path("1-5"));
    assigner.detach(&device_path("1-4"));
    assert_eq!(assigner.attach(&video(0, unit(2, None, "1-4"))), entry(3));
    assert_eq!(assigner.attach(&video(1, unit(2, None, "1-5"))), entry(2));
}

#[test]
fn a_unit_with_a_serial_number_returns_to_its_entry_in_any_port() {
    let mut assigner = Assigner::new(&registry());
    assert_eq!(assigner.attach(&video(0, unit(2, Some("X"), "1-5"))), entry(2));
    assert_eq!(assigner.attach(&video(1, unit(2, Some("Y"), "1-4"))), entry(3));
    assigner.detach(Path::new("/sys/devices/usb1"));
    assert_eq!(assigner.attach(&video(0, unit(2, Some("Y"), "1-5"))), entry(3));
    assert_eq!(assigner.attach(&video(1, unit(2, Some("X"), "1-4"))), entry(2));
}

#[test]
fn twins_with_one_serial_number_stay_separate_by_port() {
    let mut assigner = Assigner::new(&registry());
    assert_eq!(assigner.attach(&video(0, unit(2, Some("0001"), "1-5"))), entry(2));
    assert_eq!(assigner.attach(&video(1, unit(2, Some("0001"), "1-4"))), entry(3));
    assigner.detach(Path::new("/sys/devices/usb1"));
    assert_eq!(assigner.attach(&video(0, unit(2, Some("0001"), "1-4"))), entry(3));
    assert_eq!(assigner.attach(&video(1, unit(2, Some("0001"), "1-5"))), entry(2));
    assigner.detach(Path::new("/sys/devices/usb1"));
    assert_eq!(assigner.attach(&video(0, unit(2, Some("0001"), "1-5"))), entry(2));
    assert_eq!(assigner.attach(&video(1, unit(2, Some("0001"), "1-4"))), entry(3));
    // In the other order the last one plugged is not the first one to return.
    assigner.detach(Path::new("/sys/devices/usb1"));
    assert_eq!(assigner.attach(&video(0, unit(2, Some("0001"), "1-5"))), entry(2));
}

#[test]
fn a_second_capture_node_is_not_a_second_unit_but_may_take_over() {
    let mut assigner = Assigner::new(&registry());
    let first = video(0, unit(2, None, "1-5"));
    let second = video(1, unit(2, None, "1-5"));
    assert_eq!(assigner.attach(&first), entry(2));
    assert_eq!(
        assigner.attach(&second),
        Assignment::WrongNode { reason: "[device.any_low] already reads another node of this device".to_owned() }
    );
    assert_eq!(assigner.attach(&video(2, unit(2, None, "1-6"))), entry(3));
    let taken_over = Detached { freed: vec![id(2)], assigned: vec![(id(2), second)] };
    assert_eq!(assigner.detach(&first.syspath), taken_over);
}

#[test]
fn the_nodes_of_a_composite_device_go_to_their_own_entries() {
    let mut assigner = Assigner::new(&registry());
    assert_eq!(assigner.attach(&tty(unit(3, Some("C"), "1-7"))), entry(5));
    assert_eq!(assigner.attach(&video(0, unit(3, Some("C"), "1-7"))), entry(4));
    assert_eq!(assigner.detach(&device_path("1-7")).freed, [id(4), id(5)]);
    let wrong = assigner.attach(&tty(unit(2, None, "1-8")));
    assert_eq!(
        wrong,
        Assignment::WrongNode { reason: "[device.any_low] reads its camera, not /dev/ttyACM0".to_owned() }
    );
}

#[test]
fn a_node_reported_twice_is_one_node_and_a_missed_removal_is_detected() {
    let mut assigner = Assigner::new(&registry());
    let node = video(0, unit(2, None, "1-5"));
    assert_eq!(assigner.attach(&node), entry(2));
    assert_eq!(assigner.attach(&node), entry(2));
    assert!(!assigner.replaces(&node));
    let mut other = node.clone();
    other.unit = unit(1, Some("A"), "1-5").into();
    assert!(assigner.replaces(&other));
    assert_eq!(assigner.detach(&other.syspath).freed, [id(2)]);
    assert_eq!(assigner.attach(&other), entry(0));
}

#[test]
fn explanations_name_every_entry_that_fits() {
    let assigner = Assigner::new(&registry());
    let explanation = assigner.explain(&video(0, unit(2, None, "1-5")));
    assert_eq!(explanation.fits, [id(2), id(3)]);
    assert_eq!(explanation.reasons[0], "vid:pid are those of [device.any_low], which takes any such unit");
    let stranger = assigner.explain(&video(0, unit(3, None, "1-5")));
    assert_eq!(
        stranger.reasons[0],
        "vid:pid match [device.both_camera], but its serial is \"C\" and this unit has none"
    );
}

#[derive(Debug, Clone)]
enum Step {
    Attach(Attachment),
    Detach(PathBuf),
}

fn any_step() -> impl Strategy<Value = Step> {
    let serial = prop_oneof![Just(None), Just(Some("A")), Just(Some("B")), Just(Some("C"))];
    let attach = (1_u16..=4, serial, 5_u32..=9, 0_u32..3).prop_map(|(model, serial, port, node)| {
        let usb = unit(model, serial, &format!("1-{port}"));
        Step::Attach(if node == 2 { tty(usb) } else { video(node, usb) })
    });
    let detach = prop_oneof![
        8 => (5_u32..=9).prop_map(|port| device_path(&format!("1-{port}"))),
        2 => (5_u32..=9).prop_map(|port| device_path(&format!("1-{port}/video4linux/video0"))),
        1 => Just(PathBuf::from("/sys/devices/usb1")),
    ];
    prop_oneof![3 => attach, 2 => detach.prop_map(Step::Detach)]
}

/// The state of the rig, derived only from the assigner's reports.
#[derive(Default)]
struct Believed(Vec<(ModalityId, Attachment)>);

impl Believed {
    fn apply(&mut self, assigner: &mut Assigner, step: Step) {
        match step {
            Step::Attach(attachment) => {
                if assigner.replaces(&attachment) {
                    self.detach(assigner, &attachment.syspath);
                }
                if let Assignment::Entry(id) = assigner.attach(&attachment) {
                    self.0.retain(|(_, known)| known.syspath != attachment.syspath);
                    self.0.push((id, attachment));
                }
            }
            Step::Detach(path) => self.detach(assigner, &path),
        }
    }

    fn detach(&mut self, assigner: &mut Assigner, path: &Path) {
        let detached = assigner.detach(path);
        for id in detached.freed {
            let (_, gone) = self.0.remove(self.0.iter().position(|(known, _)| *known == id).unwrap());
            assert!(gone.is_under(path), "{id} was freed without cause");
        }
        assert!(self.0.iter().all(|(_, known)| !known.is_under(path)), "a node below {path:?} was not freed");
        self.0.extend(detached.assigned);
    }
}

proptest! {
    #[test]
    fn reported_assignments_match_the_state(steps in prop::collection::vec(any_step(), 0..40)) {
        let mut assigner = Assigner::new(&registry());
        let mut believed = Believed::default();
        for step in steps {
            believed.apply(&mut assigner, step);
            let ids: BTreeSet<_> = believed.0.iter().map(|(id, _)| *id).collect();
            let paths: BTreeSet<_> = believed.0.iter().map(|(_, node)| node.syspath.clone()).collect();
            prop_assert_eq!(ids.len(), believed.0.len(), "an entry has two nodes");
            prop_assert_eq!(paths.len(), believed.0.len(), "a node has two entries");
            for entry in &registry().devices {
                let derived = believed.0.iter().find(|(id, _)| *id == entry.id).map(|(_, node)| node);
                prop_assert_eq!(assigner.attached_as(entry.id), derived);
            }
            for (id, node) in &believed.0 {
                prop_assert!(assigner.explain(node).fits.contains(id), "{} does not fit", id);
            }
            // The number of running interchangeable cameras is limited only by units and entries.
            let units: BTreeSet<_> = assigner
                .attached
                .iter()
                .filter(|node| node.attachment.unit.usb().is_some_and(|usb| usb.vid == 2) && matches!(node.attachment.node, DeviceNode::Video(_)))
                .map(|node| (node.attachment.unit.place().to_owned(), node.attachment.unit.serial().map(str::to_owned)))
                .collect();
            let running = believed.0.iter().filter(|(id, _)| matches!(id.bit(), 2 | 3)).count();
            prop_assert_eq!(running, units.len().min(2));
        }
    }

    #[test]
    fn with_distinguishable_units_only_plugged_ones_count(
        noise in prop::collection::vec(0_usize..5, 0..12),
        plugged in prop::sample::subsequence(vec![0_usize, 1, 2, 3, 4], 0..=5).prop_shuffle(),
    ) {
        let units = [
            (video(0, unit(1, Some("A"), "1-5")), Some(0)),
            (video(1, unit(1, Some("B"), "1-9")), Some(1)),
            (video(2, unit(3, Some("C"), "1-6")), Some(4)),
            (tty(unit(3, Some("C"), "1-6")), Some(5)),
            (video(3, unit(1, Some("stranger"), "1-4")), None),
        ];
        let mut assigner = Assigner::new(&registry());
        for index in noise {
            assigner.attach(&units[index].0);
            assigner.detach(&units[index].0.syspath);
        }
        for index in &plugged {
            assigner.attach(&units[*index].0);
        }
        for (index, (attachment, bit)) in units.iter().enumerate() {
            let Some(bit) = bit else { continue };
            let expected = plugged.contains(&index).then_some(attachment);
            prop_assert_eq!(assigner.attached_as(id(*bit)), expected);
        }
    }
}
