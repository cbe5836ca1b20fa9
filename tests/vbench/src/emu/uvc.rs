//! A USB Video Class 1.0 camera with one bulk endpoint: one function of a device, with an interface association.
//!
//! Bulk, because `vhci_hcd` completes bulk transfers as they arrive, while isochronous ones would need a schedule that
//! a loaded machine cannot keep; above the endpoint `uvcvideo` treats both alike.
//! Invariant: a stream lasts from COMMIT to CLEAR_FEATURE(HALT), which is how Linux starts and stops a bulk camera.

use std::time::Duration;

use super::descriptor::{Answer, CS_INTERFACE, Configuration, Setup};
use super::frame::{self, FrameId};
use super::function::DATA_IN;
use super::source::{Live, Source};
use super::spec::{Format, Mode};

/// A payload fills one of `uvcvideo`'s bulk transfers, which have at most 32 packets of 512 bytes.
const PAYLOAD: u32 = 16 * 1024;
const PAYLOAD_HEADER: u8 = 2;
const PROBE_LEN: usize = 26;
/// Each camera of a device has a control and a streaming interface, in this order.
const INTERFACES: u8 = 2;
/// The processing unit, of the control interface.
const PROCESSING_UNIT: u8 = 3;
/// Interval unit of the class: 100 ns.
const INTERVALS_PER_SECOND: u32 = 10_000_000;

const GUID_YUYV: [u8; 16] = [b'Y', b'U', b'Y', b'2', 0, 0, 0x10, 0, 0x80, 0, 0, 0xaa, 0, 0x38, 0x9b, 0x71];

const GUID_Z16: [u8; 16] = [b'Z', b'1', b'6', b' ', 0, 0, 0x10, 0, 0x80, 0, 0, 0xaa, 0, 0x38, 0x9b, 0x71];

/// The pictures of one size, encoded once and shared by all cameras of that size.
pub type Pictures = std::sync::Arc<Vec<Vec<u8>>>;

/// The modes of a camera, the first of them its default, with the pictures of each that is compressed.
pub type Content = Vec<(Mode, Pictures)>;

/// A control of the processing unit: its selector (UVC 1.0, table A-13) and its range. What it is set to is kept, and
/// does not change the pictures.
#[derive(Debug)]
struct Control {
    selector: u16,
    least: i16,
    most: i16,
    default: i16,
    now: i16,
}

const fn control(selector: u16, least: i16, most: i16, default: i16) -> Control {
    Control { selector, least, most, default, now: default }
}

/// Brightness and contrast.
const CONTROLS: [Control; 2] = [control(2, -64, 64, 0), control(3, 0, 95, 32)];

/// A camera.
#[derive(Debug)]
pub struct Uvc {
    /// Which of its device's cameras it is, counted from 0.
    place: u8,
    controls: [Control; 2],
    formats: Vec<FormatGroup>,
    probe: Selection,
    committed: Selection,
    stream: Option<u32>,
    streams: u32,
    first_frame: u32,
    next_frame: u32,
    payload_parity: u8,
}

/// The modes of one pixel format, which the class numbers together.
#[derive(Debug)]
struct FormatGroup {
    format: Format,
    modes: Vec<(Mode, Pictures)>,
}

/// The result of probe and commit; indices count from 1 on the wire and from 0 here.
#[derive(Clone, Copy, Debug)]
struct Selection {
    format: usize,
    mode: usize,
    interval: u32,
}

impl Uvc {
    /// A camera with these modes, grouped by format in order of first appearance: the one with this place (counted from 0)
    /// in its device. Its first frame has number `first`.
    pub fn new(content: Content, place: u8, first: u32) -> Self {
        let mut formats: Vec<FormatGroup> = Vec::new();
        for (mode, pictures) in content {
            match formats.iter_mut().find(|group| group.format == mode.format) {
                Some(group) => group.modes.push((mode, pictures)),
                None => formats.push(FormatGroup { format: mode.format, modes: vec![(mode, pictures)] }),
            }
        }
        let default = Selection { format: 0, mode: 0, interval: interval(formats[0].modes[0].0.fps[0]) };
        Self {
            place,
            controls: CONTROLS,
            formats,
            probe: default,
            committed: default,
            stream: None,
            streams: 0,
            first_frame: first,
            next_frame: first,
            payload_parity: 0,
        }
    }

    /// Address of its endpoint.
    pub fn address(&self) -> u8 {
        DATA_IN + self.place
    }

    /// Whether this interface is one of its two.
    pub fn has_interface(&self, number: u8) -> bool {
        (self.control_interface()..=self.streaming_interface()).contains(&number)
    }

    fn control_interface(&self) -> u8 {
        self.place * INTERFACES
    }

    fn streaming_interface(&self) -> u8 {
        self.control_interface() + 1
    }

    /// Appends its descriptors: one camera terminal, one processing unit, one output terminal, one streaming interface.
    pub fn describe(&self, out: &mut Configuration) {
        let (control, streaming) = (self.control_interface(), self.streaming_interface());
        let clock = 48_000_000u32.to_le_bytes();
        let control_total = 13 + 18 + 11 + 9;
        out.push(&[11, control, INTERFACES, 0x0e, 3, 0, 2])
            .interface(control, 0, [0x0e, 1, 0])
            .push(&[&[CS_INTERFACE, 1, 0x00, 0x01, control_total, 0], &clock[..], &[1, streaming]].concat())
            .push(&[CS_INTERFACE, 2, 1, 0x01, 0x02, 0, 0, 0, 0, 0, 0, 0, 0, 3, 0, 0, 0])
            // Bits 0 and 1: brightness and contrast.
            .push(&[CS_INTERFACE, 5, PROCESSING_UNIT, 1, 0, 0, 2, 0b11, 0, 0])
            .push(&[CS_INTERFACE, 3, 2, 0x01, 0x01, 0, PROCESSING_UNIT, 0])
            .interface(streaming, 1, [0x0e, 2, 0]);
        self.describe_formats(out);
        out.bulk(self.address());
    }

    /// The header of the streaming interface, and the formats whose length it contains.
    fn describe_formats(&self, out: &mut Configuration) {
        let mut formats = Configuration::default();
        for (index, group) in (1u8..).zip(&self.formats) {
            group.describe(index, &mut formats);
        }
        let formats = formats.into_body();
        let count = u8::try_from(self.formats.len()).expect("three formats exist");
        let header_len = 13 + u16::from(count);
        let total = (header_len + u16::try_from(formats.len()).expect("a few dozen modes")).to_le_bytes();
        let mut header = vec![CS_INTERFACE, 1, count, total[0], total[1], self.address(), 0, 2, 0, 0, 0, 1];
        header.resize(usize::from(header_len) - 1, 0);
        out.push(&header).append(&formats);
    }

    /// Probe and commit, and the controls of the processing unit.
    pub fn control(&mut self, setup: Setup, data: &[u8]) -> Answer {
        let selector = setup.value >> 8;
        let [interface, entity] = setup.index.to_le_bytes();
        if setup.kind & 0x7f != 0x21 {
            return Answer::Stall;
        }
        if (entity, interface) == (PROCESSING_UNIT, self.control_interface()) {
            let control = self.controls.iter_mut().find(|control| control.selector == selector);
            return control.map_or(Answer::Stall, |control| control.answer(setup.request, data));
        }
        if interface != self.streaming_interface() || !(1..=2).contains(&selector) {
            return Answer::Stall;
        }
        let is_commit = selector == 2;
        match setup.request {
            0x01 => {
                let selection = self.negotiate(data);
                self.probe = selection;
                if is_commit {
                    self.committed = selection;
                    self.streams += 1;
                    self.stream = Some(self.streams);
                }
                Answer::Done
            }
            0x81..=0x84 | 0x87 => Answer::Data(self.wire(if is_commit { self.committed } else { self.probe })),
            0x85 => Answer::Data(vec![PROBE_LEN as u8, 0]),
            0x86 => Answer::Data(vec![0b11]),
            _ => Answer::Stall,
        }
    }

    /// The stream has ended.
    pub fn stop(&mut self) {
        self.stream = None;
    }

    fn mode(&self, selection: Selection) -> &(Mode, Pictures) {
        &self.formats[selection.format].modes[selection.mode]
    }

    /// The camera's setting nearest to the host's proposal.
    fn negotiate(&self, data: &[u8]) -> Selection {
        let byte = |at: usize| usize::from(data.get(at).copied().unwrap_or(0));
        let format = byte(2).saturating_sub(1).min(self.formats.len() - 1);
        let modes = &self.formats[format].modes;
        let mode = byte(3).saturating_sub(1).min(modes.len() - 1);
        let wanted = data.get(4..8).map_or(0, |b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
        let offered = modes[mode].0.fps.iter().map(|fps| interval(*fps));
        let default = interval(modes[mode].0.fps[0]);
        let interval =
            if wanted == 0 { default } else { offered.min_by_key(|i| i.abs_diff(wanted)).unwrap_or(default) };
        Selection { format, mode, interval }
    }

    fn wire(&self, selection: Selection) -> Vec<u8> {
        let mut bytes = vec![0; PROBE_LEN];
        bytes[0] = 1;
        bytes[2] = selection.format as u8 + 1;
        bytes[3] = selection.mode as u8 + 1;
        bytes[4..8].copy_from_slice(&selection.interval.to_le_bytes());
        bytes[18..22].copy_from_slice(&frame_bytes(&self.mode(selection).0).to_le_bytes());
        bytes[22..26].copy_from_slice(&PAYLOAD.to_le_bytes());
        bytes
    }
}

impl Source for Uvc {
    fn live(&self) -> Option<Live> {
        let period = Duration::from_nanos(u64::from(self.committed.interval) * 100);
        self.stream.map(|stream| Live { stream, period })
    }

    fn produce(&self, sent_ns: u64, out: &mut Vec<u8>) {
        let (mode, pictures) = self.mode(self.committed);
        let id = FrameId { number: self.next_frame, sent_ns };
        let place = self.next_frame.wrapping_sub(self.first_frame) as usize;
        match mode.format {
            Format::Mjpg => frame::stamp_jpeg(&pictures[place % pictures.len()], id, out),
            // As many bytes, of which the first are its identity.
            Format::Yuyv | Format::Z16 => frame::stamp_yuyv(mode.width, mode.height, id, frame::light(), out),
        }
    }

    fn packet(&self, frame: &[u8], at: usize, room: usize, out: &mut Vec<u8>) -> usize {
        const END_OF_HEADER: u8 = 0x80;
        const END_OF_FRAME: u8 = 0x02;
        let room = room.min(PAYLOAD as usize).saturating_sub(usize::from(PAYLOAD_HEADER)).max(1);
        let end = frame.len().min(at + room);
        let last = if end == frame.len() { END_OF_FRAME } else { 0 };
        out.extend_from_slice(&[PAYLOAD_HEADER, END_OF_HEADER | last | self.payload_parity]);
        out.extend_from_slice(&frame[at..end]);
        end
    }

    fn sent(&mut self) {
        self.next_frame = self.next_frame.wrapping_add(1);
        self.payload_parity ^= 1;
    }
}

impl Control {
    /// UVC 1.0, section 4.2.2.3: a value out of range is refused.
    fn answer(&mut self, request: u8, data: &[u8]) -> Answer {
        let word = |value: i16| Answer::Data(value.to_le_bytes().to_vec());
        match request {
            0x01 => match *data {
                [low, high] if (self.least..=self.most).contains(&i16::from_le_bytes([low, high])) => {
                    self.now = i16::from_le_bytes([low, high]);
                    Answer::Done
                }
                _ => Answer::Stall,
            },
            0x81 => word(self.now),
            0x82 => word(self.least),
            0x83 => word(self.most),
            0x84 => word(1),
            0x85 => word(2),
            0x86 => Answer::Data(vec![0b11]),
            0x87 => word(self.default),
            _ => Answer::Stall,
        }
    }
}

impl FormatGroup {
    fn describe(&self, index: u8, out: &mut Configuration) {
        let count = u8::try_from(self.modes.len()).expect("a few dozen modes");
        let frame_subtype = match self.format {
            Format::Mjpg => {
                out.push(&[CS_INTERFACE, 6, index, count, 1, 1, 0, 0, 0, 0]);
                7
            }
            Format::Yuyv | Format::Z16 => {
                let guid = if self.format == Format::Z16 { &GUID_Z16 } else { &GUID_YUYV };
                out.push(&[&[CS_INTERFACE, 4, index, count], &guid[..], &[16, 1, 0, 0, 0, 0]].concat());
                5
            }
        };
        for (number, (mode, _)) in (1u8..).zip(&self.modes) {
            let rate = |fps: &u32| frame_bytes(mode) * 8 * fps;
            let (slow, fast) = (mode.fps.iter().map(rate).min(), mode.fps.iter().map(rate).max());
            let mut frame = vec![CS_INTERFACE, frame_subtype, number, 0];
            frame.extend(mode.width.to_le_bytes());
            frame.extend(mode.height.to_le_bytes());
            for word in [slow.unwrap_or(0), fast.unwrap_or(0), frame_bytes(mode), interval(mode.fps[0])] {
                frame.extend(word.to_le_bytes());
            }
            frame.push(u8::try_from(mode.fps.len()).expect("a few rates"));
            // The class requires them from shortest to longest.
            let mut intervals: Vec<u32> = mode.fps.iter().map(|fps| interval(*fps)).collect();
            intervals.sort_unstable();
            frame.extend(intervals.iter().flat_map(|interval| interval.to_le_bytes()));
            out.push(&frame);
        }
        out.push(&[CS_INTERFACE, 13, 1, 1, 4]);
    }
}

fn interval(fps: u32) -> u32 {
    INTERVALS_PER_SECOND / fps
}

/// Maximum bytes of a frame of this mode: the host drops a longer one.
pub fn room(mode: &Mode) -> usize {
    frame_bytes(mode) as usize
}

/// An upper bound for both formats.
fn frame_bytes(mode: &Mode) -> u32 {
    u32::from(mode.width) * u32::from(mode.height) * 2
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::emu::descriptor::check_configuration;

    fn camera() -> Uvc {
        let pictures = Pictures::new(frame::jpegs(64, 48).unwrap());
        let mode =
            |format, width, height, fps: &[u32]| (Mode { format, width, height, fps: fps.to_vec() }, pictures.clone());
        Uvc::new(
            vec![
                mode(Format::Mjpg, 640, 480, &[30, 15]),
                mode(Format::Yuyv, 320, 240, &[30]),
                mode(Format::Mjpg, 320, 240, &[30]),
            ],
            0,
            0,
        )
    }

    #[test]
    fn configuration_lengths_add_up() {
        let mut configuration = Configuration::default();
        camera().describe(&mut configuration);
        let bytes = configuration.finish();
        check_configuration(&bytes);
        // The streaming header's own wTotalLength spans from it to the endpoint.
        let at = bytes.windows(4).position(|w| w == [15, CS_INTERFACE, 1, 2]).unwrap();
        let total = usize::from(u16::from_le_bytes([bytes[at + 4], bytes[at + 5]]));
        assert_eq!(at + total, bytes.len() - 7);
    }

    #[test]
    fn negotiation_gives_the_nearest_mode() {
        let mut camera = camera();
        let mut wanted = vec![0; PROBE_LEN];
        wanted[2] = 1;
        wanted[3] = 1;
        wanted[4..8].copy_from_slice(&600_000u32.to_le_bytes());
        let set = |value| Setup { kind: 0x21, request: 1, value, index: 1, length: 26 };
        assert_eq!(camera.control(set(0x0100), &wanted), Answer::Done);
        assert!(camera.live().is_none());
        assert_eq!(camera.control(set(0x0200), &wanted), Answer::Done);
        assert_eq!(camera.live().map(|live| live.period), Some(Duration::from_nanos(66_666_600)));
        let get = Setup { kind: 0xa1, request: 0x81, value: 0x0200, index: 1, length: 26 };
        let Answer::Data(got) = camera.control(get, &[]) else { panic!("no data") };
        assert_eq!((got[2], got[3], got.len()), (1, 1, PROBE_LEN));
        assert_eq!(camera.control(Setup { value: 0x0900, ..get }, &[]), Answer::Stall);
        camera.stop();
        assert!(camera.live().is_none());
    }

    #[test]
    fn a_control_keeps_what_it_is_set_to_within_its_range() {
        let mut camera = camera();
        let ask = |request| Setup { kind: 0xa1, request, value: 0x0200, index: 0x0300, length: 2 };
        let set = Setup { kind: 0x21, ..ask(1) };
        let word = |value: i16| Answer::Data(value.to_le_bytes().to_vec());
        assert_eq!(camera.control(ask(0x82), &[]), word(-64));
        assert_eq!(camera.control(ask(0x83), &[]), word(64));
        assert_eq!(camera.control(set, &(-40i16).to_le_bytes()), Answer::Done);
        assert_eq!(camera.control(set, &65i16.to_le_bytes()), Answer::Stall);
        assert_eq!(camera.control(ask(0x81), &[]), word(-40));
        assert_eq!(camera.control(Setup { value: 0x0400, ..set }, &[0, 0]), Answer::Stall, "no such control");
    }

    #[test]
    fn payloads_put_the_frame_together_again() {
        let mut camera = camera();
        let mut frame = Vec::new();
        camera.produce(7, &mut frame);
        let (mut at, mut whole, mut packets) = (0, Vec::new(), 0);
        while at < frame.len() {
            let mut packet = Vec::new();
            at = camera.packet(&frame, at, 512, &mut packet);
            assert!(packet.len() <= 512);
            assert_eq!(packet[1] & 0x02 != 0, at == frame.len());
            whole.extend_from_slice(&packet[2..]);
            packets += 1;
        }
        assert!(packets > 1);
        assert_eq!(whole, frame);
        assert_eq!(frame::identity(&frame), Some(FrameId { number: 0, sent_ns: 7 }));
        camera.sent();
        camera.produce(8, &mut frame);
        assert_eq!(frame::identity(&frame).map(|id| id.number), Some(1));
    }
}
