//! Serial lines against the other end of a terminal; network interfaces: `socket/tests.rs`.

use std::fs::File;
use std::io::{Read as _, Write as _};
use std::path::PathBuf;
use std::thread::{self, JoinHandle};

use crate::ports::may_be_opened;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

use super::*;
use crate::driver::DriverError;
use crate::driver::can::slcan;
use crate::patience::PATIENCE;

/// The adapter's end of a line, and the path of the host's.
fn terminal() -> (File, PathBuf) {
    let ours = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&ours).unwrap();
    unlockpt(&ours).unwrap();
    let path = PathBuf::from(ptsname(&ours, Vec::new()).unwrap().into_string().unwrap());
    (File::from(ours), path)
}

/// Answers the orders of slcan until the bus is open; returns the line and the orders.
fn slcan_adapter(mut line: File, answer: &'static [u8]) -> JoinHandle<(File, String)> {
    thread::spawn(move || {
        let mut orders = String::new();
        while !orders.ends_with("O\r") {
            let mut byte = [0];
            line.read_exact(&mut byte).unwrap();
            orders.push(char::from(byte[0]));
            if byte == *b"\r" {
                line.write_all(answer).unwrap();
            }
        }
        (line, orders)
    })
}

fn slcan_link() -> (Link, File) {
    let (terminal, path) = terminal();
    let adapter = slcan_adapter(terminal, b"\r");
    let link = Link::open_slcan(&path, 500_000).unwrap();
    let (terminal, orders) = adapter.join().unwrap();
    assert_eq!(orders, "C\rS6\rO\r");
    (link, terminal)
}

pub(in crate::driver::can) fn damiao_link() -> (Link, File) {
    let (line, path) = terminal();
    (Link::open_damiao(&path).unwrap(), line)
}

fn soon() -> Stamp {
    Stamp::now().after(PATIENCE)
}

pub(in crate::driver::can) fn received(frame: &CanFrame) -> Vec<u8> {
    [&[0xaa, 0x11, frame.len][..], &frame.id.to_le_bytes(), &frame.data, &[0x55]].concat()
}

#[test]
fn slcan_carries_frames_both_ways() {
    let (mut link, mut adapter) = slcan_link();
    link.send(&CanFrame::standard(0x123, [1, 2, 3, 4, 5, 6, 7, 8])).unwrap();
    let mut sent = [0; 22];
    adapter.read_exact(&mut sent).unwrap();
    assert_eq!(sent, *b"t12380102030405060708\r");

    let before = Stamp::now();
    adapter.write_all(b"z\rt0052AABB\r\x07T00000005").unwrap();
    let mut frame = CanFrame::default();
    let Arrival { at, from_kernel } = link.recv_until(soon(), &mut frame).unwrap().unwrap();
    assert_eq!((frame.id, frame.data()), (5, &[0xaa, 0xbb][..]));
    // Ten bytes came behind it, which no line carries at once, as this one of the test does.
    assert!(at <= Stamp::now() && at.after(Duration::from_micros(10)) >= before && !from_kernel);
    assert_eq!(link.recv_until(Stamp::now(), &mut frame), Ok(None));
    assert_eq!((link.take_refused(), link.take_refused(), link.take_lost()), (1, 0, 0));
    adapter.write_all(b"0\r").unwrap();
    assert!(link.recv_until(soon(), &mut frame).unwrap().is_some());
    assert!(frame.extended && frame.len == 0);

    drop(link);
    let mut closed = [0; 2];
    adapter.read_exact(&mut closed).unwrap();
    assert_eq!(closed, *b"C\r");
}

#[test]
fn a_silent_adapter_is_accepted_and_a_refusal_is_an_error() {
    let (line, path) = terminal();
    let adapter = slcan_adapter(line, b"");
    assert!(Link::open_slcan(&path, 1_000_000).is_ok(), "some never answer");
    adapter.join().unwrap();

    let (mut line, path) = terminal();
    let adapter = thread::spawn(move || {
        let mut order = [0; 5];
        line.read_exact(&mut order[..2]).unwrap();
        line.write_all(&[7]).unwrap();
        line.read_exact(&mut order[2..]).unwrap();
        line.write_all(&[7]).unwrap();
        (line, order)
    });
    // A busy machine may give this adapter its turn later than a real one answers.
    let refused = Line::slcan(&path, 1_000_000, PATIENCE).unwrap_err();
    assert!(matches!(&refused, LinkError::Retry(text) if text.contains("refused the bit rate")), "{refused}");
    assert_eq!(adapter.join().unwrap().1, *b"C\rS8\r");

    let odd = Link::open_slcan(&path, 123_456).unwrap_err();
    assert!(matches!(&odd, LinkError::Fatal(text) if text.contains("123456")), "{odd}");
}

#[test]
fn damiaos_adapter_carries_frames_both_ways() {
    let (mut link, mut adapter) = damiao_link();
    link.send(&CanFrame::standard(5, [0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xfc])).unwrap();
    let mut sent = [0; 30];
    adapter.read_exact(&mut sent).unwrap();
    assert_eq!((sent[..4].to_vec(), sent[13], sent[28]), (vec![0x55, 0xaa, 0x1e, 3], 5, 0xfc));

    let frame = CanFrame::standard(0x15, [1, 2, 3, 4, 5, 6, 7, 8]);
    let mut reported = received(&frame);
    reported.extend(received(&frame).iter().enumerate().map(|(at, byte)| if at == 1 { 0x01 } else { *byte }));
    reported.extend(received(&frame).iter().enumerate().map(|(at, byte)| if at == 1 { 0x02 } else { *byte }));
    reported.extend(received(&CanFrame { id: 0x16, ..frame }));
    adapter.write_all(&reported).unwrap();
    let mut found = CanFrame::default();
    for id in [0x15, 0x16] {
        assert!(link.recv_until(soon(), &mut found).unwrap().is_some());
        assert_eq!(found, CanFrame { id, ..frame });
    }
    assert_eq!((link.take_lost(), link.take_refused()), (1, 1));
}

#[test]
fn a_line_is_opened_exclusively_and_hangs_up_once() {
    let (mut link, adapter) = damiao_link();
    let mut frame = CanFrame::default();
    assert_eq!(link.recv_until(Stamp::default(), &mut frame), Ok(None));
    drop(adapter);
    assert_eq!(link.recv_until(soon(), &mut frame), Err(LinkError::Gone));
    assert_eq!(link.send(&frame), Err(LinkError::Gone));

    let missing = Link::open_damiao(Path::new("/dev/no-such-tty")).unwrap_err();
    assert_eq!(missing, LinkError::Gone);
    let (_adapter, path) = terminal();
    let first = Link::open_damiao(&path).unwrap();
    // Root may open what TIOCEXCL keeps from others; the lock keeps it from all.
    let second = Link::open_damiao(&path).unwrap_err();
    assert!(matches!(&second, LinkError::Retry(text) if text.contains("another program")), "{second}");
    drop(first);
    assert!(may_be_opened(&path));
}

#[test]
fn a_full_line_takes_whole_frames_or_none() {
    let (mut link, mut adapter) = slcan_link();
    let mut taken = 0_u32;
    let refused = loop {
        let [a, b, c, d] = taken.to_le_bytes();
        match link.send(&CanFrame::standard(0x123, [a, b, c, d, 0, 0, 0, 0])) {
            Ok(()) => taken += 1,
            Err(error) => break error,
        }
        assert!(taken < 1_000_000, "the line takes all there is");
    };
    assert_eq!(refused, LinkError::Full);
    // What has not gone by now goes when there is room.
    let reader = thread::spawn(move || {
        let mut decoder = slcan::Decoder::default();
        let (mut count, mut bytes) = (0_u32, [0; 512]);
        while count < taken {
            let read = adapter.read(&mut bytes).unwrap();
            let mut rest = &bytes[..read];
            while !rest.is_empty() {
                let (used, event) = decoder.feed(rest);
                rest = &rest[used..];
                if let Some(slcan::Event::Frame(frame, _)) = event {
                    assert_eq!(frame.data[..4], count.to_le_bytes());
                    count += 1;
                }
            }
        }
        adapter
    });
    while !reader.is_finished() {
        assert_eq!(link.recv_until(Stamp::now().after(Duration::from_millis(5)), &mut CanFrame::default()), Ok(None));
    }
    let _adapter = reader.join().unwrap();
    assert_eq!(link.send(&CanFrame::default()), Ok(()));
}

#[tokio::test]
async fn a_task_gets_all_pending_frames_and_then_the_end() {
    let (link, mut adapter) = damiao_link();
    let mut link = AsyncLink::new(link).unwrap();
    let frame = CanFrame::standard(0x15, [1, 2, 3, 4, 5, 6, 7, 8]);
    let mut into = [Received::default(); 4];
    // A read that was given up takes nothing with it.
    let given_up = tokio::time::timeout(Duration::from_millis(10), link.recv(&mut into)).await;
    assert!(given_up.is_err());
    adapter.write_all(&received(&frame).repeat(6)).unwrap();
    let mut count = 0;
    while count < 6 {
        let found = link.recv(&mut into).await.unwrap();
        assert!((1..=4).contains(&found));
        assert!(into[..found].iter().all(|received| received.frame == frame));
        count += found;
    }
    assert_eq!(count, 6);
    drop(adapter);
    let ended = tokio::time::timeout(PATIENCE, link.recv(&mut into)).await.unwrap();
    assert_eq!(ended, Err(LinkError::Gone));
}

#[tokio::test]
async fn a_task_gets_the_frame_that_came_with_the_end() {
    let (ours, mut theirs) = std::os::unix::net::UnixStream::pair().unwrap();
    ours.set_nonblocking(true).unwrap();
    let mut link = AsyncLink::new(Link::Damiao(Line::stand_in(ours.into()))).unwrap();
    let mut into = [Received::default(); 4];
    let frame = CanFrame::standard(0x15, [1, 2, 3, 4, 5, 6, 7, 8]);
    {
        // It waits, and finds both at once.
        let waiting = link.recv(&mut into);
        tokio::pin!(waiting);
        tokio::select! {
            biased;
            early = &mut waiting => panic!("{early:?}"),
            () = std::future::ready(()) => {}
        }
        theirs.write_all(&received(&frame)).unwrap();
        drop(theirs);
        let found = tokio::time::timeout(PATIENCE, waiting).await.unwrap();
        assert_eq!(found, Ok(1));
    }
    assert_eq!(into[0].frame, frame);
    assert_eq!(link.recv(&mut into).await, Err(LinkError::Gone));
}

#[test]
fn errors_name_the_next_step() {
    assert!(matches!(LinkError::Gone.into_driver(), DriverError::Gone));
    assert!(matches!(LinkError::BusOff.into_driver(), DriverError::Retry(text) if text.contains("120 ohm")));
    assert!(matches!(LinkError::Full.into_driver(), DriverError::Retry(text) if text.contains("full")));
    assert!(matches!(LinkError::of_driver(DriverError::Fatal("x".into())), LinkError::Fatal(text) if text == "x"));
}
