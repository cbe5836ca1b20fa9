use std::net::Ipv4Addr;

use super::*;

const CAMERA: Ipv4Addr = Ipv4Addr::new(172, 23, 145, 51);

/// A computer at the other end of the cable.
struct Host {
    interface: Interface,
    wire: Wire,
    sockets: SocketSet<'static>,
}

impl Host {
    fn new() -> Self {
        let mut wire = Wire::default();
        let mut interface =
            Interface::new(Config::new(EthernetAddress([2, 0, 0, 0, 0, 9]).into()), &mut wire, Instant::ZERO);
        let address = Ipv4Addr::new(172, 23, 145, 50);
        interface.update_ip_addrs(|all| all.push(IpCidr::Ipv4(Ipv4Cidr::new(address, 24))).unwrap());
        Self { interface, wire, sockets: SocketSet::new(Vec::new()) }
    }

    /// One complete GET; returns the bytes of the answer and the milliseconds it took.
    fn get(&mut self, stack: &mut Stack, gopro: &mut Gopro, target: &str, range: &str, now_ms: &mut u64) -> Vec<u8> {
        let buffer = || tcp::SocketBuffer::new(vec![0; 16 * 1024]);
        let handle = self.sockets.add(tcp::Socket::new(buffer(), buffer()));
        let port = 40_000 + (*now_ms % 20_000) as u16;
        self.sockets
            .get_mut::<tcp::Socket<'_>>(handle)
            .connect(self.interface.context(), (CAMERA, gopro::PORT), port)
            .unwrap();
        let (mut bytes, mut asked) = (Vec::new(), false);
        for _ in 0..20_000 {
            *now_ms += 1;
            let now_ns = *now_ms * 1_000_000;
            self.interface.poll(instant(now_ns), &mut self.wire, &mut self.sockets);
            std::mem::take(&mut self.wire.outbound).iter().for_each(|frame| stack.receive(frame));
            stack.poll(Some(gopro), now_ns);
            self.wire.inbound.extend(std::iter::from_fn(|| stack.next_frame()));
            let socket = self.sockets.get_mut::<tcp::Socket<'_>>(handle);
            if socket.may_send() && !asked {
                asked = true;
                socket.send_slice(format!("GET {target} HTTP/1.1\r\nHost: camera\r\n{range}\r\n").as_bytes()).unwrap();
            }
            while socket.can_recv() {
                socket
                    .recv(|part| {
                        bytes.extend_from_slice(part);
                        (part.len(), ())
                    })
                    .unwrap();
            }
            if asked && !socket.may_recv() && socket.state() != tcp::State::SynSent {
                socket.close();
                break;
            }
        }
        self.sockets.get_mut::<tcp::Socket<'_>>(handle).abort();
        bytes
    }
}

fn body(answer: &[u8]) -> &[u8] {
    let end = answer.windows(4).position(|four| four == b"\r\n\r\n").expect("a head");
    &answer[end + 4..]
}

#[test]
fn a_camera_answers_many_requests_and_serves_a_whole_clip() {
    let mut stack = Stack::new([2, 0, 0, 0, 0, 1], CAMERA);
    let mut gopro = Gopro::new("C3441325012345", 1);
    let mut host = Host::new();
    let mut now_ms = 1_000;
    let mut get = |target: &str, range: &str| host.get(&mut stack, &mut gopro, target, range, &mut now_ms);
    for _ in 0..2 * CONNECTIONS {
        let answer = get("/gopro/camera/state", "");
        assert!(answer.starts_with(b"HTTP/1.1 200 OK\r\n"), "{:?}", String::from_utf8_lossy(&answer));
    }
    get("/gopro/camera/shutter/start", "");
    get("/gopro/camera/shutter/stop", "");
    let mut wanted = vec![0; 1_000_000];
    gopro::clip(1, 0, &mut wanted);
    let mut clip = Vec::new();
    for _ in 0..1_000 {
        clip = get("/videos/DCIM/100GOPRO/GX010001.MP4", "");
        if clip.starts_with(b"HTTP/1.1 200") {
            break;
        }
    }
    assert!(body(&clip) == wanted, "{} bytes", body(&clip).len());
    let part = get("/videos/DCIM/100GOPRO/GX010001.MP4", "Range: bytes=999000-\r\n");
    assert!(part.starts_with(b"HTTP/1.1 206"));
    assert_eq!(body(&part), &wanted[999_000..]);
}

#[test]
fn a_pulled_cable_ends_connections_and_the_next_ones_work() {
    let mut stack = Stack::new([2, 0, 0, 0, 0, 1], CAMERA);
    let mut gopro = Gopro::new("C3441325012345", 1);
    let mut now_ms = 1_000;
    let mut host = Host::new();
    assert!(host.get(&mut stack, &mut gopro, "/gopro/camera/info", "", &mut now_ms).starts_with(b"HTTP/1.1 200"));
    stack.hang_up();
    assert!(stack.is_quiet());
    let mut host = Host::new();
    assert!(host.get(&mut stack, &mut gopro, "/gopro/camera/info", "", &mut now_ms).starts_with(b"HTTP/1.1 200"));
}
