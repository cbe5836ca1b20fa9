use std::thread;

use super::*;
use crate::emu::frame::{self, FrameId};
use crate::emu::function::PictureStore;
use crate::emu::spec::{DeviceSpec, Format};

/// Far longer than any answer takes: a wait for one that never comes ends.
const ANSWER_WITHIN: Duration = Duration::from_secs(60);

/// The host's end of an attached device.
struct Host {
    line: UnixStream,
    seq: u32,
}

impl Host {
    /// Attaches a device with two cameras of different rates.
    fn attach() -> Self {
        let spec = DeviceSpec::uvc(0x8086, 0x0b07).mode(Format::Z16, 64, 48, &[200]).also(Format::Yuyv, 16, 16, &[100]);
        let function = Function::new(&spec, 0, &mut PictureStore::new()).unwrap();
        let endpoints = function.endpoints();
        let shared = Arc::new(Shared::new(0, function, Arc::new(Log::new(Box::new(std::io::sink())))));
        let (ours, line) = UnixStream::pair().unwrap();
        line.set_read_timeout(Some(ANSWER_WITHIN)).unwrap();
        let epoch = shared.lock().epoch;
        shared.lock().line = Some(ours.try_clone().unwrap());
        let serving = Arc::clone(&shared);
        thread::spawn(move || serving.serve(ours, epoch));
        for endpoint in endpoints {
            let beating = Arc::clone(&shared);
            thread::spawn(move || beating.beat(epoch, endpoint));
        }
        Self { line, seq: 0 }
    }

    /// Submits a transfer; returns its sequence number.
    fn submit(&mut self, endpoint: u32, is_in: bool, length: u32, setup: [u8; 8]) -> u32 {
        self.seq += 1;
        let words = [1, self.seq, 0, is_in.into(), endpoint, 0, length, 0, 0, 0];
        let mut header = words.map(u32::to_be_bytes).concat();
        header.extend(setup);
        self.line.write_all(&header).unwrap();
        self.seq
    }

    /// The next answer: its sequence number and its data. No transfer here sends data to the device.
    fn answer(&mut self) -> (u32, Vec<u8>) {
        let mut header = [0; HEADER_LEN];
        self.line.read_exact(&mut header).expect("an answer");
        let word = |at: usize| u32::from_be_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]);
        let (seq, status, length) = (word(4), word(20), word(24));
        assert_eq!(status, 0, "transfer {seq}");
        let mut data = vec![0; length as usize];
        self.line.read_exact(&mut data).expect("its data");
        (seq, data)
    }

    /// The frame that the next transfer of this endpoint carries.
    fn frame(&mut self, endpoint: u32) -> FrameId {
        let seq = self.submit(endpoint, true, 16 * 1024, [0; 8]);
        let (answered, data) = self.answer();
        assert_eq!(answered, seq);
        frame::identity(&data[2..]).expect("a whole frame")
    }

    /// A request without data.
    fn request(&mut self, setup: [u8; 8]) {
        let seq = self.submit(0, false, 0, setup);
        assert_eq!(self.answer().0, seq);
    }

    fn commit(&mut self, interface: u8) {
        self.request([0x21, 1, 0, 2, interface, 0, 0, 0]);
    }
}

#[test]
fn each_camera_answers_at_its_own_endpoint() {
    let mut host = Host::attach();
    for interface in [1, 3] {
        host.commit(interface);
    }
    for round in 0..3 {
        for camera in [1, 0] {
            let id = host.frame(camera + 1);
            assert_eq!((id.camera(), id.number % frame::NUMBERS_PER_CAMERA), (camera as usize, round));
        }
    }
}

#[test]
fn a_stopped_camera_leaves_the_other_sending() {
    let mut host = Host::attach();
    for interface in [1, 3] {
        host.commit(interface);
    }
    assert_eq!(host.frame(2).camera(), 1);
    // CLEAR_FEATURE(ENDPOINT_HALT) of 0x82.
    host.request([0x02, 1, 0, 0, 0x82, 0, 0, 0]);
    let waits = host.submit(2, true, 16 * 1024, [0; 8]);
    assert_eq!([0; 5].map(|_| host.frame(1).number), [0, 1, 2, 3, 4]);
    // Its transfer is answered once it streams again, and its numbers continue.
    let commit = host.submit(0, false, 0, [0x21, 1, 0, 2, 3, 0, 0, 0]);
    assert_eq!(host.answer().0, commit);
    let (answered, data) = host.answer();
    assert_eq!(answered, waits);
    assert_eq!(frame::identity(&data[2..]).map(|id| id.number), Some(frame::NUMBERS_PER_CAMERA + 1));
}
