//! A pair of UDP sockets stands in for a bus: the kernel hands over datagrams, stamps and the count of
//! what found the queue full in the same way.

use std::net::UdpSocket;
use std::os::fd::OwnedFd;
use std::time::Duration;

use super::*;
use crate::driver::can::link::Link;
use crate::patience::PATIENCE;

pub(in crate::driver::can) fn bus() -> (Link, UdpSocket) {
    let (ours, theirs) = (UdpSocket::bind("127.0.0.1:0").unwrap(), UdpSocket::bind("127.0.0.1:0").unwrap());
    ours.connect(theirs.local_addr().unwrap()).unwrap();
    theirs.connect(ours.local_addr().unwrap()).unwrap();
    (Link::stand_in(OwnedFd::from(ours)).unwrap(), theirs)
}

pub(in crate::driver::can) fn bytes(frame: &CanFrame) -> [u8; 16] {
    let mut bytes = [0; 16];
    bytes[..4].copy_from_slice(&can_id(frame).to_ne_bytes());
    bytes[4] = frame.len;
    bytes[8..].copy_from_slice(&frame.data);
    bytes
}

fn soon() -> Stamp {
    Stamp::now().after(PATIENCE)
}

#[test]
fn frames_go_both_ways_with_their_flags() {
    let (mut link, bus) = bus();
    let frame = CanFrame::standard(0x123, [1, 2, 3, 4, 5, 6, 7, 8]);
    for frame in [
        frame,
        CanFrame { id: 0x1abc_def0, extended: true, len: 3, ..frame },
        CanFrame { remote: true, len: 2, data: [0; 8], ..frame },
    ] {
        link.send(&frame).unwrap();
        let mut sent = [0; 17];
        assert_eq!(bus.recv(&mut sent).unwrap(), 16);
        assert_eq!(sent[..16], bytes(&frame));

        bus.send(&bytes(&frame)).unwrap();
        let mut found = CanFrame::default();
        assert!(link.recv_until(soon(), &mut found).unwrap().is_some());
        assert_eq!(found, frame);
    }
    assert_eq!(link.recv_until(Stamp::default(), &mut CanFrame::default()), Ok(None));
}

#[test]
fn the_kernels_stamp_is_put_on_the_monotonic_clock() {
    let (mut link, bus) = bus();
    // The clocks are read one after the other.
    let inexact = Duration::from_millis(5);
    // The kernel begins to stamp a moment after it is asked to; until then it does when a frame is read.
    let deadline = soon();
    loop {
        let before = Stamp::now();
        bus.send(&bytes(&CanFrame::standard(1, [0; 8]))).unwrap();
        let after = Stamp::now();
        std::thread::sleep(Duration::from_millis(30));
        let arrival = link.try_recv(&mut CanFrame::default()).unwrap().unwrap();
        assert!(arrival.from_kernel && arrival.at >= before.before(inexact), "{before:?} {arrival:?}");
        if arrival.at <= after.after(inexact) {
            break;
        }
        assert!(Stamp::now() < deadline, "stamped when it was read: {after:?} {arrival:?}");
    }
}

#[test]
fn a_frame_is_as_old_as_its_stamp_also_across_a_set_clock() {
    const HOUR_NS: u64 = 3_600_000_000_000;
    let (now, wall) = (Stamp::now(), WallClock::now());
    let set_back = WallClock::with_offset(i128::from(wall.wall_ns(now)) + i128::from(HOUR_NS) - i128::from(now.0));
    // The stamp, the relation of the clocks before, the age, and whether it is the kernel's.
    let table = [
        (Some(wall.wall_ns(now)), wall, 0, true),
        (Some(wall.wall_ns(now) - 12_000_000_000), wall, 12, true),
        (Some(wall.wall_ns(now) + HOUR_NS - 2_000_000_000), set_back, 2, true),
        (Some(wall.wall_ns(now) + 2 * HOUR_NS), set_back, 0, false),
        (None, wall, 0, false),
    ];
    for (stamp, before, age, from_kernel) in table {
        let found = arrival(stamp, &mut StampClock::new(before, Stamp::default()));
        assert_eq!(found.from_kernel, from_kernel, "{stamp:?}");
        let latest = Stamp::now();
        let is_of_the_age = now.since(found.at).as_secs().abs_diff(age) <= 1 && found.at <= latest;
        assert!(is_of_the_age || !from_kernel && found.at >= now, "{stamp:?}: {found:?} {now:?}");
    }
}

#[test]
fn frames_lost_to_a_full_queue_are_counted() {
    const SENT: u64 = 2_000;
    let (mut link, bus) = bus();
    let Link::Socket(socket) = &link else { panic!("a socket") };
    socket.bound.set_socket_option_int(libc::SOL_SOCKET, libc::SO_RCVBUF, 16 << 10).unwrap();
    let mut frame = CanFrame::standard(1, [0; 8]);
    for _ in 0..SENT {
        bus.send(&bytes(&frame)).unwrap();
    }
    let mut received = 0;
    while link.try_recv(&mut frame).unwrap().is_some() {
        received += 1;
    }
    assert!((1..SENT).contains(&received), "{received}");
    // The count comes with the next frame.
    bus.send(&bytes(&frame)).unwrap();
    assert!(link.recv_until(soon(), &mut frame).unwrap().is_some());
    assert_eq!(link.take_lost(), SENT - received);
    assert_eq!(link.take_lost(), 0);
}

#[test]
fn reports_of_the_controller_are_not_frames_of_the_bus() {
    let (mut link, bus) = bus();
    let error =
        |id, second| CanFrame { id, error: true, len: 8, data: [0, second, 0, 0, 0, 0, 0, 0], ..CanFrame::default() };
    let frame = CanFrame::standard(7, [0; 8]);
    let mut found = CanFrame::default();
    // An overflow, a warning, then a frame.
    for sent in [error(0x4, 0x1), error(0x4, 0x4), frame] {
        bus.send(&bytes(&sent)).unwrap();
    }
    assert!(link.recv_until(soon(), &mut found).unwrap().is_some());
    assert_eq!((found, link.take_lost()), (frame, 1));
    for sent in [error(0x40, 0), frame] {
        bus.send(&bytes(&sent)).unwrap();
    }
    assert_eq!(link.recv_until(soon(), &mut found), Err(LinkError::BusOff));
    assert!(link.recv_until(soon(), &mut found).unwrap().is_some(), "the link stays open");
}

#[test]
fn datagrams_that_are_not_frames_are_skipped() {
    let (mut link, bus) = bus();
    let frame = CanFrame { len: 200, ..CanFrame::standard(0xfff, [9; 8]) };
    for sent in [&[1, 2, 3][..], &[], &[0; 72], &bytes(&frame)] {
        bus.send(sent).unwrap();
    }
    let mut found = CanFrame::default();
    assert!(link.recv_until(soon(), &mut found).unwrap().is_some());
    assert_eq!((found.id, found.len, found.data), (0x7ff, 8, [9; 8]));
}

#[test]
fn a_removed_interface_is_distinguished_from_one_that_was_set_down() {
    let (link, _bus) = bus();
    let Link::Socket(mut socket) = link else { panic!("a socket") };
    let mut of = |name: &str, index, number| {
        (socket.name, socket.index) = (name.to_owned(), index);
        socket.result_of(&io::Error::from_raw_os_error(number), "reading from")
    };
    assert_eq!(of("no-such-can0", 7, libc::ENETDOWN), Some(LinkError::Gone));
    assert_eq!(of("no-such-can0", 7, libc::ENODEV), Some(LinkError::Gone));
    assert_eq!(of("no-such-can0", 7, libc::EAGAIN), None);
    // The loopback interface is there wherever there are sockets.
    let lo = std::fs::read_to_string("/sys/class/net/lo/ifindex").unwrap().trim().parse::<u32>().unwrap();
    assert!(matches!(of("lo", lo, libc::ENETDOWN), Some(LinkError::Retry(text)) if text.contains("set down")));
    assert_eq!(of("lo", lo + 1, libc::ENETDOWN), Some(LinkError::Gone), "another of the same name");
}
